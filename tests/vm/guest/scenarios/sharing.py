"""Recorder and bridge beside the daemon: kill -9 of each, which nobody else notices, and the bridge's hardened unit."""

import json
import os
import pathlib
import shutil
import subprocess
import time

from robot import CAIRN, as_user, check, end, now, row, sh, until
from scenarios.kill import Watcher
from scenarios.reboot import install

STATE = pathlib.Path("/var/lib/cairn")
# Of the current map, for whoever fetches it.
COPIES = STATE / "maps" / "copies"
BRIDGE = "/usr/bin/cairn-bridge"
# The router's port is rmw_zenoh's, to which the unit connects.
ROUTER = {"mode": "router", "listen": {"endpoints": ["tcp/[::]:7447"]}, "scouting": {"multicast": {"enabled": False}}}


class Recorder:
    """`cairn record` as user cairn, into a file that does not exist."""

    def __init__(self, name, folder=STATE):
        self.path = pathlib.Path(folder, name)
        self.path.unlink(missing_ok=True)
        self.process = subprocess.Popen([CAIRN, "record", str(self.path)], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                        stderr=subprocess.DEVNULL, **as_user("cairn"))

    def size(self):
        return self.path.stat().st_size if self.path.exists() else 0

    def grown(self, by=200_000, limit_s=30):
        before = self.size()
        until(lambda: self.size() > before + by, limit_s, f"{self.path} grows")
        check(self.process.poll() is None, f"the recorder ended with {self.process.returncode}")

    def kill(self):
        self.process.kill()
        self.process.wait(10)

    def close(self):
        if self.process.poll() is None:
            end(self.process)


def replayed(path):
    """Pictures of a recording that nobody has closed."""
    status, text = sh(f"{CAIRN} replay {path} --lockstep --json --quiet --prefix sharing 2>{STATE}/replay.txt", 240, "cairn")
    # 1: no frame was tracked.
    check(status in (0, 1) and text, f"replay of {path}: {status} {(STATE / 'replay.txt').read_text()[-400:]}")
    return json.loads(text)["frames"]


def on_a_full_disk(stage, folder="/run/small"):
    """Ends by itself while there are 64 MB left, with its file whole; what is in that file."""
    status, text = sh(f"mkdir -p {folder} && mount -t tmpfs -o size=80m,mode=777 tmpfs {folder}")
    check(status == 0, f"tmpfs: {text}")
    try:
        victim = stage.keep(Recorder("full.mcap", folder))
        victim.grown()
        sh(f"head -c 20000000 /dev/zero >{folder}/other")
        until(lambda: victim.process.poll() is not None, 20, "the recorder ends on a full disk")
        check(victim.process.returncode == 73, f"on a full disk the recorder ended with {victim.process.returncode}")
        return replayed(victim.path)
    finally:
        sh(f"umount {folder}")


def recorder(stage):
    """Killed again and again, and on a full disk; daemon, planner and the other recorder go on."""
    rounds = 5 if stage.full else 2
    stage.usb("mjpeg", rate=15)
    daemon, health, began = stage.daemon(), stage.listener(), now()
    health.flowing(began, 20)
    planner = Watcher([], 0)
    other = stage.keep(Recorder("other.mcap"))
    pid, since, frames = daemon.process.pid, now(), []
    try:
        for turn in range(rounds):
            # The camera's pictures have places for two: that of who was killed is free again.
            victim = stage.keep(Recorder("killed.mcap"))
            victim.grown()
            recording = now()
            victim.grown()
            time.sleep(1.5)
            seconds = now() - recording
            planner.mark()
            victim.kill()
            other.grown()
            until(planner.heard, 5, "the planner gets poses")
            check(planner.process.poll() is None and daemon.alive() and daemon.process.pid == pid, f"round {turn}: somebody noticed")
            frames.append(replayed(victim.path))
            # What it heard before, less a second of the last chunk, less what a slow guest drops.
            check(frames[-1] >= 0.5 * 15 * (seconds - 1.0), f"round {turn}: {frames[-1]} pictures of {seconds:.1f} s")
        planner.mark()
        full = on_a_full_disk(stage)
        other.grown()
        until(planner.heard, 5, "the planner gets poses")
    finally:
        planner.kill()
    other.close()
    check(other.process.returncode == 0, f"the other recorder ended with {other.process.returncode}")
    return row(health, since, f"{rounds} times kill -9 of one of two recorders; one whose disk is full",
               note=f"{', '.join(map(str, frames))} pictures in the recordings of the killed ones, {full} in the one of the full disk; daemon, planner and the other "
                    "recorder went on")


