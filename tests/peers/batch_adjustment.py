#!/usr/bin/env python3
"""A batch adjustment over all frames of a recording: what its pictures and its ground truth allow at best.

    pip install pycolmap numpy
    tests/peers/batch_adjustment.py SEQUENCE OUTPUT [--refine]
    cairn evaluate OUTPUT/trajectory.txt SEQUENCE

SIFT features, sequential matching, incremental mapping and global adjustment (COLMAP, by its Python package) with the recording's own
calibration; `--refine` frees focal length and distortion. Writes TUM lines, camera to world. Takes minutes for a hundred frames.
"""
import argparse
import ast
import pathlib

import pycolmap


def camera_of(sequence):
    """COLMAP's parameters of camera.yaml; its pixel centres lie at 0.5."""
    text = (sequence / "camera.yaml").read_text().splitlines()
    values = dict(line.split("#")[0].split(":", 1) for line in text if ":" in line.split("#")[0])
    fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
    distortion = ast.literal_eval(values.get("distortion", "[0, 0, 0, 0, 0]").strip())
    parameters = [fx, fy, cx + 0.5, cy + 0.5, *distortion[:4]]
    if len(distortion) > 4 and distortion[4]:
        return "FULL_OPENCV", [*parameters, distortion[4], 0.0, 0.0, 0.0]
    return "OPENCV", parameters


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=pathlib.Path)
    parser.add_argument("output", type=pathlib.Path)
    parser.add_argument("--refine", action="store_true", help="focal length and distortion too")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    database = arguments.output / "database.db"
    database.unlink(missing_ok=True)

    lines = (arguments.sequence / "rgb.txt").read_text().splitlines()
    stamps = {name: stamp for stamp, name in (line.split()[:2] for line in lines if line.strip() and line[0] != "#")}
    model, parameters = camera_of(arguments.sequence)
    pycolmap.extract_features(
        database,
        arguments.sequence,
        image_names=list(stamps),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(camera_model=model, camera_params=",".join(map(str, parameters))),
        device=pycolmap.Device.cpu,
    )
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap, pairing.quadratic_overlap = 15, True
    pycolmap.match_sequential(database, pairing_options=pairing, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_principal_point = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = arguments.refine
    maps = pycolmap.incremental_mapping(database, arguments.sequence, arguments.output, options=options)
    if not maps:
        raise SystemExit("no map")
    largest = max(maps.values(), key=lambda m: m.num_reg_images())
    print(largest.summary())
    rows = []
    for image in largest.images.values():
        if image.has_pose:
            pose = image.cam_from_world().inverse()
            rows.append((float(stamps[image.name]), stamps[image.name], *pose.translation, *pose.rotation.quat))
    with (arguments.output / "trajectory.txt").open("w") as out:
        for _, stamp, *numbers in sorted(rows):
            out.write(stamp + " " + " ".join(f"{v:.9f}" for v in numbers) + "\n")


if __name__ == "__main__":
    main()
