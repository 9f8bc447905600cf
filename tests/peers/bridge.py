"""`cairn bridge` beside programs that are not ours: PyPI's `eclipse-zenoh` is the router and a node of ROS 2, `rosbags` decodes what it gets (and, where
there is one for this Python, `cyclonedds`), `xxhash` and the package `cairn` say what it should be.

    python tests/peers/bridge.py [--cairn target/release/cairn] [--bridge target/release/cairn] [--router-away 30]

1. A demo whose scale nobody knows: odometry in `odom_unscaled` and no transforms, pictures only while a subscriber's token stands (none while two other
   readers have them), a reset by a service and none by a pattern of keys, no command that has waited too long, a router that goes away and comes back.
2. Under the same bridge a demo that drives with its camera at a known height: transforms once lengths are metres, tf_static for who comes late and with
   the mount that the wheels have shown, scans on demand, placed by their own pose, an initial pose.
3. kill -9 of a recorder and of another bridge: daemon, planner and the first bridge do not notice, and the recording is whole up to its last chunk.
   A bridge with `--no-commands` declares nothing that could be asked.
4. Three more bridges, two of one name: `cairn fleet` lists them, says whose name is taken twice and who was killed, and that there is no router; some of
   robots that have a map: `cairn map pull` fetches it, and refuses what is broken, of two robots, or not there; some of a robot with a dock, which are in
   one plot (`fleet.py`), and two daemons that share a map.
5. SIGTERM ends it, and its tokens are gone.

`--bridge` names a binary with the feature `bridge`, `--cairn` one with `demo`; `--router-away` for how long there is no router, in s (3). Ports are free ones of this machine. Every wait is bounded, and whatever
fails, the logs of all processes are shown.
"""

import argparse
import faulthandler
import hashlib
import importlib.util
import json
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict, deque
from pathlib import Path

import cairn
import numpy as np
import xxhash
import zenoh
import zenoh.ext
from fleet import docked, fleet, maps, shared, told_last
from programs import Program, until
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).resolve().parents[2]
DOMAIN = 7
STORE = get_typestore(Stores.ROS2_JAZZY)
# Of a demo, which is ended earlier; and of all of this, after which it has hung.
DEMO_SECONDS, ALL_SECONDS = 180, 360
# A base that drives, whose wheels show where the camera sits: nobody has told that.
METRIC_CONFIG = """
[simulator]
width = 320
height = 240
scenario = "square"
[simulator.wheels]
enabled = true
[scale]
camera_height_m = 0.5
"""


def type_hash(name):
    return STORE.hash_rihs01(name)


def service_hash(name, request, response):
    """REP-2016's hash of a service, which `rosbags` does not have: of its request, its response and the event that is made of both."""

    def field(name, type_id, nested="", capacity=0):
        kind = {"type_id": type_id, "capacity": capacity, "string_capacity": 0, "nested_type_name": nested}
        return {"name": name, "type": kind}

    nested, int32, uint32, uint8, int64, uint8_array, bounded = 1, 6, 7, 3, 8, 51, 97
    asked, answered, event = f"{name}_Request", f"{name}_Response", f"{name}_Event"
    stamp, info = "builtin_interfaces/msg/Time", "service_msgs/msg/ServiceEventInfo"
    types = {
        asked: [field(*f) for f in request],
        answered: [field(*f) for f in response],
        stamp: [field("sec", int32), field("nanosec", uint32)],
        info: [field("event_type", uint8), field("stamp", nested, stamp), field("client_gid", uint8_array, "", 16),
               field("sequence_number", int64)],
        event: [field("info", nested, info), field("request", bounded, asked, 1), field("response", bounded, answered, 1)],
    }
    own = [field("request_message", nested, asked), field("response_message", nested, answered),
           field("event_message", nested, event)]
    described = {
        "type_description": {"type_name": name, "fields": own},
        "referenced_type_descriptions": [{"type_name": n, "fields": types[n]} for n in sorted(types)],
    }
    return "RIHS01_" + hashlib.sha256(json.dumps(described).encode()).hexdigest()


