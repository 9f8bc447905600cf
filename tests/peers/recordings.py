"""Recordings beside programs that are not ours: PyPI's `mcap`, `mcap-ros2-support` and `rosbags`, and `cyclonedds` where there is one for this Python, read
what `cairn record` writes, and `cairn replay` reads what `rosbags` writes.

    python tests/peers/recordings.py [--cairn target/release/cairn]

1. A demo is recorded while the Python client listens to the same services. All readers decode every message of the file, and their fields are those
   of the wire, whose bytes the client got by another way. Beside it a driver tells of wheels.
2. The same of a demo with its camera at a known height, whose scale becomes metric: obstacles, and the scan that is made of them.
3. A folder of JPEGs, as a camera compresses, is replayed at the camera's pace and recorded: each picture in the file has the bytes of its JPEG.
4. Bags in the dialects of Humble and Jazzy, with Image in mono8, bgr8 and yuyv, are replayed. mono8 must come to the same bytes as the
   folder of the same pictures.
"""

import argparse
import importlib.util
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 8
METRIC_SECONDS = 28  # at twice its speed the tour has driven the 3 m that the floor asks for in less than half of that


def run(*words, **options):
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=120, **options)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, words))}: {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done.stdout


class Listener(threading.Thread):
    """What the Python client hears of poses, health and pictures, by their numbers; graphs and tags by when they were sent."""

    def __init__(self):
        super().__init__(daemon=True)
        self.stop, self.poses, self.health, self.pictures, self.obstacles, self.wheels = False, {}, {}, {}, {}, {}
        self.graphs, self.tags = {}, {}

    def run(self):
        import cairn

        client = cairn.Client()
        poses, health, encoded, obstacles = client.poses(), client.health(), client.encoded(), client.obstacles()
        graphs, tags = client.graph(), client.tags()
        while not self.stop:
            graph, told = graphs.wait(0), tags.wait(0)
            if graph is not None:
                self.graphs[graph.published_ns] = graph.raw, graph.copy()
            if told is not None:
                self.tags[told.published_ns] = told.raw
            scan = obstacles.wait(0)
            if scan is not None:
                self.obstacles[scan.sequence] = scan
            picture = encoded.wait(0.02)
            while picture is not None:
                self.pictures[picture.sequence] = bytes(picture.data)
                picture = encoded.wait(0)
            for subscription, found in ((poses, self.poses), (health, self.health)):
                item = subscription.wait(0)
                while item is not None:
                    found[item.sequence] = item.raw
                    item = subscription.wait(0)


def drive(listener, end):
    """A driver whose wheels stand: for a second, less than it takes to be believed."""
    import cairn

    wheels = cairn.Client().wheels()
    time.sleep(end - 1)
    for number in range(50):
        stamp, twist, variance = time.monotonic_ns(), (number / 1000, 0.0, -number / 500), (1e-4, math.nan, 4e-4)
        wheels.publish(stamp, twist, variance)
        listener.wheels[stamp] = (number, twist)
        time.sleep(0.02)
    wheels.close()


def record(cairn, file, seconds, config=None):
    listener = Listener()
    listener.start()
    words = [cairn, "demo", "--quiet", "--seconds", seconds, "--output", file.with_suffix("")]
    if config:
        words += ["--config", config]
    demo = subprocess.Popen([str(word) for word in words], stdout=subprocess.DEVNULL)
    if not config:
        threading.Thread(target=drive, args=(listener, seconds - 3), daemon=True).start()
    run(cairn, "record", file, "--quiet", "--seconds", seconds - 3)
    demo.wait(timeout=60)
    listener.stop = True
    listener.join(timeout=10)
    return listener


def same(ours, wire, fields, where):
    for name in fields:
        a, b = getattr(ours, name), getattr(wire, name)
        a, b = np.atleast_1d(np.asarray(a)), np.atleast_1d(np.asarray(b))
        if a.shape != b.shape or not np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
            sys.exit(f"{where}.{name}: {a} in the file, {b} on the wire")


POSE = ("run_id timestamp_ns arrival_ns published_ns latency_arrival_ns frames_dropped position orientation odom_position odom_orientation "
        "covariance linear_velocity angular_velocity quality landmarks landmarks_sought reset_counter map_id anchor_keyframe state scale").split()
OBSTACLES = ("run_id timestamp_ns published_ns position orientation angle_min angle_increment range_min range_max robot_height scale_sigma map_id "
             "reset_counter map_revision count total told clock range sigma free_from free").split()
GRAPH = "run_id content_revision timestamp_ns count total map_id reset_counter map_revision clock map_mode".split()
EDGE = "from to shared joined_map kind".split()
TAGS = "run_id content_revision timestamp_ns count map_id reset_counter map_revision scale_sigma scale scale_source clock map_mode".split()
TAG = "position orientation size edge position_sigma orientation_sigma id sightings family is_dock".split()
HEALTH = "run_id published_ns uptime_ns realtime_minus_monotonic_ns errors frames_captured state focal_px centre_px focal_sigma".split()


def finite(*vectors):
    return all(math.isfinite(getattr(v, k)) for v in vectors for k in "xyzw" if hasattr(v, k))


def check_scans(messages, listener, offset, prefix, reader):
    """Obstacles as on the wire, and scan and frame as WIRE.md makes them of these."""
    told, scans, frames, whole = {}, {}, {}, 0
    for topic, m in messages:
        if topic == f"/{prefix}/obstacles":
            if m.sequence in listener.obstacles:
                wire = listener.obstacles[m.sequence].raw
                points = np.ctypeslib.as_array(wire.points).reshape(-1)
                assert np.array_equal(np.float32(m.points), points, equal_nan=True)
                same(m, wire, OBSTACLES, f"{reader}: obstacles {m.sequence}")
                whole += 1
            if m.told == 0:
                told[m.timestamp_ns + offset] = m
        elif topic == f"/{prefix}/scan":
            scans[m.header.stamp.sec * 10**9 + m.header.stamp.nanosec] = m
        elif topic == "/tf" and m.transforms[0].child_frame_id == "scan":
            header = m.transforms[0].header
            assert header.frame_id == "map" and len(m.transforms) == 1
            frames[header.stamp.sec * 10**9 + header.stamp.nanosec] = m.transforms[0].transform
    assert set(scans) == set(told) == set(frames), (len(scans), len(told), len(frames))
    known = 0
    for stamp, scan in scans.items():
        wire, t = told[stamp], frames[stamp].translation
        assert scan.header.frame_id == "scan" and [t.x, t.y, t.z] == list(wire.position)
        same(scan, wire, ("angle_min", "angle_increment", "range_min", "range_max"), f"{reader}: scan")
        assert np.array_equal(np.float32(scan.ranges), np.float32(wire.range), equal_nan=True)
        assert not np.isinf(scan.ranges).any() and len(scan.intensities) == 0
        assert abs(scan.angle_min + 179 * scan.angle_increment - scan.angle_max) < 1e-5
        known += int(np.isfinite(scan.ranges).any())
    if whole < 5 or known < 5:
        sys.exit(f"{reader}: {whole} obstacles compared, {known} of {len(scans)} scans know anything")
    print(f"{reader}: {whole} obstacles as on the wire, {len(scans)} scans, {known} with something in the way")


def field(message, name):
    """Some readers write a word of Python's own with a line behind it."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name + "_")


def check_graph(m, listener, reader):
    """Edges that were compared."""
    if m.header.published_ns not in listener.graphs:
        return 0
    header, edges = listener.graphs[m.header.published_ns]
    same(m.header, header, GRAPH, f"{reader}: graph {m.header.content_revision}")
    got = [[field(edge, name) for name in EDGE] for edge in m.edges]
    assert got == [[int(edge[name]) for name in EDGE] for edge in edges], f"{reader}: {got} is not {edges}"
    return len(got)


def check_tags(m, listener, reader):
    """Whether they were compared: those that are there, and what stands in the places of the others."""
    if m.published_ns not in listener.tags:
        return False
    wire = listener.tags[m.published_ns]
    same(m, wire, TAGS, f"{reader}: tags {m.content_revision}")
    assert len(m.tags) == len(wire.tags)
    for number, (tag, on_wire) in enumerate(zip(m.tags, wire.tags)):
        for name in TAG:
            ours, theirs = np.float64(getattr(tag, name)), np.float64(np.asarray(getattr(on_wire, name)))
            assert np.array_equal(ours, theirs, equal_nan=True), f"{reader}: tag {number}: {name}: {ours} is not {theirs}"
    return True


def check_odometry(m, wire):
    p, q = m.pose.pose.position, m.pose.pose.orientation
    assert finite(p, q) and m.header.frame_id == "odom_unscaled" and m.child_frame_id == "base_link_unscaled"
    assert [p.x, p.y, p.z] == list(wire.odom_position) and [q.x, q.y, q.z, q.w] == list(wire.odom_orientation)
    is_known = np.isfinite([*wire.linear_velocity, *wire.angular_velocity]).all()
    assert m.twist.covariance[0] == (-1 if is_known else 1e6) and finite(m.twist.twist.linear, m.twist.twist.angular)


def check_path(m, keyframes, offset):
    """Whether there is anything in it."""
    assert m.header.frame_id == "map_unscaled" and len(m.poses) == keyframes.header.count
    for pose, k in zip(m.poses, keyframes.keyframes):
        p, q, stamp = pose.pose.position, pose.pose.orientation, pose.header.stamp
        assert [p.x, p.y, p.z] == list(k.position) and [q.x, q.y, q.z, q.w] == list(k.orientation)
        assert stamp.sec * 10**9 + stamp.nanosec == k.timestamp_ns + offset and pose.header.frame_id == "map_unscaled"
    return len(m.poses) > 0


def check(messages, listener, offset, prefix, reader):
    """`messages`: (topic, message), decoded by somebody else."""
    seen, compared, headers, poses = Counter(), Counter(), {}, {}
    images = []
    for topic, m in messages:
        seen[topic] += 1
        if topic == f"/{prefix}/pose":
            poses[m.timestamp_ns + offset] = m
            if m.sequence in listener.poses:
                same(m, listener.poses[m.sequence], POSE, f"{reader}: pose {m.sequence}")
                compared["pose"] += 1
        elif topic == f"/{prefix}/health" and m.sequence in listener.health:
            same(m, listener.health[m.sequence], HEALTH, f"{reader}: health {m.sequence}")
            assert abs(m.realtime_minus_monotonic_ns - offset) < 100_000_000
            compared["health"] += 1
        elif topic == f"/{prefix}/image/header":
            headers[m.timestamp_ns + offset] = m
        elif topic == f"/{prefix}/image/compressed":
            images.append((m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, m.format, bytes(m.data)))
        elif topic == f"/{prefix}/odom":
            check_odometry(m, poses[m.header.stamp.sec * 10**9 + m.header.stamp.nanosec])
            compared["odom"] += 1
        elif topic == f"/{prefix}/graph":
            compared["graph"] += check_graph(m, listener, reader)
        elif topic == f"/{prefix}/tags":
            compared["tags"] += check_tags(m, listener, reader)
        elif topic == "/tf":
            assert all(finite(t.transform.translation, t.transform.rotation) for t in m.transforms)
            assert [t.child_frame_id for t in m.transforms[:2]] == ["odom_unscaled", "base_link_unscaled"]
        elif topic == f"/{prefix}/wheel":
            number, twist = listener.wheels[m.timestamp_ns]
            assert m.sequence == number and (m.linear_x_mps, m.linear_y_mps, m.angular_z_radps) == twist
            compared["wheel"] += 1
        elif topic == f"/{prefix}/wheel/twist":
            _, (x, _, yaw) = listener.wheels[m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - offset]
            twist, covariance = m.twist.twist, m.twist.covariance
            assert (twist.linear.x, twist.angular.z) == (x, yaw) and m.header.frame_id == "base_link"
            assert (covariance[0], covariance[7], covariance[35]) == (1e-4, 0.0, 4e-4)
            compared["twist"] += 1
        elif topic == f"/{prefix}/points":
            assert len(m.data) == m.row_step == m.width * m.point_step
        elif topic == f"/{prefix}/keyframes":
            keyframes = m
        elif topic == f"/{prefix}/path":
            # With the keyframes that it is made of, which come before it.
            compared["path"] += check_path(m, keyframes, offset)
        elif topic == f"/{prefix}/camera_info":
            assert m.width > 0 and m.distortion_model == "plumb_bob" and len(m.d) == 5 and m.k[0] > 100
    for stamp, format, data in images:
        header = headers[stamp]
        raw = listener.pictures.get(header.sequence)
        if raw is not None:
            import png

            assert format == "png"
            width, height, rows, _ = png.Reader(bytes=data).read()
            assert (width, height) == (header.width, header.height) and b"".join(rows) == raw
            compared["picture"] += 1
    for kind in ("pose", "health", "odom", "picture", "wheel", "twist", "path", "graph", "tags"):
        if compared[kind] < (3 if kind == "tags" else 5):
            sys.exit(f"{reader}: only {compared[kind]} of {kind} compared; seen {seen}")
    print(f"{reader}: {sum(seen.values())} messages decoded, as on the wire: {dict(compared)}")


def readers(file):
    """How each program decodes the file: its name, the clocks' offset, and (topic, message) for all."""
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        statistics, chunks = reader.get_summary().statistics, reader.get_summary().chunk_indexes
        # Foxglove and Lichtblick take the file to begin with the first of its chunks, and one without messages begins in 1970.
        assert min(c.message_start_time for c in chunks) == statistics.message_start_time
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}["cairn"]
        offset = int(metadata["realtime_minus_monotonic_ns"])
        yield "mcap-ros2-support", offset, [(channel.topic, m) for _, channel, _, m in reader.iter_decoded_messages()]
    store = get_typestore(Stores.ROS2_JAZZY)
    with file.open("rb") as stream:
        for schema in make_reader(stream).get_summary().schemas.values():
            if schema.name.startswith("cairn_msgs/"):
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
    with AnyReader([file], default_typestore=store) as reader:
        yield "rosbags", offset, [(c.topic, store.deserialize_cdr(raw, c.msgtype)) for c, _, raw in reader.messages()]
    if importlib.util.find_spec("cyclonedds"):
        import cyclone

        yield "cyclonedds", offset, list(cyclone.messages(file))
    else:
        print("cyclonedds: not asked, there is none for this Python")


