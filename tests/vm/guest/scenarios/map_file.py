"""Power that goes at seeded moments while the map's file is written, or made."""

import glob
import json
import os
import pathlib
import random
import time

import power
from robot import CAIRN, check, now, row, sh, until

FOLDER = "/var/lib/cairn/kept"
FILE = f"{FOLDER}/robot.map"
# The host's, so that nothing of it is in the disk's journal or cache.
CUT = pathlib.Path("/mnt/out/cut.json")
# The longest that a cut may take from the map, s.
MOST_LOST_S = 5.0
# Every so manieth cut comes while the file is made, the others while it is written to.
MADE_EVERY = 5
# From the first byte of a write on; writes take some tens of milliseconds.
LONGEST_S = 0.12


def state():
    """Changes with every write: of the file, and of what is to become one."""
    found = []
    for path in glob.glob(f"{FOLDER}/*") + glob.glob(f"{FOLDER}/.*map*"):
        try:
            found.append((path, os.stat(path).st_mtime_ns, os.stat(path).st_size))
        except FileNotFoundError:  # it was renamed meanwhile
            pass
    return sorted(found)


def info():
    """What the file says of itself; one that is not whole fails."""
    status, text = sh(f"{CAIRN} map info {FILE} --json", 60, "cairn")
    check(status == 0, f"map info: {status} {text}")
    return json.loads(text)


def after_a_cut(stage):
    """What the last cut left, before a daemon has looked at it."""
    cut = json.loads(CUT.read_text())
    if cut["made"] and not os.path.exists(FILE):
        return {**cut, "left": "nothing"}
    check(os.path.exists(FILE), "the map's file is gone")
    told = info()
    newest = float(told["newest_frame_s"])
    lost = cut["at_s"] - newest
    check(lost <= MOST_LOST_S, f"{lost:.2f} s of the map are lost by cut {stage.phase}: {cut}, newest {newest}")
    # The map is written every two seconds: what is newer than one is of the write that was cut.
    return {**cut, "left": "the write" if lost < 1.0 else "what was before", "lost_s": lost, "keyframes": sum(m["keyframes"] for m in told["maps"])}


def cut_in_a_write(stage):
    cuts = 20 if stage.full else 2
    if stage.phase > 0:
        stage.memory.setdefault("cuts", []).append(after_a_cut(stage))
    random_ = random.Random(stage.phase)
    made = stage.phase % MADE_EVERY == 0 and stage.phase < cuts
    sh(f"mkdir -p {FOLDER}; chown cairn:cairn {FOLDER}")
    # The last time goes on in what the last cut left. Else a map is begun, as one that is known well is written to seldom.
    if stage.phase < cuts:
        sh(f"rm -f {FILE}; sync")
    stage.usb("mjpeg")
    began = now()
    stage.daemon(config=f'[map]\nfile = "{FILE}"\n')
    health = stage.listener()
    if not made:
        tracked = health.wait(lambda r: r["state"] == "TRACKING", 60, "tracking, in the map that was kept if there is one", began)
        if stage.phase == cuts:
            return told(stage, health, began, tracked["t"] - began)
        until(lambda: os.path.exists(FILE), 30, "the map's file is made")
    wait, after = random_.uniform(0.0, 4.0), random_.uniform(0.0, LONGEST_S)

    def moment():
        if not made:
            time.sleep(wait)
        untouched = state()
        until(lambda: state() != untouched, 60, "a write begins", pause_s=0.001)
        time.sleep(after)
        CUT.write_text(json.dumps({"at_s": now(), "after_s": after, "made": made}))

    raise power.Reboot(stage.memory, orderly=False, moment=moment)


def told(stage, health, began, recovery_s):
    found = stage.memory["cuts"]
    lost = [cut["lost_s"] for cut in found if "lost_s" in cut]
    made = [cut for cut in found if cut["made"]]
    written = [cut for cut in found if not cut["made"]]
    new = sum(cut["left"] == "the write" for cut in written)
    return row(health, began, f"power cut while the map's file is written, {len(found)} times", recovery_s,
               f"a whole map every time; of {len(written)} writes {new} were on the disk, the others left what was before; of {len(made)} cuts while the file was made "
               f"{sum(cut['left'] == 'nothing' for cut in made)} left none; at most {max(lost):.2f} s lost; {max(cut.get('keyframes', 0) for cut in found)} keyframes; "
               "recovery: start to tracking in the map that was kept")


SCENARIOS = {"map_file": cut_in_a_write}