# The one that rmw_zenoh's design shows.
assert service_hash("example_interfaces/srv/AddTwoInts", [("a", 8), ("b", 8)], [("sum", 8)]) == (
    "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a")
TRIGGER = service_hash("std_srvs/srv/Trigger", [("structure_needs_at_least_one_member", 3)], [("success", 15), ("message", 17)])

# Topic below the namespace (or with / at the root), type, and the quality of service in its token.
TOPICS = {
    "odom": ("nav_msgs/msg/Odometry", "::,10:,:,:,,"),
    "/tf": ("tf2_msgs/msg/TFMessage", "::,100:,:,:,,"),
    "/tf_static": ("tf2_msgs/msg/TFMessage", ":1:,1:,:,:,,"),
    "pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", "::,10:,:,:,,"),
    "points": ("sensor_msgs/msg/PointCloud2", ":1:,1:,:,:,,"),
    "scan": ("sensor_msgs/msg/LaserScan", "2::,5:,:,:,,"),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", "::,10:,:,:,,"),
    "camera_info": ("sensor_msgs/msg/CameraInfo", "2::,5:,:,:,,"),
    "image/compressed": ("sensor_msgs/msg/CompressedImage", "2::,5:,:,:,,"),
}


def dds(name):
    package, kind, base = name.split("/")
    return f"{package}::{kind}::dds_::{base}_"


def key(topic, type_name, hashed):
    return f"{DOMAIN}{topic}/{dds(type_name)}/{hashed}"


def attachment(sequence, gid):
    return struct.pack("<qqB16s", sequence, time.time_ns(), 16, gid)