def foreign_readers(cairn, out, prefix):
    listener = record(cairn, out / "out.mcap", SECONDS)
    for reader, offset, messages in readers(out / "out.mcap"):
        check(messages, listener, offset, prefix, reader)
    config = out / "floor.toml"
    config.write_text("[simulator]\nwidth = 320\nheight = 240\nspeed = 2.0\n[scale]\ncamera_height_m = 0.5\n")
    listener = record(cairn, out / "floor.mcap", METRIC_SECONDS, config)
    for reader, offset, messages in readers(out / "floor.mcap"):
        check_scans(messages, listener, offset, prefix, reader)


def pictures(folder):
    import png

    for line in (folder / "rgb.txt").read_text().splitlines():
        if not line.startswith("#"):
            time, file = line.split()
            seconds, _, fraction = time.partition(".")
            width, height, rows, info = png.Reader(filename=str(folder / file)).read()
            assert info["planes"] == 1
            yield int(seconds), int(fraction.ljust(9, "0")), np.vstack([np.asarray(r, np.uint8) for r in rows])


def jpegs(folder, out):
    """The same pictures in a folder as a camera's JPEGs, in colour with its chroma at half the size; the bytes by time, ns."""
    from PIL import Image

    (out / "rgb").mkdir(parents=True)
    shutil.copy(folder / "camera.yaml", out)
    lines, files = [], {}
    for number, (sec, nanosec, grey) in enumerate(pictures(folder)):
        name = f"rgb/{number:04}.jpg"
        colour = Image.fromarray(np.dstack([grey, grey // 2 + 64, 255 - grey]))
        # Another quality is other tables: nothing that is compressed anew could have the same bytes.
        colour.save(out / name, quality=75 + number % 20, subsampling="4:2:0")
        lines.append(f"{sec}.{nanosec:09} {name}\n")
        files[sec * 10**9 + nanosec] = (out / name).read_bytes()
    (out / "rgb.txt").write_text("".join(lines))
    return files


def camera_jpegs(cairn, out, prefix):
    folder, file = out / "camera", out / "jpeg.mcap"
    run(cairn, "simulate", "--scenario", "hand_held", "--seconds", 4, "--size", "320x240", "--output", folder)
    files = jpegs(folder, out / "jpegs")
    recorder = subprocess.Popen([str(cairn), "record", str(file), "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        run(cairn, "replay", out / "jpegs", "--quiet")
    finally:
        recorder.send_signal(signal.SIGTERM)
        told, _ = recorder.communicate(timeout=30)
    assert recorder.returncode == 0, recorder.returncode
    for reader, _, messages in readers(file):
        recorded = [m for topic, m in messages if topic == f"/{prefix}/image/compressed"]
        for m in recorded:
            time = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
            assert m.format == "jpeg" and bytes(m.data) == files[time], f"{reader}: the picture at {time} ns is not its file"
        # It subscribes while the first come.
        if len(recorded) < len(files) // 2:
            sys.exit(f"{reader}: only {len(recorded)} of {len(files)} JPEGs recorded: {told}")
        print(f"{reader}: {len(recorded)} of {len(files)} JPEGs recorded, each byte for byte")


def write_bag(path, folder, store, version, encoding, camera):
    types = store.types
    with Writer(path, version=version, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/cam/image_raw", "sensor_msgs/msg/Image", typestore=store)
        info = writer.add_connection("/cam/camera_info", "sensor_msgs/msg/CameraInfo", typestore=store)
        for sec, nanosec, grey in pictures(folder):
            height, width = grey.shape
            data = {"mono8": lambda: grey, "bgr8": lambda: np.repeat(grey[:, :, None], 3, 2),
                    "yuyv": lambda: np.dstack([grey, np.full_like(grey, 128)])}[encoding]()
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](sec, nanosec), "cam")
            name = {"yuyv": "yuv422_yuy2"}.get(encoding, encoding)
            step = data.size // height
            time = 1_700_000_000 * 10**9 + sec * 10**9 + nanosec
            image = types["sensor_msgs/msg/Image"](header, height, width, name, 0, step, np.ascontiguousarray(data).reshape(-1))
            fx, fy, cx, cy, d = camera
            region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
            p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0.0])
            calibration = types["sensor_msgs/msg/CameraInfo"](header, height, width, "plumb_bob", d, k, np.eye(3).reshape(-1), p, 0, 0, region)
            writer.write(info, time, store.serialize_cdr(calibration, "sensor_msgs/msg/CameraInfo"))
            writer.write(topic, time, store.serialize_cdr(image, "sensor_msgs/msg/Image"))


def read_camera(file):
    """fx fy cx cy and distortion of the camera.yaml that `cairn simulate` writes: `name: value` in a line."""
    values = dict(line.split(": ", 1) for line in file.read_text().splitlines() if ": " in line and line[0] != "#")
    fx, fy, cx, cy = (float(values[name]) for name in ("fx", "fy", "cx", "cy"))
    return fx, fy, cx, cy, np.array([float(v) for v in values["distortion"].strip("[]").split(",")])


def foreign_bags(cairn, out):
    folder = out / "folder"
    run(cairn, "simulate", "--scenario", "hand_held", "--seconds", 3, "--size", "320x240", "--output", folder)
    camera = read_camera(folder / "camera.yaml")

    def replay(path):
        trajectory = out / "trajectory.txt"
        run(cairn, "replay", path, "--lockstep", "--quiet", "--trajectory", trajectory)
        return trajectory.read_bytes()

    want = replay(folder)
    assert want.count(b"\n") > 30, want
    dialects = (("humble", Stores.ROS2_HUMBLE, 8), ("jazzy", Stores.ROS2_JAZZY, 9))
    for dialect, store, version in dialects:
        for encoding in ("mono8", "bgr8", "yuyv"):
            path = out / f"{dialect}-{encoding}"
            write_bag(path, folder, get_typestore(store), version, encoding, camera)
            # Grey as colour and as YUYV is the same grey: luma's weights add up to one.
            if replay(path) != want:
                sys.exit(f"{path}: its replay differs from that of the folder")
    print(f"rosbags: {len(dialects)} dialects in 3 encodings replayed to the same {want.count(bytes([10]))} poses as the folder")


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--cairn", default=ROOT / "target/release/cairn", type=Path)
    cairn = arguments.parse_args().cairn.resolve()
    prefix = f"recordings{os.getpid()}"
    os.environ["CAIRN_PREFIX"] = prefix
    with tempfile.TemporaryDirectory() as out:
        foreign_readers(cairn, Path(out), prefix)
        camera_jpegs(cairn, Path(out), prefix)
        foreign_bags(cairn, Path(out))


if __name__ == "__main__":
    main()
