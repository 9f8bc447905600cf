"""A camera that nobody has calibrated: its lens is found from the motion, kept, and found again at the next start."""

import math
import pathlib

from robot import check, end, now, row

KEPT = pathlib.Path("/var/lib/cairn")
# Of the simulated lens, px; what is supposed of an unknown one sees 60 degrees across 320 px.
TRUE_FOCAL_PX = 0.82 * 320
# The sway lasts 12 s; how often it is seen to and fro until the lens is found at the latest.
LIMIT_S = 60


def estimates():
    return sorted(KEPT.rglob("*.estimated.toml"))


def off(record):
    """Of the focal length that health names, as a share."""
    return math.log(record["focal_px"][0] / TRUE_FOCAL_PX)


def uncalibrated(stage):
    camera = stage.usb("mjpeg", place="sway-")
    began = now()
    daemon = stage.daemon(calibration=None)
    health = stage.listener()
    guess = health.wait(lambda r: r["frames_tracked"] + r["frames_captured"] > 0 and r["intrinsics"] == "GUESSED" and r["focal_px"][0],
                        20, "the lens is a guess", began)
    check("UNCALIBRATED" in guess["errors"] and abs(guess["focal_px"][0] - 277) < 2, f"not 60 degrees: {guess['focal_px']}, {guess['errors']}")
    found = health.wait(lambda r: r["intrinsics"] == "ESTIMATED", LIMIT_S, "the lens is found from the motion", began)
    check("UNCALIBRATED" not in found["errors"], "found, and yet a fault")
    check(abs(off(found)) < 3 * found["focal_sigma"], f"{100 * off(found):.1f} % off, said {100 * found['focal_sigma']:.1f} %")
    daemon.wait_said("lens.*estimated|estimated.*lens")
    health.wait(lambda r: r["t"] > found["t"] + 3, 10, "three seconds more")
    last = health.last()
    end(daemon.process)
    files = estimates()
    check(len(files) == 1, f"kept: {files}")
    again = now()
    daemon.start()
    daemon.wait_said("lens of the last run")
    next_start = health.wait(lambda r: r["intrinsics"] == "ESTIMATED" and r["focal_px"][0], 20, "the next start begins with it", again)
    kept = float(next(line.split("=")[1] for line in files[0].read_text().splitlines() if line.startswith("fx_px")))
    check(abs(next_start["focal_px"][0] - kept) < 0.05 * kept, f"kept {kept}, begun with {next_start['focal_px'][0]}")
    check("UNCALIBRATED" not in next_start["errors"], "kept, and yet a fault")
    files[0].unlink()
    camera.unplug()
    note = (f"found after {found['t'] - began:.1f} s, {100 * off(last):+.1f} % off at the end, said {100 * last['focal_sigma']:.1f} %; "
            f"kept in {files[0].name}; the next start begins with {kept:.0f} px")
    return row(health, began, "uvc, not calibrated, MJPEG 320x240 at 15 Hz", note=note)


SCENARIOS = {"uncalibrated": uncalibrated}