def property_of(unit, name):
    return sh(f"systemctl show -p {name} --value {unit}")[1].strip()


def within(command):
    """As root, in the bridge's view of the files."""
    return sh(f"nsenter --target {property_of('cairn-bridge', 'MainPID')} --mount -- sh -c '{command}'")[0] == 0


class Fleet:
    """`cairn fleet`, and with it the router: a session that listens is one."""

    def __init__(self):
        pathlib.Path("/run/router.json5").write_text(json.dumps(ROUTER))
        self.out = open("/run/fleet.txt", "w+", encoding="utf-8")
        self.process = subprocess.Popen([BRIDGE, "fleet", "--json", "--zenoh", "/run/router.json5"], stdin=subprocess.DEVNULL,
                                        stdout=self.out, stderr=subprocess.STDOUT, **as_user("cairn"))

    def robot(self):
        """The robot's row, if it is here."""
        text = pathlib.Path(self.out.name).read_text()
        check(self.process.poll() is None, f"fleet ended with {self.process.returncode}: {text[-400:]}")
        told = [line for line in text.split("\n")[:-1] if line.startswith("{")]
        rows = json.loads(told[-1])["robots"] if told else []
        return next((r for r in rows if (r["name"], r["presence"]) == ("cairn", "here")), None)

    def session(self, other=None, limit_s=60):
        """That of the bridge that is here and is not the other one."""
        return until(lambda: (row := self.robot()) and row["session"] != other and row["session"], limit_s, "the robot is in the fleet", 0.1)

    def close(self):
        if self.process.poll() is None:
            end(self.process)
        self.out.close()


def start_bridge(stage):
    """Copied as the package would install it; it starts before the daemon, before there is a map or a router."""
    install()
    shutil.copy("/mnt/stage/cairn-bridge", BRIDGE)
    os.chmod(BRIDGE, 0o755)
    shutil.copy("/mnt/stage/systemd/cairn-bridge.service", "/etc/systemd/system/cairn-bridge.service")
    shutil.rmtree(STATE, ignore_errors=True)
    status, text = sh("systemctl daemon-reload; systemd-tmpfiles --create cairn.conf; systemctl start cairn-bridge", 60)
    check(status == 0, f"systemctl start: {text} {sh('journalctl -u cairn-bridge -n 20 --no-pager')[1]}")
    owners = {str(path): path.owner() for path in (STATE, STATE / "maps", COPIES)}
    check(set(owners.values()) == {"cairn"}, f"whose folders: {owners}")
    camera = stage.usb("mjpeg", rate=15)
    check(sh("systemctl start cairn", 60)[0] == 0, "the daemon's start")
    health, began = stage.listener(), now()
    health.flowing(began, 20)
    return camera, health, began


def pull(health, began):
    """The current map by the bridge, and what it may not write meanwhile; what the table says of it."""
    health.wait(lambda r: r["landmarks"] > 20 and r["state"] == "TRACKING", 40, "a map", began)
    stored = lambda: json.loads(sh(f"{CAIRN} map list --json", 40, "cairn")[1] or "[]")
    until(lambda: [m for m in stored() if m["current"]], 40, "the map has a file", 1.0)
    name = next(m["name"] for m in stored() if m["current"])
    pulled = now()
    status, text = sh(f"{BRIDGE} map pull cairn:{name} --output {STATE}/pulled.map", 120, "cairn")
    check(status == 0 and "verified" in text, f"map pull: {status} {text}")
    took = now() - pulled
    check(not os.listdir(COPIES), f"the copy that was made for the bridge is left: {os.listdir(COPIES)}")
    # Not even as root, where the unit's view of the files refuses.
    refused = [f"{folder}/x" for folder in ("/etc", "/usr", "/opt", STATE, STATE / "maps", "/var/log", "/root", "/home")]
    for path in refused:
        check(not within(f"echo > {path}") and not os.path.exists(path), f"it may write {path}")
    check(not within(f"rm {STATE}/maps/{name}.map") and not within(f"echo >> {STATE}/maps/{name}.map"), "it may change the robot's maps")
    check(within(f"echo > {COPIES}/x && rm {COPIES}/x") and within("echo > /dev/shm/x && rm /dev/shm/x"), "it cannot write where it has to")
    return f"{os.path.getsize(STATE / 'pulled.map') / 1e6:.1f} MB of map in {took:.1f} s; {len(refused)} places and the maps cannot be written"