def stamp_ns(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def hung(seconds):
    sys.stderr.write(f"not done within {seconds} s\n")
    faulthandler.dump_traceback()
    Program.show_all()
    Program.kill_all()
    os._exit(1)


class Network:
    """The router, with a node of ROS 2 in it that hears everything."""

    def __init__(self, robot):
        self.robot, self.lock = robot, threading.Lock()
        self.got, self.last = defaultdict(list), {}
        # The newest by type, with their bytes.
        self.newest = defaultdict(lambda: deque(maxlen=50))
        self.names = {}
        for word, (type_name, qos) in TOPICS.items():
            topic = word if word.startswith("/") else f"/{robot}/{word}"
            self.names[key(topic, type_name, type_hash(type_name))] = (word, topic, type_name, qos)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.open()

    def open(self):
        config = {"mode": "router", "listen": {"endpoints": [f"tcp/127.0.0.1:{self.port}"]}, "timestamping": {"enabled": True},
                  "scouting": {"multicast": {"enabled": False}}}
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.subscriber = self.session.declare_subscriber(f"{DOMAIN}/**", self.take)
        self.zid = str(self.session.info.zid())

    def close(self):
        self.session.close()

    def take(self, sample):
        if "/initialpose/" in str(sample.key_expr) or "*" in str(sample.key_expr):
            return  # our own
        with self.lock:
            self.got["arrived"].append((str(sample.key_expr), sample.payload.to_bytes(), sample.attachment.to_bytes(), time.time_ns()))

    def decode(self):
        """Everything that has come since the last call is decoded and checked; messages by topic."""
        with self.lock:
            arrived, self.got["arrived"] = self.got["arrived"], []
        for name, payload, attached, now in arrived:
            if name not in self.names:
                sys.exit(f"nobody should send {name}")
            word, _, type_name, _ = self.names[name]
            message = STORE.deserialize_cdr(payload, type_name)
            assert len(attached) == 33, f"{word}: an attachment of {len(attached)} bytes"
            sequence, sent, length, gid = struct.unpack("<qqB16s", attached)
            assert length == 16 and abs(now - sent) < 2 * 10**9, f"{word}: sent at {sent}, come at {now}"
            before, known = self.last.get(word, (None, gid))
            assert known == gid, f"{word}: two senders"
            # Numbers go on while the router is away.
            assert before is None or sequence > before, f"{word}: {sequence} after {before}"
            self.last[word] = (sequence, gid)
            self.got[word].append(message)
            self.newest[type_name].append((payload, message))
        return self.got

    def seen(self, word):
        return self.decode()[word]

    def fresh(self, word):
        """Messages of a topic from now on."""
        known = len(self.decode()[word])
        return lambda: self.decode()[word][known:]

    def tokens(self, domain=DOMAIN):
        return [str(reply.ok.key_expr) for reply in self.session.liveliness().get(f"@ros2_lv/{domain}/**", timeout=5) if reply.ok]

    def subscribe(self, word, number):
        """Declares what rmw_zenoh declares for a subscription: its token."""
        _, topic, type_name, qos = next(entry for entry in self.names.values() if entry[0] == word)
        token = (f"@ros2_lv/{DOMAIN}/{self.zid}/0/{number}/MS/%/%/listener/{topic.replace('/', '%')}/{dds(type_name)}/"
                 f"{type_hash(type_name)}/{qos}")
        return self.session.liveliness().declare_token(token)

    def service(self, name):
        return key(f"/{self.robot}/{name}", "std_srvs/srv/Trigger", TRIGGER)

    def ask(self, name, **given):
        """What services answer to a query; of all that a pattern meets."""
        replies = self.session.get(name, target=zenoh.QueryTarget.ALL, timeout=2, consolidation=zenoh.ConsolidationMode.NONE, **given)
        return [reply for reply in replies if not reply.ok or dds("std_srvs/srv/Trigger") in str(reply.ok.key_expr)]

    def place(self, x, y):
        """Sends an initial pose."""
        types, name = STORE.types, "geometry_msgs/msg/PoseWithCovarianceStamped"
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "map")
        there = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, y, 0.0),
                                                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
        message = types[name](header, types["geometry_msgs/msg/PoseWithCovariance"](there, np.zeros(36)))
        self.session.put(key(f"/{self.robot}/initialpose", name, type_hash(name)), bytes(STORE.serialize_cdr(message, name)),
                         attachment=attachment(1, bytes(16)))

    def call(self, service, seconds=20):
        name = self.service(service)
        gid = bytes(range(16))
        replies = list(self.session.get(name, target=zenoh.QueryTarget.ALL_COMPLETE, payload=b"\0\1\0\0\0", timeout=seconds,
                                        consolidation=zenoh.ConsolidationMode.NONE, attachment=attachment(42, gid)))
        if len(replies) != 1 or not replies[0].ok:
            sys.exit(f"{service}: {len(replies)} answers")
        payload, attached = replies[0].ok.payload.to_bytes(), replies[0].ok.attachment.to_bytes()
        sequence, _, _, back = struct.unpack("<qqB16s", attached)
        assert (sequence, back) == (42, gid), "the answer is for somebody else"
        length = struct.unpack_from("<I", payload, 8)[0]
        return bool(payload[4]), payload[12 : 12 + length - 1].decode()


class Wire(threading.Thread):
    """Poses as the Python client hears them, by their time."""

    def __init__(self):
        super().__init__(daemon=True)
        self.stop, self.poses, self.scans, self.offset, self.fault = False, {}, {}, None, None

    def run(self):
        try:
            self.listen()
        except Exception as error:  # it would be lost with the thread
            self.fault = error

    def listen(self):
        client = cairn.Client()
        poses, health, obstacles = client.poses(), client.health(), client.obstacles()
        while not self.stop:
            pose = poses.wait(0.05)
            while pose is not None:
                self.poses[pose.timestamp_ns] = pose
                pose = poses.wait(0)
            while (report := health.wait(0)) is not None:
                self.offset = report.realtime_minus_monotonic_ns
            while (scan := obstacles.wait(0)) is not None:
                if scan.told:
                    self.scans[scan.timestamp_ns] = scan


