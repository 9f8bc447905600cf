"""The messages as they lie in shared memory: ctypes twins of `src/messages`.

Fields, units and frames: src/messages/WIRE.md. A test holds every offset against `clients/c/cairn.h`, which is made from the Rust
sources.
"""

import ctypes as c

UNKNOWN_NS = -(2**63)
NO_KEYFRAME = 2**32 - 1
NO_LANDMARK = 2**32 - 1
NO_MAP = 2**32 - 1
NO_TRACK = 2**64 - 1
TEXT_LEN = 512

STATES = ("INITIALIZING", "TRACKING", "LOST", "ORIENTATION", "DEAD_RECKONING")
SCALES = ("UNKNOWN", "ESTIMATED", "METRIC")
SCALE_SOURCES = ("WHEELS", "HEIGHT", "TAG", "STORED_MAP")
MAP_MODES = ("LOCALISATION_ONLY", "STORED", "DOCK_FRAME")
EDGES = ("COVISIBLE", "LOOP", "JOIN")
CLOCKS = ("MONOTONIC", "RECORDING")
INTRINSICS = ("CALIBRATED", "ESTIMATED", "GUESSED")
LENS_MODELS = ("RADIAL_TANGENTIAL", "KANNALA_BRANDT")
ERRORS = (
    "NO_CAMERA",
    "NO_FRAMES",
    "NO_FEATURES",
    "LOW_FEATURES",
    "DROPPED_FRAMES",
    "CORRUPT_FRAMES",
    "BAD_CALIBRATION",
    "BAD_TIMESTAMP",
    "STALLED_STAGE",
    "MAPPING_LATE",
    "LOST",
    "SAVE_FAILED",
    "PUBLISH_FAILED",
    "UNCALIBRATED",
    "LOW_RATE",
    "SCALE_ASSUMED",
    "WHEELS_SILENT",
    "WHEELS_WRONG",
    "WHEELS_LATE",
)
OBSTACLES_TOLD = ("TOLD", "NO_POSE", "NOT_METRIC", "NO_FLOOR")
OBSTACLE_BEARINGS = 180
OBSTACLE_POINTS = 500
MAX_TAGS = 16
FAMILIES = ("36h11",)
STAGES = ("capture", "features", "tracking", "mapping", "publishing", "end_to_end")

COMMANDS = {
    "RESET": 1,
    "SAVE_TRAJECTORY": 2,
    "SAVE_MAP": 3,
    "LOAD_MAP": 4,
    "SET_POSE": 5,
    "STORE_MAP": 6,
    "NEW_MAP": 7,
    "LOCALISE": 8,
    "LIST_MAPS": 9,
    "COPY_MAP": 10,
    "CAMERA_CONTROLS": 11,
    "SET_CAMERA": 12,
    "CAMERA_IDENTITY": 13,
    "KEEP_CALIBRATION": 14,
    "MERGE_MAP": 15,
}
REPLIES = ("OK", "UNSUPPORTED", "INVALID", "FAILED", "BUSY")


def word(words, value):
    """A value of a newer daemon is UNKNOWN, and not taken for a good one."""
    return words[value] if value < len(words) else "UNKNOWN"


def bits(words, value):
    """Words of the bits that are set; those of a newer daemon together are UNKNOWN."""
    return [name for bit, name in enumerate(words) if value >> bit & 1] + ["UNKNOWN"] * (value >> len(words) != 0)


class _Message(c.Structure):
    VERSION = 1

    @classmethod
    def type_name(cls):
        """What iceoryx2 compares when two processes meet."""
        return f"cairn.{cls.__name__}.v{cls.VERSION}"


