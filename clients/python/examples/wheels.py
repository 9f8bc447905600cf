"""A base's driver in three lines. It may be started before the daemon, and survives the daemon's restarts.

python wheels.py [--seconds S]                         CAIRN_PREFIX says which daemon
"""

import argparse
import time

import cairn


def read_encoders():
    """Stands for the robot's own: the mean speed forward, m/s, and turn to the left, rad/s, since the last time."""
    time.sleep(0.02)
    return 0.3, 0.1


parser = argparse.ArgumentParser()
parser.add_argument("--seconds", type=float, default=float("inf"))
end = time.monotonic() + parser.parse_args().seconds
wheels = cairn.connect().wheels()
heard = 0
while time.monotonic() < end:
    speed, turn = read_encoders()
    heard += wheels.send(speed, 0.0, turn)
print(f"{heard} messages to a daemon that was there")
