"""Runs in the guest at every boot: the scenarios that job.json names, one after the other; those that reboot it are taken up again.

Writes a line of JSON for each begun and each ended scenario to /mnt/out/results.jsonl, then switches the guest off.
"""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import time
import traceback

sys.path.insert(0, "/mnt/stage/guest")
import power  # noqa: E402
from robot import Failure, Stage, now  # noqa: E402
from scenarios import SCENARIOS  # noqa: E402

PROGRESS = pathlib.Path("/var/lib/cairn-vm.json")
LIMIT_S = 1800


def report(record):
    with open("/mnt/out/results.jsonl", "a", encoding="utf-8") as file:
        file.write(json.dumps(record, ensure_ascii=False) + "\n")


def first_boot(scenarios):
    """Users, binary; the unit's own installation is the business of the scenario that tests it, and the package brings all of it."""
    if scenarios == ["package"]:
        return
    subprocess.run(["useradd", "--system", "--user-group", "--groups", "video", "--no-create-home", "--shell",
                    "/usr/sbin/nologin", "cairn"], check=True)
    subprocess.run(["useradd", "--user-group", "--groups", "video", "--no-create-home", "other"], check=True)
    shutil.copy("/mnt/stage/cairn", "/usr/local/bin/cairn")
    os.chmod("/usr/local/bin/cairn", 0o755)


def run(name, form, progress):
    """A record of how the scenario went. Does not return where it reboots the guest."""
    stage = Stage(form)
    stage.phase, stage.memory = progress["phase"], progress["memory"]
    began = now()
    record = {"scenario": name}
    try:
        try:
            outcome = SCENARIOS[name](stage)
        except power.Reboot as reboot:
            power.save(PROGRESS, {"left": progress["left"], "phase": progress["phase"] + 1, "memory": reboot.memory})
            reboot.go()
            raise Failure("the guest did not reboot")
        rows = outcome if isinstance(outcome, list) else [outcome]
        record.update(passed=True, rows=rows)
    except Failure as failure:
        record.update(passed=False, reason=str(failure))
    except Exception:  # a fault of the scenario's own must not end the others
        record.update(passed=False, reason=traceback.format_exc())
    try:
        stage.close()
    except Exception:
        record.update(passed=False, reason=traceback.format_exc())
    record["seconds"] = round(now() - began, 1)
    if not record["passed"] and os.path.exists("/run/cairn.log"):
        tail = pathlib.Path("/run/cairn.log").read_text(errors="replace").splitlines()
        record["log"] = [line for line in tail if '"message":"health"' not in line][-12:]
    return record


def main():
    job = json.loads(pathlib.Path("/mnt/stage/job.json").read_text())
    if PROGRESS.exists():
        progress = json.loads(PROGRESS.read_text())
    else:
        first_boot(job["scenarios"])
        progress = {"left": job["scenarios"], "phase": 0, "memory": {}}
    report({"booted": True, "uptime_s": round(time.clock_gettime(time.CLOCK_BOOTTIME), 1)})
    while progress["left"]:
        name = progress["left"][0]
        if progress["phase"] == 0:
            report({"begun": name})
        record = run(name, job["form"], progress)
        progress = {"left": progress["left"][1:], "phase": 0, "memory": {}}
        power.save(PROGRESS, progress)
        report(record)
        print(f"{name}: {'passed' if record['passed'] else record['reason']}", flush=True)
    report({"finished": True})
    subprocess.run(["sh", "-c", "dmesg > /mnt/out/dmesg.txt; journalctl -b all -o short-monotonic --no-pager > /mnt/out/journal.txt"])
    os.sync()
    subprocess.run(["systemctl", "poweroff", "-ff"])


try:
    main()
except Exception:
    traceback.print_exc()
    sys.stdout.flush()
    subprocess.run(["systemctl", "poweroff", "-ff"])
