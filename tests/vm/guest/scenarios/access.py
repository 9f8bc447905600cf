"""Who may use the camera, and who may listen."""

import glob
import os
import pathlib
import re
import shutil
import subprocess
import time

from robot import CAIRN, check, end, now, row, sh, until

RETURN_LIMIT_S = 2.0


def busy(stage):
    camera = stage.vivid()
    other = subprocess.Popen(["v4l2-ctl", "-d", camera.node, "--stream-mmap", "--stream-count=0"],
                             stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(2)
    began = now()
    daemon = stage.daemon(size=(320, 180), calibration="vivid.yaml")
    health = stage.listener()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 10, "NO_CAMERA", began)
    daemon.wait_said("another program uses it")
    time.sleep(2)
    end(other)
    freed = now()
    back = health.flowing(freed - 0.1, 10)
    check(back["t"] - freed < RETURN_LIMIT_S, f"{back['t'] - freed:.2f} s")
    return row(health, began, "another program streams from it, then ends", max(0.0, back["t"] - freed),
               "log: “another program uses it”")


def by_path(node):
    """The name of the port that the camera with this node is plugged into."""
    links = [link for link in glob.glob("/dev/v4l/by-path/*") if os.path.realpath(link) == node]
    check(links, f"udev made no name of a port for {node}")
    return links[0]


def two_cameras(stage):
    """`auto` takes the next camera when another program has the first, and keeps to it; a camera named by its port is not replaced by its twin."""
    rows = []
    first = stage.usb("mjpeg", serial="A1")
    other = subprocess.Popen(["v4l2-ctl", "-d", first.node, "--stream-mmap", "--stream-count=0"],
                             stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(2)
    second = stage.usb("mjpeg", serial="B2")
    for calibration in ("camera.yaml", None):
        daemon = stage.daemon(calibration=calibration)
        health = stage.listener()
        began = now()
        health.flowing(began, 20)
        check(any("will be looked for" in line and ":B2" in line for line in daemon.lines()), "it did not take the free camera")
        check(any("passed over" in line and "another program uses it" in line for line in daemon.lines()), "the log does not say why not the first")
        if calibration is None:
            break
        health.close()
        daemon.close()
    end(other)
    gone = second.unplug()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 3, "NO_CAMERA", gone)
    time.sleep(3)
    check("NO_CAMERA" in health.last()["errors"], "the daemon took a camera that is not its own")
    second = stage.usb("mjpeg", serial="B2")
    back = health.flowing(second.appeared - 0.2, 10)
    recovery = max(0.0, back["t"] - second.appeared)
    check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
    rows.append(row(health, began, "auto, two cameras, the first is busy; then that one is free and the other is unplugged, and back", recovery,
                    "took the second, waited for it"))
    stop(daemon, health)
    first.unplug()
    second.unplug()
    # Makers who number nothing: both have the same identity.
    named, twin = stage.usb("mjpeg", serial="0000"), stage.usb("mjpeg", serial="000000")
    port = by_path(named.node)
    daemon = stage.daemon(camera=f'device = "{port}"')
    health = stage.listener()
    began = now()
    health.flowing(began, 20)
    gone = named.unplug()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 3, "NO_CAMERA", gone)
    daemon.wait_said("one like it, but not the one that is named", 5)
    time.sleep(2)
    check("NO_CAMERA" in health.last()["errors"], "the daemon took the twin at another port")
    named = stage.usb("mjpeg", serial="0000")
    check(by_path(named.node) == port, "it came back at another port")
    back = health.flowing(named.appeared - 0.2, 10)
    recovery = max(0.0, back["t"] - named.appeared)
    check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
    rows.append(row(health, began, "a camera named by its port is unplugged beside its twin, and plugged in again", recovery, "waited for its own"))
    twin.unplug()
    return rows


def permission(stage):
    camera = stage.vivid()
    os.chmod(camera.node, 0o600)
    began = now()
    daemon = stage.daemon(size=(320, 180), calibration="vivid.yaml")
    health = stage.listener()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 10, "NO_CAMERA", began)
    daemon.wait_said("group 'video'")
    time.sleep(2)
    os.chmod(camera.node, 0o660)
    freed = now()
    back = health.flowing(freed - 0.1, 10)
    check(back["t"] - freed < RETURN_LIMIT_S, f"{back['t'] - freed:.2f} s")
    return row(health, began, "the user may not open it, then may", max(0.0, back["t"] - freed),
               "log: “cameras belong to the group 'video'”")