class Pose(_Message):
    VERSION = 2
    _fields_ = [
        ("run_id", c.c_uint64),
        ("sequence", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("arrival_ns", c.c_int64),
        ("published_ns", c.c_int64),
        ("latency_arrival_ns", c.c_int64),
        ("latency_capture_ns", c.c_int64),
        ("frames_dropped", c.c_uint64),
        ("position", c.c_double * 3),
        ("orientation", c.c_double * 4),
        ("odom_position", c.c_double * 3),
        ("odom_orientation", c.c_double * 4),
        ("covariance", c.c_double * 21),
        ("linear_velocity", c.c_double * 3),
        ("angular_velocity", c.c_double * 3),
        ("quality", c.c_float),
        ("scale_sigma", c.c_float),
        ("landmarks", c.c_uint32),
        ("landmarks_sought", c.c_uint32),
        ("reset_counter", c.c_uint32),
        ("map_id", c.c_uint32),
        ("map_revision", c.c_uint32),
        ("anchor_keyframe", c.c_uint32),
        ("state", c.c_uint8),
        ("scale", c.c_uint8),
        ("scale_source", c.c_uint8),
        ("clock", c.c_uint8),
        ("keyframe", c.c_uint8),
        ("reserved", c.c_uint8 * 19),
    ]


class StageHealth(_Message):
    _fields_ = [
        ("steps", c.c_uint64),
        ("heartbeat_age_ns", c.c_int64),
        ("p50_ms", c.c_float),
        ("p95_ms", c.c_float),
        ("p99_ms", c.c_float),
        ("rate_hz", c.c_float),
    ]


class Health(_Message):
    VERSION = 3
    _fields_ = [
        ("run_id", c.c_uint64),
        ("sequence", c.c_uint64),
        ("published_ns", c.c_int64),
        ("uptime_ns", c.c_int64),
        ("realtime_minus_monotonic_ns", c.c_int64),
        ("errors", c.c_uint64),
        ("frames_captured", c.c_uint64),
        ("frames_dropped", c.c_uint64),
        ("frames_corrupt", c.c_uint64),
        ("frames_tracked", c.c_uint64),
        ("keyframes_made", c.c_uint64),
        ("landmarks_made", c.c_uint64),
        ("adjustments", c.c_uint64),
        ("adjustments_late", c.c_uint64),
        ("resets", c.c_uint64),
        ("relocalisations", c.c_uint64),
        ("maps_joined", c.c_uint64),
        ("loops_closed", c.c_uint64),
        ("frame_age_ns", c.c_int64),
        ("pose_age_ns", c.c_int64),
        ("stages", StageHealth * len(STAGES)),
        ("keyframes", c.c_uint32),
        ("landmarks", c.c_uint32),
        ("maps", c.c_uint32),
        ("reset_counter", c.c_uint32),
        ("map_id", c.c_uint32),
        ("map_revision", c.c_uint32),
        ("pid", c.c_uint32),
        ("state", c.c_uint8),
        ("clock", c.c_uint8),
        ("intrinsics", c.c_uint8),
        ("lens_model", c.c_uint8),
        ("version", c.c_uint8 * 32),
        ("focal_px", c.c_float * 2),
        ("centre_px", c.c_float * 2),
        ("focal_sigma", c.c_float),
        ("centre_sigma_px", c.c_float),
        ("correction_distance", c.c_float),
        ("correction_rad", c.c_float),
        ("map_mode", c.c_uint8),
        ("reserved", c.c_uint8 * 15),
        ("blind_ns", c.c_uint64),
        ("blind_m", c.c_double),
        ("wheel_messages", c.c_uint64),
        ("wheel_refused", c.c_uint64),
        ("wheel_missing", c.c_uint64),
        ("wheel_late", c.c_uint64),
    ]


class Landmark(_Message):
    _fields_ = [
        ("id", c.c_uint32),
        ("observations", c.c_uint32),
        ("position", c.c_float * 3),
        ("sigma", c.c_float),
    ]


class MapHeader(_Message):
    VERSION = 2
    _fields_ = [
        ("run_id", c.c_uint64),
        ("content_revision", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("published_ns", c.c_int64),
        ("count", c.c_uint32),
        ("total", c.c_uint32),
        ("map_id", c.c_uint32),
        ("reset_counter", c.c_uint32),
        ("map_revision", c.c_uint32),
        ("scale_sigma", c.c_float),
        ("scale", c.c_uint8),
        ("scale_source", c.c_uint8),
        ("clock", c.c_uint8),
        ("map_mode", c.c_uint8),
        ("reserved", c.c_uint8 * 4),
    ]


class Keyframe(_Message):
    _fields_ = [
        ("timestamp_ns", c.c_int64),
        ("position", c.c_double * 3),
        ("orientation", c.c_double * 4),
        ("id", c.c_uint32),
        ("reserved", c.c_uint32),
    ]


class KeyframesHeader(_Message):
    VERSION = 2
    _fields_ = MapHeader._fields_


class GraphEdge(_Message):
    _fields_ = [
        ("from", c.c_uint32),
        ("to", c.c_uint32),
        ("shared", c.c_uint32),
        ("joined_map", c.c_uint32),
        ("kind", c.c_uint8),
        ("reserved", c.c_uint8 * 3),
    ]


class GraphHeader(_Message):
    _fields_ = [
        ("run_id", c.c_uint64),
        ("content_revision", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("published_ns", c.c_int64),
        ("count", c.c_uint32),
        ("total", c.c_uint32),
        ("map_id", c.c_uint32),
        ("reset_counter", c.c_uint32),
        ("map_revision", c.c_uint32),
        ("clock", c.c_uint8),
        ("map_mode", c.c_uint8),
        ("reserved", c.c_uint8 * 10),
    ]


class FrameHeader(_Message):
    _fields_ = [
        ("run_id", c.c_uint64),
        ("sequence", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("arrival_ns", c.c_int64),
        ("width", c.c_uint32),
        ("height", c.c_uint32),
        ("stride", c.c_uint32),
        ("clock", c.c_uint8),
        ("reserved", c.c_uint8 * 3),
    ]


class Feature(_Message):
    _fields_ = [
        ("track", c.c_uint64),
        ("position", c.c_float * 2),
        ("age", c.c_uint32),
        ("landmark", c.c_uint32),
    ]


class FeaturesHeader(_Message):
    _fields_ = [
        ("run_id", c.c_uint64),
        ("sequence", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("arrival_ns", c.c_int64),
        ("width", c.c_uint32),
        ("height", c.c_uint32),
        ("count", c.c_uint32),
        ("total", c.c_uint32),
        ("clock", c.c_uint8),
        ("reserved", c.c_uint8 * 7),
    ]


class EncodedHeader(_Message):
    _fields_ = [
        ("run_id", c.c_uint64),
        ("sequence", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("arrival_ns", c.c_int64),
        ("focal_px", c.c_double * 2),
        ("centre_px", c.c_double * 2),
        ("distortion", c.c_double * 5),
        ("camera_position", c.c_double * 3),
        ("camera_orientation", c.c_double * 4),
        ("width", c.c_uint32),
        ("height", c.c_uint32),
        ("stride", c.c_uint32),
        ("format", c.c_uint8),
        ("clock", c.c_uint8),
        ("intrinsics", c.c_uint8),
        ("lens_model", c.c_uint8),
        ("reserved", c.c_uint8 * 16),
    ]


class Command(_Message):
    _fields_ = [
        ("kind", c.c_uint32),
        ("path_len", c.c_uint32),
        ("path", c.c_uint8 * TEXT_LEN),
        ("position", c.c_double * 3),
        ("orientation", c.c_double * 4),
    ]


class CommandReply(_Message):
    _fields_ = [
        ("code", c.c_uint32),
        ("message_len", c.c_uint32),
        ("message", c.c_uint8 * TEXT_LEN),
    ]


class WheelOdometry(_Message):
    _fields_ = [
        ("sequence", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("interval_start_ns", c.c_int64),
        ("linear_x_mps", c.c_double),
        ("linear_y_mps", c.c_double),
        ("angular_z_radps", c.c_double),
        ("variance", c.c_double * 3),
        ("reserved", c.c_uint8 * 24),
    ]


class Obstacles(_Message):
    _fields_ = [
        ("run_id", c.c_uint64),
        ("sequence", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("published_ns", c.c_int64),
        ("position", c.c_double * 3),
        ("orientation", c.c_double * 4),
        ("angle_min", c.c_float),
        ("angle_increment", c.c_float),
        ("range_min", c.c_float),
        ("range_max", c.c_float),
        ("robot_height", c.c_float),
        ("scale_sigma", c.c_float),
        ("map_id", c.c_uint32),
        ("reset_counter", c.c_uint32),
        ("map_revision", c.c_uint32),
        ("count", c.c_uint32),
        ("total", c.c_uint32),
        ("told", c.c_uint8),
        ("clock", c.c_uint8),
        ("reserved", c.c_uint8 * 2),
        ("range", c.c_float * OBSTACLE_BEARINGS),
        ("sigma", c.c_float * OBSTACLE_BEARINGS),
        ("free_from", c.c_float * OBSTACLE_BEARINGS),
        ("free", c.c_float * OBSTACLE_BEARINGS),
        ("points", (c.c_float * 4) * OBSTACLE_POINTS),
    ]


class Tag(_Message):
    _fields_ = [
        ("position", c.c_double * 3),
        ("orientation", c.c_double * 4),
        ("size", c.c_float),
        ("edge", c.c_float),
        ("position_sigma", c.c_float),
        ("orientation_sigma", c.c_float),
        ("id", c.c_uint32),
        ("sightings", c.c_uint32),
        ("family", c.c_uint8),
        ("is_dock", c.c_uint8),
        ("reserved", c.c_uint8 * 6),
    ]


class Tags(_Message):
    _fields_ = [
        ("run_id", c.c_uint64),
        ("content_revision", c.c_uint64),
        ("timestamp_ns", c.c_int64),
        ("published_ns", c.c_int64),
        ("count", c.c_uint32),
        ("map_id", c.c_uint32),
        ("reset_counter", c.c_uint32),
        ("map_revision", c.c_uint32),
        ("scale_sigma", c.c_float),
        ("scale", c.c_uint8),
        ("scale_source", c.c_uint8),
        ("clock", c.c_uint8),
        ("map_mode", c.c_uint8),
        ("reserved", c.c_uint8 * 8),
        ("tags", Tag * MAX_TAGS),
    ]
