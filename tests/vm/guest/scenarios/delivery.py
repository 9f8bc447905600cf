"""A camera that is there and delivers badly: nothing, half, garbage, another format."""

import pathlib
import time

from robot import CAIRN, CAMERA_GONE, check, now, row, sh, summary

RETURN_LIMIT_S = 2.0


def streaming(stage, **options):
    camera = stage.usb("mjpeg", **options)
    daemon = stage.daemon()
    health = stage.listener()
    began = now()
    health.flowing(began, 20, frames=5)
    return camera, daemon, health


def stops_delivering(stage):
    camera, daemon, health = streaming(stage)
    began = now()
    camera.tell("pause")
    silent = health.wait(lambda r: "NO_FRAMES" in r["errors"], 4, "NO_FRAMES", began)
    check(silent["state"] != "TRACKING", summary(silent))
    # It is opened anew meanwhile, which must not look like a camera that is gone.
    time.sleep(6)
    daemon.wait_said("gives no good frame, opened anew")
    check("NO_FRAMES" in health.last()["errors"], f"no NO_FRAMES while silent: {summary(health.last())}")
    camera.tell("go")
    back_at = now()
    back = health.flowing(back_at, 5)
    recovery = back["t"] - back_at
    check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
    return row(health, began, "stops delivering for some 9 s, then goes on", recovery, f"NO_FRAMES after {silent['t'] - began:.1f} s")


def half_rate(stage):
    camera, _, health = streaming(stage)
    began = now()
    camera.tell("rate 7.5")
    slow = health.wait(lambda r: "LOW_RATE" in r["errors"], 4, "LOW_RATE", began)
    time.sleep(2)
    check("LOW_RATE" in health.last()["errors"], "LOW_RATE does not stand")
    camera.tell("rate 15")
    back_at = now()
    back = health.wait(lambda r: "LOW_RATE" not in r["errors"], 5, "LOW_RATE ends", back_at)
    return row(health, began, "delivers at half the rate it granted, then in full", back["t"] - back_at,
               f"LOW_RATE after {slow['t'] - began:.1f} s; ends after a full second at full rate")


def bad_frames(stage):
    """Broken JPEGs reach the daemon; broken YUYV is thrown away by uvcvideo, and shows as a gap in its frame numbers."""
    rows = []
    for form, verb, bit, counter, what in [
            ("mjpeg", "broken", "CORRUPT_FRAMES", "frames_corrupt", "garbage in place of JPEG"),
            ("mjpeg", "short", "CORRUPT_FRAMES", "frames_corrupt", "JPEG cut short"),
            ("yuyv", "broken", "DROPPED_FRAMES", "frames_dropped", "YUYV with the error bit"),
            ("yuyv", "short", "DROPPED_FRAMES", "frames_dropped", "YUYV cut short")]:
        camera = stage.usb(form)
        daemon = stage.daemon()
        health = stage.listener()
        began = now()
        before = health.flowing(began, 20, frames=5)
        began = now()
        camera.tell(f"{verb} 20")
        seen = health.wait(lambda r: bit in r["errors"], 5, bit, began)
        counted = health.wait(lambda r: r[counter] >= before[counter] + 18, 5, f"18 frames in {counter}", began)
        back = health.wait(lambda r: bit not in r["errors"], 5, f"{bit} ends", counted["t"])
        check(daemon.alive(), "the daemon ended")
        rows.append(row(health, began, f"20 frames: {what}", None,
                        f"{back[counter] - before[counter]} counted; bit after {seen['t'] - began:.1f} s, gone a second after the last"))
        health.close()
        daemon.close()
        camera.unplug()
    return rows


