"""What OpenCV makes of a folder of chessboard pictures: corners, calibration, times on one thread.

usage: opencv_chessboard.py FOLDER COLUMNSxROWS EXTENSION; exit code 3: no OpenCV here
lines: picture FILE (corners follow) | c X Y | result RMS FX FY CX CY K1 K2 P1 P2 K3 | sigma ... | time DETECT_MS SOLVE_MS;
model NAME RMS FX ...: the same with fewer coefficients, solved to the end
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


def detect():
    found = []
    for name, picture in zip(files, pictures):
        seen, corners = cv2.findChessboardCorners(picture, (columns, rows))
        if seen:
            found.append((name, cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), criteria)))
    return found


def shortest_of_three(work):
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        result = work()
        times.append((time.perf_counter() - begin) * 1e3)
    return result, min(times)


model_flags = {
    "none": cv2.CALIB_ZERO_TANGENT_DIST + cv2.CALIB_FIX_K1 + cv2.CALIB_FIX_K2 + cv2.CALIB_FIX_K3,
    "radial": cv2.CALIB_ZERO_TANGENT_DIST + cv2.CALIB_FIX_K3,
    "radial-tangential": cv2.CALIB_FIX_K3,
    "full": 0,
}
# To the end: the default of 30 steps is not always there.
to_the_end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 300, 1e-15)


def calibrate(flags, **options):
    corners = [c for _, c in found]
    size = pictures[0].shape[::-1]
    rms, k, d, _, _, sigma, _, _ = cv2.calibrateCameraExtended(
        [board] * len(found), corners, size, None, None, flags=flags, **options
    )
    return [rms, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[:5]], sigma.ravel()[:9]


found, detect_ms = shortest_of_three(detect)
(numbers, sigma), solve_ms = shortest_of_three(lambda: calibrate(0))
models = {name: calibrate(flags, criteria=to_the_end)[0] for name, flags in model_flags.items()}
for name, corners in found:
    print("picture", os.path.basename(name))
    for x, y in corners.reshape(-1, 2):
        print("c %.9g %.9g" % (x, y))
print("result", *["%.12g" % v for v in numbers])
print("sigma", *["%.12g" % v for v in sigma])
for name, model in models.items():
    print("model", name, *["%.12g" % v for v in model])
print("time %.3f %.3f" % (detect_ms, solve_ms))
