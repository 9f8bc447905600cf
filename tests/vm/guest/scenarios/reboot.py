"""Power that goes in the middle of a save, an orderly reboot, and the service that comes back."""

import glob
import hashlib
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter

import power
from robot import CAIRN, Failure, Listener, UsbCamera, check, now, row, sh, until

MAP = "/var/lib/cairn/map.ply"


def save(path=MAP):
    return sh(f"{CAIRN} command save-map {path}", 40, "cairn")


def whole(path):
    """A binary PLY file has as many bytes as its header promises."""
    header, end, body = pathlib.Path(path).read_bytes().partition(b"end_header\n")
    check(end, f"{path} has no end of its header: {header[:80]!r}")
    sizes = {"float": 4, "double": 8, "uchar": 1, "int": 4, "uint": 4, "ushort": 2, "short": 2, "char": 1}
    promised = record = count = 0
    for line in header.decode("ascii").splitlines() + ["element end 0"]:
        words = line.split()
        if words[0] == "element":
            promised += record * count
            record, count = 0, int(words[2])
        elif words[0] == "property":
            record += sizes[words[1]]
    check(promised > 0, f"{path} promises nothing")
    return len(body) == promised


def unfinished():
    """Temporary files of saves, by the daemon's naming."""
    return [name for name in os.listdir("/var/lib/cairn") if ".cairn-" in name]


def cut_in_a_save(stage):
    """Saves without end while the power goes; after it the file is the old one or the new one, and the daemon starts."""
    cuts = 5 if stage.full else 1
    if stage.phase > 0:
        check(os.path.exists(MAP), "the saved map is gone")
        check(whole(MAP), "half a map was left")
        stage.memory.setdefault("leftovers", []).append(len(unfinished()))
    camera = stage.usb("mjpeg")
    daemon = stage.daemon()
    health = stage.listener()
    began = now()
    first = health.wait(lambda r: r["landmarks"] > 20 and r["state"] == "TRACKING", 40, "a map", began)
    check(not unfinished(), f"temporary files are left after the start: {unfinished()}")
    if stage.phase == cuts:
        check(save()[0] == 0, "saving does not work any more")
        return row(health, began, f"power cut in the middle of a save, {cuts} times", first["t"] - began,
                   f"the map's file was whole every time; temporary files that the cuts left: {stage.memory['leftovers']}, and after the next start: none; recovery: start to tracking")
    status, text = save()
    check(status == 0, f"save-map: {text}")
    os.sync()
    stop = threading.Event()

    def again_and_again():
        while not stop.is_set():
            save()

    def save_is_under_way():
        """Returns while a new file is being written beside the old one: in turns, when its name has reached the disk, and when nothing of it has."""
        def stopped_in_it():
            if not unfinished():
                return False
            # There is one processor, and it is ours: the daemon is somewhere between making this file and renaming it. Stopped, it
            # stays there; without that, whether it is caught is a matter of luck.
            daemon.process.send_signal(signal.SIGSTOP)
            if unfinished():
                return True
            daemon.process.send_signal(signal.SIGCONT)
            return False

        try:
            until(stopped_in_it, 60, "a save is under way", pause_s=0.0005)
        except Failure:
            stop.set()
            raise
        if stage.phase % 2 == 0:
            folder = os.open("/var/lib/cairn", os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)

    threading.Thread(target=again_and_again, daemon=True).start()
    stage.memory["cuts"] = stage.memory.get("cuts", 0) + 1
    raise power.Reboot(stage.memory, orderly=False, moment=save_is_under_way)


def install():
    """The unit as its head says, by hand; the Debian package has a scenario of its own."""
    os.makedirs("/etc/cairn", exist_ok=True)
    unit = pathlib.Path("/mnt/stage/systemd/cairn.service").read_text()
    binary = re.search(r"^ExecStart=(\S+)", unit, re.M).group(1)
    if not os.path.exists(binary):
        shutil.copy("/mnt/stage/cairn", binary)
    shutil.copy("/mnt/stage/systemd/cairn.service", "/etc/systemd/system/cairn.service")
    for kind, folder in (("sysusers", "/usr/lib/sysusers.d"), ("tmpfiles", "/usr/lib/tmpfiles.d")):
        for path in glob.glob(f"/mnt/stage/systemd/*{kind}*"):
            shutil.copy(path, f"{folder}/cairn.conf")
    sh("systemd-sysusers; systemd-tmpfiles --create")
    shutil.copy("/mnt/stage/camera.yaml", "/etc/cairn/camera.yaml")
    pathlib.Path("/etc/cairn/cairn.toml").write_text(
        '[camera]\nwidth_px = 320\nheight_px = 240\nrate_hz = 15\n[calibration]\nfile = "/etc/cairn/camera.yaml"\n')
    sh("chown -R cairn:cairn /var/lib/cairn; systemctl daemon-reload")


