"""What subscriptions yield: messages with numpy arrays and words in them."""

import ctypes
import math
import time

import numpy as np

from . import messages as m

LANDMARK = np.dtype([("id", "<u4"), ("observations", "<u4"), ("position", "<f4", 3), ("sigma", "<f4")])
FEATURE = np.dtype([("track", "<u8"), ("position", "<f4", 2), ("age", "<u4"), ("landmark", "<u4")])
GRAPH_EDGE = np.dtype(
    [
        ("from", "<u4"),
        ("to", "<u4"),
        ("shared", "<u4"),
        ("joined_map", "<u4"),
        ("kind", "u1"),
        ("reserved", "u1", 3),
    ]
)
KEYFRAME = np.dtype(
    [("timestamp_ns", "<i8"), ("position", "<f8", 3), ("orientation", "<f8", 4), ("id", "<u4"), ("reserved", "<u4")]
)


def rotation_matrix(orientation):
    """3x3 of a unit quaternion (x, y, z, w)."""
    x, y, z, w = orientation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class Value:
    """One message. Its fields have the wire's names (src/messages/WIRE.md); arrays are numpy's, times not known are None."""

    __slots__ = ("raw", "__weakref__")

    def __init__(self, raw):
        self.raw = raw

    def __getattr__(self, name):
        if name == "raw":  # not yet there, while an instance is being copied
            raise AttributeError(name)
        value = getattr(self.raw, name)
        if isinstance(value, ctypes.Array):
            return np.ctypeslib.as_array(value)
        return None if value == m.UNKNOWN_NS else value

    @property
    def clock(self):
        """MONOTONIC: `timestamp_ns` is a camera's, comparable with time.monotonic_ns(); RECORDING: a recording's own time."""
        return m.word(m.CLOCKS, self.raw.clock)

    @property
    def live(self):
        """Not a recording's time."""
        return self.clock == "MONOTONIC"

    @property
    def scale(self):
        """UNKNOWN (lengths are arbitrary), ESTIMATED (meant to be metres), METRIC (metres)."""
        return m.word(m.SCALES, self.raw.scale)

    @property
    def metric(self):
        """Lengths are metres: their relative standard deviation (0.01: 1 %); None where they are of an arbitrary unit."""
        return self.raw.scale_sigma if self.scale == "METRIC" else None

    @property
    def scale_source(self):
        """What the scale comes from, as words; empty = nothing."""
        return m.bits(m.SCALE_SOURCES, self.raw.scale_source)

    @property
    def map_mode(self):
        """How the map is used, as words (in health, maps and keyframes)."""
        return m.bits(m.MAP_MODES, self.raw.map_mode)

    @property
    def state(self):
        """INITIALIZING, ORIENTATION (how the body has turned is known, not where it is), TRACKING, LOST, DEAD_RECKONING (by the wheels alone), or UNKNOWN for one of a newer daemon."""
        return m.word(m.STATES, self.raw.state)

    def __repr__(self):
        return f"<{type(self).__name__} {self.sequence} {self.state}>"


