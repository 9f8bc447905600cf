#!/usr/bin/env python3
"""Makes harder recordings of recordings: fewer pictures a second, gaps, other starts, small, dark, blurred, backwards, mirrored, with somebody who walks past.

    tests/results/derived.py make OUT DIR...     DIR: a recording in TUM layout with ground truth and camera.yaml
    tests/results/derived.py table RESULTS       RESULTS: what `cairn evaluate --suite OUT/* --output` left there

Names are RECORDING.KIND, with a number where a kind is made several times. Nothing in them is random but for a seed made of the name, so the same
recordings give the same pictures. Halves: every second name in alphabetical order within a kind, so that something can be chosen on half A and judged on
half B. `table` prints for each kind and half the coverage, the live coverage and the geometric mean of the errors as Markdown; an error is compared
between two commits only where both tracked, so keep their `results.json`: a third argument, another such folder, adds the ratio to it.

| kind | what |
|---|---|
| every2 to every8 | every 2nd to 8th picture |
| gaps | four times up to a second of pictures is missing |
| from20, from40, from60 | begins after that much of its frames, % |
| half, small | half the size; 416 px wide |
| dark | 0.3 times as bright, with noise of 2.5 grey levels |
| hunting | exposure swings between 0.6 and 1.5 times in three seconds |
| long | every third picture, the mean of three: an exposure as long as the time between frames |
| back | backwards in time |
| mirror | left and right exchanged |
| passing33 | somebody walks past every five seconds, within two, from the first picture on, over a third of the picture's width; looks like another of its pictures upside down in a mirror |
| passing50 | the same over half of the width, from 2.5 s on |
"""

import json
import math
import os
import pathlib
import random
import re
import sys

EVERY = {"every2": 2, "every3": 3, "every4": 4, "every6": 6, "every8": 8}
FROM = {"from20": 0.2, "from40": 0.4, "from60": 0.6}
# The shortest recording that says something, frames.
LEAST = 20
PICTURES = ("half", "small", "dark", "hunting", "long", "mirror")


def rows(path):
    return [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]