def rotation(q):
    x, y, z, w = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def check_scans(network, wire):
    """Each scan's transform takes it from the body of its own pose to where the wire has it in the map."""
    compared = 0
    for message in network.seen("/tf"):
        for transform in (t for t in message.transforms if t.child_frame_id == "scan"):
            assert transform.header.frame_id == "base_link", transform.header.frame_id
            near = [t for t in dict(wire.scans) if abs(t + wire.offset - stamp_ns(transform.header)) < 10**6 and t in wire.poses]
            for scan, pose in ((wire.scans[t], wire.poses[t]) for t in near):
                assert (pose.sequence, pose.map_revision) == (scan.sequence, scan.map_revision), "a scan of another map"
                shift, turn = transform.transform.translation, transform.transform.rotation
                there = rotation(pose.orientation) @ np.array([shift.x, shift.y, shift.z]) + np.array(pose.position)
                turned = rotation(pose.orientation) @ rotation((turn.x, turn.y, turn.z, turn.w))
                assert np.allclose(there, scan.position, atol=1e-9), f"{there} is not {list(scan.position)}"
                assert np.allclose(turned, rotation(scan.orientation), atol=1e-9)
                compared += 1
    return compared


def check_mount(static, wire_client):
    """What is sent last is what the daemon uses, which the motion of the base has shown."""
    reader = wire_client.encoded()
    try:
        picture = until("a picture on the wire", 10, lambda: reader.wait(0.5))
        place, turn = [float(v) for v in picture.camera_position], [float(v) for v in picture.camera_orientation]
    finally:
        reader.close()
    transform = static()[-1].transforms[0].transform
    shift, turned = transform.translation, transform.rotation
    assert any(place), "the wheels have shown nothing"
    return [shift.x, shift.y, shift.z] == place and [turned.x, turned.y, turned.z, turned.w] == turn and place


def check_poses(messages, wire, frame, child, fields):
    """Each against the pose on the wire of the same time; the clocks' offset is measured anew with each health, so times agree to a millisecond."""
    times = sorted(dict(wire.poses))
    compared = 0
    for m in messages:
        assert m.header.frame_id == frame, f"{m.header.frame_id} and not {frame}"
        if child:
            assert m.child_frame_id == child and m.twist.covariance[0] in (-1, 1e6)
        p, q = m.pose.pose.position, m.pose.pose.orientation
        assert all(math.isfinite(v) for v in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)), "a position that is none"
        assert all(math.isfinite(v) for v in m.pose.covariance)
        nearest = min(times, key=lambda t: abs(t + wire.offset - stamp_ns(m.header)), default=None)
        if nearest is None or abs(nearest + wire.offset - stamp_ns(m.header)) > 10**6:
            continue
        pose = wire.poses[nearest]
        position, orientation = (getattr(pose, name) for name in fields)
        assert [p.x, p.y, p.z] == list(position) and [q.x, q.y, q.z, q.w] == list(orientation), f"{m} is not {pose}"
        assert abs(stamp_ns(m.header) - time.time_ns()) < 120 * 10**9
        compared += 1
    if compared < 20:
        sys.exit(f"{frame}: only {compared} of {len(messages)} compared")
    return compared


def check_tokens(network):
    tokens = until("the bridge's tokens", 10, lambda: [t for t in network.tokens() if "/cairn_bridge" in t])
    robot = network.robot
    heads = {"/".join(t.split("/")[:3]) for t in tokens}
    assert len(heads) == 1, heads
    head = heads.pop()
    want = {f"/NN/%/%{robot}/cairn_bridge"}
    for _, topic, type_name, qos in network.names.values():
        want.add(f"/MP/%/%{robot}/cairn_bridge/{topic.replace('/', '%')}/{dds(type_name)}/{type_hash(type_name)}/{qos}")
    for service in ("reset", "save"):
        want.add(f"/SS/%/%{robot}/cairn_bridge/%{robot}%{service}/{dds('std_srvs/srv/Trigger')}/{TRIGGER}/::,10:,:,:,,")
    pose = "geometry_msgs/msg/PoseWithCovarianceStamped"
    want.add(f"/MS/%/%{robot}/cairn_bridge/%{robot}%initialpose/{dds(pose)}/{type_hash(pose)}/::,10:,:,:,,")
    got = {t[len(head) :].split("/", 3)[3] for t in tokens}
    assert got == {w[1:] for w in want}, f"{sorted(got)}\n{sorted(want)}"
    ids = [t.split("/")[4] for t in tokens]
    assert len(set(ids)) == len(ids), "two entities with one number"
    # Whoever sends has the id that belongs to its token.
    for word, (_, gid) in network.last.items():
        topic = next(entry[1] for entry in network.names.values() if entry[0] == word).replace("/", "%")
        token = next(t for t in tokens if f"/MP/%/%{robot}/cairn_bridge/{topic}/" in t)
        digest = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        assert gid == digest, f"{word}: {gid.hex()} is not the id of {token}"
    return len(tokens)