class Pose(Value):
    """One frame's pose. Unless `tracking` or `dead_reckoned`, everything that belongs to the pose is NaN or zero, but for the rotation while `oriented`."""

    __slots__ = ()

    @property
    def tracking(self):
        """There is a pose in this message."""
        return self.raw.state == 1

    @property
    def oriented(self):
        """The orientations and their covariance are known: of a pose, or alone, before there is a map."""
        return self.state in ("TRACKING", "ORIENTATION", "DEAD_RECKONING")

    @property
    def dead_reckoned(self):
        """The picture is lost and the wheels alone carry the pose on; its covariance grows, and it is not `usable`."""
        return self.state == "DEAD_RECKONING"

    @property
    def heading(self):
        """Angle about the vertical in odom, counter-clockwise from above, rad; None unless `oriented`. It goes on into the first map."""
        return _yaw(self.raw.odom_orientation) if self.oriented else None

    @property
    def age(self):
        """Seconds since the frame was taken or, of a recording, arrived in the daemon."""
        raw = self.raw
        return (time.monotonic_ns() - (min(raw.timestamp_ns, raw.arrival_ns) if self.live else raw.arrival_ns)) * 1e-9

    def usable(self, max_age=0.2):
        """The robot may act on it: it was tracked, and its frame is no older than `max_age` seconds (nor in the future)."""
        return self.tracking and 0.0 <= self.age <= max_age

    @property
    def anchor_keyframe(self):
        """Keyframe that the covariance is relative to, or None."""
        return None if self.raw.anchor_keyframe == m.NO_KEYFRAME else self.raw.anchor_keyframe

    @property
    def yaw(self):
        """Angle about the vertical in the map, counter-clockwise from above, rad."""
        return _yaw(self.raw.orientation)

    @property
    def map_from_body(self):
        """4x4: points of the robot's body into the map."""
        return _matrix(self.raw.position, self.raw.orientation)

    @property
    def odom_from_body(self):
        """4x4: points of the robot's body into odom, which never jumps within one `reset_counter`."""
        return _matrix(self.raw.odom_position, self.raw.odom_orientation)

    @property
    def map_from_odom(self):
        """4x4, as REP-105 wants it."""
        return self.map_from_body @ np.linalg.inv(self.odom_from_body)

    @property
    def covariance(self):
        """6x6: x, y, z, rotation about x, y, z, in the body's axes; NaN = unknown."""
        full = np.empty((6, 6))
        rows, columns = np.triu_indices(6)
        full[rows, columns] = full[columns, rows] = self.raw.covariance
        return full

    @property
    def covariance_in_map_axes(self):
        """6x6 along the map's axes, as nav_msgs/Odometry and MAVLink's ODOMETRY define theirs."""
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = rotation_matrix(self.raw.orientation)
        return turn @ self.covariance @ turn.T


def _yaw(orientation):
    x, y, z, w = orientation
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _matrix(position, orientation):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(orientation)
    matrix[:3, 3] = position
    return matrix


class Health(Value):
    """How the daemon is."""

    __slots__ = ()

    @property
    def errors(self):
        """Faults that stand now, as words."""
        return m.bits(m.ERRORS, self.raw.errors)

    @property
    def stages(self):
        """By name: steps, heartbeat_age_ns, p50_ms, p95_ms, p99_ms, rate_hz."""
        return dict(zip(m.STAGES, self.raw.stages))

    @property
    def intrinsics(self):
        """CALIBRATED, ESTIMATED (from the motion) or GUESSED, or UNKNOWN for one of a newer daemon; how surely: `focal_sigma`."""
        return m.word(m.INTRINSICS, self.raw.intrinsics)

    @property
    def lens_model(self):
        """RADIAL_TANGENTIAL (pinhole) or KANNALA_BRANDT (wide angle: `focal_px` is pixels per radian), or UNKNOWN for one of a newer daemon."""
        return m.word(m.LENS_MODELS, self.raw.lens_model)

    @property
    def version(self):
        """Of the daemon."""
        return bytes(self.raw.version).split(b"\0")[0].decode("utf-8", "replace")

    @property
    def age(self):
        """Seconds since it was sent."""
        return (time.monotonic_ns() - self.raw.published_ns) * 1e-9


