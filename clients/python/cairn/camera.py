"""What a camera offers of exposure, gain and focus. The twin of `src/messages/camera.rs` in Rust."""

from typing import NamedTuple, Optional


class CameraControl(NamedTuple):
    """One control. `unit`: ms, or steps of the camera's own. `value`: NaN where the camera does not tell it."""

    name: str
    unit: str
    low: float
    high: float
    step: float
    default: float
    value: float
    auto: Optional[bool]  # the camera decides; None: it has no automatic for it


_WHO = {"auto": True, "manual": False, "manual-only": None}


def controls(message):
    """An answer to CAMERA_CONTROLS; lines and words of a newer daemon that are none to us are left out."""
    found = []
    for line in message.splitlines():
        try:
            name, unit, *numbers, who = line.split(" ")[:8]
            low, high, step, default, value = map(float, numbers)
            found.append(CameraControl(name, unit, low, high, step, default, value, _WHO[who]))
        except (ValueError, KeyError):
            continue
    return found
