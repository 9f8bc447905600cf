"""The robot of the scenarios: daemon, cameras, a planner that listens, and checks that say what was seen.

Everything is measured in the guest's CLOCK_MONOTONIC, seconds. Every wait has a limit.
"""

import glob
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import threading
import time

CAIRN = "/usr/local/bin/cairn"
FRAMES = "/mnt/stage/frames"
CONFIG = pathlib.Path("/etc/cairn/cairn.toml")
HEALTH_PERIOD_S = 0.1
# A pause of this many periods between two health messages is a hole.
HOLE = 5
CAMERA_GONE = {"NO_CAMERA", "NO_FRAMES"}


class Failure(Exception):
    """A scenario's demand is not met."""


def check(condition, message):
    if not condition:
        raise Failure(message)


def now():
    return time.monotonic()


def sh(command, limit_s=60, user=None):
    """A command's status and its output with errors; one that does not end has status 124."""
    try:
        done = subprocess.run(["sh", "-c", command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, timeout=limit_s, text=True, errors="replace", **as_user(user))
        return done.returncode, done.stdout
    except subprocess.TimeoutExpired as late:
        return 124, str(late.output)


def as_user(user):
    return {"user": user, "group": user, "extra_groups": ["video"]} if user else {}


def until(condition, limit_s, what, pause_s=0.02):
    """What the condition gave once it was true."""
    end = now() + limit_s
    while now() < end:
        value = condition()
        if value:
            return value
        time.sleep(pause_s)
    raise Failure(f"not within {limit_s:g} s: {what}")


def end(process, signal_number=signal.SIGTERM, limit_s=10):
    """Ends a process; the time that it took, s, and its status."""
    began = now()
    if process.poll() is None:
        process.send_signal(signal_number)
    try:
        process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(limit_s)
        raise Failure(f"{process.args[0]} did not end within {limit_s} s of signal {signal_number}") from None
    return now() - began, process.returncode


class Daemon:
    """`cairn run` as user cairn. Its log is kept and can be searched."""

    def __init__(self, config="", user="cairn", calibration="camera.yaml", size=(320, 240), rate=15, camera=""):
        text = f'prefix = "cairn"\n[camera]\nwidth_px = {size[0]}\nheight_px = {size[1]}\nrate_hz = {rate}\n{camera}\n'
        if calibration:
            text += f'[calibration]\nfile = "/mnt/stage/{calibration}"\n'
        CONFIG.parent.mkdir(exist_ok=True)
        CONFIG.write_text(text + config)
        self.user = user
        self.log = open("/run/cairn.log", "w+", encoding="utf-8", errors="replace")
        self.process = None
        self.start()

    def start(self):
        os.makedirs("/var/lib/cairn", exist_ok=True)
        sh("chown cairn:cairn /var/lib/cairn")
        environment = {**os.environ, "STATE_DIRECTORY": "/var/lib/cairn"}
        self.process = subprocess.Popen([CAIRN, "run"], stdin=subprocess.DEVNULL, stdout=self.log, stderr=self.log,
                                        env=environment, cwd="/", **as_user(self.user))

    def alive(self):
        return self.process.poll() is None

    def lines(self):
        text = pathlib.Path(self.log.name).read_text(errors="replace")
        return text.splitlines()

    def said(self, pattern):
        """The last line of the log that has the pattern."""
        return next((line for line in reversed(self.lines()) if re.search(pattern, line)), None)

    def wait_said(self, pattern, limit_s=10):
        return until(lambda: self.said(pattern), limit_s, f"the log says {pattern!r}")

    def close(self):
        if self.process is not None and self.alive():
            end(self.process)
        self.log.close()


class Listener:
    """`cairn watch --json` of health as user cairn, every message kept with the monotonic time of its sending."""

    def __init__(self, what="--health", user="cairn"):
        self.records = []
        self.process = subprocess.Popen([CAIRN, "watch", "--json", *([what] if what else [])], stdin=subprocess.DEVNULL,
                                        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **as_user(user))
        self.thread = threading.Thread(target=self.read, daemon=True)
        self.thread.start()

    def read(self):
        for line in self.process.stdout:
            try:
                record = json.loads(line)
            except ValueError:
                continue
            record["t"] = record["published_ns"] * 1e-9
            self.records.append(record)

    def last(self):
        return self.records[-1] if self.records else None

    def wait(self, condition, limit_s, what, after=0.0):
        """The first message sent after `after` that meets the condition."""
        seen = 0
        end_at = now() + limit_s
        while now() < end_at:
            count = len(self.records)
            for record in self.records[seen:count]:
                if record["t"] >= after and condition(record):
                    return record
            seen = count
            time.sleep(0.02)
        last = self.last()
        raise Failure(f"not within {limit_s:g} s: {what}; the last health was {summary(last) if last else 'none'}")

    def since(self, t):
        return [r for r in self.records if r["t"] >= t]

    def widest_gap(self, since):
        """Longest time without a message, and how long after `since` it began, s."""
        times = [r["t"] for r in self.since(since)]
        return max(((b - a, a - since) for a, b in zip(times, times[1:])), default=(0.0, 0.0))

    def story(self, since, most=7):
        """States and error bits as they followed each other."""
        parts = []
        for record in self.since(since):
            text = summary(record)
            if not parts or parts[-1] != text:
                parts.append(text)
        if len(parts) > most:
            parts = parts[:most - 2] + ["…"] + parts[-1:]
        return " → ".join(parts)

    def flowing(self, after, limit_s=10, frames=1):
        """The first health after `after` that reports new frames and a camera."""
        before = max((r["frames_captured"] for r in self.records if r["t"] < after), default=0)
        return self.wait(lambda r: r["frames_captured"] >= before + frames and not CAMERA_GONE & set(r["errors"]), limit_s,
                         "frames flow", after)

    def close(self):
        if self.process.poll() is None:
            end(self.process)


def summary(record):
    return " ".join([record["state"], *record["errors"]])


def usb_node(serial="A1"):
    """The capture node of the USB camera with this serial number."""
    for path in sorted(glob.glob("/sys/class/video4linux/video*")):
        folder = os.path.realpath(f"{path}/device")
        try:
            if pathlib.Path(folder, "../serial").read_text().strip() == serial and \
                    pathlib.Path(path, "index").read_text().strip() == "0":
                return "/dev/" + os.path.basename(path)
        except OSError:
            continue
    return None


class UsbCamera:
    """The camera of usb_camera.py, plugged in."""

    def __init__(self, form="mjpeg", serial="A1", rate=15, size="320x240", start=0, wait=True, place=""):
        ending = {"mjpeg": "jpg", "yuyv": "yuyv"}[form]
        files = sorted(glob.glob(f"{FRAMES}/{place}{size}-*.{ending}"))
        check(files, f"no frames {place}{size} {ending}")
        sh("modprobe vhci-hcd; modprobe uvcvideo")
        command = ["python3", "/mnt/stage/guest/usb_camera.py", "--format", form, "--size", size, "--rate", str(rate),
                   "--serial", serial, "--start", str(start), *files]
        self.serial = serial
        self.said = open(f"/run/usb-{serial}.txt", "w+", encoding="utf-8")
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=self.said, stderr=self.said, text=True)
        self.plugged = now()
        self.node = None
        if wait:
            self.node = until(lambda: self.usable(), 20, "the kernel makes a node for the USB camera")
            self.appeared = now()

    def usable(self):
        """The node once udev has given it to the group `video`."""
        node = usb_node(self.serial)
        return node if node and os.path.exists(node) and os.stat(node).st_mode & 0o060 == 0o060 else None

    def tell(self, command):
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()

    def controls(self):
        """What was set on its controls: `unit selector = value`, one a line."""
        return pathlib.Path(self.said.name).read_text()

    def unplug(self):
        if self.process.poll() is None:
            end(self.process)
        at = now()
        until(lambda: usb_node(self.serial) is None, 10, "the kernel removes the node")
        return at

    def close(self):
        if self.process.poll() is None:
            end(self.process)
        self.process.stdin.close()
        self.said.close()


