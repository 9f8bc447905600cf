"""What OpenCV's fisheye module makes of chessboard corners, and where it puts points: its model is the one that must be met.

usage: opencv_fisheye.py WIDTHxHEIGHT < lines: view | c COLUMN ROW X Y; exit code 3: no OpenCV here
lines: result RMS FX FY CX CY K1 K2 K3 K4 | time SOLVE_MS
"""
import sys
import time

try:
    import cv2
    import numpy as np
except ImportError:
    sys.exit(3)

cv2.setNumThreads(1)
width, height = map(int, sys.argv[1].split("x"))
boards, pixels = [], []
for line in sys.stdin:
    words = line.split()
    if words[0] == "view":
        boards.append([])
        pixels.append([])
    else:
        column, row, x, y = map(float, words[1:])
        boards[-1].append((column, row, 0.0))
        pixels[-1].append((x, y))
shape = lambda lists, n: [np.array(points, np.float64).reshape(1, -1, n) for points in lists]
# OpenCV 5 has them beside those of the other models, with other values.
names = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
flags = names.CALIB_RECOMPUTE_EXTRINSIC + names.CALIB_FIX_SKEW
criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 300, 1e-12)
begin = time.perf_counter()
rms, k, d, _, _ = cv2.fisheye.calibrate(
    shape(boards, 3), shape(pixels, 2), (width, height), np.zeros((3, 3)), np.zeros((4, 1)), flags=flags, criteria=criteria
)
solved = time.perf_counter()
print("result", *["%.12g" % v for v in [rms, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()]])
print("time %.3f" % ((solved - begin) * 1e3))
