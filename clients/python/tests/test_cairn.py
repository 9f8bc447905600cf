"""The package against `cairn demo`: CAIRN_BINARY names the binary (default target/release/cairn), every run has services of its own.

python -m pytest clients/python
"""

import ctypes
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import iceoryx2 as iox2
import numpy as np
import pytest

import cairn
from cairn import messages

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
BINARY = Path(os.environ.get("CAIRN_BINARY", ROOT / "target/release/cairn"))
EXAMPLES = HERE.parent / "examples"


class Daemon:
    """`cairn demo` with services of its own."""

    def __init__(self):
        self.root = Path(tempfile.mkdtemp(prefix="cp", dir="/tmp"))
        self.ipc_prefix = f"{self.root.name}_"
        self.environment = {
            "CAIRN_IPC_ROOT": str(self.root / "ipc"),
            "CAIRN_IPC_PREFIX": self.ipc_prefix,
            "CAIRN_PREFIX": "py/robot",
        }
        self.process = None

    def start(self):
        assert BINARY.exists(), f"{BINARY} is not there: cargo build --release, or set CAIRN_BINARY"
        self.process = subprocess.Popen(
            [BINARY, "demo", "--seconds", "120", "--output", self.root / "demo", "--quiet"],
            env={**os.environ, **self.environment},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )

    def kill(self):
        self.process.kill()
        self.process.wait()

    def clean(self):
        if self.process is not None:
            self.kill()
        shutil.rmtree(self.root, ignore_errors=True)
        for file in Path("/dev/shm").glob(f"{self.ipc_prefix}*"):
            file.unlink(missing_ok=True)


@pytest.fixture(scope="module")
def daemon():
    daemon = Daemon()
    kept = {name: os.environ.get(name) for name in daemon.environment}
    os.environ.update(daemon.environment)
    daemon.start()
    assert cairn.connect().wait_for_daemon(20)
    poses = cairn.poses()
    assert tracked(poses)
    yield daemon
    poses.close()
    daemon.clean()
    for name, value in kept.items():
        os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


