#!/usr/bin/env python3
"""Cuts frames out of recordings, or blurs them, and prints as a Markdown table how soon the map is known again.

    tests/results/recovery.py cut|blur SEEDS DIR...      SEEDS: 1-4, say; DIR: a recording in TUM layout with ground truth and camera.yaml

At seeded places 5 to 60 frames are missing (cut), or blurred by the camera's own motion (blur): each picture is the mean of itself, moved
along the path that the ground truth has there, over an exposure of 30 ms, or longer where the camera was so slow that the median streak of
the place would be shorter than a jerk of the hand makes it (STREAK_PX). What is seen is taken to lie at one depth, lens distortion is left out.

A view counts as come back from the first sharp frame behind the place on in which, by ground truth, at least half of the picture shows
what a frame before it saw from between half and twice the distance (its corners are taken to lie at the median depth of the map's start).

| column | what |
|---|---|
| places | that were cut or blurred |
| lost before | the map had no pose just before the place: not counted |
| came back | of the others, those whose view came back, or that were known without it |
| lost in it | of these, tracking was lost in the blur or in the first frame behind the place |
| known within 3, 60 | sharp frames until tracked in the same map, or until the map under way is joined to it, at the right place |
| frames, median / 90 % | the same number of frames; "never" where no such frame came |
| wrong | known again with an error above 15 % of that depth, after one alignment of the whole trajectory |
| not judged | known again, but no pose of that map was written or the truth has a gap |
| one trajectory | frames from both sides of the place are in one trajectory in the end, tracked all the way or joined |

An error is taken from the trajectory at the end of the recording, or if that is of another map, from a replay that ends just behind the
frame. Needs `cairn` in PATH; blur needs OpenCV. One replay at a time.
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
EXPOSURE_S = 0.030
# A turn of 150 degrees/s for 30 ms, seen with a focal length of 500 px; no exposure is made longer than a camera with 3 frames a second has.
STREAK_PX, LONGEST_S = 40, 0.3
# Moments that are averaged lie so far apart, px; so many at the most.
STEP_PX, MOMENTS = 1.5, 64
# Frames behind the one to be judged that a shorter replay goes on for.
BEYOND = 10
# Places of a picture that are asked whether they were seen before, across and down.
GRID = 8, 6


def lines(path):
    return [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]


def turned(q, v):
    """A vector turned by a quaternion x y z w."""
    x, y, z, w = q
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx]


def product(a, b):
    """Of two quaternions x y z w."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return (aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz)


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

    def motion(self, time, period):
        """Speed in camera axes, m/s, and turn rate, rad/s, over two frame periods; None where the truth has a gap."""
        before, after = self.at(time - period), self.at(time + period)
        if not before or not after or before is after:
            return None
        (p, q), (u, r) = before, after
        inverse = [-q[0], -q[1], -q[2], q[3]]
        speed = [v / (2 * period) for v in turned(inverse, [b - a for a, b in zip(p, u)])]
        x, y, z, w = product(inverse, r)
        sine = math.hypot(x, y, z)
        angle = 2 * math.atan2(sine, abs(w)) * (1 if w >= 0 else -1)
        return speed, [v / max(sine, 1e-12) * angle / (2 * period) for v in (x, y, z)]

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