class Obstacles(Value):
    """What stands around the robot, by bearing, in its axes on the floor. Unknown is NaN in `range` and 0 in `free`: never far, never free."""

    __slots__ = ()

    @property
    def told(self):
        """The scan says something; else all of it is unknown, and `why` says why."""
        return self.raw.told == 0

    @property
    def why(self):
        """TOLD, NO_POSE, NOT_METRIC, NO_FLOOR, or UNKNOWN for one of a newer daemon."""
        return m.word(m.OBSTACLES_TOLD, self.raw.told)

    @property
    def angles(self):
        """Of the bearings, from the robot's forward to the left, rad."""
        return self.raw.angle_min + self.raw.angle_increment * np.arange(len(self.raw.range), dtype=np.float32)

    @property
    def points(self):
        """(N, 4): forward, left, up, standard deviation along the floor, m; nearest first."""
        return np.ctypeslib.as_array(self.raw.points)[: self.raw.count]

    def laser_scan(self):
        """The fields of sensor_msgs/LaserScan but for its header; unknown is NaN, never infinity (REP-117)."""
        angles = self.angles
        return {
            "angle_min": float(angles[0]),
            "angle_max": float(angles[-1]),
            "angle_increment": self.raw.angle_increment,
            "time_increment": 0.0,
            "scan_time": 0.0,
            "range_min": self.raw.range_min,
            "range_max": self.raw.range_max,
            "ranges": self.range,
            "intensities": np.empty(0, np.float32),
        }

    def __repr__(self):
        return f"<Obstacles {self.sequence} {self.why}: {self.count} of {self.total} points>"


class Tag(Value):
    """A tag: its number `id`, `sightings`, and where it is, once it was seen from enough directions."""

    __slots__ = ()

    @property
    def placed(self):
        """Its place in the map is known; else position, orientation, edge and sigmas are NaN."""
        return bool(np.isfinite(self.raw.position).all() and np.isfinite(self.raw.orientation).all())

    @property
    def family(self):
        """36h11, or UNKNOWN for one of a newer daemon."""
        return m.word(m.FAMILIES, self.raw.family)

    @property
    def dock(self):
        """It is the dock of the daemon's configuration."""
        return self.raw.is_dock == 1

    @property
    def map_from_tag(self):
        """4x4: the axes of a robot that looks straight at it (x into the tag, y left, z up) in the map."""
        return _matrix(self.raw.position, self.raw.orientation)

    def __repr__(self):
        return f"<Tag {self.id}: {self.sightings} sightings, {'placed' if self.placed else 'not placed yet'}>"


class Tags(Value):
    """The tags that the map's keyframes have seen, as they were at one moment: a sequence of Tag, by number."""

    __slots__ = ()

    def __len__(self):
        return min(self.raw.count, m.MAX_TAGS)

    def __getitem__(self, index):
        return Tag(self.raw.tags[range(len(self))[index]])

    def __repr__(self):
        return f"<Tags of map {self.map_id} content {self.content_revision}: {len(self)}>"


class _Slice(Value):
    """Elements in shared memory, held as long as this object or an array of it lives. Never changes."""

    __slots__ = ("elements",)

    def __init__(self, sample, port, header, dtype):
        count = sample.header.number_of_elements
        # iceoryx2's own Slice.as_memory_view does not keep the sample: this buffer does, and numpy keeps the buffer.
        size = count * dtype.itemsize
        buffer = (ctypes.c_uint8 * size).from_address(sample.payload_ptr) if size else bytes(0)
        if size:
            # The subscriber too: without it the publisher takes the memory back and writes the next message into it.
            buffer.held = (sample, port)
        self.elements = np.frombuffer(buffer, dtype)
        self.elements.flags.writeable = False
        super().__init__(header.from_buffer_copy(ctypes.string_at(sample.user_header_ptr, ctypes.sizeof(header))))

    def __len__(self):
        return len(self.elements)

    def copy(self):
        """The elements, apart from shared memory."""
        return self.elements.copy()


class Map(_Slice):
    """The sparse map as it was at one moment."""

    __slots__ = ()

    def __init__(self, sample, port):
        super().__init__(sample, port, m.MapHeader, LANDMARK)

    points = property(lambda self: self.elements["position"], doc="(N, 3) float32, map units: a view.")
    ids = property(lambda self: self.elements["id"], doc="(N,) never reused within a run.")
    observations = property(lambda self: self.elements["observations"], doc="(N,) keyframes that see it.")
    sigma = property(lambda self: self.elements["sigma"], doc="(N,) along the line of sight, map units; NaN = unknown.")

    def __array__(self, dtype=None, copy=None):
        points = self.points if dtype is None else self.points.astype(dtype)
        return points.copy() if copy else points

    def __repr__(self):
        return f"<Map {self.map_id} content {self.content_revision}: {len(self)} of {self.total} landmarks>"


