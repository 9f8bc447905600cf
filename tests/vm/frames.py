"""The pictures that the guest's USB camera sends: a simulated drive, to and fro, as JPEG and YUYV, and one elsewhere; and its calibrations."""

import pathlib
import subprocess
import tempfile

SECONDS, RATE = 3, 15


# A sway long enough to show the focal length, for the scenario that starts without a calibration.
SWAY_SECONDS, SWAY_SEED = 12, 3


def make(binary, target, sway):
    """Writes frames/WxH-NNN.jpg and .yuyv, frames/elsewhere-WxH-NNN.jpg, camera.yaml (of the drive) and vivid.yaml (any, of vivid's size); with
    `sway` also frames/sway-WxH-NNN.jpg."""
    folder = target / "frames"
    folder.mkdir()
    with tempfile.TemporaryDirectory() as work:
        drive, pictures = simulated(binary, work, "hand_held", 1)
        _, elsewhere = simulated(binary, work, "corridor", 2)
        _, swaying = simulated(binary, work, "hand_held", SWAY_SEED, SWAY_SECONDS) if sway else (None, [])
        model = (drive / "camera.yaml").read_text()
        (target / "camera.yaml").write_text(model)
        (target / "camera.toml").write_text(as_toml(model))
    for index, picture in enumerate(to_and_fro(elsewhere)):
        picture.save(folder / f"elsewhere-320x240-{index:03}.jpg", quality=90)
    for index, picture in enumerate(to_and_fro(swaying)):
        picture.save(folder / f"sway-320x240-{index:03}.jpg", quality=90)
    for index, picture in enumerate(to_and_fro(pictures)):
        picture.save(folder / f"320x240-{index:03}.jpg", quality=90)
        luma = picture.tobytes()
        yuyv = bytearray(b"\x80" * (2 * len(luma)))
        yuyv[0::2] = luma
        (folder / f"320x240-{index:03}.yuyv").write_bytes(yuyv)
    for index, picture in enumerate(pictures[:4]):
        picture.resize((640, 480)).save(folder / f"640x480-{index:03}.jpg", quality=80)
    (target / "vivid.yaml").write_text("width: 320\nheight: 180\nfx: 260.0\nfy: 260.0\ncx: 159.5\ncy: 89.5\ndistortion: [0.0, 0.0, 0.0, 0.0, 0.0]\n")


def simulated(binary, work, scenario, seed, seconds=SECONDS):
    """A recording and its pictures; the seed furnishes the place."""
    from PIL import Image  # installed by image.install_host_packages

    drive = pathlib.Path(work) / f"{scenario}-{seed}"
    subprocess.run([binary, "simulate", "--output", drive, "--scenario", scenario, "--seed", str(seed), "--seconds", str(seconds),
                    "--size", "320x240", "--rate", str(RATE)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return drive, [Image.open(path).convert("L") for path in sorted((drive / "rgb").glob("*.png"), key=number)]


def to_and_fro(pictures):
    """So that the last is next to the first."""
    return pictures + pictures[-2:0:-1]


def number(path):
    return float(path.stem)


def as_toml(text):
    """A camera.yaml of the simulator's as the daemon's own TOML, for the USB camera of usb_camera.py whatever its serial number."""
    lines = ['camera = "1d6b:0102"']
    for line in text.splitlines():
        key, _, value = line.partition(": ")
        if key in ("width", "height", "fx", "fy", "cx", "cy", "distortion"):
            lines.append(f"{key}{'' if key == 'distortion' else '_px'} = {value}")
    return "\n".join(lines) + "\n"
