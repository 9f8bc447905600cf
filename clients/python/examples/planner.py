"""A toy planner: drives to a goal in the map and keeps away from mapped points.

    python planner.py GOAL_X GOAL_Y [--seconds S]          map units; CAIRN_PREFIX says which daemon

Every pose it looks ahead along a fan of arcs, drops those that come close to mapped points, and takes the one that ends nearest
to the goal. It prints what a robot's wheels would be told. A sketch: one camera's map is sparse, and a bare wall is not in it.
"""

import argparse
import time

import numpy as np

import cairn

SPEED = 0.5  # map units/s
TURNS = np.linspace(-1.0, 1.0, 21)  # rad/s
AHEAD = np.linspace(0.1, 2.0, 20)  # s
CLEARANCE = 0.3  # map units
HEIGHT = 0.5  # points this far above and below the body are in the way


def arcs():
    """Places in the body's axes, (turns, times, 2)."""
    angle = TURNS[:, None] * AHEAD[None, :]
    radius = SPEED / np.where(np.abs(TURNS) < 1e-6, 1.0, TURNS)[:, None]
    straight = np.stack([SPEED * AHEAD[None, :] + 0 * angle, 0 * angle], axis=-1)
    bent = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle))], axis=-1)
    return np.where((np.abs(TURNS) < 1e-6)[:, None, None], straight, bent)


ARCS = arcs()


def steer(pose, points, goal):
    """Speed and turn rate; (0, 0) when every arc is blocked."""
    body_from_map = np.linalg.inv(pose.map_from_body)
    goal = body_from_map[:2, :2] @ goal + body_from_map[:2, 3]
    seen = points @ body_from_map[:3, :3].T + body_from_map[:3, 3]
    near = (np.abs(seen[:, 2]) < HEIGHT) & (np.hypot(seen[:, 0], seen[:, 1]) < SPEED * AHEAD[-1] + CLEARANCE)
    obstacles = seen[near, :2]
    gap = np.full(len(TURNS), np.inf)
    if len(obstacles):
        gap = np.linalg.norm(ARCS[:, :, None] - obstacles[None, None], axis=-1).min(axis=(1, 2))
    cost = np.linalg.norm(ARCS[:, -1] - goal, axis=-1)
    cost[gap < CLEARANCE] = np.inf
    best = int(cost.argmin())
    return (SPEED, float(TURNS[best])) if np.isfinite(cost[best]) else (0.0, 0.0)


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("goal", type=float, nargs=2)
    arguments.add_argument("--seconds", type=float, default=float("inf"))
    arguments = arguments.parse_args()
    client = cairn.connect()
    poses, maps = client.poses(), client.map()
    steered, end = 0, time.monotonic() + arguments.seconds
    while time.monotonic() < end:
        pose = poses.wait(0.5)
        landmarks = maps.latest()
        if pose is None or not pose.usable(0.2) or landmarks is None:
            turned = "" if pose is None or pose.heading is None else f", turned by {np.degrees(pose.heading):.0f} degrees"
            print(f"stop: no pose to drive by{turned}", flush=True)
            continue
        # Points that few keyframes have seen are often wrong.
        points = landmarks.points[landmarks.observations >= 3]
        speed, turn = steer(pose, points, np.array(arguments.goal))
        x, y, _ = pose.position
        print(f"x {x:6.2f} y {y:6.2f}  {len(points):4} points -> speed {speed:.1f} turn {turn:+.1f}", flush=True)
        steered += 1
    return 0 if steered or not np.isfinite(arguments.seconds) else 1


if __name__ == "__main__":
    raise SystemExit(main())
