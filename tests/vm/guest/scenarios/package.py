"""The Debian package, from installing to purging, in a guest that has never seen Cairn: every check of service.sh, a reboot between them."""

import re
import shutil
import subprocess

import power
from robot import Failure, check, now

DEB = "/mnt/stage/cairn.deb"
# On an emulated processor every program that a check calls takes its time.
LIMIT_S = 900


def checks(*words):
    """Runs service.sh; its passed checks, what it measured, and an error that names the failed ones."""
    done = subprocess.run(["bash", "/mnt/stage/guest/service.sh", DEB, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, timeout=LIMIT_S, text=True, errors="replace")
    lines = done.stdout.splitlines()
    print(done.stdout, flush=True)
    failed = [line for line in lines if line.startswith("FAIL ")]
    passed = [line.removeprefix("ok ") for line in lines if line.startswith("ok ")]
    if failed or done.returncode != 0:
        raise Failure("; ".join(failed) or f"service.sh ended with {done.returncode}: {lines[-3:]}")
    return passed, [line for line in lines if re.search(r" \d+ ms\b", line) and not line.startswith("ok ")]


def package(stage):
    """What `service.sh` demands before a reboot, and after it."""
    if stage.phase == 0:
        check(shutil.which("cairn") is None, "cairn is there before the package is")
        began = now()
        passed, measured = checks()
        raise power.Reboot({"passed": passed, "measured": measured, "seconds": now() - began}, orderly=True)
    memory = stage.memory
    passed, measured = checks("after-reboot")
    passed, measured = memory["passed"] + passed, memory["measured"] + measured
    figures = [re.sub(r" (\d+) ms\b", lambda ms: f" {int(ms[1]) / 1000:.2f} s", line) for line in measured]
    # Figures stand in the names of some checks.
    figures += [name for name in passed if re.match(r"exposure|stop took", name)]
    text = " ".join(figures)
    again = re.search(r"frames again ([\d.]+) s", text)
    return {"done": f"Debian package: installed, used, rebooted, purged; {len(passed)} checks of service.sh, all passed",
            "recovery_s": float(again[1]) if again else None, "note": "; ".join(figures)}


SCENARIOS = {"package": package}
