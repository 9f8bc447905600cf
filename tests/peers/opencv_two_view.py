#!/usr/bin/env python3
"""Relative pose of picture pairs by OpenCV, to stand beside `cairn compare` on the same pairs.

ORB, brute-force Hamming matching (cross-check, or both ways with a ratio test), findEssentialMat (RANSAC, 1 px,
confidence 0.9999) and recoverPose; the median of several seeds, because one run is one draw.

    pip install opencv-python-headless numpy
    python3 tests/peers/opencv_two_view.py LIST [--features 2000] [--rule ratio|cross] [--seeds 5]

LIST: one pair a line, "pictureA pictureB rotationA rotationB K_A(9) K_B(9) second_from_first(16)", pictures beside the
list. Prints a Markdown table. Exit code 77 (skipped) where OpenCV is not installed.
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


def pairs(path):
    for line in path.read_text().splitlines():
        fields = line.split()
        if len(fields) != 38:
            continue
        numbers = np.array([float(v) for v in fields[2:]])
        yield fields[0], fields[1], numbers[2:11].reshape(3, 3), numbers[11:20].reshape(3, 3), numbers[20:].reshape(4, 4)


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


def relative_pose(points_a, points_b, k_a, k_b, seed):
    cv2.setRNGSeed(seed)
    if len(points_a) < 8:
        return None
    a = cv2.undistortPoints(points_a.reshape(-1, 1, 2), k_a, None)
    b = cv2.undistortPoints(points_b.reshape(-1, 1, 2), k_b, None)
    focal = (k_a[0, 0] + k_a[1, 1] + k_b[0, 0] + k_b[1, 1]) / 4
    essential, mask = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=1.0 / focal)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, np.eye(3), mask=mask.copy())
    return rotation, translation.ravel(), int(mask.sum())


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("list", type=pathlib.Path)
    arguments.add_argument("--features", type=int, default=2000)
    arguments.add_argument("--rule", choices=["ratio", "cross"], default="ratio")
    arguments.add_argument("--seeds", type=int, default=5)
    arguments = arguments.parse_args()
    print(f"OpenCV {cv2.__version__}, ORB {arguments.features}, {arguments.rule}, median of {arguments.seeds} seeds\n")
    print("| pair | matches | inliers | rotation ° | translation ° | ms |\n|---|---:|---:|---:|---:|---:|")
    worst = (180.0, 180.0, 0)
    rows = []
    for name_a, name_b, k_a, k_b, truth in pairs(arguments.list):
        picture_a, picture_b = (cv2.imread(str(arguments.list.parent / n), cv2.IMREAD_GRAYSCALE) for n in (name_a, name_b))
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
            found = relative_pose(points_a, points_b, k_a, k_b, seed)
            if found is None:
                errors.append(worst)
                continue
            rotation, translation, inliers = found
            angle = math.degrees(math.acos(max(-1.0, min(1.0, (np.trace(rotation @ truth[:3, :3].T) - 1) / 2))))
            errors.append((angle, degrees_between(translation, truth[:3, 3]), inliers))
        ms = features_ms + 1e3 * (time.perf_counter() - begin) / arguments.seeds
        row = [float(np.median([e[k] for e in errors])) for k in range(3)]
        rows.append(row)
        print(f"| {name_a} {name_b} | {len(matches)} | {row[2]:.0f} | {row[0]:.2f} | {row[1]:.2f} | {ms:.0f} |")
    if rows:
        print(f"| median | | | {np.median([r[0] for r in rows]):.2f} | {np.median([r[1] for r in rows]):.2f} | |")


if __name__ == "__main__":
    main()
