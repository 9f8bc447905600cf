"""`cairn doctor` on every fault of a camera: with a daemon that reports it, and where none runs. Faults of the service, of shared memory and of
other users are in service.sh and access.py."""

import os
import re
import shutil
import subprocess
import time

from robot import CAIRN, CONFIG, check, end, now, sh


def explains(fault, words, daemon=None, user="cairn"):
    """What doctor says of it; every one of `words` must be in it. A line of the table."""
    status, text = sh(f"{CAIRN} doctor", 60, user)
    for word in words:
        check(word in text, f"{fault}: doctor does not say {word!r}: {text}")
    lines = [line.strip() for line in text.splitlines()]
    line = next(line for line in lines if words[0] in line)
    cure = next((line for line in lines if words[-1] in line), "")
    said = re.sub(r"^(FAIL|warn|note|ok)\s+", r"\1: ", line)
    return {"done": f"{fault}{', told by the daemon' if daemon else ', no daemon'}", "note": f"{said}; exit code {status}; next: {re.sub(r'^[0-9]+. ', '', cure)}"}


def doctor(stage):
    rows = []

    def settled(condition, what):
        return health.wait(condition, 15, what, now())

    # With a daemon.
    camera = stage.usb("mjpeg")
    daemon = stage.daemon()
    health = stage.listener()
    began = now()
    health.flowing(began, 20, frames=5)
    for fault, tell, words in [
            ("NO_FRAMES", "pause", ["the daemon reports NO_FRAMES", "plug it in anew"]),
            ("LOW_RATE", "rate 7.5", ["the daemon reports LOW_RATE", "more light"]),
            ("CORRUPT_FRAMES", "broken 150", ["the daemon reports CORRUPT_FRAMES", "another cable"])]:
        camera.tell(tell)
        settled(lambda r: fault in r["errors"], fault)
        rows.append(explains(fault, words, daemon))
        for undo in ("go", "rate 15", "broken 0"):
            camera.tell(undo)
        settled(lambda r: fault not in r["errors"], f"{fault} ends")
    camera.unplug()
    settled(lambda r: "NO_CAMERA" in r["errors"], "NO_CAMERA")
    rows.append(explains("unplugged", ["the daemon reports NO_CAMERA", "plug the camera in"], daemon))
    daemon.close()
    camera = stage.usb("mjpeg")
    daemon = stage.daemon(calibration=None)
    settled(lambda r: "UNCALIBRATED" in r["errors"], "UNCALIBRATED")
    shutil.rmtree("/var/lib/cairn/cameras", ignore_errors=True)
    rows.append(explains("UNCALIBRATED", ["warn  the daemon reports UNCALIBRATED", "cairn calibrate"], daemon))
    daemon.close()
    health.close()
    # Without one. The configuration stays.
    def configure(lines, calibration="camera.yaml"):
        named = f'[calibration]\nfile = "/mnt/stage/{calibration}"\n' if calibration else ""
        CONFIG.write_text(f"[camera]\nwidth_px = 320\nheight_px = 240\nrate_hz = 15\n{lines}\n{named}")

    configure("")
    rows.append(explains("all is well", ["pictures a second", "has all it needs"]))
    for fault, tell, words in [
            ("sends nothing", "pause", ["sends no picture within 4 s", "plug it in anew"]),
            ("half the rate", "rate 7.5", ["promised 15", "camera.dynamic_rate"]),
            ("broken frames", "broken 150", ["that cannot be read", "another cable"]),
            ("hangs while it is opened", "slow 4", ["does not answer", "plug the camera out and in again"])]:
        camera.tell(tell)
        rows.append(explains(fault, words))
        for undo in ("go", "rate 15", "broken 0", "slow 0"):
            camera.tell(undo)
        time.sleep(1)
    other = subprocess.Popen(["v4l2-ctl", "-d", camera.node, "--stream-mmap", "--stream-count=0"],
                             stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(2)
    rows.append(explains("busy", [f"is busy: used by v4l2-ctl (pid {other.pid})", "end the program"], user="root"))
    end(other)
    os.chmod(camera.node, 0o600)
    rows.append(explains("permission denied", ["cameras belong to the group 'video'", "usermod -aG video"]))
    os.chmod(camera.node, 0o660)
    configure("", "vivid.yaml")
    rows.append(explains("calibration of another shape", ["vivid.yaml is for 320x180 px", "calibrated shape"]))
    configure('device = "/dev/video7"')
    rows.append(explains("a camera is named that is not there", ['camera.device = "/dev/video7" is none of these cameras', "set camera.device"]))
    configure('format = "grey"')
    rows.append(explains("no format that is allowed", ["sends nothing usable", "another camera"]))
    configure("widht = 3")
    rows.append(explains("a typo in the configuration", ["cairn.toml:5", "correct the configuration file"]))
    configure("")
    camera.unplug()
    rows.append(explains("no camera", ["no camera that sends", "plug a USB webcam in"]))
    return rows


SCENARIOS = {"doctor": doctor}
