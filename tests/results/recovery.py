#!/usr/bin/env python3
"""Cuts frames out of recordings and prints, as a Markdown table, how soon the map is known again.

    tests/results/recovery.py SEEDS DIR...      SEEDS: 1-4, say; DIR: a recording in TUM layout with ground truth and camera.yaml

At seeded places 5 to 60 frames are missing. A view counts as come back from the first frame on in which, by ground truth, at least half of
the picture shows what a frame before the cut saw from between half and twice the distance (its corners are taken to lie at the median
depth of the map's start). Known again: tracked in the same map. In the end: the frames from both sides of the cut are in one trajectory,
tracked all the way or joined. Wrong: known again with an error above 15 % of that depth, after one alignment of the whole trajectory.
Needs `cairn` in PATH. One replay at a time.
"""

import bisect
import json
import math
import os
import pathlib
import random
import re
import subprocess
import sys
import tempfile

SOON, LATE = 3, 60
WRONG = 0.15
# Places of a picture that are asked whether they were seen before, across and down.
GRID = 8, 6


def lines(path):
    return [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]


def turned(q, v):
    """A vector turned by a quaternion x y z w."""
    x, y, z, w = q
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx]


class Truth:
    def __init__(self, folder):
        rows = sorted([float(v) for v in line] for line in lines(folder / "groundtruth.txt"))
        self.times, self.poses = [r[0] for r in rows], [(r[1:4], r[4:8]) for r in rows]
        text = (folder / "camera.yaml").read_text()
        number = lambda key: float(re.search(rf"^\s*{key}:\s*([\d.eE+-]+)", text, re.MULTILINE)[1])  # noqa: E731
        self.width, self.height, self.fx, self.fy, self.cx, self.cy = map(number, ("width", "height", "fx", "fy", "cx", "cy"))

    def at(self, time):
        i = bisect.bisect(self.times, time)
        near = min((k for k in (i - 1, i) if 0 <= k < len(self.times)), key=lambda k: abs(self.times[k] - time))
        return self.poses[near] if abs(self.times[near] - time) < 0.05 else None

    def overlap(self, now, before, depth):
        """Share of the picture at `now` that the one at `before` showed."""
        (t, q), (u, p) = now, before
        inverse = [-p[0], -p[1], -p[2], p[3]]
        seen = 0
        for i in range(GRID[0] * GRID[1]):
            px, py = (i % GRID[0] + 0.5) / GRID[0] * self.width, (i // GRID[0] + 0.5) / GRID[1] * self.height
            ray = [(px - self.cx) / self.fx * depth, (py - self.cy) / self.fy * depth, depth]
            there = turned(inverse, [a + b - c for a, b, c in zip(turned(q, ray), t, u)])
            if 0.5 * depth < there[2] < 2 * depth:
                x, y = there[0] / there[2] * self.fx + self.cx, there[1] / there[2] * self.fy + self.cy
                seen += 0 <= x < self.width and 0 <= y < self.height
        return seen / (GRID[0] * GRID[1])


def cuts(frames, seed):
    chance = random.Random(7919 * seed + frames)
    found, at = [], int(0.15 * frames) + chance.randrange(40)
    while True:
        count = chance.randint(5, 60)
        if at + count > frames - 20:
            return found
        found.append((at, at + count))
        at += count + 50 + chance.randrange(60)


def replay(folder, out):
    """States by frame (state, map), and the alignment of the trajectory that was written."""
    command = ["cairn", "replay", "--lockstep", str(folder), "--log", "cairn=info", "--json", "--trajectory", str(out / "trajectory.txt")]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-500:]}")
    events = re.findall(r'INFO state sequence=(\d+) .*?map=(\d+) from="\w+" state="(\w+)"', done.stderr)
    frames, states = len(lines(folder / "rgb.txt")), []
    for at in range(frames):
        told = [e for e in events if int(e[0]) <= at]
        states.append((told[-1][2], int(told[-1][1])) if told else ("INITIALIZING", -1))
    judge = ["cairn", "evaluate", str(out / "trajectory.txt"), str(folder), "--json", "--quiet", "--plot", str(out / "plot.png")]
    judged = json.loads(subprocess.run(judge, stdin=subprocess.DEVNULL, capture_output=True, text=True).stdout)
    return states, judged


