"""The scenarios by name, in the order in which they run. The host reads ORDER from this text."""

from . import access, console, delivery, doctor, injection, kill, lens, map_file, package, reboot, sharing, streaming, unplug

ORDER = [
    "usb_mjpeg",
    "usb_yuyv",
    "vivid_formats",
    "controls",
    "no_camera_at_start",
    "unplug_cycles",
    "another_place",
    "device_busy",
    "two_cameras",
    "permission_denied",
    "vivid_injections",
    "stops_delivering",
    "half_rate",
    "bad_frames",
    "format_change",
    "uncalibrated",
    "opening_hangs",
    "doctor",
    "orderly_stop",
    "strangers",
    "squatting",
    "squatting_in_shm",
    "kill_rounds",
    "power_cut",
    "map_file",
    "service",
    "console",
    "recorder",
    "bridge",
    "journal_rate",
    "package"
]
KNOWN = {}
for module in (access, console, delivery, doctor, injection, kill, lens, map_file, package, reboot, sharing, streaming, unplug):
    KNOWN.update(module.SCENARIOS)
SCENARIOS = {name: KNOWN[name] for name in ORDER}