class Recording:
    def __init__(self, folder):
        self.folder, self.name = folder.resolve(), folder.name
        self.frames = [(float(time), self.folder / picture) for time, picture in rows(folder / "rgb.txt")]
        self.truth = [[float(v) for v in row] for row in rows(folder / "groundtruth.txt")]
        text = (folder / "camera.yaml").read_text()
        self.camera = {key: float(re.search(rf"^\s*{key}:\s*([\d.eE+-]+)", text, re.MULTILINE)[1]) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        found = re.search(r"^\s*distortion:\s*\[(.*)\]", text, re.MULTILINE)
        self.distortion = [float(v) for v in found[1].split(",")] if found else [0.0] * 5


def write(folder, frames, truth, camera, distortion):
    """`frames`: time and picture, a file that is linked to or an array that is written."""
    import cv2

    (folder / "rgb").mkdir(parents=True)
    lines = []
    for n, (time, picture) in enumerate(frames):
        if isinstance(picture, pathlib.Path):
            name = f"rgb/{n:05d}{picture.suffix}"
            (folder / name).symlink_to(picture)
        else:
            name = f"rgb/{n:05d}.jpg"
            cv2.imwrite(str(folder / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
        lines.append(f"{time:.6f} {name}\n")
    (folder / "rgb.txt").write_text("".join(lines))
    (folder / "groundtruth.txt").write_text("".join(" ".join(f"{v:.7f}" for v in row) + "\n" for row in truth))
    numbers = "".join(f"{key}: {value:.0f}\n" if key in ("width", "height") else f"{key}: {value}\n" for key, value in camera.items())
    (folder / "camera.yaml").write_text(numbers + f"distortion: {distortion}\n")


def resized(camera, width):
    """Of a picture so wide; a pixel's centre is a whole number."""
    factor = width / camera["width"]
    return {"width": width, "height": round(camera["height"] * factor), "fx": camera["fx"] * factor, "fy": camera["fy"] * factor,
            "cx": (camera["cx"] + 0.5) * factor - 0.5, "cy": (camera["cy"] + 0.5) * factor - 0.5}


def without_gaps(frames, name):
    chance = random.Random(name)
    spans = [(at := int(len(frames) * share) + chance.randrange(max(1, len(frames) // 20)), at + chance.randint(3, min(30, max(4, len(frames) // 8))))
             for share in (0.2, 0.4, 0.6, 0.8)]
    return [frame for n, frame in enumerate(frames) if not any(begin <= n < end for begin, end in spans)]


class Passer:
    """Walks past: as wide as `share` of the picture, from below to near its upper edge, from the left and from the right by turns."""

    EVERY_S, TAKES_S = 5.0, 2.0

    def __init__(self, cut_from, share):
        import cv2
        import numpy

        self.height, self.width = cut_from.shape
        wide = int(share * self.width)
        left = (self.width - wide) // 2
        # Upside down, in a mirror: nothing of the scene is to be known again in it.
        self.looks = cut_from[::-1, left:left + wide].astype(float)
        # A body with a head, its edge a few pixels soft.
        body = numpy.zeros((self.height, wide), numpy.uint8)
        cv2.ellipse(body, (wide // 2, self.height), (wide // 2 - 4, int(0.7 * self.height)), 0, 0, 360, 255, -1)
        cv2.ellipse(body, (wide // 2, int(0.27 * self.height)), (wide // 4, int(0.2 * self.height)), 0, 0, 360, 255, -1)
        self.covers = cv2.GaussianBlur(body, (0, 0), 1.5).astype(float) / 255

    def before(self, picture, time):
        import numpy

        pass_number, into = divmod(time, self.EVERY_S)
        if into > self.TAKES_S:
            return picture
        wide = self.looks.shape[1]
        share = into / self.TAKES_S if pass_number % 2 == 0 else 1 - into / self.TAKES_S
        left = round(share * (self.width + wide)) - wide
        begin, end = max(left, 0), min(left + wide, self.width)
        out = picture.astype(float)
        covers, looks = (a[:, begin - left:end - left] for a in (self.covers, self.looks))
        out[:, begin:end] += covers * (looks - out[:, begin:end])
        return numpy.clip(numpy.rint(out), 0, 255).astype(numpy.uint8)


def derived(recording):
    """Kind, frames, truth, camera, distortion."""
    import cv2
    import numpy

    frames, truth, camera, distortion = recording.frames, recording.truth, recording.camera, recording.distortion
    for kind, step in EVERY.items():
        for offset in (0, step // 2):
            yield f"{kind}-{offset}", frames[offset::step], truth, camera, distortion
    for kind, share in FROM.items():
        yield kind, frames[int(share * len(frames)):], truth, camera, distortion
    yield "gaps", without_gaps(frames, recording.name), truth, camera, distortion
    first, last = frames[0][0], frames[-1][0]
    back = lambda time: first + last - time  # noqa: E731
    yield "back", [(back(time), path) for time, path in reversed(frames)], [[back(row[0]), *row[1:]] for row in reversed(truth)], camera, distortion
    grey = lambda path: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)  # noqa: E731
    for kind, width in (("half", camera["width"] // 2), ("small", 416)):
        other = resized(camera, int(width))
        size = int(other["width"]), int(other["height"])
        yield kind, [(time, cv2.resize(grey(path), size, interpolation=cv2.INTER_AREA)) for time, path in frames], truth, other, distortion
    noise = numpy.random.default_rng(len(frames))
    clipped = lambda picture: numpy.clip(numpy.rint(picture), 0, 255).astype(numpy.uint8)  # noqa: E731
    yield "dark", [(time, clipped(0.3 * grey(path) + noise.normal(0, 2.5, grey(path).shape))) for time, path in frames], truth, camera, distortion
    gain = lambda time: 1.05 + 0.45 * math.sin(2 * math.pi * (time - first) / 3)  # noqa: E731
    yield "hunting", [(time, clipped(gain(time) * grey(path))) for time, path in frames], truth, camera, distortion
    threes = [frames[n:n + 3] for n in range(0, len(frames) - 2, 3)]
    mean = lambda three: clipped(sum(grey(path).astype(float) for _, path in three) / 3)  # noqa: E731
    yield "long", [(three[1][0], mean(three)) for three in threes], truth, camera, distortion
    for kind, share, phase in (("passing33", 0.33, 0.0), ("passing50", 0.5, 2.5)):
        passer = Passer(grey(frames[len(frames) // 2][1]), share)
        yield kind, [(time, passer.before(grey(path), time - first + phase)) for time, path in frames], truth, camera, distortion
    # A reflection x -> -x of the camera's axes and of the world's keeps rotations rotations; p2 is the tangential term that changes its sign.
    k1, k2, p1, p2, k3 = distortion
    mirrored = [[t, -x, y, z, qx, -qy, -qz, qw] for t, x, y, z, qx, qy, qz, qw in truth]
    yield ("mirror", [(time, cv2.flip(grey(path), 1)) for time, path in frames], mirrored, camera | {"cx": camera["width"] - 1 - camera["cx"]},
           [k1, k2, p1, -p2, k3])


def make(out, folders):
    for recording in map(Recording, folders):
        for kind, *what in derived(recording):
            folder = out / f"{recording.name}.{kind}"
            if len(what[0]) >= LEAST and not folder.exists():
                write(folder, *what)
                print(folder.name, file=sys.stderr, flush=True)


def read(folder):
    """By name: coverage, live coverage, error or None."""
    found = {}
    for row in json.loads((folder / "results.json").read_text())["sequences"]:
        evaluation, live = row.get("evaluation") or {}, row.get("live") or {}
        error = (evaluation.get("ate_m") or {}).get("rmse")
        found[row["name"]] = evaluation.get("coverage_percent") or 0.0, live.get("coverage_percent") or 0.0, error
    return found


def halves(names):
    kinds = {}
    for name in sorted(names):
        kinds.setdefault(re.sub(r"-\d+$", "", name.rpartition(".")[2]), []).append(name)
    return {(kind, half): members[n::2] for kind, members in kinds.items() for n, half in enumerate("AB")}


def table(folder, before):
    now, then = read(folder), read(before) if before else {}
    groups = halves(now)
    for half in "AB":
        groups["all", half] = [name for (kind, h), names in groups.items() if h == half and kind != "all" for name in names]
    mean = lambda values: sum(values) / len(values) if values else math.nan  # noqa: E731
    geometric = lambda values: math.exp(mean([math.log(v) for v in values])) if values else math.nan  # noqa: E731
    more = " | coverage before | live before | error, ratio where both tracked" if before else ""
    print(f"| kind | half | recordings | coverage % | live % | error m, geometric mean{more} |\n|---|---|" + "---:|" * (4 + 3 * bool(before)))
    for (kind, half), names in groups.items():
        if not names:
            continue
        cells = [kind, half, len(names), f"{mean([now[n][0] for n in names]):.1f}", f"{mean([now[n][1] for n in names]):.1f}",
                 f"{geometric([now[n][2] for n in names if now[n][2]]):.4f}"]
        if before:
            both = [n for n in names if n in then and now[n][2] and then[n][2]]
            cells += [f"{mean([then[n][0] for n in names if n in then]):.1f}", f"{mean([then[n][1] for n in names if n in then]):.1f}",
                      f"{geometric([now[n][2] / then[n][2] for n in both]):.3f}"]
        print("| " + " | ".join(map(str, cells)) + " |")


def main():
    words = sys.argv[1:]
    if len(words) >= 3 and words[0] == "make":
        return make(pathlib.Path(words[1]), [pathlib.Path(word) for word in words[2:]])
    if len(words) in (2, 3) and words[0] == "table":
        return table(pathlib.Path(words[1]), pathlib.Path(words[2]) if len(words) == 3 else None)
    sys.exit(__doc__)


if __name__ == "__main__":
    main()