def format_change(stage):
    """The camera comes back sending another format, then another size."""
    camera, daemon, health = streaming(stage)
    began = now()
    camera.unplug()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 3, "NO_CAMERA", began)
    other = stage.usb("yuyv")
    back = health.flowing(other.appeared - 0.2, 10)
    recovery = max(0.0, back["t"] - other.appeared)
    check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
    rows = [row(health, began, "comes back with YUYV in place of MJPEG", recovery)]
    other.unplug()
    for size, serial in (("640x480", "twice as large"), ("320x240", "as before")):
        began = now()
        before = health.last()
        health.wait(lambda r: "NO_CAMERA" in r["errors"], 3, "NO_CAMERA")
        sized = stage.usb("mjpeg", size=size)
        new = health.wait(lambda r: r["reset_counter"] > before["reset_counter"] and not CAMERA_GONE & set(r["errors"]), 10,
                          "the reset counter for pictures of another size", sized.appeared - 0.2)
        health.wait(lambda r: "CORRUPT_FRAMES" not in r["errors"], 5, "no fault", new["t"])
        check(daemon.alive(), "the daemon ended")
        check(daemon.said("camera sends another size now"), "the log does not speak of the size")
        check(daemon.said("calibration scaled"), "the calibration was not scaled")
        recovery = max(0.0, new["t"] - sized.appeared)
        check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
        rows.append(row(health, began, f"comes back with {size}, {serial}", recovery,
                        f"calibration scaled; a new map, reset counter {before['reset_counter']} to {new['reset_counter']}"))
        if size == "640x480":
            sized.unplug()
    return rows


def opening_hangs(stage):
    """A camera that hardly answers: its driver hangs for seconds while it is opened. What is told is the camera's fault, and health goes on."""
    rows = []
    ways = [("at start, calibration named", "camera.yaml", "NO_CAMERA"), ("at start, calibration found by the camera", None, "NO_CAMERA"),
            ("opened anew after it went silent", "camera.yaml", "NO_FRAMES")]
    for way, calibration, fault in ways:
        camera = stage.usb("mjpeg")
        at_start = way.startswith("at start")
        if at_start:
            camera.tell("slow 3")
        daemon = stage.daemon(calibration=calibration)
        health = stage.listener()
        began = now()
        if not at_start:
            health.flowing(began, 20, frames=5)
            began = now()
            camera.tell("slow 3")
            camera.tell("pause")
        health.wait(lambda r: fault in r["errors"], 6, fault, began)
        daemon.wait_said("does not answer while it is opened", 12)
        time.sleep(3)
        check(fault in health.last()["errors"], f"{fault} does not stand: {summary(health.last())}")
        check(health.last()["state"] != "TRACKING", summary(health.last()))
        camera.tell("slow 0")
        camera.tell("go")
        back_at = now()
        back = health.flowing(back_at, 10)
        recovery = back["t"] - back_at
        check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
        stalled = [r for r in health.since(began) if "STALLED_STAGE" in r["errors"]]
        check(not stalled, f"the camera's fault was told as a stalled stage {len(stalled)} times")
        rows.append(row(health, began, f"hangs while its driver opens it (3 s for each request), {way}", recovery, "never STALLED_STAGE; log: “does not answer while it is opened”"))
        health.close()
        daemon.close()
        camera.unplug()
    return rows


def controls(stage):
    """What the configuration says of focus, exposure and lamps reaches the camera; the lock after settling, too."""
    camera = stage.usb("mjpeg")
    daemon = stage.daemon(camera='focus = 30\npower_line = "50hz"\nlock_after_s = 2.0\nexposure_limit_ms = 8.0')
    health = stage.listener()
    began = now()
    health.flowing(began, 20, frames=5)
    daemon.wait_said("exposure locked", 10)
    said = camera.controls().splitlines()
    # Unit and selector as in the UVC specification; exposure in 0.1 ms, gain from 64 by 25 ms / 8 ms.
    for line in ["control 1 0x8 = 0", "control 1 0x3 = 0", "control 1 0x6 = 30", "control 2 0x5 = 1",
                 "control 1 0x2 = 1", "control 1 0x4 = 80", "control 2 0x4 = 200", "control 2 0xb = 0"]:
        check(line in said, f"the camera was not told {line!r}: {said}")
    return [row(health, began, "focus 30, 50 Hz, lock after 2 s with exposure of at most 8 ms",
                note="autofocus off, exposure 25 ms to 8 ms, gain 64 to 200"), by_hand(camera, health),
            handed_in(stage, camera, daemon, health)]


