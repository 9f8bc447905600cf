#!/usr/bin/env python3
"""Relative pose of picture pairs by OpenCV, to stand beside `cairn compare` on the same pairs.

ORB, brute-force Hamming matching (cross-check, or both ways with a ratio test), findEssentialMat (RANSAC, 1 px,
confidence 0.9999) and recoverPose; the median of several seeds, because one run is one draw.

    pip install opencv-python-headless numpy
    python3 tests/peers/opencv_two_view.py PATH... [--features 2000] [--rule ratio|cross] [--seeds 5] [--step 15] [--pairs 10]

PATH: a list, one pair a line, "pictureA pictureB rotationA rotationB K_A(9) K_B(9) second_from_first(16)", pictures
beside it; or a sequence's folder (rgb.txt, groundtruth.txt, camera.yaml), whose pairs are those that `cairn compare
--step --pairs` takes. Points are undistorted. Prints a Markdown table; a pair without a pose counts as 180 degrees.
Exit code 77 (skipped) where OpenCV is not installed.
"""
import argparse
import math
import pathlib
import sys
import time

try:
    import cv2
    import numpy as np
except ImportError as error:
    print(f"skipped: {error}")
    sys.exit(77)


def pairs(path, step, count):
    """Pictures' paths, K of both, distortion of both, second_from_first."""
    if path.is_dir():
        yield from sequence(path, step, count)
        return
    for line in path.read_text().splitlines():
        fields = line.split()
        if len(fields) != 38:
            continue
        numbers = np.array([float(v) for v in fields[2:]])
        yield (path.parent / fields[0], path.parent / fields[1], numbers[2:11].reshape(3, 3), numbers[11:20].reshape(3, 3),
               None, numbers[20:].reshape(4, 4))


def lines_of(path):
    for line in path.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            yield line.split()


def sequence(folder, step, count):
    camera = {k.strip(): v.strip() for k, _, v in (l.partition(":") for l in (folder / "camera.yaml").read_text().splitlines())}
    fx, fy, cx, cy = (float(camera[k].split("#")[0]) for k in ("fx", "fy", "cx", "cy"))
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    text = camera["distortion"]
    lens = np.array([float(v) for v in text[text.index("[") + 1:text.index("]")].split(",")])
    frames = [(float(t), folder / name) for t, name in lines_of(folder / "rgb.txt")]
    poses = [[float(v) for v in line] for line in lines_of(folder / "groundtruth.txt")]
    times = np.array([p[0] for p in poses])

    def pose(time):
        at = int(np.argmin(np.abs(times - time)))
        if abs(times[at] - time) > 0.02:
            return None
        _, tx, ty, tz, x, y, z, w = poses[at]
        x, y, z, w = np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])
        out = np.eye(4)
        out[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                       [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                       [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
        out[:3, 3] = tx, ty, tz
        return out

    last = max(len(frames) - step - 1, 0)
    count = max(min(count, last + 1), 1)
    for i in range(count):
        at = i * last // (count - 1) if count > 1 else 0
        if at + step >= len(frames):
            continue
        a, b = pose(frames[at][0]), pose(frames[at + step][0])
        if a is not None and b is not None:
            yield frames[at][1], frames[at + step][1], k, k, lens, np.linalg.inv(b) @ a


def match(descriptors_a, descriptors_b, rule):
    if rule == "cross":
        return [(m.queryIdx, m.trainIdx) for m in cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors_a, descriptors_b)]
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def clear(first, second):
        return {m.queryIdx: m.trainIdx for m, n in (p for p in matcher.knnMatch(first, second, k=2) if len(p) == 2) if m.distance < 0.8 * n.distance}

    forward, backward = clear(descriptors_a, descriptors_b), clear(descriptors_b, descriptors_a)
    return [(a, b) for a, b in forward.items() if backward.get(b) == a]


def degrees_between(a, b):
    return math.degrees(math.acos(max(-1.0, min(1.0, float(a @ b) / (np.linalg.norm(a) * np.linalg.norm(b))))))


def relative_pose(points_a, points_b, k_a, k_b, lens, seed):
    cv2.setRNGSeed(seed)
    if len(points_a) < 8:
        return None
    a = cv2.undistortPoints(points_a.reshape(-1, 1, 2), k_a, lens)
    b = cv2.undistortPoints(points_b.reshape(-1, 1, 2), k_b, lens)
    focal = (k_a[0, 0] + k_a[1, 1] + k_b[0, 0] + k_b[1, 1]) / 4
    essential, mask = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=1.0 / focal)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, np.eye(3), mask=mask.copy())
    return rotation, translation.ravel(), int(mask.sum())


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("paths", type=pathlib.Path, nargs="+", metavar="PATH")
    arguments.add_argument("--step", type=int, default=15)
    arguments.add_argument("--pairs", type=int, default=10)
    arguments.add_argument("--features", type=int, default=2000)
    arguments.add_argument("--rule", choices=["ratio", "cross"], default="ratio")
    arguments.add_argument("--seeds", type=int, default=5)
    arguments = arguments.parse_args()
    print(f"OpenCV {cv2.__version__}, ORB {arguments.features}, {arguments.rule}, median of {arguments.seeds} seeds\n")
    print("| pair | matches | inliers | rotation ° | translation ° | ms |\n|---|---:|---:|---:|---:|---:|")
    worst = (180.0, 180.0, 0)
    rows = []
    todo = [pair for path in arguments.paths for pair in pairs(path, arguments.step, arguments.pairs)]
    for path_a, path_b, k_a, k_b, lens, truth in todo:
        picture_a, picture_b = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (path_a, path_b))
        begin = time.perf_counter()
        orb = cv2.ORB_create(arguments.features)
        corners_a, descriptors_a = orb.detectAndCompute(picture_a, None)
        corners_b, descriptors_b = orb.detectAndCompute(picture_b, None)
        matches = match(descriptors_a, descriptors_b, arguments.rule)
        points_a = np.array([corners_a[a].pt for a, _ in matches])
        points_b = np.array([corners_b[b].pt for _, b in matches])
        features_ms = 1e3 * (time.perf_counter() - begin)
        errors = []
        begin = time.perf_counter()
        for seed in range(arguments.seeds):
            found = relative_pose(points_a, points_b, k_a, k_b, lens, seed)
            if found is None:
                errors.append(worst)
                continue
            rotation, translation, inliers = found
            angle = math.degrees(math.acos(max(-1.0, min(1.0, (np.trace(rotation @ truth[:3, :3].T) - 1) / 2))))
            errors.append((angle, degrees_between(translation, truth[:3, 3]), inliers))
        ms = features_ms + 1e3 * (time.perf_counter() - begin) / arguments.seeds
        row = [float(np.median([e[k] for e in errors])) for k in range(3)]
        rows.append(row)
        print(f"| {path_a.stem} {path_b.stem} | {len(matches)} | {row[2]:.0f} | {row[0]:.2f} | {row[1]:.2f} | {ms:.0f} |")
    if rows:
        right = sum(r[0] <= 5 and r[1] <= 10 for r in rows)
        print("\n| way | poses right | rotation ° | translation ° |\n|---|---:|---:|---:|")
        medians = " | ".join(f"{np.median([r[k] for r in rows]):.2f}" for k in range(2))
        print(f"| ORB, {arguments.rule} | {right} of {len(rows)} | {medians} |")
        print("\nMedians over the pairs; a pose is right within 5° of rotation and 10° of translation.")


if __name__ == "__main__":
    main()