def demo(program, name, folder, config=None):
    words = [program, "demo", "--quiet", "--seconds", DEMO_SECONDS, "--output", folder / name]
    return Program(name, words + (["--config", config] if config else []), folder)


def resets(network):
    """As the last diagnostics tell them."""
    values = {v.key: v.value for v in network.seen("/diagnostics")[-1].status[0].values}
    return int(values["resets"])


def health_of(bridge, network, seconds):
    """So many seconds in which it lives, and tells of the daemon's health."""
    diagnostics = network.fresh("/diagnostics")
    time.sleep(seconds)
    assert bridge.process.poll() is None, f"the bridge has ended: {bridge.process.returncode}"
    until("diagnostics", 5, diagnostics)


def check_patterns(bridge, network):
    """Whoever looks around, or knows no ROS, resets and moves nothing."""
    before, name = resets(network), network.service("reset")
    node, empty = {"attachment": attachment(1, bytes(16))}, b"\0\1\0\0\0"
    answered = [
        network.ask("**"),
        network.ask("**", payload=empty, **node),
        network.ask(f"{DOMAIN}/{network.robot}/**", payload=empty, **node),
        network.ask(name.replace("/reset/", "/*/"), payload=empty, **node),
        network.ask(name, payload=empty),
        network.ask(name, **node),
        network.ask(name, payload=b"please", **node),
    ]
    assert not any(answered), answered
    network.session.put(f"{DOMAIN}/**", b"\0\1\0\0", **node)
    health_of(bridge, network, 1.5)
    assert resets(network) == before, "a pattern of keys has reset the map"
    bridge.says("request over Zenoh refused", 1, 5)
    assert bridge.said()["asked by ROS 2"] == 0, "something was carried out"
    print(f"patterns: {len(answered)} queries of no node of ROS 2's, nothing carried out")


def check_stale(bridge, network, running):
    """A daemon that stands still for some seconds holds the queue: what waited meanwhile is refused, and only the newest initial pose is looked at."""
    before, answers = resets(network), {}
    refused = bridge.said()["initial pose of ROS 2 refused"]
    running.process.send_signal(signal.SIGSTOP)

    def ask(name):
        answers[name] = network.call("reset")

    threads = [threading.Thread(target=ask, args=(name,), daemon=True) for name in ("first", "second")]
    try:
        threads[0].start()
        time.sleep(0.5)
        threads[1].start()
        for x in (10.0, 20.0, 30.0):
            network.place(x, 0.0)
        time.sleep(3)
    finally:
        running.process.send_signal(signal.SIGCONT)
    for thread in threads:
        thread.join(20)
    assert answers.get("first", (False,))[0], answers
    success, message = answers.get("second", (True, ""))
    assert not success and message.startswith("too late"), answers
    bridge.says("initial pose of ROS 2 refused", refused + 1, 5)
    until("the reset", 15, lambda: resets(network) > before)
    health_of(bridge, network, 1.5)
    assert resets(network) == before + 1, "a reset that had waited too long was carried out"
    assert bridge.said()["initial pose of ROS 2 refused"] == refused + 1, "more than the newest initial pose"
    print(f"a held queue: {message}")


def check_places(bridge, network):
    """Two other readers have the pictures: the bridge goes on, and has them once one of the two is gone."""
    client = cairn.Client()
    readers = [client.encoded(), client.encoded()]
    until("both readers", 10, lambda: all(reader.wait(0.2) is not None for reader in readers))
    image, tokens = network.fresh("image/compressed"), [network.subscribe("image/compressed", 10)]
    bridge.says("all places at a service are taken, tried again", 1, 10)
    health_of(bridge, network, 6)
    assert not image() and bridge.said()["all places at a service are taken, tried again"] == 1
    for reader in readers:
        reader.close()
    until("pictures", 15, lambda: len(image()) > 3)
    tokens[0].undeclare()
    print("pictures: not while two others read them, and the bridge lives on")