class Vivid:
    """The kernel's test camera, with its error injection."""

    SIZE = (320, 180)

    def __init__(self):
        status, text = sh("modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0x0 && udevadm settle -t 10")
        check(status == 0, f"vivid: {text}")
        self.node = until(self.find, 10, "vivid's node")

    @staticmethod
    def find():
        for path in sorted(glob.glob("/sys/class/video4linux/video*")):
            if "vivid" in pathlib.Path(path, "name").read_text():
                return "/dev/" + os.path.basename(path)
        return None

    def set(self, control, value=1):
        status, text = sh(f"v4l2-ctl -d {self.node} -c {control}={value}")
        check(status == 0, f"vivid's {control}: {text}")

    def controls(self):
        """Names of all its controls."""
        return re.findall(r"^\s+(\w+) 0x", sh(f"v4l2-ctl -d {self.node} --list-ctrls")[1], re.M)

    def unbind(self):
        pathlib.Path("/sys/bus/platform/drivers/vivid/unbind").write_text("vivid.0")

    def bind(self):
        pathlib.Path("/sys/bus/platform/drivers/vivid/bind").write_text("vivid.0")
        sh("udevadm settle -t 10")
        self.node = until(self.find, 10, "vivid's node")

    def close(self):
        until(lambda: sh("rmmod vivid")[0] == 0 or self.find() is None, 10, "vivid is unloaded", 0.3)


class Stage:
    """What a scenario uses; everything is closed at its end, in reverse order."""

    def __init__(self, form):
        self.full = form == "full"
        self.open = []
        # What the daemon of another scenario has learnt or found of the same camera.
        shutil.rmtree("/var/lib/cairn/cameras", ignore_errors=True)

    def daemon(self, **options):
        return self.keep(Daemon(**options))

    def listener(self, **options):
        return self.keep(Listener(**options))

    def usb(self, *args, **options):
        return self.keep(UsbCamera(*args, **options))

    def vivid(self):
        return self.keep(Vivid())

    def keep(self, thing):
        self.open.append(thing)
        return thing

    def close(self):
        for thing in reversed(self.open):
            try:
                thing.close()
            except Failure as failure:
                print(f"closing: {failure}", flush=True)
        self.open = []


def row(listener, since, done, recovery_s=None, note=""):
    """A line of the table; fails where health had a hole."""
    gap, at = listener.widest_gap(since)
    check(gap < HOLE * HEALTH_PERIOD_S, f"no health for {gap:.2f} s, {at:.2f} s after the beginning: {listener.story(since)}")
    published = listener.story(since)
    return {"done": done, "published": published, "widest_gap_s": round(gap, 3), "recovery_s": recovery_s, "note": note}
