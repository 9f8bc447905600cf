"""Reboots of the guest in the middle of a scenario: orderly, or as a power cut."""

import json
import os
import pathlib
import subprocess
import time


class Reboot(Exception):
    """Raised by a scenario that goes on after the reboot, with `stage.phase` one higher and `stage.memory` kept."""

    def __init__(self, memory, orderly, moment=None):
        """`moment`: a function that returns when the power is to go."""
        super().__init__("reboot")
        self.memory, self.orderly, self.moment = memory, orderly, moment

    def go(self):
        if self.orderly:
            subprocess.run(["systemctl", "reboot", "--no-block"])
        else:
            # What was not synced is lost with the page cache.
            pathlib.Path("/proc/sys/kernel/sysrq").write_text("1")
            with open("/proc/sysrq-trigger", "wb", buffering=0) as trigger:
                if self.moment:
                    self.moment()
                trigger.write(b"b")
        time.sleep(300)


def save(path, value):
    """Written so that a power cut right after does not lose it, and without syncing any other file."""
    temporary = path.with_suffix(".new")
    with open(temporary, "w", encoding="utf-8") as file:
        json.dump(value, file)
        file.flush()
        os.fsync(file.fileno())
    os.rename(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    os.fsync(folder)
    os.close(folder)
