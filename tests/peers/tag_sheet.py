"""Sheets of `cairn tag`, drawn by MuPDF and read by OpenCV: number, true size, which side is up.

usage: tag_sheet.py --cairn PATH; needs PyPI's opencv-python-headless and pymupdf
"""
import argparse
import pathlib
import subprocess
import sys
import tempfile

import cv2
import numpy as np
import pymupdf

DPI = 200
# OpenCV keeps the family's pictures turned by a half: its first corner is our third, the lower right one.
FIRST_CORNER = 2


def drawn(sheet):
    """The sheet as grey pixels, DPI of them an inch of what it says to be its size."""
    pixmap = pymupdf.open(sheet)[0].get_pixmap(dpi=DPI, colorspace=pymupdf.csGRAY, alpha=False)
    return np.frombuffer(pixmap.samples, np.uint8).reshape(pixmap.height, pixmap.stride)[:, :pixmap.width].copy()


def check(cairn, folder, number, size_m):
    sheet = folder / f"{number}.svg"
    subprocess.run([cairn, "tag", "--print", str(number), "--size", str(size_m), "--output", sheet], check=True, stdin=subprocess.DEVNULL,
                   stdout=subprocess.DEVNULL)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)
    found, numbers, _ = detector.detectMarkers(drawn(sheet))
    assert numbers is not None and numbers.ravel().tolist() == [number], f"{number}: read as {numbers}"
    corners = np.roll(found[0].reshape(4, 2), -FIRST_CORNER, axis=0)
    across, down = corners[1] - corners[0], corners[3] - corners[0]
    assert across[0] > 0 and down[1] > 0 and abs(across[1]) < 3 and abs(down[0]) < 3, f"{number}: not upright: {corners.tolist()}"
    for side in (across, down):
        read_m = np.linalg.norm(side) / DPI * 0.0254
        assert abs(read_m / size_m - 1) < 0.01, f"{number}: {size_m} m is drawn as {read_m:.5f} m"
    print(f"tag {number}, {size_m} m: read, upright, {np.linalg.norm(across) / DPI * 0.0254:.5f} m")


def refused(cairn, folder, number, size, word):
    output = folder / "refused.svg"
    told = subprocess.run([cairn, "tag", "--print", number, "--size", size, "--output", output], stdin=subprocess.DEVNULL, capture_output=True,
                          text=True)
    assert told.returncode == 64 and word in told.stderr and not output.exists(), (number, size, told)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cairn", required=True)
    cairn = parser.parse_args().cairn
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        for number, size_m in [(0, 0.15), (7, 0.05), (42, 0.0945), (300, 0.3), (586, 0.1)]:
            check(cairn, folder, number, size_m)
        refused(cairn, folder, "587", "0.15", "0 to 586")
        refused(cairn, folder, "3", "150", " m: must lie in")
        refused(cairn, folder, "3", "NaN", " m: must lie in")


if __name__ == "__main__":
    sys.exit(main())