class Keyframes(_Slice):
    """The keyframes as they were at one moment."""

    __slots__ = ()

    def __init__(self, sample, port):
        super().__init__(sample, port, m.KeyframesHeader, KEYFRAME)

    positions = property(lambda self: self.elements["position"], doc="(N, 3), map units: a view.")
    orientations = property(lambda self: self.elements["orientation"], doc="(N, 4) quaternions x, y, z, w: a view.")
    ids = property(lambda self: self.elements["id"], doc="(N,) never reused within a run.")
    timestamps_ns = property(lambda self: self.elements["timestamp_ns"], doc="(N,) in the source's clock.")

    def __repr__(self):
        return f"<Keyframes of map {self.map_id} content {self.content_revision}: {len(self)} of {self.total}>"


class Graph(_Slice):
    """What held the map together at one moment: joins, closed loops, then what is covisible, strongest first."""

    __slots__ = ()

    def __init__(self, sample, port):
        super().__init__(sample, port, m.GraphHeader, GRAPH_EDGE)

    froms = property(lambda self: self.elements["from"], doc="(N,) ids of the older keyframes: a view.")
    tos = property(lambda self: self.elements["to"], doc="(N,) ids of the newer keyframes: a view.")
    shared = property(lambda self: self.elements["shared"], doc="(N,) landmarks that both see.")
    joined_maps = property(lambda self: self.elements["joined_map"], doc="(N,) of a join the other map's number, else `NO_MAP`.")
    kinds = property(lambda self: self.elements["kind"], doc="(N,) index of `messages.EDGES`.")

    def __repr__(self):
        return f"<Graph of map {self.map_id} content {self.content_revision}: {len(self)} of {self.total} edges>"


class Frame(_Slice):
    """A grey picture as the camera gave it, lens distortion included."""

    __slots__ = ()

    def __init__(self, sample, port):
        super().__init__(sample, port, m.FrameHeader, np.dtype("u1"))

    @property
    def image(self):
        """(H, W) uint8: a view."""
        height, width, stride = self.raw.height, self.raw.width, self.raw.stride
        if stride < width or stride * height > len(self.elements):
            raise ValueError(f"a picture of {width}x{height} px, stride {stride}, in {len(self.elements)} bytes")
        return self.elements[: stride * height].reshape(height, stride)[:, :width]

    def __repr__(self):
        return f"<Frame {self.sequence} {self.width}x{self.height}>"


class Features(_Slice):
    """What was found in one picture: landmarks that the pose rests on, then tracks."""

    __slots__ = ()

    def __init__(self, sample, port):
        super().__init__(sample, port, m.FeaturesHeader, FEATURE)

    points = property(lambda self: self.elements["position"], doc="(N, 2) float32, px: a view.")
    tracks = property(lambda self: self.elements["track"], doc="(N,) `NO_TRACK` where a landmark was found.")
    ages = property(lambda self: self.elements["age"], doc="(N,) frames since the corner was detected.")
    landmarks = property(lambda self: self.elements["landmark"], doc="(N,) `NO_LANDMARK` for a track.")

    def __repr__(self):
        return f"<Features of {self.sequence}: {len(self)} of {self.total}>"


class Encoded(_Slice):
    """A picture's bytes as they came from the camera: `format` says what they are (0 grey, 1 YUYV, 2 JPEG, 3 PNG)."""

    __slots__ = ()

    def __init__(self, sample, port):
        super().__init__(sample, port, m.EncodedHeader, np.dtype("u1"))

    @property
    def data(self):
        """(N,) uint8: a view."""
        return self.elements

    def __repr__(self):
        return f"<Encoded {self.sequence} {self.width}x{self.height}, {len(self.elements)} bytes>"
