"""Draws map and path live, from above.

    python plot.py [--seconds S] [--save FILE.png]         CAIRN_PREFIX says which daemon; needs matplotlib
"""

import argparse
import time

import matplotlib

import cairn


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--seconds", type=float, default=float("inf"))
    arguments.add_argument("--save", help="write the last picture; no window")
    arguments = arguments.parse_args()
    if arguments.save:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 7))
    cloud = axes.scatter([], [], s=2, c="grey", label="landmarks")
    (path,) = axes.plot([], [], "b-", label="path")
    (robot,) = axes.plot([], [], "r>", markersize=9, label="robot")
    axes.set(xlabel="x forward, map units", ylabel="y left, map units", aspect="equal")
    axes.legend(loc="upper right")

    client = cairn.connect()
    poses, maps = client.poses(), client.map()
    walked, resets, drawn = [], None, 0.0
    end = time.monotonic() + arguments.seconds
    while time.monotonic() < end and (arguments.save or plt.fignum_exists(figure.number)):
        pose = poses.wait(0.1)
        if pose is not None and pose.tracking:
            if resets != pose.reset_counter:
                walked, resets = [], pose.reset_counter  # poses across a reset are unrelated
            walked.append(pose.position[:2])
        if time.monotonic() - drawn < 0.1:
            continue
        drawn = time.monotonic()
        landmarks = maps.latest()
        if landmarks is not None and len(landmarks):
            points = landmarks.points[landmarks.observations >= 3, :2]
            cloud.set_offsets(points)
            axes.set_title(f"map {landmarks.map_id}, {len(landmarks)} landmarks")
        if walked:
            x, y = zip(*walked)
            path.set_data(x, y)
            robot.set_data(x[-1:], y[-1:])
            size = max(5.0, 1.5 * max(map(abs, x)), 1.5 * max(map(abs, y)))
            axes.set(xlim=(-size, size), ylim=(-size, size))
        if not arguments.save:
            plt.pause(0.001)
    if arguments.save:
        figure.savefig(arguments.save)
        print(f"{arguments.save}: {len(walked)} poses, {len(cloud.get_offsets())} landmarks")
    return 0 if walked or not arguments.save else 1


if __name__ == "__main__":
    raise SystemExit(main())