def by_hand(camera, health):
    """Exposure, gain and focus by command while it streams: asked for, set, refused with the range, given back; poses go on meanwhile."""
    began = now()

    def command(words, status, *said):
        got, text = sh(f"{CAIRN} command camera {words}", 20, "cairn")
        check(got == status and all(part in text for part in said), f"camera {words}: {got}: {text}")

    command("", 0, "exposure: 8 ms, set", "(0.3 to 204.7 ms, every 0.1; 25 when plugged in)", "gain: 200 steps",
            "focus: 30 steps, set")
    command("exposure 12.5", 0, "exposure is 12.5 ms")
    command("gain 90", 0, "gain is 90 steps")
    # The camera's lens moves in steps of 5.
    command("focus 61", 0, "focus is 60 steps")
    command("exposure 900", 64, "exposure 900 ms: this camera takes 0.3 to 204.7 ms")
    command("gain auto", 69, "no automatic")
    command("exposure auto", 0, "the camera decides on exposure")
    told = camera.controls().splitlines()
    told = told[len(told) - told[::-1].index("control 1 0x4 = 125") - 1:]
    for line in ["control 2 0x4 = 90", "control 1 0x6 = 60", "control 1 0x2 = 8"]:
        check(line in told, f"the camera was not told {line!r}: {told}")
    health.flowing(now(), 5, frames=5)
    return row(health, began, "exposure 12.5 ms, gain 90, focus 60 by command while it streams, and exposure given back",
               note="beyond the range: refused with range and unit")


def handed_in(stage, camera, daemon, health):
    """A calibration that is handed in while it streams is kept for this camera, and is what the next map and the daemon's next start begin with."""
    began = now()
    handed = pathlib.Path("/home/cairn-handed.toml")

    def hand_in(fx_px, more=""):
        handed.write_text(f"width_px = 320\nheight_px = 240\nfx_px = {fx_px}\nfy_px = 251.0\ncx_px = 160.0\ncy_px = 120.0\n"
                          f"distortion = [0.0, 0.0, 0.0, 0.0, 0.0]\nrms_px = 0.2\n{more}")
        handed.chmod(0o644)
        return sh(f"{CAIRN} command keep-calibration {handed}", 20, "cairn")

    status, text = sh(f"{CAIRN} command camera", 20, "cairn")
    identity = text.split()[1] if text.startswith("camera ") else ""
    check(status == 0 and identity.endswith(":A1") and camera.node in text, f"which camera it is: {status}: {text}")
    status, text = hand_in(251.5)
    check(status == 0 and "/var/lib/cairn/cameras/" in text and identity in text, f"keep-calibration: {status}: {text}")
    check("configuration" in text, f"the configuration names another one, which is not said: {text}")
    check(not list(pathlib.Path("/dev/shm").glob("cairn-calibration-*")), "what was handed over is left behind")
    status, text = hand_in(251.5, f'camera = "{identity[:-3]}:B7"\n')
    check(status == 1 and f"the daemon's is {identity}" in text, f"of another camera: {status}: {text}")
    health.flowing(now(), 5, frames=5)
    daemon.close()
    daemon = stage.daemon(calibration="")
    daemon.wait_said("stored calibration used.*/var/lib/cairn/cameras/", 10)
    daemon.wait_said("camera model.*251[.]5", 10)
    status, text = hand_in(252.5)
    check(status == 0 and "the next map" in text, f"keep-calibration: {status}: {text}")
    check(not daemon.said("camera model.*252[.]5"), "the lens of a map has changed while it was in use")
    status, text = sh(f"{CAIRN} command reset", 20, "cairn")
    check(status == 0, f"reset: {status}: {text}")
    daemon.wait_said("camera model.*252[.]5", 10)
    handed.unlink()
    return row(health, began, "a calibration handed in while it streams",
               note="kept for this camera, refused for another, used from the next start or reset on")


SCENARIOS = {"stops_delivering": stops_delivering, "half_rate": half_rate, "bad_frames": bad_frames,
             "format_change": format_change, "opening_hangs": opening_hangs, "controls": controls}