def tracked(poses, timeout=20.0):
    """The next pose that is one."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        pose = poses.wait(1.0)
        if pose is not None and pose.tracking:
            return pose
    raise AssertionError("no pose was tracked")


def test_the_layout_is_the_headers_which_is_the_daemons():
    header = (ROOT / "clients/c/cairn.h").read_text()
    names = {
        "_".join(re.findall("[A-Z][a-z]+", name)).lower(): getattr(messages, name)
        for name in dir(messages)
        if isinstance(getattr(messages, name), type) and name[0] != "_"
    }
    facts = re.findall(r"offsetof\(cairn_(\w+), (\w+)\) == (\d+) && sizeof\(.*?\) == (\d+)", header)
    assert len(facts) > 100
    listed = {}
    for type_name, field, offset, size in facts:
        described = getattr(names[type_name], field)
        assert (described.offset, described.size) == (int(offset), int(size)), f"{type_name}.{field}"
        listed.setdefault(type_name, []).append(field)
    for type_name, structure in names.items():
        assert [field for field, _ in structure._fields_] == listed[type_name]
        assert f'#define CAIRN_{type_name.upper()}_TYPE "{structure.type_name()}"' in header
        size = re.search(rf"sizeof\(cairn_{type_name}\) == (\d+)", header)
        assert ctypes.sizeof(structure) == int(size[1])


def test_the_words_are_the_headers_numbers():
    header = (ROOT / "clients/c/cairn.h").read_text()

    def numbers(prefix, skip=()):
        found = re.findall(rf"#define CAIRN_{prefix}_(\w+) \(?([0-9 <]+)\)?\n", header)
        return {name: eval(value) for name, value in found if name not in skip}  # noqa: S307 - digits and shifts

    assert numbers("STATE") == {name: i for i, name in enumerate(messages.STATES)}
    sources = {f"SOURCE_{name}": 1 << i for i, name in enumerate(messages.SCALE_SOURCES)}
    assert numbers("SCALE") == {name: i for i, name in enumerate(messages.SCALES)} | sources
    assert numbers("MAP_MODE") == {name: 1 << i for i, name in enumerate(messages.MAP_MODES)}
    assert numbers("EDGE") == {name: i for i, name in enumerate(messages.EDGES)}
    assert numbers("CLOCK") == {name: i for i, name in enumerate(messages.CLOCKS)}
    assert numbers("ERROR") == {name: 1 << i for i, name in enumerate(messages.ERRORS)}
    assert numbers("STAGE") == {name.upper(): i for i, name in enumerate(messages.STAGES)}
    assert numbers("COMMAND") == messages.COMMANDS
    assert numbers("REPLY") == {name: i for i, name in enumerate(messages.REPLIES)}


def test_a_frame_that_waited_in_its_driver_is_as_old_as_it_is():
    now = time.monotonic_ns()
    raw = messages.Pose(state=1, timestamp_ns=now - 5_000_000_000, arrival_ns=now)
    assert cairn.Pose(raw).tracking and 5.0 <= cairn.Pose(raw).age < 6.0 and not cairn.Pose(raw).usable(1.0)
    raw.clock = 1
    assert cairn.Pose(raw).usable(1.0)


def test_an_orientation_without_a_position_is_a_heading_and_nothing_to_drive_by():
    half = 0.5**0.5
    raw = messages.Pose(state=3, position=(math.nan,) * 3, odom_orientation=(0, 0, half, half), arrival_ns=time.monotonic_ns())
    pose = cairn.Pose(raw)
    assert pose.state == "ORIENTATION" and pose.oriented and not pose.tracking and not pose.usable(10.0)
    assert abs(pose.heading - math.pi / 2) < 1e-12
    raw.state = 4
    assert pose.state == "DEAD_RECKONING" and pose.dead_reckoned and pose.heading is not None and not pose.usable(10.0)
    for state, word in ((0, "INITIALIZING"), (2, "LOST"), (77, "UNKNOWN")):
        raw.state = state
        assert pose.state == word and pose.heading is None and not pose.usable(10.0), word
    raw.scale_source = 0b1000_0101
    assert pose.scale_source == ["WHEELS", "TAG", "UNKNOWN"]
    assert pose.metric is None
    raw.scale, raw.scale_sigma = 2, 0.25
    assert pose.metric == 0.25


def test_without_a_daemon_nothing_is_made_and_nothing_raised(tmp_path, monkeypatch):
    monkeypatch.setenv("CAIRN_IPC_ROOT", str(tmp_path / "none"))
    client = cairn.connect("nobody")
    assert client.poses().wait(0.1) is None
    assert client.map().latest() is None
    assert not client.wait_for_daemon(0.1)
    with pytest.raises(cairn.NoDaemon, match="nobody"):
        client.reset()
    assert not (tmp_path / "none").exists()
    for bad in ("a//b", "ä", "/a", "x" * 65):
        with pytest.raises(cairn.CairnError, match="prefix"):
            cairn.connect(bad)


def test_poses_come_in_order_and_are_fresh(daemon):
    got = []
    for pose in cairn.poses():
        got.append(pose)
        if len(got) == 40:
            break
    sequences = [pose.sequence for pose in got]
    assert sequences == sorted(set(sequences))
    pose = got[-1]
    assert pose.tracking and pose.state == "TRACKING" and pose.usable(0.5) and pose.live
    assert pose.position.shape == (3,) and np.isfinite(pose.position).all()
    assert abs(np.linalg.norm(pose.orientation) - 1) < 1e-9
    assert np.allclose(pose.map_from_body[:3, 3], pose.position)
    assert np.allclose(pose.map_from_odom @ pose.odom_from_body, pose.map_from_body)
    assert pose.covariance.shape == (6, 6) and np.array_equal(pose.covariance, pose.covariance.T)
    assert (np.linalg.eigvalsh(pose.covariance_in_map_axes) > 0).all()
    assert 0 <= pose.latency_arrival_ns < 2_000_000_000
    assert not pose.usable(0.0)


def test_the_latest_comes_at_once_and_again(daemon):
    begin = time.monotonic()
    pose, landmarks, health = cairn.latest_pose(), cairn.latest_map(), cairn.latest_health()
    assert pose is not None and landmarks is not None and health is not None
    assert time.monotonic() - begin < 5
    assert cairn.latest_pose().sequence >= pose.sequence
    assert health.version and health.pid == daemon.process.pid
    assert isinstance(health.errors, list) and health.stages["tracking"].steps > 0


def test_the_map_is_an_array_over_shared_memory(daemon):
    landmarks = cairn.connect().map().latest()
    assert len(landmarks) == landmarks.count > 50
    points = landmarks.points
    assert points.shape == (landmarks.count, 3) and points.dtype == np.float32
    assert np.isfinite(points).all() and not points.flags.writeable
    assert np.asarray(landmarks).shape == points.shape
    address = points.__array_interface__["data"][0]
    maps = [line.split() for line in Path("/proc/self/maps").read_text().splitlines()]
    inside = [line[-1] for line in maps if int(line[0].split("-")[0], 16) <= address < int(line[0].split("-")[1], 16)]
    assert inside and inside[0].startswith("/dev/shm/"), inside
    # The array holds it after everything else has gone.
    kept, copied = points, landmarks.copy()["position"]
    del landmarks, points
    time.sleep(1.2)
    assert np.array_equal(kept, copied)
    keyframes = cairn.connect().keyframes().latest()
    assert keyframes.positions.shape == (len(keyframes), 3) and len(keyframes) > 1


def test_too_many_maps_held_is_told_and_cured(daemon):
    maps = cairn.connect().map()
    held = [maps.wait(5), maps.wait(5)]
    with pytest.raises(cairn.TooManyHeld, match="copy"):
        for _ in range(20):
            held.append(maps.wait(1))
    held.clear()
    assert maps.wait(5) is not None


def test_pictures_are_arrays(daemon):
    frame = cairn.connect().frames().wait(10)
    assert frame.image.shape == (frame.height, frame.width) and frame.image.dtype == np.uint8
    assert 5 < frame.image.mean() < 250 and frame.image.std() > 2
    assert not frame.image.flags.writeable and frame.live


def test_the_cameras_own_bytes_come_with_their_lens(daemon):
    encoded = cairn.connect().encoded().wait(10)
    assert encoded.format == 0 and len(encoded.data) == encoded.stride * encoded.height > 0
    assert not encoded.data.flags.writeable
    assert encoded.focal_px[0] > 100 and len(encoded.distortion) == 5


def test_what_was_found_in_a_picture_is_an_array(daemon):
    lists = cairn.connect().features()
    features = lists.wait(10)
    # The first ones may be of a frame without a pose.
    for _ in range(30):
        if (features.landmarks != messages.NO_LANDMARK).any():
            break
        features = lists.wait(10)
    found, tracked = features.landmarks != messages.NO_LANDMARK, features.tracks != messages.NO_TRACK
    assert found.sum() > 20 and tracked.sum() > 20 and (found ^ tracked).all()
    assert features.points.shape == (len(features), 2)
    assert (features.points >= -0.5).all() and (features.points < [features.width, features.height]).all()


def test_what_holds_the_map_together_is_an_array_over_keyframes(daemon):
    client = cairn.connect()
    graphs, keyframes = client.graph(), client.keyframes()
    deadline = time.monotonic() + 30
    while len(graph := graphs.wait(10)) < 3:
        assert time.monotonic() < deadline
    known = keyframes.latest()
    while known.content_revision < graph.content_revision:
        known = keyframes.wait(10)
    assert graph.map_id == known.map_id and graph.total >= len(graph)
    covisible = graph.kinds == messages.EDGES.index("COVISIBLE")
    assert covisible.sum() > 2 and (graph.shared[covisible] > 0).all()
    assert (np.diff(graph.shared[covisible].astype(int)) <= 0).all(), "strongest first"
    assert (graph.froms < graph.tos).all() and np.isin(graph.tos, known.ids).mean() > 0.8
    assert (graph.joined_maps[covisible] == messages.NO_MAP).all() and not graph.elements.flags.writeable


def test_tags_say_where_they_are_and_what_is_not_known():
    raw = messages.Tags(count=2, scale=2, scale_sigma=0.01, map_id=3)
    raw.tags[0] = messages.Tag(id=7, sightings=2, position=(math.nan,) * 3, orientation=(math.nan,) * 4)
    half = math.sqrt(0.5)
    raw.tags[1] = messages.Tag(id=8, sightings=9, size=0.15, position=(1, -2, 0), orientation=(0, 0, -half, half), is_dock=1)
    tags = cairn.Tags(raw)
    assert len(tags) == 2 and [tag.id for tag in tags] == [7, 8] and tags.metric == pytest.approx(0.01)
    assert not tags[0].placed and np.isnan(tags[0].position).all() and not tags[0].dock
    assert tags[-1].placed and tags[1].dock and tags[1].family == "36h11"
    # Who looks straight at it looks to the right, along -y.
    assert np.allclose(tags[1].map_from_tag @ [1, 0, 0, 1], [1, -3, 0, 1])
    with pytest.raises(IndexError):
        tags[2]


def test_tags_come_with_every_map(daemon):
    tags = cairn.connect().tags().wait(10)
    assert len(tags) == 0 and tags.live, "the demo looks for none"


def test_commands_are_answered(daemon):
    client = cairn.connect()
    path = daemon.root / "map.ply"
    client.save_map(str(path))
    assert path.read_bytes().startswith(b"ply")
    with pytest.raises(cairn.Refused, match="INVALID") as refused:
        client.load_map(str(path))
    assert refused.value.reply == "INVALID", "a name, not a path"
    with pytest.raises(cairn.Refused, match="FAILED"):
        client.load_map("no-such-map")
    with pytest.raises(cairn.Refused, match="UNSUPPORTED"):
        client.command(4711)
    with pytest.raises(cairn.Refused, match="INVALID"):
        client.command("SET_POSE", orientation=(0, 0, 0, 2))


def test_a_simulated_camera_says_that_nothing_can_be_set_on_it(daemon):
    client = cairn.connect()
    with pytest.raises(cairn.Refused, match="UNSUPPORTED.*simulator .* has no exposure, gain or focus"):
        client.camera_controls()
    with pytest.raises(cairn.Refused, match="UNSUPPORTED"):
        client.set_camera("exposure", "auto")
    with pytest.raises(cairn.Refused, match="INVALID.*a number or auto"):
        client.set_camera("zoom", 2)
    with pytest.raises(cairn.Refused, match="UNSUPPORTED.*simulator .* is no camera"):
        client.camera_identity()
    with pytest.raises(cairn.Refused, match="UNSUPPORTED.*is no camera"):
        client.keep_calibration("camera.toml")


def test_a_cameras_answer_is_read_line_by_line():
    exposure, gain = cairn.camera.controls("exposure ms 0.3 204.7 0.1 25 8 auto\nsenseless\ngain steps 0 255 1 64 NaN manual-only more")
    assert exposure == ("exposure", "ms", 0.3, 204.7, 0.1, 25.0, 8.0, True)
    assert gain.name == "gain" and gain.auto is None and np.isnan(gain.value)


def test_maps_are_stored_listed_left_and_gone_on_in(daemon):
    client = cairn.connect()
    healths = client.health()
    deadline = time.monotonic() + 20
    while healths.wait(10).keyframes < 4:
        assert time.monotonic() < deadline
    client.store_map("room")
    assert [(name, current) for name, _, _, current in client.list_maps()] == [("room", False)]
    with pytest.raises(cairn.Refused, match="already"):
        client.store_map("room")
    with pytest.raises(cairn.Refused, match="already"):  # it is the present map
        client.merge_map("room")
    copy, own = client.copy_map()
    assert os.path.getsize(copy) > 4096 and own == ""
    os.remove(copy)
    before = healths.wait(10)
    client.load_map("room")
    assert [current for *_, current in client.list_maps()] == [True]
    client.localise_only(True)
    while (health := healths.wait(10)).reset_counter == before.reset_counter:
        assert time.monotonic() < deadline + 20
    assert health.map_id != before.map_id
    client.localise_only(False)
    client.new_map("other")
    assert {name: current for name, _, _, current in client.list_maps()}["room"] is False


def test_the_robot_is_where_a_planner_says_it_is(daemon):
    client = cairn.connect()
    poses, maps = client.poses(), client.map()
    before = tracked(poses)
    client.set_pose(100.0, -50.0, yaw=1.0)
    while (after := tracked(poses)).reset_counter == before.reset_counter:
        pass
    assert np.linalg.norm(after.position - [100, -50, 0]) < 2
    assert after.reset_counter == before.reset_counter + 1 and after.map_id == before.map_id
    landmarks = maps.wait(5)
    while landmarks.reset_counter != after.reset_counter:
        landmarks = None  # two may be held
        landmarks = maps.wait(5)
    assert np.linalg.norm(np.median(landmarks.points, axis=0) - [100, -50, 0]) < 20


def test_another_version_is_told_so(daemon, monkeypatch):
    monkeypatch.setattr(messages.Pose, "type_name", classmethod(lambda cls: "cairn.Pose.v0"))
    with pytest.raises(cairn.VersionMismatch, match=r"cairn\.Pose\.v2 of 448 bytes.*cairn\.Pose\.v0"):
        cairn.poses().wait(5)


def test_another_iceoryx2_is_told_so(daemon):
    kept = {}
    try:
        for file in (daemon.root / "ipc/services").iterdir():
            kept[file] = file.read_bytes()
            assert b"minor = 10" in kept[file]
            file.unlink()
            file.write_bytes(kept[file].replace(b"minor = 10", b"minor = 99"))
            file.chmod(0o400)
        with pytest.raises(cairn.VersionMismatch, match="another version of iceoryx2"):
            cairn.poses().wait(5)
    finally:
        for file, text in kept.items():
            file.unlink()
            file.write_bytes(text)
            file.chmod(0o400)
    assert cairn.poses().wait(5) is not None


def test_the_ninth_subscriber_is_told_that_the_house_is_full(daemon):
    client = cairn.connect()
    guests = [client.health() for _ in range(9)]
    with pytest.raises(cairn.TooManySubscribers, match="8 subscribers"):
        for guest in guests:
            assert guest.wait(5) is not None
    for guest in guests:
        guest.close()
    assert client.health().wait(5) is not None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can hand files to another user")
def test_another_users_daemon_is_refused_with_the_reason_and_the_cure(daemon):
    services = list((daemon.root / "ipc/services").iterdir())
    try:
        for file in services:
            os.chown(file, 65534, -1)
        with pytest.raises(cairn.OtherOwner, match=r"65534.*same user"):
            cairn.poses()
    finally:
        for file in services:
            os.chown(file, 0, -1)
    assert cairn.poses().wait(5) is not None


@pytest.mark.parametrize(("taken", "fault"), [("folder", "is no file"), ("garbage", "does not hold what it should")])
def test_a_squatted_name_is_told_with_owner_and_cure(daemon, taken, fault):
    (counter,) = Path("/dev/shm").glob(f"{daemon.ipc_prefix}*.global_mgmt")
    kept = counter.with_name(f"kept-{counter.name}")
    counter.rename(kept)
    try:
        if taken == "folder":
            counter.mkdir()
        else:
            counter.write_bytes(os.urandom(4096))
        with pytest.raises(cairn.IpcError, match=rf"{counter} belongs to user .* and {fault}.*sudo rm -r {counter}"):
            cairn.connect().poses().wait(20)
    finally:
        shutil.rmtree(counter) if counter.is_dir() else counter.unlink()
        kept.rename(counter)
    assert cairn.poses().wait(5) is not None


def test_a_reply_that_cannot_be_received_is_an_error_of_ours(daemon, monkeypatch):
    class Broken:
        """Every step to the reply, and then none."""

        number_of_servers, is_connected = 1, True

        def __getattr__(self, _):
            return lambda *_: self

        def receive(self):
            raise iox2.ReceiveError("ConnectionFailure")

        @property
        def dynamic_config(self):
            return self

    client = cairn.connect()
    monkeypatch.setattr(client, "_shared_node", Broken)
    with pytest.raises(cairn.IpcError, match=r"receiving the reply failed: ConnectionFailure.*send it again"):
        client.reset()


def test_other_threads_run_while_one_waits(daemon):
    """iceoryx2 lets go of the interpreter while it sleeps."""
    waiter = threading.Thread(target=lambda: cairn.connect("py/nobody").poses().wait(0.5))
    waiter.start()
    turns = 0
    while waiter.is_alive():
        turns += 1
        time.sleep(0.01)
    assert turns > 10


@pytest.mark.parametrize(
    ("script", "arguments", "said"),
    [
        ("planner.py", ["3", "1", "--seconds", "3"], "speed"),
        ("plot.py", ["--seconds", "3", "--save", "plot.png"], "landmarks"),
        ("wheels.py", ["--seconds", "1"], "messages to a daemon"),
    ],
)
def test_the_examples_run(daemon, script, arguments, said, tmp_path):
    if script == "plot.py":
        pytest.importorskip("matplotlib")
    done = subprocess.run(
        [sys.executable, EXAMPLES / script, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert said in done.stdout, done.stdout
    if script == "plot.py":
        assert (tmp_path / "plot.png").stat().st_size > 10_000


def test_a_driver_tells_of_the_wheels_and_is_the_only_one(daemon):
    wheels = cairn.connect().wheels()
    health = cairn.connect().health()
    before = health.wait(5.0).wheel_messages
    end = time.monotonic() + 2.0
    while time.monotonic() < end:
        wheels.send(0.2, 0.0, 0.1)
        time.sleep(0.02)
    after = health.latest()
    assert after.wheel_messages >= before + 50
    assert "WHEELS_WRONG" not in after.errors
    with pytest.raises(cairn.SecondPublisher, match="only one driver"):
        cairn.connect().wheels().send(0.2, 0.0, 0.1)
    refused = after.wheel_refused
    wheels.publish(time.monotonic_ns(), (math.nan, 0.0, 0.0))
    wheels.publish(time.time_ns(), (0.2, 0.0, 0.0))
    end = time.monotonic() + 5.0
    while health.latest().wheel_refused < refused + 2:
        assert time.monotonic() < end
        time.sleep(0.05)
    wheels.close()


def test_a_restarted_daemon_is_found_again(daemon):
    """Last: it kills the daemon."""
    poses = cairn.connect().poses()
    first = tracked(poses)
    daemon.kill()
    stale = poses.latest()
    time.sleep(1.0)
    assert not stale.usable(0.2)
    daemon.start()
    end = time.monotonic() + 30
    while time.monotonic() < end:
        pose = poses.wait(1.0)
        if pose is not None and pose.run_id != first.run_id:
            return
    raise AssertionError("no pose of the new daemon")
