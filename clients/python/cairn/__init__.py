"""Pose, map and pictures of the Cairn SLAM daemon, out of shared memory.

    for pose in cairn.poses():                       # may start before the daemon, survives its restarts
        drive(pose.position, pose.yaw) if pose.usable(0.2) else stop()

`connect(prefix)` gives the same for another daemon. Services, units and frames: src/messages/WIRE.md.
"""

import threading

from .camera import CameraControl
from .client import Client, Subscription
from .errors import (
    CairnError,
    IpcError,
    NoDaemon,
    NoReply,
    OtherOwner,
    Refused,
    SecondPublisher,
    TooManyHeld,
    TooManySubscribers,
    VersionMismatch,
)
from .wheels import WheelPublisher
from .values import Encoded, Features, Frame, Graph, Health, Keyframes, Map, Obstacles, Pose, Tag, Tags

__version__ = "0.1.0"
__all__ = [
    "CairnError",
    "CameraControl",
    "Client",
    "Encoded",
    "Features",
    "Frame",
    "Graph",
    "Health",
    "IpcError",
    "Keyframes",
    "Map",
    "NoDaemon",
    "NoReply",
    "Obstacles",
    "OtherOwner",
    "Pose",
    "Refused",
    "SecondPublisher",
    "Subscription",
    "Tag",
    "Tags",
    "TooManyHeld",
    "TooManySubscribers",
    "VersionMismatch",
    "WheelPublisher",
    "connect",
    "frames",
    "latest_health",
    "latest_map",
    "latest_pose",
    "poses",
]

connect = Client

_shared = {}
_lock = threading.Lock()


def _latest(topic):
    with _lock:
        if topic not in _shared:
            _shared[topic] = getattr(Client(), topic)()
        return _shared[topic].latest()


def poses():
    """Every pose of the daemon that CAIRN_PREFIX names ("cairn" if it is not set); sleeps until the next one comes."""
    return Client().poses()


def frames():
    """Every grey picture of that daemon that is not overtaken by a newer one."""
    return Client().frames()


def latest_pose():
    """The newest pose of that daemon, None while there has been none. Ask its `usable()` before you drive."""
    return _latest("poses")


def latest_map():
    """The newest map of that daemon, None while there has been none."""
    return _latest("map")


def latest_health():
    """The newest health of that daemon, None while there has been none."""
    return _latest("health")