def unscaled(network, wire, bridge, program, with_zenoh, out, environment, away):
    running = demo(program, "plain", out)
    odom = network.fresh("odom")
    until("odometry", 30, lambda: len(odom()) > 60)
    until("health on the wire", 5, lambda: wire.offset is not None)
    tokens = check_tokens(network)
    compared = check_poses(odom(), wire, "odom_unscaled", "base_link_unscaled", ("odom_position", "odom_orientation"))
    check_poses(network.seen("pose"), wire, "map_unscaled", None, ("position", "orientation"))
    cloud = until("points", 10, lambda: network.seen("points"))[-1]
    assert cloud.header.frame_id == "map_unscaled" and len(cloud.data) == cloud.row_step == cloud.width * cloud.point_step
    status = network.seen("/diagnostics")[-1].status[0]
    assert status.name == f"{network.robot}: pose and map" and status.hardware_id == os.environ["CAIRN_PREFIX"]
    silent = [word for word in ("/tf", "/tf_static", "image/compressed", "camera_info", "scan") if network.seen(word)]
    assert not silent, f"{silent} unasked"
    print(f"unscaled: {tokens} tokens, {compared} odometries as on the wire, no transforms, nothing unasked")

    token = network.subscribe("image/compressed", 10), network.subscribe("camera_info", 11)
    image, info = network.fresh("image/compressed"), network.fresh("camera_info")
    until("pictures", 10, lambda: len(image()) > 10 and len(info()) > 10)
    assert image()[-1].format in ("png", "jpeg") and image()[-1].header.frame_id == "camera_unscaled"
    assert info()[-1].width > 0 and info()[-1].distortion_model == "plumb_bob"
    for one in token:
        one.undeclare()
    time.sleep(1)
    image, info = network.fresh("image/compressed"), network.fresh("camera_info")
    time.sleep(2)
    assert not image() and not info(), "pictures that nobody wants any more"
    print("pictures: while a subscriber's token stands, and not after")

    check_places(bridge, network)
    check_patterns(bridge, network)
    before = resets(network)
    success, message = network.call("reset")
    assert success, message
    until("the reset", 15, lambda: resets(network) > before)
    success, message = network.call("save")
    # A demo keeps no map: the daemon says so, and the answer comes through.
    assert not success and message, f"save: {success} {message}"
    print(f"services: reset done; save answered: {message}")

    check_stale(bridge, network, running)

    listing = Program("away_fleet", [with_zenoh, "fleet", "--json"], out, environment)
    presences = lambda: [row["presence"] for row in told_last(listing)["robots"]]  # noqa: E731
    until("the robot in the fleet", 20, lambda: presences() == ["here"])
    # Those who have met by the router stay linked without it.
    alone = lambda: sum(bridge.said()[m] for m in ("waiting for a Zenoh router", "other peers of Zenoh are there, and no router"))  # noqa: E731
    waited = alone()
    network.close()
    gone = time.monotonic()
    until("the bridge says that there is no router", 15, lambda: alone() > waited)
    until("a fleet without a router", 15, lambda: not (told := told_last(listing))["has_router"] and told["notices"])
    time.sleep(max(0.0, gone + away - time.monotonic()))
    assert bridge.process.poll() is None and running.process.poll() is None, "without a router it ended"
    assert alone() <= waited + 2, "said again and again"
    network.open()
    back = time.monotonic()
    odom = network.fresh("odom")
    until("odometry behind the router's absence", 30, lambda: len(odom()) > 30)
    check_tokens(network)
    print(f"router: away for {back - gone:.0f} s, odometry and tokens back within {time.monotonic() - back:.1f} s")
    until("the robot in the fleet again", 20, lambda: told_last(listing)["has_router"] and presences() == ["here"])
    assert listing.end(signal.SIGTERM) == 0
    running.end(signal.SIGINT)


