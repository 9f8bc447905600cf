"""What OpenCV makes of a folder of chessboard pictures: corners, calibration, times on one thread.

usage: opencv_chessboard.py FOLDER COLUMNSxROWS EXTENSION; exit code 3: no OpenCV here
lines: picture FILE (corners follow) | c X Y | result RMS FX FY CX CY K1 K2 P1 P2 K3 | sigma ... | time DETECT_MS SOLVE_MS
"""
import glob
import os
import sys
import time

try:
    import cv2
    import numpy as np
except ImportError:
    sys.exit(3)

cv2.setNumThreads(1)
folder, size, extension = sys.argv[1:4]
columns, rows = map(int, size.split("x"))
criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.001)
board = np.zeros((columns * rows, 3), np.float32)
board[:, :2] = np.mgrid[0:columns, 0:rows].T.reshape(-1, 2)
files = sorted(glob.glob(os.path.join(folder, "*." + extension)))
pictures = [cv2.imread(f, cv2.IMREAD_GRAYSCALE) for f in files]
found = []
begin = time.perf_counter()
for name, picture in zip(files, pictures):
    seen, corners = cv2.findChessboardCorners(picture, (columns, rows))
    if seen:
        found.append((name, cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), criteria)))
detected = time.perf_counter()
rms, k, d, _, _, sigma, _, _ = cv2.calibrateCameraExtended(
    [board] * len(found), [c for _, c in found], pictures[0].shape[::-1], None, None
)
solved = time.perf_counter()
for name, corners in found:
    print("picture", os.path.basename(name))
    for x, y in corners.reshape(-1, 2):
        print("c %.9g %.9g" % (x, y))
numbers = [rms, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[:5]]
print("result", *["%.12g" % v for v in numbers])
print("sigma", *["%.12g" % v for v in sigma.ravel()[:9]])
print("time %.3f %.3f" % ((detected - begin) * 1e3, (solved - detected) * 1e3))