def property_of(name):
    return sh(f"systemctl show -p {name} --value cairn")[1].strip()


def service(stage):
    """systemd starts it, starts it again when it is killed, stops it within a second, and has it back after an orderly reboot."""
    if stage.phase == 0:
        # What earlier scenarios left belongs to user cairn as well.
        install()
        status, text = sh("systemctl enable cairn && systemctl start cairn", 60)
        check(status == 0, f"systemctl start: {text} {sh('journalctl -u cairn -n 20 --no-pager')[1]}")
        health = stage.listener()
        began = now()
        health.wait(lambda r: "NO_CAMERA" in r["errors"], 10, "NO_CAMERA", began)
        stage.usb("mjpeg")
        health.flowing(began, 15)
        pid = property_of("MainPID")
        killed = now()
        sh(f"kill -9 {pid}")
        back = health.wait(lambda r: r["frames_captured"] > 0 and str(r["pid"]) != pid, 20, "frames of a new process", killed)
        stop = now()
        status, text = sh("systemctl stop cairn", 30)
        took = now() - stop
        check(status == 0 and took < 1.5, f"systemctl stop: {status} {text} {took:.2f} s")
        check(sh("systemctl start cairn", 30)[0] == 0, "a second start")
        health.flowing(now(), 15)
        status, text = sh(f"{CAIRN} command save-map {MAP}", 40, "cairn")
        digest = hashlib.sha256(pathlib.Path(MAP).read_bytes()).hexdigest() if os.path.exists(MAP) else ""
        raise power.Reboot({"restart_s": back["t"] - killed, "stop_s": took, "map": digest}, orderly=True)
    memory = stage.memory
    until(lambda: property_of("ActiveState") == "active", 60, "the service is active after the reboot")
    health = stage.listener()
    began = now()
    camera = stage.usb("mjpeg")
    back = health.flowing(camera.appeared - 0.2, 15)
    if memory["map"]:
        check(hashlib.sha256(pathlib.Path(MAP).read_bytes()).hexdigest() == memory["map"], "the saved map changed over the reboot")
    text = row(health, began, "service: kill -9, stop, orderly reboot", memory["restart_s"],
               f"frames {memory['restart_s']:.1f} s after kill -9, stopped in {memory['stop_s']:.2f} s, active after the reboot, "
               f"frames {max(0.0, back['t'] - camera.appeared):.2f} s after the camera")
    sh("systemctl disable --now cairn", 30)
    return text


def records(since, until_):
    """Records of the service in the journal between two moments of realtime: how many, how many of them are information, and their bytes as text."""
    lines = sh(f"journalctl -q -u cairn -o json --since=@{since:.3f} --until=@{until_:.3f}", 60)[1].splitlines()
    found = [json.loads(line) for line in lines if line.startswith("{")]
    ours = [r for r in found if r.get("SYSLOG_IDENTIFIER") == "cairn"]
    return len(ours), sum(r["PRIORITY"] == "6" for r in ours), sum(len(line) for line in lines), Counter(r["MESSAGE"] for r in ours)


def journal_rate(stage):
    """How much the service writes at `log.level = "info"`: idle, tracking, and while every frame is broken and the camera is unplugged again and again."""
    window = 30 if stage.full else 15
    install()
    check(sh("systemctl start cairn", 60)[0] == 0, sh("journalctl -u cairn -n 20 --no-pager")[1])
    health = stage.listener()
    began = now()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 10, "NO_CAMERA", began)
    rows = []

    def measure(what, doing, limit):
        time.sleep(1)
        since, began = time.time(), now()
        while now() < began + window:
            doing()
        until_ = time.time()
        time.sleep(1)
        count, information, size, messages = records(since, until_)
        minutes = (until_ - since) / 60
        most = ", ".join(f"{n / minutes:.0f} {text}" for text, n in messages.most_common(3))
        check(count / minutes < limit, f"{what}: {count / minutes:.0f} records a minute, of these {most}")
        rows.append(row(health, began, f"the journal at log.level = info: {what}, {window} s", None,
                        f"{count / minutes:.0f} records a minute ({information / minutes:.0f} of information), {size / minutes / 1024:.0f} kB as JSON; most: {most}"))

    measure("no camera", lambda: time.sleep(0.5), 30)
    camera = stage.usb("mjpeg")
    health.wait(lambda r: r["state"] == "TRACKING", 40, "tracking", now())
    measure("tracking", lambda: time.sleep(0.5), 300)

    def storm():
        nonlocal camera
        camera.tell("broken 45")
        time.sleep(3)
        camera.unplug()
        time.sleep(1)
        camera = stage.usb("mjpeg")
        time.sleep(1)

    measure("20 of 30 frames broken, unplugged every 6 s", storm, 600)
    sh("systemctl stop cairn", 30)
    return rows


SCENARIOS = {"journal_rate": journal_rate, "power_cut": cut_in_a_save, "service": service}