def metric(network, wire, bridge, program, out):
    config = out / "metric.toml"
    config.write_text(METRIC_CONFIG)
    running = demo(program, "metric", out, config)
    scan_token = network.subscribe("scan", 12)
    static = network.fresh("/tf_static")
    until("transforms", 50, lambda: network.seen("/tf"))
    first = network.seen("/tf")[0].transforms
    assert [(t.header.frame_id, t.child_frame_id) for t in first] == [("map", "odom"), ("odom", "base_link")], first
    until("tf_static", 10, static)
    late = []
    held = zenoh.ext.declare_advanced_subscriber(
        network.session, key("/tf_static", "tf2_msgs/msg/TFMessage", type_hash("tf2_msgs/msg/TFMessage")), late.append,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1))
    until("tf_static for who comes late", 10, lambda: late)
    mount = STORE.deserialize_cdr(late[0].payload.to_bytes(), "tf2_msgs/msg/TFMessage").transforms
    assert [(t.header.frame_id, t.child_frame_id) for t in mount] == [("base_link", "camera")], mount
    assert len(late[0].attachment.to_bytes()) == 33
    held.undeclare()
    shown = until("the mount that the wheels have shown", 20, lambda: check_mount(static, cairn.Client()))
    print(f"tf_static: the camera at ({shown[0]:.3f}, {shown[1]:.3f}) m, as the wheels have shown it")
    odom = network.fresh("odom")
    until("metric odometry", 10, lambda: len(odom()) > 60)
    compared = check_poses(odom(), wire, "odom", "base_link", ("odom_position", "odom_orientation"))
    scan = until("scans", 30, lambda: network.seen("scan"))[-1]
    assert scan.header.frame_id == "scan" and not any(math.isinf(r) for r in scan.ranges) and scan.range_max > 0
    frames = Counter(t.child_frame_id for m in network.seen("/tf") for t in m.transforms)
    assert frames["scan"] >= 1 and frames["odom"] == frames["base_link"], frames
    placed = until("scans as on the wire", 20, lambda: check_scans(network, wire))
    print(f"metric: {compared} odometries as on the wire, {len(network.seen('/tf'))} transforms, {len(network.seen('scan'))} scans, "
          f"{placed} placed as on the wire, tf_static for who comes late")

    network.place(50.0, -20.0)
    there = network.fresh("pose")
    until("the initial pose", 15, lambda: any(abs(m.pose.pose.position.x - 50) < 5 for m in there()))
    print("initial pose: the map was moved")
    scan_token.undeclare()
    return running


def second_witness(network):
    if importlib.util.find_spec("cyclonedds") is None:
        print("cyclonedds: not asked, there is none for this Python")
        return
    import cyclone

    network.decode()
    for name, pairs in network.newest.items():
        cyclone.agrees(name, STORE.fielddefs, pairs)
    assert {"nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"} <= set(network.newest)
    print(f"cyclonedds: {sum(map(len, network.newest.values()))} messages of {len(network.newest)} types, each value as rosbags has it")


def killed(network, wire, running, program, with_zenoh, out, environment):
    """Beside a running daemon with a planner and a bridge, who go on."""
    file = out / "killed.mcap"
    other = {**environment, "ROS_DOMAIN_ID": str(DOMAIN + 1)}
    victims = [Program("killed_record", [program, "record", file], out), Program("killed_bridge", [with_zenoh, "bridge", "--robot", "killed"], out, other)]
    victims[1].says("bridging a daemon", 1, 20)
    until("a recording", 20, lambda: file.exists() and file.stat().st_size > 10**6)
    time.sleep(2)
    began, runs = max(wire.poses), {pose.run_id for pose in dict(wire.poses).values()}
    for victim in victims:
        victim.end(signal.SIGKILL)
    odom = network.fresh("odom")
    time.sleep(3)
    until("odometry of the other bridge", 5, lambda: len(odom()) > 30)
    times = sorted(t for t in dict(wire.poses) if t >= began)
    gap = max(b - a for a, b in zip(times, times[1:])) / 1e9
    assert len(times) > 30 and gap < 1.0, f"{len(times)} poses, {gap:.2f} s without one"
    assert running.process.poll() is None and runs == {pose.run_id for pose in dict(wire.poses).values()}, "another daemon"
    replay = [program, "replay", file, "--lockstep", "--json", "--quiet", "--prefix", f"killed{os.getpid()}"]
    told = subprocess.run(replay, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)
    # 1: no frame was tracked, as in a turn on the spot.
    assert told.returncode in (0, 1) and (pictures := json.loads(told.stdout)["frames"]) > 20, told
    print(f"kill -9 of recorder and bridge: {pictures} pictures in the recording, at most {gap:.2f} s without a pose meanwhile")


