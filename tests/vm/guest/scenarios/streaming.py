"""What a camera is asked for, and that its frames arrive: every format on the driver that has it."""

import json

from robot import Failure, check, now, row


def streams(stage, format_name, camera):
    """The daemon with this format on whatever camera there is; a line of the table."""
    began = now()
    size, calibration = ((320, 180), "vivid.yaml") if camera == "vivid" else ((320, 240), "camera.yaml")
    daemon = stage.daemon(size=size, calibration=calibration, camera=f'format = "{format_name}"')
    health = stage.listener()
    first = health.flowing(began, 20, frames=10)
    opened = json.loads(daemon.wait_said("camera open"))
    name = str(opened)
    check(f"{format_name.upper()} {size[0]}x{size[1]}" in name, f"negotiated something else: {name}")
    after = first["t"]
    health.wait(lambda r: r["t"] > after + 3, 10, "three seconds more")
    second = health.last()
    rate = (second["frames_captured"] - first["frames_captured"]) / (second["t"] - first["t"])
    check(12 < rate < 18, f"15 frames a second were asked for, {rate:.1f} came")
    check(second["frames_corrupt"] == 0, f"{second['frames_corrupt']} frames corrupt")
    return row(health, first["t"], f"{camera}, {format_name.upper()} {size[0]}x{size[1]} at 15 Hz", note=f"{rate:.1f} frames/s")


def vivid_formats(stage):
    stage.vivid()
    rows = []
    for name in ("yuyv", "grey"):
        rows.append(streams(stage, name, "vivid"))
        for thing in (stage.open.pop(), stage.open.pop()):
            thing.close()
    return rows


def usb_mjpeg(stage):
    stage.usb("mjpeg")
    return streams(stage, "mjpeg", "uvc")


def usb_yuyv(stage):
    stage.usb("yuyv")
    return streams(stage, "yuyv", "uvc")


SCENARIOS = {"usb_mjpeg": usb_mjpeg, "usb_yuyv": usb_yuyv, "vivid_formats": vivid_formats}