def whole(folder, depths):
    """Median depth at the start of the map of the uncut recording, m."""
    if folder not in depths:
        with tempfile.TemporaryDirectory() as out:
            depths[folder] = replay(folder, pathlib.Path(out))[1]["alignment"]["scale"]
    return depths[folder]


def cases(folder, seed, depth):
    truth = Truth(folder)
    frames = lines(folder / "rgb.txt")
    missing = cuts(len(frames), seed)
    kept = [i for i in range(len(frames)) if not any(a <= i < b for a, b in missing)]
    with tempfile.TemporaryDirectory() as out:
        out = pathlib.Path(out)
        cut = out / "cut"
        cut.mkdir()
        for entry in folder.iterdir():
            if entry.name != "rgb.txt":
                (cut / entry.name).symlink_to(entry.resolve())
        (cut / "rgb.txt").write_text("".join(" ".join(frames[i]) + "\n" for i in kept))
        states, judged = replay(cut, out)
        written = {round(float(line[0]), 3): [float(v) for v in line[1:4]] for line in lines(out / "trajectory.txt")}
    alignment = judged["alignment"]
    place = lambda t: [alignment["scale"] * a + b for a, b in zip(turned(alignment["rotation_xyzw"], t), alignment["translation_m"])]  # noqa: E731
    poses = [truth.at(float(frames[i][0])) for i in kept]
    stamps = [round(float(frames[i][0]), 3) for i in kept]
    for n, (begin, end) in enumerate(missing):
        after = bisect.bisect_left(kept, end)
        if not after or states[after - 1][0] != "TRACKING":
            yield "lost before", None
            continue
        own = states[after - 1][1]
        known = [poses[i] for i in range(after) if states[i] == ("TRACKING", own) and poses[i]][::3]
        limit = bisect.bisect_left(kept, missing[n + 1][0]) if n + 1 < len(missing) else len(kept)
        back = next((i for i in range(after, limit)
                     if poses[i] and any(truth.overlap(poses[i], k, depth) >= 0.5 for k in known)), None)
        found = next((i for i in range(after, limit) if states[i] == ("TRACKING", own)), None)
        if back is None and found is None:
            yield "never came back", None
            continue
        waited = max(0, found - back) if found is not None and back is not None else 0 if found is not None else math.inf
        error = None
        if found is not None and stamps[found] in written and poses[found]:
            error = math.dist(place(written[stamps[found]]), poses[found][0]) / depth
        one = any(s in written for s in stamps[max(0, after - 10):after]) and any(s in written for s in stamps[limit - 10:limit])
        yield "came back", (waited, error, one)


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    first, _, last = sys.argv[1].partition("-")
    seeds = range(int(first), int(last or first) + 1)
    print("| recording | cuts | came back | known within 3 frames | within 60 | wrong | not judged | one trajectory in the end | "
          "not counted: lost before |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    total, depths = [0] * 8, {}
    for folder in map(pathlib.Path, sys.argv[2:]):
        found = [case for seed in seeds for case in cases(folder, seed, whole(folder, depths))]
        told = [case for kind, case in found if kind == "came back"]
        right = [waited for waited, error, _ in told if error is not None and error <= WRONG]
        row = [len(found), len(told), sum(w < SOON for w in right), sum(w < LATE for w in right),
               sum(error is not None and error > WRONG for _, error, _ in told),
               sum(error is None and waited < math.inf for waited, error, _ in told), sum(one for _, _, one in told),
               sum(kind == "lost before" for kind, _ in found)]
        print(f"| {folder.name} | {' | '.join(map(str, row))} |", flush=True)
        total = [a + b for a, b in zip(total, row)]
    print(f"| all | {' | '.join(map(str, total))} |")


if __name__ == "__main__":
    main()