class Blur:
    """Pictures as the camera's own motion would blur them."""

    def __init__(self, truth, depth):
        import cv2
        import numpy

        self.cv2, self.np, self.truth, self.depth = cv2, numpy, truth, depth

    def homography(self, motion, seconds):
        """Where what a pixel shows is seen `seconds` later: K (R + t nT / d) K^-1, the plane of all corners facing the camera."""
        np, (speed, rate) = self.np, motion
        # Of the later camera from the earlier one: the inverse of the camera's own motion.
        rotation = self.cv2.Rodrigues(-np.array(rate) * seconds)[0]
        shift = rotation @ (-np.array(speed) * seconds)
        plane = rotation + np.outer(shift, [0, 0, 1 / self.depth])
        t = self.truth
        k = np.array([[t.fx, 0, t.cx], [0, t.fy, t.cy], [0, 0, 1]])
        return k @ plane @ np.linalg.inv(k)

    def streak_px(self, motion, seconds):
        """How far the picture moves: mean over a grid, px."""
        np, t = self.np, self.truth
        xs, ys = np.meshgrid((np.arange(4) + 0.5) / 4 * t.width, (np.arange(3) + 0.5) / 3 * t.height)
        at = np.stack([xs.ravel(), ys.ravel(), np.ones(12)])
        there = self.homography(motion, seconds) @ at
        return float(np.linalg.norm(there[:2] / there[2] - at[:2], axis=0).mean())

    def picture(self, source, target, motion, seconds):
        cv2, np = self.cv2, self.np
        sharp = cv2.imread(str(source), cv2.IMREAD_GRAYSCALE)
        moments = min(MOMENTS, max(1, math.ceil(self.streak_px(motion, seconds) / STEP_PX)))
        total = np.zeros(sharp.shape, np.float32)
        for i in range(moments):
            moved = self.homography(motion, seconds * ((i + 0.5) / moments - 0.5))
            total += cv2.warpPerspective(sharp, moved, sharp.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(str(target), np.rint(total / moments).astype(np.uint8))


def blurred(folder, out, truth, frames, places, depth):
    """The recording's list of pictures, those in `places` blurred; where the truth has a gap they stay as they are."""
    blur, frames = Blur(truth, depth), [list(f) for f in frames]
    times = [float(f[0]) for f in frames]
    period = sorted(b - a for a, b in zip(times, times[1:]))[len(times) // 2]
    for begin, end in places:
        motions = {i: m for i in range(begin, end) if (m := truth.motion(times[i], period))}
        streaks = sorted(blur.streak_px(m, EXPOSURE_S) for m in motions.values())
        if not streaks:
            continue
        median = max(streaks[len(streaks) // 2], 1e-3)
        seconds = min(max(EXPOSURE_S, EXPOSURE_S * STREAK_PX / median), LONGEST_S)
        for i, motion in motions.items():
            target = out / f"blurred-{i}.png"
            blur.picture(folder / frames[i][1], target, motion, seconds)
            frames[i][1] = target.name
    return frames


def replay(folder, out):
    """States by frame (state, map), numbers of the frames at which maps were joined, the trajectory written by time stamp, and its
    alignment (None without a trajectory)."""
    trajectory = out / "trajectory.txt"
    command = ["cairn", "replay", "--lockstep", str(folder), "--log", "cairn=info", "--json", "--trajectory", str(trajectory)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-500:]}")
    events = re.findall(r'INFO state sequence=(\d+) .*?map=(\d+) from="\w+" state="(\w+)"', done.stderr)
    joins = [int(n) for n in re.findall(r"INFO map joined sequence=(\d+)", done.stderr)]
    # A frame whose time stamp is not believed (behind a long cut) is not looked at, and no state is told for it.
    dropped = {int(n) for n in re.findall(r"WARN timestamp not believed, frame dropped .*?sequence=(\d+)", done.stderr)}
    frames, states = len(lines(folder / "rgb.txt")), []
    for at in range(frames):
        if at in dropped:
            states.append(("DROPPED", -1))
            continue
        told = [e for e in events if int(e[0]) <= at]
        states.append((told[-1][2], int(told[-1][1])) if told else ("INITIALIZING", -1))
    written = {stamp(line[0]): [float(v) for v in line[1:4]] for line in lines(trajectory)} if trajectory.is_file() else {}
    judge = ["cairn", "evaluate", str(trajectory), str(folder), "--json", "--quiet", "--plot", str(out / "plot.png")]
    judged = subprocess.run(judge, stdin=subprocess.DEVNULL, capture_output=True, text=True).stdout if written else ""
    alignment = json.loads(judged).get("alignment") if judged.startswith("{") else None
    return states, joins, written, alignment


def stamp(text):
    return round(float(text), 3)


def whole(folder, depths):
    """Median depth at the start of the map of the unspoilt recording, m."""
    if folder not in depths:
        with tempfile.TemporaryDirectory() as out:
            depths[folder] = replay(folder, pathlib.Path(out))[3]["scale"]
    return depths[folder]


def recording(folder, at, frames):
    """A recording at `at` with these lines of pictures and everything else of `folder`."""
    at.mkdir(exist_ok=True)
    for entry in folder.iterdir():
        if entry.name != "rgb.txt" and not (at / entry.name).exists():
            (at / entry.name).symlink_to(entry.resolve())
    (at / "rgb.txt").write_text("".join(" ".join(f) + "\n" for f in frames))
    return at


def error_at(written, alignment, frame, pose):
    """Distance of a written pose from the truth, m; None: not written or no truth."""
    if alignment is None or pose is None or stamp(frame[0]) not in written:
        return None
    moved = turned(alignment["rotation_xyzw"], written[stamp(frame[0])])
    return math.dist([alignment["scale"] * a + b for a, b in zip(moved, alignment["translation_m"])], pose[0])


def cases(way, folder, seed, depth):
    truth = Truth(folder)
    frames = lines(folder / "rgb.txt")
    places = cuts(len(frames), seed)
    spoilt = {i for a, b in places for i in range(a, b)}
    with tempfile.TemporaryDirectory() as out:
        out = pathlib.Path(out)
        again = recording(folder, out / "again", [])
        if way == "blur":
            kept, shown = list(range(len(frames))), blurred(folder, again, truth, frames, places, depth)
        else:
            kept = [i for i in range(len(frames)) if i not in spoilt]
            shown = [frames[i] for i in kept]
        recording(folder, again, shown)
        states, joins, written, alignment = replay(again, out)
        poses = [truth.at(float(f[0])) for f in shown]
        for n, (begin, end) in enumerate(places):
            first, after = bisect.bisect_left(kept, begin), bisect.bisect_left(kept, end)
            limit = bisect.bisect_left(kept, places[n + 1][0]) if n + 1 < len(places) else len(kept)
            if not first or states[first - 1][0] != "TRACKING":
                yield "lost before", None
                continue
            own = states[first - 1][1]
            known = [poses[i] for i in range(first) if states[i] == ("TRACKING", own) and poses[i]][::3]
            back = next((i for i in range(after, limit)
                         if poses[i] and any(truth.overlap(poses[i], k, depth) >= 0.5 for k in known)), None)
            one = all(any(stamp(shown[i][0]) in written for i in range(*side)) for side in ((max(0, first - 10), first), (limit - 10, limit)))
            found = next((i for i in range(after, limit) if states[i] == ("TRACKING", own) or one and i in joins), None)
            if back is None and found is None:
                yield "never came back", None
                continue
            error = None
            if found is not None:
                error = error_at(written, alignment, shown[found], poses[found])
                if error is None and poses[found]:
                    # The trajectory at the end is another map's.
                    short = recording(folder, again, shown[: found + BEYOND])
                    error = error_at(*replay(short, out)[2:], shown[found], poses[found])
            waited = math.inf if found is None else max(0, found - (back if back is not None else found))
            lost = any(states[i] not in (("TRACKING", own), ("DROPPED", -1)) for i in range(first, after + 1))
            yield "came back", (waited, error and error / depth, one, lost)


def waits(told):
    """Median and 90 % quantile of frames, as text."""
    ordered = sorted(waited for waited, *_ in told)
    if not ordered:
        return "–"
    of = lambda share: ordered[min(len(ordered) - 1, int(share * len(ordered)))]  # noqa: E731
    return " / ".join("never" if math.isinf(w) else str(w) for w in (of(0.5), of(0.9)))


def row(found):
    told = [case for kind, case in found if kind == "came back"]
    right = [waited for waited, error, *_ in told if error is not None and error <= WRONG]
    return [len(found), sum(kind == "lost before" for kind, _ in found), len(told), sum(lost for *_, lost in told),
            sum(w < SOON for w in right), sum(w < LATE for w in right), waits(told),
            sum(error is not None and error > WRONG for _, error, *_ in told),
            sum(error is None and waited < math.inf for waited, error, *_ in told), sum(one for _, _, one, _ in told)]


def main():
    if len(sys.argv) < 4 or sys.argv[1] not in ("cut", "blur"):
        sys.exit(__doc__)
    way, (first, _, last) = sys.argv[1], sys.argv[2].partition("-")
    seeds = range(int(first), int(last or first) + 1)
    heads = ["recording", "places", "lost before", "came back", "lost in it", "known within 3 frames", "within 60",
             "frames, median / 90 %", "wrong", "not judged", "one trajectory"]
    print("| " + " | ".join(heads) + " |\n|---|" + "---:|" * (len(heads) - 1))
    everything, depths = [], {}
    for folder in map(pathlib.Path, sys.argv[3:]):
        found = [case for seed in seeds for case in cases(way, folder, seed, whole(folder, depths))]
        print(f"| {folder.name} | {' | '.join(map(str, row(found)))} |", flush=True)
        everything += found
    print(f"| all | {' | '.join(map(str, row(everything)))} |")


if __name__ == "__main__":
    main()