def strangers(stage):
    """A second user and root are refused with a message that says what to do, and leave nothing behind."""
    stage.usb("mjpeg")
    stage.daemon()
    health = stage.listener()
    began = now()
    health.flowing(began, 20)
    before = files()
    rows = []
    for user in ("other", "root"):
        for command in ("watch --count 1 --timeout 5", "command reset"):
            status, text = sh(f"{CAIRN} {command}", 20, user)
            check(status not in (0, 124), f"{user} was let in by {command}: {text}")
            check("cairn" in text and "same user" in text, f"{user}, {command}: {text}")
        rows.append(row(health, began, f"user {user} listens and commands", note="refused: " + re.sub(r".*?runs as", "… runs as", text.strip().splitlines()[-1])))
    check(files() == before, f"files changed: {sorted(set(files()) ^ set(before))}")
    check(sh(f"{CAIRN} watch --count 1 --timeout 5", 20, "cairn")[0] == 0, "user cairn does not get poses")
    return rows


def files():
    found = []
    for top in ("/dev/shm", "/tmp/iceoryx2"):
        for folder, _, entries in os.walk(top):
            found += [os.path.join(folder, name) for name in entries]
    return found


def squatting(stage):
    """Another user makes /tmp/iceoryx2 first: the daemon says whose it is and what to do, and runs once it is gone."""
    shutil.rmtree("/tmp/iceoryx2", ignore_errors=True)
    check(sh("mkdir -p /tmp/iceoryx2/services /tmp/iceoryx2/nodes && chmod 755 /tmp/iceoryx2", user="other")[0] == 0, "mkdir")
    camera = stage.usb("mjpeg")
    began = now()
    daemon = stage.daemon()
    status = daemon.process.wait(15)
    text = "\n".join(daemon.lines()[-3:])
    check(status not in (0, None), f"status {status}")
    check("other" in text and "/tmp/iceoryx2" in text, f"it does not say whose folder it is: {text}")
    told, listener_text = sh(f"{CAIRN} watch --count 1 --timeout 3", 20, "cairn")
    check(told != 0, "a listener was satisfied")
    shutil.rmtree("/tmp/iceoryx2")
    removed = now()
    daemon.start()
    health = stage.listener()
    back = health.flowing(removed, 10)
    return row(health, back["t"], "another user made /tmp/iceoryx2 first; removed, started again", back["t"] - removed,
               f"status {status}: {daemon_message(text)}")


def squatting_in_shm(stage):
    """Another user takes the one name in /dev/shm that can be known beforehand, in each way: the daemon says which file, whose, and what to do. One that
    iceoryx2 made for another user is no squatter."""
    stage.usb("mjpeg")
    daemon = stage.daemon()
    health = stage.listener()
    health.flowing(now(), 20)
    (path,) = glob.glob("/dev/shm/iox2_*.global_mgmt")
    good = pathlib.Path(path).read_bytes()
    ways = {"closed to others": f"cp /run/good {path} && chmod 600 {path}", "empty": f": > {path} && chmod 666 {path}",
            "garbage": f"head -c 4096 /dev/urandom > {path} && chmod 666 {path}", "a folder": f"mkdir {path}"}
    pathlib.Path("/run/good").write_bytes(good)
    told = []
    for way, command in ways.items():
        stop(daemon, health)
        sh(f"rm -rf {path}")
        check(sh(command, user="other")[0] == 0, f"{way}: {command}")
        time.sleep(1.2)
        asked = now()
        daemon = stage.daemon()
        status = daemon.process.wait(15)
        text = daemon_message("\n".join(daemon.lines()[-3:]))
        check(status == 69, f"{way}: status {status}: {text}")
        for part in (path, "other (1000)", f"sudo rm -r {path}"):
            check(part in text, f"{way}: {part!r} is not in: {text}")
        told.append(f"{way} ({now() - asked:.1f} s)")
        if way != "garbage":
            check(f"sudo rm -r {path}" in sh(f"{CAIRN} doctor", 30, "cairn")[1], f"doctor does not speak of it ({way})")
    sh(f"rm -rf {path}")
    removed = now()
    daemon.start()
    health = stage.listener()
    back = health.flowing(removed, 10)
    recovery = back["t"] - removed
    stop(daemon, health)
    sh(f"cp /run/good {path}; chown other {path}; chmod 666 {path}")
    daemon = stage.daemon()
    health = stage.listener()
    began = now()
    health.flowing(began, 10)
    shown = text.replace(path, "/dev/shm/iox2_….global_mgmt")
    return row(health, began, "another user takes iceoryx2's common name in /dev/shm first; removed, started again", recovery,
               f"status 69 each time: {', '.join(told)}; {shown}; one that another user's iceoryx2 made is used")


def stop(daemon, health):
    health.close()
    daemon.close()


def daemon_message(text):
    return next((line for line in text.splitlines() if line.startswith("cairn:")), text)[:400]


SCENARIOS = {"device_busy": busy, "two_cameras": two_cameras, "permission_denied": permission, "strangers": strangers, "squatting": squatting,
             "squatting_in_shm": squatting_in_shm}