def killed_bridge(fleet):
    """systemd starts it again, the fleet lists it again, and the daemon does not notice; seconds that it took."""
    session, since = fleet.session(), now()
    pid = {unit: property_of(unit, "MainPID") for unit in ("cairn", "cairn-bridge")}
    sh(f"kill -9 {pid['cairn-bridge']}")
    until(lambda: property_of("cairn-bridge", "NRestarts") == "1" and property_of("cairn-bridge", "MainPID") not in ("0", pid["cairn-bridge"]), 20,
          "systemd starts the bridge again")
    fleet.session(session)
    recovery = now() - since
    check(property_of("cairn", "MainPID") == pid["cairn"] and property_of("cairn", "NRestarts") == "0", "the daemon noticed")
    return recovery


def killed_router(stage, fleet):
    """The same session of the bridge once there is another one, which it returns."""
    session = fleet.session()
    fleet.process.kill()
    fleet.process.wait(10)
    fleet.close()
    time.sleep(3)
    fleet = stage.keep(Fleet())
    check(fleet.session() == session, "the bridge has another session once the router is back")
    return fleet


def killed_daemon(health):
    """The same bridge goes on with the next one."""
    pid = {unit: property_of(unit, "MainPID") for unit in ("cairn", "cairn-bridge")}
    bridged = lambda: sh("journalctl -q -u cairn-bridge -o cat --no-pager")[1].count("bridging a daemon")
    restarted, before = now(), bridged()
    sh(f"kill -9 {pid['cairn']}")
    health.flowing(restarted, 40)
    until(lambda: property_of("cairn", "MainPID") not in ("0", pid["cairn"]), 20, "systemd starts the daemon again")
    until(lambda: bridged() > before, 60, "the next daemon is bridged", 0.5)
    check(property_of("cairn-bridge", "MainPID") == pid["cairn-bridge"], "the bridge was started again with another")


def bridge(stage):
    """kill -9 of bridge and daemon beside each other; in the full form of router and recorder, too, and the current map by the bridge."""
    camera, health, began = start_bridge(stage)
    fleet = stage.keep(Fleet())
    fleet.session()
    notes, victims = ["recovery: the fleet lists it again after kill -9 of the bridge"], "bridge and daemon"
    recording = None
    if stage.full:
        notes, victims = notes + [pull(health, began)], "bridge, recorder, router and daemon"
        recording = stage.keep(Recorder("beside.mcap"))
        recording.grown()
    since = now()
    recovery = killed_bridge(fleet)
    if recording:
        recording.grown()
    first = "first to start, map pull of the current map; " if stage.full else "first to start; "
    done = row(health, since, f"cairn-bridge.service: {first}kill -9 of {victims}; stop", recovery)
    if recording:
        recording.kill()
        fleet = killed_router(stage, fleet)
    killed_daemon(health)
    if recording:
        frames = replayed(recording.path)
        check(frames > 10, f"{frames} pictures in the killed recording")
        notes.append(f"{frames} pictures in the killed recording")
    stop = now()
    status, text = sh("systemctl stop cairn-bridge", 60)
    stopped = now() - stop
    check(status == 0 and stopped < 10 and property_of("cairn-bridge", "Result") == "success", f"stop: {status} {text} {stopped:.2f} s")
    if stage.full:
        # It is the router itself, so it cannot tell who has gone from who cannot be reached.
        until(lambda: fleet.robot() is None, 30, "the robot is no longer in the fleet", 0.1)
    camera.close()
    sh("systemctl stop cairn", 30)
    done["note"] = "; ".join([*notes, f"stopped in {stopped:.2f} s"])
    return done


SCENARIOS = {"recorder": recorder, "bridge": bridge}