def listener(program, network, out, environment):
    """With --no-commands there is nothing in the graph that could be asked."""
    other = DOMAIN + 1
    words = [program, "bridge", "--robot", "quiet", "--no-commands"]
    quiet = Program("quiet", words, out, {**environment, "ROS_DOMAIN_ID": str(other)})
    until("its tokens", 15, lambda: len(network.tokens(other)) == 1 + len(TOPICS))
    kinds = Counter(token.split("/")[5] for token in network.tokens(other))
    assert kinds == {"NN": 1, "MP": len(TOPICS)}, kinds
    assert quiet.end(signal.SIGTERM) == 0
    print("--no-commands: a node and its topics, no service and no subscription")


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--cairn", default=ROOT / "target/release/cairn", type=Path)
    arguments.add_argument("--bridge", default=ROOT / "target/release/cairn", type=Path)
    arguments.add_argument("--router-away", default=3.0, type=float, metavar="SECONDS")
    given = arguments.parse_args()
    program, with_zenoh = given.cairn.resolve(), given.bridge.resolve()
    os.environ["CAIRN_PREFIX"] = f"bridge{os.getpid()}"
    robot = "robot7"
    wire = Wire()
    seconds = ALL_SECONDS + given.router_away
    watch = threading.Timer(seconds, hung, [seconds])
    watch.daemon = True
    watch.start()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        network = Network(robot)
        file = out / "zenoh.json5"
        file.write_text(json.dumps({"mode": "peer", "connect": {"endpoints": [f"tcp/127.0.0.1:{network.port}"]},
                                    "listen": {"endpoints": ["tcp/127.0.0.1:0"]}, "timestamping": {"enabled": True},
                                    "scouting": {"multicast": {"enabled": False}}}))
        environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ZENOH_SESSION_CONFIG_URI": str(file)}
        bridge = Program("bridge", [with_zenoh, "bridge", "--robot", robot], out, environment)
        try:
            bridge.says("waiting for a daemon", 1, 20)
            wire.start()
            unscaled(network, wire, bridge, program, with_zenoh, out, environment, given.router_away)
            bridge.says("waiting for a daemon", 2, 20)
            running = metric(network, wire, bridge, program, out)
            second_witness(network)
            killed(network, wire, running, program, with_zenoh, out, environment)
            listener(with_zenoh, network, out, environment)
            fleet(with_zenoh, out, environment, DOMAIN + 2)
            maps(program, with_zenoh, out, environment, DOMAIN + 3)
            running.end(signal.SIGINT)
            bridge.says("waiting for a daemon", 3, 20)
            docked(program, with_zenoh, out, environment, DOMAIN + 4)
            shared(program, with_zenoh, out, environment, DOMAIN + 5, METRIC_CONFIG)
            code = bridge.end(signal.SIGTERM, 10)
            assert code == 0, f"SIGTERM: {code}"
            until("the end of its tokens", 5, lambda: not [t for t in network.tokens() if "/cairn_bridge" in t])
            said = bridge.said()
            # Two daemons, each missed once; a router that went once.
            assert said["waiting for a daemon"] == 3 and said["bridging a daemon"] == 2, said
            assert said["connected to Zenoh"] == 2, said
            assert wire.fault is None, wire.fault
            print(f"SIGTERM: an orderly end; {sum(said.values())} lines of log")
        except BaseException:
            Program.show_all()
            raise
        finally:
            wire.stop = True
            Program.kill_all()
            network.close()
            watch.cancel()


if __name__ == "__main__":
    main()
