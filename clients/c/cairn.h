/* Cairn for C and C++: messages as they are in shared memory, and a small client (libcairn.so).
 * Made from the Rust sources by `CAIRN_WRITE=1 cargo test --test layout`; do not edit.
 *
 *     cairn_client *client = cairn_connect(NULL);
 *     cairn_pose pose;
 *     while (client && cairn_pose_wait(client, 1000000000, &pose) != CAIRN_ERROR)
 *         drive(cairn_pose_is_usable(&pose, 200000000) ? &pose : NULL);
 *     fprintf(stderr, "%s\n", cairn_error());
 *
 * Services, units, frames, rates and failures: src/messages/WIRE.md. Licence: MIT OR Apache-2.0. */


#ifndef CAIRN_H
#define CAIRN_H

#include <stddef.h>
#include <stdint.h>

/**
 * Stands where a time or duration in ns is not known.
 */
#define CAIRN_UNKNOWN_NS INT64_MIN

/**
 * Stands where there is no keyframe.
 */
#define CAIRN_NO_KEYFRAME UINT32_MAX

/**
 * Stands where there is no landmark.
 */
#define CAIRN_NO_LANDMARK UINT32_MAX

/**
 * Stands where there is no map.
 */
#define CAIRN_NO_MAP UINT32_MAX

/**
 * Stands where there is no track.
 */
#define CAIRN_NO_TRACK UINT64_MAX

/**
 * `state`: no map yet, no pose.
 */
#define CAIRN_STATE_INITIALIZING 0

/**
 * `state`: the pose rests on landmarks that were seen in this frame.
 */
#define CAIRN_STATE_TRACKING 1

/**
 * `state`: there was a map and this frame could not be placed in it; no pose.
 */
#define CAIRN_STATE_LOST 2

/**
 * `state`: no map yet, but how the body has turned since the first frame is known: orientation and its covariance without a position. Not
 * tracking, and nothing to drive by; enough for a heading while a robot turns on the spot.
 */
#define CAIRN_STATE_ORIENTATION 3

/**
 * `state`: reserved, not sent yet: `odom` goes on by other means than the picture, with growing covariance. Not tracking.
 */
#define CAIRN_STATE_DEAD_RECKONING 4

/**
 * `scale`: lengths are arbitrary (one camera alone); only ratios mean something.
 */
#define CAIRN_SCALE_UNKNOWN 0

/**
 * `scale`: lengths are meant to be metres, with the relative uncertainty `scale_sigma`.
 */
#define CAIRN_SCALE_ESTIMATED 1

/**
 * `scale`: lengths are metres, the mount's translation is applied, `scale_sigma` says how well.
 */
#define CAIRN_SCALE_METRIC 2

/**
 * `clock`: `timestamp_ns` is CLOCK_MONOTONIC of this machine.
 */
#define CAIRN_CLOCK_MONOTONIC 0

/**
 * `clock`: `timestamp_ns` is a recording's own time.
 */
#define CAIRN_CLOCK_RECORDING 1

/**
 * `intrinsics`: of a calibration, refined around it.
 */
#define CAIRN_INTRINSICS_CALIBRATED 0

/**
 * `intrinsics`: the camera is not calibrated; found from its motion, as surely as `focal_sigma` says.
 */
#define CAIRN_INTRINSICS_ESTIMATED 1

/**
 * `intrinsics`: the camera is not calibrated, and its motion has not shown the focal length so far: angles, depths and the shape of
 * the map may be off by `focal_sigma`.
 */
#define CAIRN_INTRINSICS_GUESSED 2

/**
 * `lens_model`: pinhole with radial and tangential distortion.
 */
#define CAIRN_LENS_RADIAL_TANGENTIAL 0

/**
 * `lens_model`: wide angle (Kannala-Brandt; `equidistant` of ROS, OpenCV's `fisheye`): `focal_px` is pixels per radian off the axis.
 */
#define CAIRN_LENS_KANNALA_BRANDT 1

/**
 * `format` of an encoded picture: rows of `stride` bytes, one byte a pixel, top left first.
 */
#define CAIRN_ENCODED_GREY 0

/**
 * `format` of an encoded picture: rows of `stride` bytes, packed 4:2:2 as Y0 U Y1 V.
 */
#define CAIRN_ENCODED_YUYV 1

/**
 * `format` of an encoded picture: a JPEG, or a webcam's motion JPEG, which may lack its Huffman tables.
 */
#define CAIRN_ENCODED_JPEG 2

/**
 * `format` of an encoded picture: a PNG.
 */
#define CAIRN_ENCODED_PNG 3

/**
 * Bytes of a path or message at most.
 */
#define CAIRN_TEXT_LEN 512

/**
 * Drop the map and start over.
 */
#define CAIRN_COMMAND_RESET 1

/**
 * Write the trajectory so far to `path` (TUM format).
 */
#define CAIRN_COMMAND_SAVE_TRAJECTORY 2

/**
 * Write the sparse map to `path` (PLY).
 */
#define CAIRN_COMMAND_SAVE_MAP 3

/**
 * Go on in the stored map of this name (`path`), and find the robot in it. What was tracked in is in its file before.
 */
#define CAIRN_COMMAND_LOAD_MAP 4

/**
 * The body is at `position`, `orientation` of the map now.
 */
#define CAIRN_COMMAND_SET_POSE 5

/**
 * Store the map now: in its own file, or, with a name in `path`, a copy of it under that name.
 */
#define CAIRN_COMMAND_STORE_MAP 6

/**
 * Begin a new map, to be kept under the name in `path`. What was tracked in is in its file before.
 */
#define CAIRN_COMMAND_NEW_MAP 7

/**
 * Only be located in the map (`path` is `on`), or let it grow again (`off`).
 */
#define CAIRN_COMMAND_LOCALISE 8

/**
 * Name the stored maps: a line each of the message, `NAME BYTES SECONDS` (since 1970, when it was written), ` current` behind the one
 * in use. A last line `...`: there are more, behind the last name; ask again with that in `path`.
 */
#define CAIRN_COMMAND_LIST_MAPS 9

/**
 * Write a copy of the map for the sender; the message is its path, then a line with that of the map's own file, if it has one. The
 * sender removes the copy; the daemon does after some minutes.
 */
#define CAIRN_COMMAND_COPY_MAP 10

/**
 * Name the camera's controls: a line each of the message, `NAME UNIT LOWEST HIGHEST STEP DEFAULT VALUE WHO`. Names: `exposure` (unit `ms`), `gain`
 * and `focus` (unit `steps`, of the camera's own). WHO: `auto` (the camera decides), `manual`, `manual-only` (it has no automatic).
 */
#define CAIRN_COMMAND_CAMERA_CONTROLS 11

/**
 * Set a control of the camera to a value in its unit, or have the camera decide: `path` is its name, a space, and a number or `auto`. It holds
 * until the camera is opened anew.
 */
#define CAIRN_COMMAND_SET_CAMERA 12

/**
 * Name the camera: the message is its identity, as calibrations are found by, a space, and its device file.
 */
#define CAIRN_COMMAND_CAMERA_IDENTITY 13

/**
 * Keep the calibration in the file `path` for the camera, which has it from the next map on that a command begins. The message says where it
 * lies.
 */
#define CAIRN_COMMAND_KEEP_CALIBRATION 14

/**
 * Keep what is in the stored map of this name (`path`) beside the present one, and make it a part of that once a place of both is known. The
 * present map's frame and number stay; the stored one stays as it is.
 */
#define CAIRN_COMMAND_MERGE_MAP 15

/**
 * Done.
 */
#define CAIRN_REPLY_OK 0

/**
 * The daemon does not know this kind of command (it is older), or cannot do it.
 */
#define CAIRN_REPLY_UNSUPPORTED 1

/**
 * The command makes no sense as it is: path missing or not UTF-8, pose not finite.
 */
#define CAIRN_REPLY_INVALID 2

/**
 * It was tried and failed; the message says why.
 */
#define CAIRN_REPLY_FAILED 3

/**
 * Not now: another one of its kind is under way.
 */
#define CAIRN_REPLY_BUSY 4

/**
 * `kind` of an edge: both keyframes see the same landmarks.
 */
#define CAIRN_EDGE_COVISIBLE 0

/**
 * `kind` of an edge: a loop was closed, the newer keyframe showed the place of the older one again.
 */
#define CAIRN_EDGE_LOOP 1

/**
 * `kind` of an edge: another map was joined to this one, by a keyframe that showed a place of it.
 */
#define CAIRN_EDGE_JOIN 2

/**
 * Number of stages.
 */
#define CAIRN_STAGES 6

/**
 * No camera is there, or it cannot be opened.
 */
#define CAIRN_ERROR_NO_CAMERA (1 << 0)

/**
 * The source is open and gives no frames.
 */
#define CAIRN_ERROR_NO_FRAMES (1 << 1)

/**
 * No keypoint was found in the last frame: black, white, covered or badly out of focus.
 */
#define CAIRN_ERROR_NO_FEATURES (1 << 2)

/**
 * So few keypoints or landmarks that tracking may be lost soon.
 */
#define CAIRN_ERROR_LOW_FEATURES (1 << 3)

/**
 * Frames were dropped lately because the pipeline could not keep up, or were lost by the camera's driver.
 */
#define CAIRN_ERROR_DROPPED_FRAMES (1 << 4)

/**
 * Frames lately could not be decoded.
 */
#define CAIRN_ERROR_CORRUPT_FRAMES (1 << 5)

/**
 * Calibration is missing, is of another picture size, or does not fit what is seen.
 */
#define CAIRN_ERROR_BAD_CALIBRATION (1 << 6)

/**
 * Frames lately had a time that repeats, goes back or jumps.
 */
#define CAIRN_ERROR_BAD_TIMESTAMP (1 << 7)

/**
 * A stage has shown no sign of life for longer than its limit; see cairn_stage_health.heartbeat_age_ns.
 */
#define CAIRN_ERROR_STALLED_STAGE (1 << 8)

/**
 * Map adjustments come later than configured.
 */
#define CAIRN_ERROR_MAPPING_LATE (1 << 9)

/**
 * There was a map and tracking is lost.
 */
#define CAIRN_ERROR_LOST (1 << 10)

/**
 * A file could not be written (trajectory, map).
 */
#define CAIRN_ERROR_SAVE_FAILED (1 << 11)

/**
 * Messages lately could not be sent.
 */
#define CAIRN_ERROR_PUBLISH_FAILED (1 << 12)

/**
 * The lens is a guess: nobody calibrated the camera, and its motion has not shown the focal length so far.
 */
#define CAIRN_ERROR_UNCALIBRATED (1 << 13)

/**
 * The camera lately gave less than three quarters of the rate that it said it would.
 */
#define CAIRN_ERROR_LOW_RATE (1 << 14)

/**
 * A turn on the spot has left everything behind whose distance was known: lengths since then are those of an assumed one,
 * and may be off by a factor from those before.
 */
#define CAIRN_ERROR_SCALE_ASSUMED (1 << 15)

/**
 * The base's driver has told of its wheels and has fallen silent, for a second at least.
 */
#define CAIRN_ERROR_WHEELS_SILENT (1 << 16)

/**
 * Wheel messages lately were not believed: no number, an absurd speed, another clock, time that goes back, a second publisher.
 */
#define CAIRN_ERROR_WHEELS_WRONG (1 << 17)

/**
 * Wheel messages lately were lost, or most of them came after the frame that they belong to.
 */
#define CAIRN_ERROR_WHEELS_LATE (1 << 18)

/**
 * The map does not grow: the robot is only located in it.
 */
#define CAIRN_MAP_MODE_LOCALISATION_ONLY (1 << 0)

/**
 * The current map is that of the map file, or has been joined to it: places in it are those of earlier runs.
 */
#define CAIRN_MAP_MODE_STORED (1 << 1)

/**
 * The map is told in the frame of the configuration's dock, a tag that has been seen.
 */
#define CAIRN_MAP_MODE_DOCK_FRAME (1 << 2)

/**
 * Frames from the source into the ring.
 */
#define CAIRN_STAGE_CAPTURE 0

/**
 * Decoding, pyramid, corners, tracks.
 */
#define CAIRN_STAGE_FEATURES 1

/**
 * Pose of the frame.
 */
#define CAIRN_STAGE_TRACKING 2

/**
 * Keyframes, landmarks, adjustment.
 */
#define CAIRN_STAGE_MAPPING 3

/**
 * Messages into shared memory.
 */
#define CAIRN_STAGE_PUBLISHING 4

/**
 * A whole frame, from its arrival to its published pose.
 */
#define CAIRN_STAGE_END_TO_END 5

/**
 * Bearings of a scan: two degrees each, all round.
 */
#define CAIRN_OBSTACLE_BEARINGS 180

/**
 * Points of a scan at the most.
 */
#define CAIRN_OBSTACLE_POINTS 500

/**
 * `told`: the scan is what is known.
 */
#define CAIRN_OBSTACLES_TOLD 0

/**
 * `told`: the robot has no pose, so nothing is known.
 */
#define CAIRN_OBSTACLES_NO_POSE 1

/**
 * `told`: the map's lengths are no metres, so nothing is known.
 */
#define CAIRN_OBSTACLES_NOT_METRIC 2

/**
 * `told`: the floor was not found, so nothing is known.
 */
#define CAIRN_OBSTACLES_NO_FLOOR 3

/**
 * Event: a publisher has come.
 */
#define CAIRN_EVENT_CREATED 1

/**
 * Event: the publisher has left.
 */
#define CAIRN_EVENT_DROPPED 2

/**
 * Event: the publisher died without leaving, and its remains were cleared away.
 */
#define CAIRN_EVENT_DEAD 3

/**
 * Event: there is a new message.
 */
#define CAIRN_EVENT_NEW 4

/**
 * Largest event id of a service, with room for later ones.
 */
#define CAIRN_EVENT_MAX 15

/**
 * Subscribers of a service at most, but of `encoded`.
 */
#define CAIRN_MAX_SUBSCRIBERS 8

/**
 * Processes that can send commands at once.
 */
#define CAIRN_MAX_COMMANDERS 8

/**
 * Tags of a message at the most.
 */
#define CAIRN_MAX_TAGS 16

/**
 * `family` of a tag: AprilTag 36h11.
 */
#define CAIRN_TAG_36H11 0

/**
 * Wheel odometry.
 */
#define CAIRN_SCALE_SOURCE_WHEELS (1 << 0)

/**
 * The camera's known height above the floor.
 */
#define CAIRN_SCALE_SOURCE_HEIGHT (1 << 1)

/**
 * A tag or board of known size.
 */
#define CAIRN_SCALE_SOURCE_TAG (1 << 2)

/**
 * The map was metric when it was loaded.
 */
#define CAIRN_SCALE_SOURCE_STORED_MAP (1 << 3)

/**
 * Grows when a function or a message of this header changes or goes; compare it with `cairn_abi_version()`.
 */
#define CAIRN_ABI_VERSION 2

/**
 * There is a message, and it is where it was to be put.
 */
#define CAIRN_MESSAGE 1

/**
 * There was none in that time.
 */
#define CAIRN_NOTHING 0

/**
 * It cannot work, and waiting will not help: see `cairn_error()`.
 */
#define CAIRN_ERROR -1

/**
 * Keeps features in shared memory.
 */
typedef struct cairn_features_hold cairn_features_hold;

/**
 * Keeps a picture in shared memory.
 */
typedef struct cairn_frame_hold cairn_frame_hold;

/**
 * Keeps a graph in shared memory.
 */
typedef struct cairn_graph_hold cairn_graph_hold;

/**
 * A connection to one daemon.
 */
typedef struct cairn_client cairn_client;

/**
 * Keeps keyframes in shared memory.
 */
typedef struct cairn_keyframes_hold cairn_keyframes_hold;

/**
 * Keeps a map in shared memory.
 */
typedef struct cairn_map_hold cairn_map_hold;

/**
 * One frame's pose. Unless `state` is CAIRN_STATE_TRACKING or CAIRN_STATE_DEAD_RECKONING, everything that belongs to the pose is NaN or zero; but with
 * CAIRN_STATE_ORIENTATION both orientations, the covariance of the rotation and the angular velocity are there.
 *
 * # Covariance
 * `covariance` is the upper triangle, row by row, of the symmetric 6x6 matrix in the order x, y, z, rotation about x, y, z,
 * for a small error of the **body**, in the body's own axes (right tangent):
 *
 * ```text
 * position_true = position + R · e[0..3]        R_true = R · exp(e[3..6])        covariance = E[e eᵀ]
 * ```
 *
 * Positions in map units squared, angles in rad². It is relative to `anchor_keyframe`, scale removed: it says how well the
 * pose is known within the map around it. An absolute one of a monocular map would be an artefact of where its origin
 * lies. One part of it is not local: behind a turn on the spot that left everything behind whose distance was known, lengths are
 * those of an assumed distance, and what that may be wrong makes of the way since the turn is in it, along that way, until the robot
 * is located by what lies before the turn (health says `SCALE_ASSUMED` as long). NaN means unknown. The clients unpack it (`covariance_matrix`) and turn it into the axes that `nav_msgs/Odometry` and
 * MAVLink want (`covariance_in_map_axes`).
 */
typedef struct cairn_pose {
  /**
   * Another value at every start of the daemon: ids, counters and frames of two runs are unrelated.
   */
  uint64_t run_id;
  /**
   * Counts every frame that the source saw, dropped ones too; 0 is the first.
   */
  uint64_t sequence;
  /**
   * Capture time in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
   */
  int64_t arrival_ns;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * From arrival to sending, ns.
   */
  int64_t latency_arrival_ns;
  /**
   * From capture to sending, ns; CAIRN_UNKNOWN_NS unless `clock` is CLOCK_MONOTONIC. Some drivers stamp slightly in the
   * future, so it can be negative.
   */
  int64_t latency_capture_ns;
  /**
   * Frames of this run that were never looked at because a later one was there already.
   */
  uint64_t frames_dropped;
  /**
   * Map pose: the body's origin in the map, map units.
   */
  double position[3];
  /**
   * Map pose: `map_from_body`, quaternion (x, y, z, w). With CAIRN_STATE_ORIENTATION, as there is no map, the same as `odom_orientation`.
   */
  double orientation[4];
  /**
   * Odom pose: the body's origin in odom, map units.
   */
  double odom_position[3];
  /**
   * Odom pose: `odom_from_body`, quaternion (x, y, z, w). With CAIRN_STATE_ORIENTATION: since the first frame; a map that then begins
   * continues it.
   */
  double odom_orientation[4];
  /**
   * Upper triangle of the 6x6 covariance, see above.
   */
  double covariance[21];
  /**
   * Velocity of the body's origin in the body's axes, map units/s.
   */
  double linear_velocity[3];
  /**
   * Angular velocity in the body's axes, rad/s.
   */
  double angular_velocity[3];
  /**
   * 0 (none) to 1 (as good as it gets).
   */
  float quality;
  /**
   * Relative standard deviation of the scale (0.02: a length of 1 is known to 0.02); NaN unless it is estimated.
   */
  float scale_sigma;
  /**
   * Landmarks seen in this frame that the pose rests on.
   */
  uint32_t landmarks;
  /**
   * Landmarks that were looked for in this frame.
   */
  uint32_t landmarks_sought;
  /**
   * Grows with every reset and re-initialisation, and where an orientation without a map begins anew: poses across a change are unrelated.
   */
  uint32_t reset_counter;
  /**
   * The map that the pose is in.
   */
  uint32_t map_id;
  /**
   * Grows whenever coordinates of the map are corrected by more than ordinary adjustment; `odom` does not move then.
   */
  uint32_t map_revision;
  /**
   * Keyframe that the covariance is relative to; CAIRN_NO_KEYFRAME if there is none.
   */
  uint32_t anchor_keyframe;
  /**
   * CAIRN_STATE_INITIALIZING, CAIRN_STATE_TRACKING, CAIRN_STATE_LOST, CAIRN_STATE_ORIENTATION,
   * CAIRN_STATE_DEAD_RECKONING.
   */
  uint8_t state;
  /**
   * CAIRN_SCALE_UNKNOWN, CAIRN_SCALE_ESTIMATED, CAIRN_SCALE_METRIC.
   */
  uint8_t scale;
  /**
   * Bits of scale_source: what the scale comes from; 0 = nothing.
   */
  uint8_t scale_source;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * 1 if this frame becomes a keyframe, else 0.
   */
  uint8_t keyframe;
  /**
   * Zero.
   */
  uint8_t reserved[19];
} cairn_pose;

/**
 * One stage of the pipeline over the last interval between two health messages (or longer, as the daemon chooses).
 */
typedef struct cairn_stage_health {
  /**
   * Steps since the start.
   */
  uint64_t steps;
  /**
   * Time since the stage's last sign of life, ns; CAIRN_UNKNOWN_NS if it is not under watch.
   */
  int64_t heartbeat_age_ns;
  /**
   * Median duration of a step, ms; NaN if there was none.
   */
  float p50_ms;
  /**
   * 95 of 100 steps were not longer, ms; NaN if there was none.
   */
  float p95_ms;
  /**
   * 99 of 100 steps were not longer, ms; NaN if there was none.
   */
  float p99_ms;
  /**
   * Steps a second; NaN = unknown.
   */
  float rate_hz;
} cairn_stage_health;

/**
 * The daemon's health. Counters count from its start.
 */
typedef struct cairn_health {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * Counts health messages of this run.
   */
  uint64_t sequence;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * Time since the start, ns.
   */
  int64_t uptime_ns;
  /**
   * CLOCK_REALTIME minus CLOCK_MONOTONIC, ns: add it to a monotonic time to get the time of day.
   */
  int64_t realtime_minus_monotonic_ns;
  /**
   * Faults that stand now: bits of error.
   */
  uint64_t errors;
  /**
   * Frames that arrived from the source.
   */
  uint64_t frames_captured;
  /**
   * Frames never looked at: a later one was there already, or the camera's driver lost them.
   */
  uint64_t frames_dropped;
  /**
   * Frames that could not be decoded.
   */
  uint64_t frames_corrupt;
  /**
   * Frames with a pose.
   */
  uint64_t frames_tracked;
  /**
   * Keyframes made.
   */
  uint64_t keyframes_made;
  /**
   * Landmarks made.
   */
  uint64_t landmarks_made;
  /**
   * Map adjustments merged.
   */
  uint64_t adjustments;
  /**
   * Map adjustments that came later than configured.
   */
  uint64_t adjustments_late;
  /**
   * Resets and re-initialisations.
   */
  uint64_t resets;
  /**
   * Times that a lost robot was found again in its map.
   */
  uint64_t relocalisations;
  /**
   * Maps that were recognised and joined to the current one.
   */
  uint64_t maps_joined;
  /**
   * Loops closed: places of the current map that were recognised after drift, and corrected.
   */
  uint64_t loops_closed;
  /**
   * Time since the last frame arrived, ns; CAIRN_UNKNOWN_NS if there was none.
   */
  int64_t frame_age_ns;
  /**
   * Time since the last frame with a pose arrived, ns; CAIRN_UNKNOWN_NS if there was none.
   */
  int64_t pose_age_ns;
  /**
   * By stage.
   */
  struct cairn_stage_health stages[CAIRN_STAGES];
  /**
   * Keyframes in the current map.
   */
  uint32_t keyframes;
  /**
   * Landmarks in the current map.
   */
  uint32_t landmarks;
  /**
   * Maps that are kept, the current one among them.
   */
  uint32_t maps;
  /**
   * As in cairn_pose.reset_counter.
   */
  uint32_t reset_counter;
  /**
   * As in cairn_pose.map_id.
   */
  uint32_t map_id;
  /**
   * As in cairn_pose.map_revision.
   */
  uint32_t map_revision;
  /**
   * Process id of the daemon.
   */
  uint32_t pid;
  /**
   * As in cairn_pose.state, of the last frame; lost, too, when pictures have stopped coming while tracking, and initializing
   * when they have while only the orientation was known.
   */
  uint8_t state;
  /**
   * CAIRN_CLOCK_MONOTONIC or CAIRN_CLOCK_RECORDING: what the source's times count from.
   */
  uint8_t clock;
  /**
   * CAIRN_INTRINSICS_CALIBRATED, CAIRN_INTRINSICS_ESTIMATED, CAIRN_INTRINSICS_GUESSED: where focal length and
   * principal point come from.
   */
  uint8_t intrinsics;
  /**
   * CAIRN_LENS_RADIAL_TANGENTIAL, CAIRN_LENS_KANNALA_BRANDT: which lens model focal length and principal point are of.
   */
  uint8_t lens_model;
  /**
   * Version of the daemon, UTF-8, zero-padded.
   */
  uint8_t version[32];
  /**
   * Focal lengths fx and fy in use, px; NaN before the first frame.
   */
  float focal_px[2];
  /**
   * Principal point in use, px; NaN before the first frame.
   */
  float centre_px[2];
  /**
   * Standard deviation of the focal length, as a share of it; NaN before the first frame.
   */
  float focal_sigma;
  /**
   * Standard deviation of the principal point, the larger of both coordinates, px; NaN before the first frame.
   */
  float centre_sigma_px;
  /**
   * How far the map pose was moved when `map_revision` grew last, map units; NaN if it never did.
   */
  float correction_distance;
  /**
   * How far it was turned then, rad.
   */
  float correction_rad;
  /**
   * Bits of map_mode: how the current map is used.
   */
  uint8_t map_mode;
  /**
   * Zero.
   */
  uint8_t reserved[15];
  /**
   * Time for which the wheels alone told the pose (STATE_DEAD_RECKONING), since the start, ns; 0, as the next, where they never did.
   */
  uint64_t blind_ns;
  /**
   * And the way, m.
   */
  double blind_m;
  /**
   * Messages of the base's driver that were believed; 0, as the three that follow, where nothing tells of wheels.
   */
  uint64_t wheel_messages;
  /**
   * Messages of a driver that were not: no number, an absurd speed, another clock, time that goes back, a second publisher.
   */
  uint64_t wheel_refused;
  /**
   * Messages of the driver that were lost on the way, or dropped because no frame asked for them.
   */
  uint64_t wheel_missing;
  /**
   * Messages of the driver that came after the frame that they belong to; they count from the next one on.
   */
  uint64_t wheel_late;
} cairn_health;

/**
 * What a map message is a picture of.
 */
typedef struct cairn_map_header {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * Grows with every change of what the message holds: another picture of the map.
   */
  uint64_t content_revision;
  /**
   * Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * Landmarks in this message.
   */
  uint32_t count;
  /**
   * Landmarks in the map; if larger than `count`, the oldest ones were left out.
   */
  uint32_t total;
  /**
   * As in cairn_pose.map_id.
   */
  uint32_t map_id;
  /**
   * As in cairn_pose.reset_counter.
   */
  uint32_t reset_counter;
  /**
   * As in cairn_pose.map_revision: what was kept of messages with another one is out of place.
   */
  uint32_t map_revision;
  /**
   * Relative standard deviation of the scale; NaN unless it is estimated.
   */
  float scale_sigma;
  /**
   * CAIRN_SCALE_UNKNOWN, CAIRN_SCALE_ESTIMATED, CAIRN_SCALE_METRIC.
   */
  uint8_t scale;
  /**
   * As in cairn_pose.scale_source.
   */
  uint8_t scale_source;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Bits of map_mode.
   */
  uint8_t map_mode;
  /**
   * Zero.
   */
  uint8_t reserved[4];
} cairn_map_header;

/**
 * One point of the sparse map; `PREFIX/map` carries a slice of them, ascending `id`.
 */
typedef struct cairn_landmark {
  /**
   * Never reused within a run.
   */
  uint32_t id;
  /**
   * Keyframes that observe it.
   */
  uint32_t observations;
  /**
   * In the map (REP-103 axes), map units.
   */
  float position[3];
  /**
   * Standard deviation along the line of sight, map units; NaN = unknown.
   */
  float sigma;
} cairn_landmark;

/**
 * A map in shared memory; never changes. Two may be held at a time.
 */
typedef struct cairn_map {
  /**
   * What the landmarks are a picture of.
   */
  const struct cairn_map_header *header;
  /**
   * `count` landmarks.
   */
  const struct cairn_landmark *landmarks;
  size_t count;
  /**
   * For `cairn_map_release`.
   */
  struct cairn_map_hold *held;
} cairn_map;

/**
 * What a keyframes message is a picture of; the same `content_revision` as the map message that was sent with it.
 */
typedef struct cairn_keyframes_header {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * Grows with every change of what the message holds: another picture of the map.
   */
  uint64_t content_revision;
  /**
   * Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * Keyframes in this message.
   */
  uint32_t count;
  /**
   * Keyframes in the map; if larger than `count`, the oldest ones were left out.
   */
  uint32_t total;
  /**
   * As in cairn_pose.map_id.
   */
  uint32_t map_id;
  /**
   * As in cairn_pose.reset_counter.
   */
  uint32_t reset_counter;
  /**
   * As in cairn_pose.map_revision: what was kept of messages with another one is out of place.
   */
  uint32_t map_revision;
  /**
   * Relative standard deviation of the scale; NaN unless it is estimated.
   */
  float scale_sigma;
  /**
   * CAIRN_SCALE_UNKNOWN, CAIRN_SCALE_ESTIMATED, CAIRN_SCALE_METRIC.
   */
  uint8_t scale;
  /**
   * As in cairn_pose.scale_source.
   */
  uint8_t scale_source;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Bits of map_mode.
   */
  uint8_t map_mode;
  /**
   * Zero.
   */
  uint8_t reserved[4];
} cairn_keyframes_header;

/**
 * One keyframe; `PREFIX/keyframes` carries a slice of them, ascending `id`.
 */
typedef struct cairn_keyframe {
  /**
   * Capture time in the source's clock, ns.
   */
  int64_t timestamp_ns;
  /**
   * The body's origin in the map, map units.
   */
  double position[3];
  /**
   * `map_from_body`, quaternion (x, y, z, w).
   */
  double orientation[4];
  /**
   * Never reused within a run.
   */
  uint32_t id;
  /**
   * Zero.
   */
  uint32_t reserved;
} cairn_keyframe;

/**
 * The keyframes in shared memory; never change. Two may be held at a time.
 */
typedef struct cairn_keyframes {
  /**
   * What the keyframes are a picture of.
   */
  const struct cairn_keyframes_header *header;
  /**
   * `count` keyframes.
   */
  const struct cairn_keyframe *keyframes;
  size_t count;
  /**
   * For `cairn_keyframes_release`.
   */
  struct cairn_keyframes_hold *held;
} cairn_keyframes;

/**
 * Describes the bytes of a `PREFIX/frame` message: rows of `stride` bytes, top left first, one byte a pixel. The picture
 * is as the camera gave it, lens distortion included.
 */
typedef struct cairn_frame_header {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * As in cairn_pose.sequence of the same frame.
   */
  uint64_t sequence;
  /**
   * Capture time in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
   */
  int64_t arrival_ns;
  /**
   * Pixels.
   */
  uint32_t width;
  /**
   * Pixels.
   */
  uint32_t height;
  /**
   * Bytes from one row to the next, at least `width`.
   */
  uint32_t stride;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Zero.
   */
  uint8_t reserved[3];
} cairn_frame_header;

/**
 * A grey picture in shared memory; never changes. Two may be held at a time.
 */
typedef struct cairn_frame {
  /**
   * Size, stride and time of the picture.
   */
  const struct cairn_frame_header *header;
  /**
   * Rows of `header->stride` bytes, `size` bytes in all.
   */
  const uint8_t *pixels;
  size_t size;
  /**
   * For `cairn_frame_release`.
   */
  struct cairn_frame_hold *held;
} cairn_frame;

/**
 * Which picture the features are of.
 */
typedef struct cairn_features_header {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * As in cairn_pose.sequence of the same frame.
   */
  uint64_t sequence;
  /**
   * Capture time in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
   */
  int64_t arrival_ns;
  /**
   * Pixels.
   */
  uint32_t width;
  /**
   * Pixels.
   */
  uint32_t height;
  /**
   * Features in this message.
   */
  uint32_t count;
  /**
   * Features of the frame; if larger than `count`, the newest tracks were left out.
   */
  uint32_t total;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Zero.
   */
  uint8_t reserved[7];
} cairn_features_header;

/**
 * A place in a picture that was found; `PREFIX/features` carries a slice of them: first the landmarks of the map that the pose rests on, then
 * the tracks, ascending `track`. A track may lie where a landmark was found.
 */
typedef struct cairn_feature {
  /**
   * Of a track: unique within a run; CAIRN_NO_TRACK for a landmark.
   */
  uint64_t track;
  /**
   * In the picture as the camera gave it, (0, 0) in the middle of its first pixel, px.
   */
  float position[2];
  /**
   * Of a track: frames since the corner was detected, 0 in this one; 0 for a landmark.
   */
  uint32_t age;
  /**
   * As in cairn_landmark.id; CAIRN_NO_LANDMARK for a track.
   */
  uint32_t landmark;
} cairn_feature;

/**
 * What was found in a picture, in shared memory; never changes. Two may be held at a time.
 */
typedef struct cairn_features {
  /**
   * Which picture, and how many features.
   */
  const struct cairn_features_header *header;
  /**
   * `count` features.
   */
  const struct cairn_feature *features;
  size_t count;
  /**
   * For `cairn_features_release`.
   */
  struct cairn_features_hold *held;
} cairn_features;

/**
 * A request to the daemon.
 */
typedef struct cairn_command {
  /**
   * Of command_kind.
   */
  uint32_t kind;
  /**
   * Bytes of `path` that are used.
   */
  uint32_t path_len;
  /**
   * UTF-8; the daemon opens it as its own user, so it should be absolute. Of stored maps it is a name, never a path.
   */
  uint8_t path[CAIRN_TEXT_LEN];
  /**
   * For command_kind.CAIRN_COMMAND_SET_POSE: the body in the map, map units.
   */
  double position[3];
  /**
   * For command_kind.CAIRN_COMMAND_SET_POSE: `map_from_body`, quaternion (x, y, z, w).
   */
  double orientation[4];
} cairn_command;

/**
 * What became of a cairn_command.
 */
typedef struct cairn_command_reply {
  /**
   * Of reply_code.
   */
  uint32_t code;
  /**
   * Bytes of `message` that are used.
   */
  uint32_t message_len;
  /**
   * For a person, UTF-8.
   */
  uint8_t message[CAIRN_TEXT_LEN];
} cairn_command_reply;

/**
 * What a graph message is a picture of; the same `content_revision` as the keyframes message that was sent with it.
 */
typedef struct cairn_graph_header {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * Grows with every change of what the message holds: another picture of the map.
   */
  uint64_t content_revision;
  /**
   * Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * Edges in this message.
   */
  uint32_t count;
  /**
   * Edges of the map; if larger than `count`, those of keyframes that were left out and the weakest covisible ones are not here.
   */
  uint32_t total;
  /**
   * As in cairn_pose.map_id.
   */
  uint32_t map_id;
  /**
   * As in cairn_pose.reset_counter.
   */
  uint32_t reset_counter;
  /**
   * As in cairn_pose.map_revision.
   */
  uint32_t map_revision;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Bits of map_mode.
   */
  uint8_t map_mode;
  /**
   * Zero.
   */
  uint8_t reserved[10];
} cairn_graph_header;

/**
 * Two keyframes that belong together; `PREFIX/graph` carries a slice of them: joins, then loops, oldest first each, then what is covisible, strongest
 * first.
 */
typedef struct cairn_graph_edge {
  /**
   * As in cairn_keyframe.id: the older one; of a join, the one of the map that was joined.
   */
  uint32_t from;
  /**
   * As in cairn_keyframe.id: the newer one; of a join, the one that showed the other map's place.
   */
  uint32_t to;
  /**
   * Landmarks that both see now.
   */
  uint32_t shared;
  /**
   * Of a join: what cairn_pose.map_id the other map had; else CAIRN_NO_MAP.
   */
  uint32_t joined_map;
  /**
   * CAIRN_EDGE_COVISIBLE, CAIRN_EDGE_LOOP, CAIRN_EDGE_JOIN.
   */
  uint8_t kind;
  /**
   * Zero.
   */
  uint8_t reserved[3];
} cairn_graph_edge;

/**
 * What holds the map together, in shared memory; never changes. Two may be held at a time.
 */
typedef struct cairn_graph {
  /**
   * What the edges are a picture of.
   */
  const struct cairn_graph_header *header;
  /**
   * `count` edges.
   */
  const struct cairn_graph_edge *edges;
  size_t count;
  /**
   * For `cairn_graph_release`.
   */
  struct cairn_graph_hold *held;
} cairn_graph;

/**
 * The mean twist of the base over an interval, in the base frame at its start (REP-103: x forward, y left, yaw positive to the left).
 */
typedef struct cairn_wheel_odometry {
  /**
   * Counts the driver's messages, so that lost ones are seen; a driver that starts anew may begin anywhere.
   */
  uint64_t sequence;
  /**
   * CLOCK_MONOTONIC at the end of the interval, ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC at its start, ns, at most 0.5 s before; CAIRN_UNKNOWN_NS: where the message before ended.
   */
  int64_t interval_start_ns;
  /**
   * Forward, m/s.
   */
  double linear_x_mps;
  /**
   * To the left, m/s; 0 of a base that cannot.
   */
  double linear_y_mps;
  /**
   * Turn to the left, rad/s.
   */
  double angular_z_radps;
  /**
   * Variances of the three, (m/s)^2, (m/s)^2, (rad/s)^2; NaN or 0 where the driver does not know.
   */
  double variance[3];
  /**
   * Zero.
   */
  uint8_t reserved[24];
} cairn_wheel_odometry;

/**
 * A planar scan by bearing, and the points that it is made from, in the robot's axes on the floor (forward, left, up, from the foot of its origin).
 * What is not known is never free and never far: NaN, and 0.
 */
typedef struct cairn_obstacles {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * As in cairn_pose.sequence of the frame that the robot's place is of.
   */
  uint64_t sequence;
  /**
   * Capture time of that frame in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * The scan's origin in the map, m.
   */
  double position[3];
  /**
   * `map_from_scan`, quaternion (x, y, z, w): its z axis is the floor's normal.
   */
  double orientation[4];
  /**
   * Of the first bearing, from the robot's forward to the left, rad.
   */
  float angle_min;
  /**
   * From one bearing to the next, rad.
   */
  float angle_increment;
  /**
   * Nothing is told nearer, and nothing farther, m.
   */
  float range_min;
  /**
   * See `range_min`.
   */
  float range_max;
  /**
   * What is higher above the floor is not in the way, m.
   */
  float robot_height;
  /**
   * Relative standard deviation of the scale: of all lengths alike.
   */
  float scale_sigma;
  /**
   * As in cairn_pose.map_id.
   */
  uint32_t map_id;
  /**
   * As in cairn_pose.reset_counter.
   */
  uint32_t reset_counter;
  /**
   * As in cairn_pose.map_revision.
   */
  uint32_t map_revision;
  /**
   * Points in this message, nearest first.
   */
  uint32_t count;
  /**
   * Points in reach; if larger than `count`, the farthest were left out.
   */
  uint32_t total;
  /**
   * CAIRN_OBSTACLES_TOLD, CAIRN_OBSTACLES_NO_POSE, CAIRN_OBSTACLES_NOT_METRIC, CAIRN_OBSTACLES_NO_FLOOR.
   */
  uint8_t told;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Zero.
   */
  uint8_t reserved[2];
  /**
   * Distance of the nearest thing by bearing, m; NaN: none is known, which does not say that there is none. With `[obstacles] seen_floor` also of what keyframes saw stand, which is not in `points`.
   */
  float range[CAIRN_OBSTACLE_BEARINGS];
  /**
   * Standard deviation of `range`, m; NaN as there.
   */
  float sigma[CAIRN_OBSTACLE_BEARINGS];
  /**
   * The floor is free from here on, m: the longest stretch of those that begin near the robot; before it nothing is known, as a camera looks over the floor at the robot's feet; NaN where `free` is 0.
   */
  float free_from[CAIRN_OBSTACLE_BEARINGS];
  /**
   * The floor is free up to here, m; 0: not known. Where the robot has been, or (`[obstacles] seen_floor`) keyframes saw nothing stand: not where what hangs above it has no landmark, and with unknown places filled up to a fifth of the distance.
   */
  float free[CAIRN_OBSTACLE_BEARINGS];
  /**
   * Forward, left, up, and the standard deviation along the floor, m; NaN beyond `count`.
   */
  float points[CAIRN_OBSTACLE_POINTS][4];
} cairn_obstacles;

/**
 * A tag. Its axes are those of a robot that looks straight at it: x into the tag, y to the left, z up; its origin is the middle of its black square.
 */
typedef struct cairn_tag {
  /**
   * Its middle in the map, map units; NaN: seen, but from too few directions to be placed.
   */
  double position[3];
  /**
   * `map_from_tag`, quaternion (x, y, z, w); NaN as there.
   */
  double orientation[4];
  /**
   * Side of its black square as the configuration has it, m.
   */
  float size;
  /**
   * The same as the keyframes see it, map units: in a metric map another size than `size` is another tag, or a wrong `size`. NaN as above.
   */
  float edge;
  /**
   * Standard deviation of `position` in its worst direction, relative to the keyframes that saw it, map units; NaN as above.
   */
  float position_sigma;
  /**
   * Standard deviation of `orientation` about its worst axis, relative to the same, rad; NaN as above.
   */
  float orientation_sigma;
  /**
   * Its number in the family.
   */
  uint32_t id;
  /**
   * Keyframes of the map, as far as they are kept for it, that saw it.
   */
  uint32_t sightings;
  /**
   * TAG_36H11.
   */
  uint8_t family;
  /**
   * 1: it is the dock of the configuration, whose place the map may be told in; else 0.
   */
  uint8_t is_dock;
  /**
   * Zero.
   */
  uint8_t reserved[6];
} cairn_tag;

/**
 * The tags of the map, at their places by the keyframes of now; the same `content_revision` as the map that was sent with it.
 */
typedef struct cairn_tags {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * Grows with every change of what the map holds: another picture of it.
   */
  uint64_t content_revision;
  /**
   * Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when this message was sent, ns.
   */
  int64_t published_ns;
  /**
   * Tags in this message.
   */
  uint32_t count;
  /**
   * As in cairn_pose.map_id.
   */
  uint32_t map_id;
  /**
   * As in cairn_pose.reset_counter.
   */
  uint32_t reset_counter;
  /**
   * As in cairn_pose.map_revision: what was kept of messages with another one is out of place.
   */
  uint32_t map_revision;
  /**
   * Relative standard deviation of the scale; NaN unless it is estimated.
   */
  float scale_sigma;
  /**
   * SCALE_UNKNOWN, SCALE_ESTIMATED, SCALE_METRIC.
   */
  uint8_t scale;
  /**
   * As in cairn_pose.scale_source.
   */
  uint8_t scale_source;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * Bits of map_mode.
   */
  uint8_t map_mode;
  /**
   * Zero.
   */
  uint8_t reserved[8];
  /**
   * By number, ascending; beyond `count` nothing.
   */
  struct cairn_tag tags[CAIRN_MAX_TAGS];
} cairn_tags;

/**
 * Describes the bytes of a `PREFIX/encoded` message: the picture as it came from the camera, before it is decoded or looked at, with what is
 * believed of its lens and mount at that moment.
 */
typedef struct cairn_encoded_header {
  /**
   * Another value at every start of the daemon.
   */
  uint64_t run_id;
  /**
   * As in cairn_pose.sequence of the same frame, whether it becomes a pose or not.
   */
  uint64_t sequence;
  /**
   * Capture time in the source's clock (`clock`), ns.
   */
  int64_t timestamp_ns;
  /**
   * CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
   */
  int64_t arrival_ns;
  /**
   * Focal lengths fx and fy in use, px; NaN before the first frame was looked at.
   */
  double focal_px[2];
  /**
   * Principal point in use, px; NaN as `focal_px`.
   */
  double centre_px[2];
  /**
   * Distortion in use: k1 k2 p1 p2 k3, or k1 k2 k3 k4 and zero of a wide-angle lens; NaN as `focal_px`.
   */
  double distortion[5];
  /**
   * The mount: the camera's optical centre in the body, m. Part of a pose only where `scale` is CAIRN_SCALE_METRIC.
   */
  double camera_position[3];
  /**
   * The mount: `body_from_camera` of the optical axes (right, down, forward), quaternion (x, y, z, w).
   */
  double camera_orientation[4];
  /**
   * Pixels; 0 where the picture's own header cannot be read.
   */
  uint32_t width;
  /**
   * Pixels; 0 where the picture's own header cannot be read.
   */
  uint32_t height;
  /**
   * Bytes from one row to the next of CAIRN_ENCODED_GREY and CAIRN_ENCODED_YUYV; else 0.
   */
  uint32_t stride;
  /**
   * CAIRN_ENCODED_GREY, CAIRN_ENCODED_YUYV, CAIRN_ENCODED_JPEG, CAIRN_ENCODED_PNG.
   */
  uint8_t format;
  /**
   * CAIRN_CLOCK_MONOTONIC, CAIRN_CLOCK_RECORDING.
   */
  uint8_t clock;
  /**
   * As in cairn_health.intrinsics.
   */
  uint8_t intrinsics;
  /**
   * As in cairn_health.lens_model.
   */
  uint8_t lens_model;
  /**
   * Zero.
   */
  uint8_t reserved[16];
} cairn_encoded_header;





















#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * `ABI_VERSION` of the library.
 */
uint32_t cairn_abi_version(void);

/**
 * CLOCK_MONOTONIC now, ns.
 */
int64_t cairn_monotonic_ns(void);

/**
 * Why the last call of this thread failed, and what to do about it. Valid until the thread's next failure; never null.
 */
const char *cairn_error(void);

/**
 * The daemon with this prefix, which need not run yet; null: the one that CAIRN_PREFIX names, or "cairn". Returns null on
 * failure.
 *
 * # Safety
 * `prefix` is null or a string that ends in a zero.
 */
struct cairn_client *cairn_connect(const char *prefix);

/**
 * Ends a connection. Views taken from it stay valid until they are released.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`, and is not used any more.
 */
void cairn_close(struct cairn_client *client);

/**
 * The newest pose, without waiting; the same one again while no newer has come (look at `cairn_pose_is_usable`). A client that
 * has had none yet waits up to 0.4 s, once, for the last pose of a daemon that is there.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `pose` may be written.
 */
int32_t cairn_pose_latest(struct cairn_client *client,
                          struct cairn_pose *pose);

/**
 * The oldest pose that has not been read, waiting for it if need be: every pose in order. Ends early, with `CAIRN_NOTHING`, when
 * a signal comes.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `pose` may be written.
 */
int32_t cairn_pose_wait(struct cairn_client *client,
                        uint64_t timeout_ns,
                        struct cairn_pose *pose);

/**
 * 1 if the robot may act on this pose: it was tracked, and its frame is no older than `max_age_ns`; else 0.
 *
 * # Safety
 * `pose` is null or may be read.
 */
int32_t cairn_pose_is_usable(const struct cairn_pose *pose, uint64_t max_age_ns);

/**
 * 1 if the body's orientation is known, with a position (`CAIRN_STATE_TRACKING`, `CAIRN_STATE_DEAD_RECKONING`) or before there is one (`CAIRN_STATE_ORIENTATION`); then
 * `heading_rad`, unless null, is its angle about the vertical in odom, counter-clockwise from above, rad. Else 0, and nothing is written.
 * It is no leave to drive: ask `cairn_pose_is_usable` for that.
 *
 * # Safety
 * `pose` is null or may be read; `heading_rad` is null or may be written.
 */
int32_t cairn_pose_heading(const struct cairn_pose *pose,
                           double *heading_rad);

/**
 * The pose's covariance as a 6x6 matrix, 36 numbers, order x, y, z, rotation about x, y, z; in the body's axes, or (`in_map_axes` not
 * 0) in the map's, as `nav_msgs/Odometry` and MAVLink want it.
 *
 * # Safety
 * `pose` may be read; `matrix` has room for 36 numbers.
 */
void cairn_pose_covariance(const struct cairn_pose *pose,
                           int32_t in_map_axes,
                           double *matrix);

/**
 * Health as it is sent, the newest, waiting for it if need be.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `health` may be written.
 */
int32_t cairn_health_wait(struct cairn_client *client, uint64_t timeout_ns, struct cairn_health *health);

/**
 * The next map that has not been read, waiting for it if need be; the first call gives the current one. Release it with
 * `cairn_map_release`.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `map` may be written.
 */
int32_t cairn_map_wait(struct cairn_client *client, uint64_t timeout_ns, struct cairn_map *map);

/**
 * Gives a map back; the view is empty then. Null and empty views are left alone.
 *
 * # Safety
 * `map` is null or was filled by `cairn_map_wait`, and is zeroed or unchanged since.
 */
void cairn_map_release(struct cairn_map *map);

/**
 * The next keyframes that have not been read, waiting for them if need be. Release them with `cairn_keyframes_release`.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `keyframes` may be written.
 */
int32_t cairn_keyframes_wait(struct cairn_client *client, uint64_t timeout_ns, struct cairn_keyframes *keyframes);

/**
 * Gives keyframes back; the view is empty then. Null and empty views are left alone.
 *
 * # Safety
 * `keyframes` is null or was filled by `cairn_keyframes_wait`, and is zeroed or unchanged since.
 */
void cairn_keyframes_release(struct cairn_keyframes *keyframes);

/**
 * The next picture, waiting for it if need be. From the first call until `cairn_close` or `cairn_frames_stop` the daemon makes a
 * copy of every picture for this client. Release it with `cairn_frame_release`.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `frame` may be written.
 */
int32_t cairn_frame_wait(struct cairn_client *client,
                         uint64_t timeout_ns,
                         struct cairn_frame *frame);

/**
 * Gives a picture back; the view is empty then. Null and empty views are left alone.
 *
 * # Safety
 * `frame` is null or was filled by `cairn_frame_wait`, and is zeroed or unchanged since.
 */
void cairn_frame_release(struct cairn_frame *frame);

/**
 * No more pictures are wanted.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`.
 */
void cairn_frames_stop(struct cairn_client *client);

/**
 * What was found in the next picture, waiting for it if need be. From the first call until `cairn_close` or `cairn_features_stop` the
 * daemon tells it. Release it with `cairn_features_release`.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `features` may be written.
 */
int32_t cairn_features_wait(struct cairn_client *client,
                            uint64_t timeout_ns,
                            struct cairn_features *features);

/**
 * Gives features back; the view is empty then. Null and empty views are left alone.
 *
 * # Safety
 * `features` is null or was filled by `cairn_features_wait`, and is zeroed or unchanged since.
 */
void cairn_features_release(struct cairn_features *features);

/**
 * No more features are wanted.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`.
 */
void cairn_features_stop(struct cairn_client *client);

/**
 * Sends a command and waits for its reply, which may be a refusal: look at `reply->code`. Zero `command` before it is filled in.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `command` may be read and `reply` written.
 */
int32_t cairn_send_command(struct cairn_client *client,
                           const struct cairn_command *command,
                           uint64_t timeout_ns,
                           struct cairn_command_reply *reply);

/**
 * The next graph that has not been read, waiting for it if need be. From the first call until `cairn_close` or `cairn_graph_stop` the daemon
 * makes one with every map. Release it with `cairn_graph_release`.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `graph` may be written.
 */
int32_t cairn_graph_wait(struct cairn_client *client,
                         uint64_t timeout_ns,
                         struct cairn_graph *graph);

/**
 * Gives a graph back; the view is empty then. Null and empty views are left alone.
 *
 * # Safety
 * `graph` is null or was filled by `cairn_graph_wait`, and is zeroed or unchanged since.
 */
void cairn_graph_release(struct cairn_graph *graph);

/**
 * No more graphs are wanted.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`.
 */
void cairn_graph_stop(struct cairn_client *client);

/**
 * For the driver of the robot's base: its mean twist since the last call, up to now (REP-103: forward, to the left, turn to the left). To be
 * called 20 to 100 times a second. `CAIRN_MESSAGE` if a daemon is there, `CAIRN_NOTHING` if not, `CAIRN_ERROR` where waiting does not
 * help: another driver tells of the wheels already. Never waits.
 *
 * # Safety
 * `client` comes from `cairn_connect`.
 */
int32_t cairn_wheel_send(struct cairn_client *client,
                         double linear_x_mps,
                         double linear_y_mps,
                         double angular_z_radps);

/**
 * The same with stamps and variances of the driver's own; `sequence` is filled in here. Fill in every field: what the driver does not know is
 * `CAIRN_UNKNOWN_NS` or NaN.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `message` may be read.
 */
int32_t cairn_wheel_publish(struct cairn_client *client,
                            const struct cairn_wheel_odometry *message);

/**
 * The driver tells no more; another one may.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`.
 */
void cairn_wheel_stop(struct cairn_client *client);

/**
 * The newest scan of what stands around the robot and where the floor is seen free, waiting for it if need be. From the first call until
 * `cairn_close` or `cairn_obstacles_stop` the daemon makes scans, about six a second.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `obstacles` may be written.
 */
int32_t cairn_obstacles_wait(struct cairn_client *client,
                             uint64_t timeout_ns,
                             struct cairn_obstacles *obstacles);

/**
 * No more scans are wanted.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`.
 */
void cairn_obstacles_stop(struct cairn_client *client);

/**
 * The newest word on where the map's tags are, waiting for it if need be. From the first call until `cairn_close` or `cairn_tags_stop` the
 * daemon tells it with every map.
 *
 * # Safety
 * `client` comes from `cairn_connect`; `tags` may be written.
 */
int32_t cairn_tags_wait(struct cairn_client *client,
                        uint64_t timeout_ns,
                        struct cairn_tags *tags);

/**
 * No more tags are wanted.
 *
 * # Safety
 * `client` is null or comes from `cairn_connect`.
 */
void cairn_tags_stop(struct cairn_client *client);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* CAIRN_H */

/* Names that iceoryx2 compares when two processes meet. */
#define CAIRN_POSE_TYPE "cairn.Pose.v2"
#define CAIRN_HEALTH_TYPE "cairn.Health.v3"
#define CAIRN_STAGE_HEALTH_TYPE "cairn.StageHealth.v1"
#define CAIRN_LANDMARK_TYPE "cairn.Landmark.v1"
#define CAIRN_MAP_HEADER_TYPE "cairn.MapHeader.v2"
#define CAIRN_KEYFRAME_TYPE "cairn.Keyframe.v1"
#define CAIRN_KEYFRAMES_HEADER_TYPE "cairn.KeyframesHeader.v2"
#define CAIRN_GRAPH_EDGE_TYPE "cairn.GraphEdge.v1"
#define CAIRN_GRAPH_HEADER_TYPE "cairn.GraphHeader.v1"
#define CAIRN_FRAME_HEADER_TYPE "cairn.FrameHeader.v1"
#define CAIRN_ENCODED_HEADER_TYPE "cairn.EncodedHeader.v1"
#define CAIRN_FEATURE_TYPE "cairn.Feature.v1"
#define CAIRN_FEATURES_HEADER_TYPE "cairn.FeaturesHeader.v1"
#define CAIRN_COMMAND_TYPE "cairn.Command.v1"
#define CAIRN_COMMAND_REPLY_TYPE "cairn.CommandReply.v1"
#define CAIRN_WHEEL_ODOMETRY_TYPE "cairn.WheelOdometry.v1"
#define CAIRN_OBSTACLES_TYPE "cairn.Obstacles.v1"
#define CAIRN_TAG_TYPE "cairn.Tag.v1"
#define CAIRN_TAGS_TYPE "cairn.Tags.v1"

/* The layout, checked wherever this file is included. */
#ifdef __cplusplus
#define CAIRN_ASSERT(fact) static_assert(fact, #fact)
#else
#define CAIRN_ASSERT(fact) _Static_assert(fact, #fact)
#endif
CAIRN_ASSERT(sizeof(cairn_pose) == 448);
CAIRN_ASSERT(offsetof(cairn_pose, run_id) == 0 && sizeof(((cairn_pose *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, sequence) == 8 && sizeof(((cairn_pose *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, timestamp_ns) == 16 && sizeof(((cairn_pose *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, arrival_ns) == 24 && sizeof(((cairn_pose *)0)->arrival_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, published_ns) == 32 && sizeof(((cairn_pose *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, latency_arrival_ns) == 40 && sizeof(((cairn_pose *)0)->latency_arrival_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, latency_capture_ns) == 48 && sizeof(((cairn_pose *)0)->latency_capture_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, frames_dropped) == 56 && sizeof(((cairn_pose *)0)->frames_dropped) == 8);
CAIRN_ASSERT(offsetof(cairn_pose, position) == 64 && sizeof(((cairn_pose *)0)->position) == 24);
CAIRN_ASSERT(offsetof(cairn_pose, orientation) == 88 && sizeof(((cairn_pose *)0)->orientation) == 32);
CAIRN_ASSERT(offsetof(cairn_pose, odom_position) == 120 && sizeof(((cairn_pose *)0)->odom_position) == 24);
CAIRN_ASSERT(offsetof(cairn_pose, odom_orientation) == 144 && sizeof(((cairn_pose *)0)->odom_orientation) == 32);
CAIRN_ASSERT(offsetof(cairn_pose, covariance) == 176 && sizeof(((cairn_pose *)0)->covariance) == 168);
CAIRN_ASSERT(offsetof(cairn_pose, linear_velocity) == 344 && sizeof(((cairn_pose *)0)->linear_velocity) == 24);
CAIRN_ASSERT(offsetof(cairn_pose, angular_velocity) == 368 && sizeof(((cairn_pose *)0)->angular_velocity) == 24);
CAIRN_ASSERT(offsetof(cairn_pose, quality) == 392 && sizeof(((cairn_pose *)0)->quality) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, scale_sigma) == 396 && sizeof(((cairn_pose *)0)->scale_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, landmarks) == 400 && sizeof(((cairn_pose *)0)->landmarks) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, landmarks_sought) == 404 && sizeof(((cairn_pose *)0)->landmarks_sought) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, reset_counter) == 408 && sizeof(((cairn_pose *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, map_id) == 412 && sizeof(((cairn_pose *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, map_revision) == 416 && sizeof(((cairn_pose *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, anchor_keyframe) == 420 && sizeof(((cairn_pose *)0)->anchor_keyframe) == 4);
CAIRN_ASSERT(offsetof(cairn_pose, state) == 424 && sizeof(((cairn_pose *)0)->state) == 1);
CAIRN_ASSERT(offsetof(cairn_pose, scale) == 425 && sizeof(((cairn_pose *)0)->scale) == 1);
CAIRN_ASSERT(offsetof(cairn_pose, scale_source) == 426 && sizeof(((cairn_pose *)0)->scale_source) == 1);
CAIRN_ASSERT(offsetof(cairn_pose, clock) == 427 && sizeof(((cairn_pose *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_pose, keyframe) == 428 && sizeof(((cairn_pose *)0)->keyframe) == 1);
CAIRN_ASSERT(offsetof(cairn_pose, reserved) == 429 && sizeof(((cairn_pose *)0)->reserved) == 19);
CAIRN_ASSERT(sizeof(cairn_health) == 512);
CAIRN_ASSERT(offsetof(cairn_health, run_id) == 0 && sizeof(((cairn_health *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_health, sequence) == 8 && sizeof(((cairn_health *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_health, published_ns) == 16 && sizeof(((cairn_health *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_health, uptime_ns) == 24 && sizeof(((cairn_health *)0)->uptime_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_health, realtime_minus_monotonic_ns) == 32 && sizeof(((cairn_health *)0)->realtime_minus_monotonic_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_health, errors) == 40 && sizeof(((cairn_health *)0)->errors) == 8);
CAIRN_ASSERT(offsetof(cairn_health, frames_captured) == 48 && sizeof(((cairn_health *)0)->frames_captured) == 8);
CAIRN_ASSERT(offsetof(cairn_health, frames_dropped) == 56 && sizeof(((cairn_health *)0)->frames_dropped) == 8);
CAIRN_ASSERT(offsetof(cairn_health, frames_corrupt) == 64 && sizeof(((cairn_health *)0)->frames_corrupt) == 8);
CAIRN_ASSERT(offsetof(cairn_health, frames_tracked) == 72 && sizeof(((cairn_health *)0)->frames_tracked) == 8);
CAIRN_ASSERT(offsetof(cairn_health, keyframes_made) == 80 && sizeof(((cairn_health *)0)->keyframes_made) == 8);
CAIRN_ASSERT(offsetof(cairn_health, landmarks_made) == 88 && sizeof(((cairn_health *)0)->landmarks_made) == 8);
CAIRN_ASSERT(offsetof(cairn_health, adjustments) == 96 && sizeof(((cairn_health *)0)->adjustments) == 8);
CAIRN_ASSERT(offsetof(cairn_health, adjustments_late) == 104 && sizeof(((cairn_health *)0)->adjustments_late) == 8);
CAIRN_ASSERT(offsetof(cairn_health, resets) == 112 && sizeof(((cairn_health *)0)->resets) == 8);
CAIRN_ASSERT(offsetof(cairn_health, relocalisations) == 120 && sizeof(((cairn_health *)0)->relocalisations) == 8);
CAIRN_ASSERT(offsetof(cairn_health, maps_joined) == 128 && sizeof(((cairn_health *)0)->maps_joined) == 8);
CAIRN_ASSERT(offsetof(cairn_health, loops_closed) == 136 && sizeof(((cairn_health *)0)->loops_closed) == 8);
CAIRN_ASSERT(offsetof(cairn_health, frame_age_ns) == 144 && sizeof(((cairn_health *)0)->frame_age_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_health, pose_age_ns) == 152 && sizeof(((cairn_health *)0)->pose_age_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_health, stages) == 160 && sizeof(((cairn_health *)0)->stages) == 192);
CAIRN_ASSERT(offsetof(cairn_health, keyframes) == 352 && sizeof(((cairn_health *)0)->keyframes) == 4);
CAIRN_ASSERT(offsetof(cairn_health, landmarks) == 356 && sizeof(((cairn_health *)0)->landmarks) == 4);
CAIRN_ASSERT(offsetof(cairn_health, maps) == 360 && sizeof(((cairn_health *)0)->maps) == 4);
CAIRN_ASSERT(offsetof(cairn_health, reset_counter) == 364 && sizeof(((cairn_health *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_health, map_id) == 368 && sizeof(((cairn_health *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_health, map_revision) == 372 && sizeof(((cairn_health *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_health, pid) == 376 && sizeof(((cairn_health *)0)->pid) == 4);
CAIRN_ASSERT(offsetof(cairn_health, state) == 380 && sizeof(((cairn_health *)0)->state) == 1);
CAIRN_ASSERT(offsetof(cairn_health, clock) == 381 && sizeof(((cairn_health *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_health, intrinsics) == 382 && sizeof(((cairn_health *)0)->intrinsics) == 1);
CAIRN_ASSERT(offsetof(cairn_health, lens_model) == 383 && sizeof(((cairn_health *)0)->lens_model) == 1);
CAIRN_ASSERT(offsetof(cairn_health, version) == 384 && sizeof(((cairn_health *)0)->version) == 32);
CAIRN_ASSERT(offsetof(cairn_health, focal_px) == 416 && sizeof(((cairn_health *)0)->focal_px) == 8);
CAIRN_ASSERT(offsetof(cairn_health, centre_px) == 424 && sizeof(((cairn_health *)0)->centre_px) == 8);
CAIRN_ASSERT(offsetof(cairn_health, focal_sigma) == 432 && sizeof(((cairn_health *)0)->focal_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_health, centre_sigma_px) == 436 && sizeof(((cairn_health *)0)->centre_sigma_px) == 4);
CAIRN_ASSERT(offsetof(cairn_health, correction_distance) == 440 && sizeof(((cairn_health *)0)->correction_distance) == 4);
CAIRN_ASSERT(offsetof(cairn_health, correction_rad) == 444 && sizeof(((cairn_health *)0)->correction_rad) == 4);
CAIRN_ASSERT(offsetof(cairn_health, map_mode) == 448 && sizeof(((cairn_health *)0)->map_mode) == 1);
CAIRN_ASSERT(offsetof(cairn_health, reserved) == 449 && sizeof(((cairn_health *)0)->reserved) == 15);
CAIRN_ASSERT(offsetof(cairn_health, blind_ns) == 464 && sizeof(((cairn_health *)0)->blind_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_health, blind_m) == 472 && sizeof(((cairn_health *)0)->blind_m) == 8);
CAIRN_ASSERT(offsetof(cairn_health, wheel_messages) == 480 && sizeof(((cairn_health *)0)->wheel_messages) == 8);
CAIRN_ASSERT(offsetof(cairn_health, wheel_refused) == 488 && sizeof(((cairn_health *)0)->wheel_refused) == 8);
CAIRN_ASSERT(offsetof(cairn_health, wheel_missing) == 496 && sizeof(((cairn_health *)0)->wheel_missing) == 8);
CAIRN_ASSERT(offsetof(cairn_health, wheel_late) == 504 && sizeof(((cairn_health *)0)->wheel_late) == 8);
CAIRN_ASSERT(sizeof(cairn_stage_health) == 32);
CAIRN_ASSERT(offsetof(cairn_stage_health, steps) == 0 && sizeof(((cairn_stage_health *)0)->steps) == 8);
CAIRN_ASSERT(offsetof(cairn_stage_health, heartbeat_age_ns) == 8 && sizeof(((cairn_stage_health *)0)->heartbeat_age_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_stage_health, p50_ms) == 16 && sizeof(((cairn_stage_health *)0)->p50_ms) == 4);
CAIRN_ASSERT(offsetof(cairn_stage_health, p95_ms) == 20 && sizeof(((cairn_stage_health *)0)->p95_ms) == 4);
CAIRN_ASSERT(offsetof(cairn_stage_health, p99_ms) == 24 && sizeof(((cairn_stage_health *)0)->p99_ms) == 4);
CAIRN_ASSERT(offsetof(cairn_stage_health, rate_hz) == 28 && sizeof(((cairn_stage_health *)0)->rate_hz) == 4);
CAIRN_ASSERT(sizeof(cairn_landmark) == 24);
CAIRN_ASSERT(offsetof(cairn_landmark, id) == 0 && sizeof(((cairn_landmark *)0)->id) == 4);
CAIRN_ASSERT(offsetof(cairn_landmark, observations) == 4 && sizeof(((cairn_landmark *)0)->observations) == 4);
CAIRN_ASSERT(offsetof(cairn_landmark, position) == 8 && sizeof(((cairn_landmark *)0)->position) == 12);
CAIRN_ASSERT(offsetof(cairn_landmark, sigma) == 20 && sizeof(((cairn_landmark *)0)->sigma) == 4);
CAIRN_ASSERT(sizeof(cairn_map_header) == 64);
CAIRN_ASSERT(offsetof(cairn_map_header, run_id) == 0 && sizeof(((cairn_map_header *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_map_header, content_revision) == 8 && sizeof(((cairn_map_header *)0)->content_revision) == 8);
CAIRN_ASSERT(offsetof(cairn_map_header, timestamp_ns) == 16 && sizeof(((cairn_map_header *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_map_header, published_ns) == 24 && sizeof(((cairn_map_header *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_map_header, count) == 32 && sizeof(((cairn_map_header *)0)->count) == 4);
CAIRN_ASSERT(offsetof(cairn_map_header, total) == 36 && sizeof(((cairn_map_header *)0)->total) == 4);
CAIRN_ASSERT(offsetof(cairn_map_header, map_id) == 40 && sizeof(((cairn_map_header *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_map_header, reset_counter) == 44 && sizeof(((cairn_map_header *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_map_header, map_revision) == 48 && sizeof(((cairn_map_header *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_map_header, scale_sigma) == 52 && sizeof(((cairn_map_header *)0)->scale_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_map_header, scale) == 56 && sizeof(((cairn_map_header *)0)->scale) == 1);
CAIRN_ASSERT(offsetof(cairn_map_header, scale_source) == 57 && sizeof(((cairn_map_header *)0)->scale_source) == 1);
CAIRN_ASSERT(offsetof(cairn_map_header, clock) == 58 && sizeof(((cairn_map_header *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_map_header, map_mode) == 59 && sizeof(((cairn_map_header *)0)->map_mode) == 1);
CAIRN_ASSERT(offsetof(cairn_map_header, reserved) == 60 && sizeof(((cairn_map_header *)0)->reserved) == 4);
CAIRN_ASSERT(sizeof(cairn_keyframe) == 72);
CAIRN_ASSERT(offsetof(cairn_keyframe, timestamp_ns) == 0 && sizeof(((cairn_keyframe *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_keyframe, position) == 8 && sizeof(((cairn_keyframe *)0)->position) == 24);
CAIRN_ASSERT(offsetof(cairn_keyframe, orientation) == 32 && sizeof(((cairn_keyframe *)0)->orientation) == 32);
CAIRN_ASSERT(offsetof(cairn_keyframe, id) == 64 && sizeof(((cairn_keyframe *)0)->id) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframe, reserved) == 68 && sizeof(((cairn_keyframe *)0)->reserved) == 4);
CAIRN_ASSERT(sizeof(cairn_keyframes_header) == 64);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, run_id) == 0 && sizeof(((cairn_keyframes_header *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, content_revision) == 8 && sizeof(((cairn_keyframes_header *)0)->content_revision) == 8);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, timestamp_ns) == 16 && sizeof(((cairn_keyframes_header *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, published_ns) == 24 && sizeof(((cairn_keyframes_header *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, count) == 32 && sizeof(((cairn_keyframes_header *)0)->count) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, total) == 36 && sizeof(((cairn_keyframes_header *)0)->total) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, map_id) == 40 && sizeof(((cairn_keyframes_header *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, reset_counter) == 44 && sizeof(((cairn_keyframes_header *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, map_revision) == 48 && sizeof(((cairn_keyframes_header *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, scale_sigma) == 52 && sizeof(((cairn_keyframes_header *)0)->scale_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, scale) == 56 && sizeof(((cairn_keyframes_header *)0)->scale) == 1);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, scale_source) == 57 && sizeof(((cairn_keyframes_header *)0)->scale_source) == 1);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, clock) == 58 && sizeof(((cairn_keyframes_header *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, map_mode) == 59 && sizeof(((cairn_keyframes_header *)0)->map_mode) == 1);
CAIRN_ASSERT(offsetof(cairn_keyframes_header, reserved) == 60 && sizeof(((cairn_keyframes_header *)0)->reserved) == 4);
CAIRN_ASSERT(sizeof(cairn_graph_edge) == 20);
CAIRN_ASSERT(offsetof(cairn_graph_edge, from) == 0 && sizeof(((cairn_graph_edge *)0)->from) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_edge, to) == 4 && sizeof(((cairn_graph_edge *)0)->to) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_edge, shared) == 8 && sizeof(((cairn_graph_edge *)0)->shared) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_edge, joined_map) == 12 && sizeof(((cairn_graph_edge *)0)->joined_map) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_edge, kind) == 16 && sizeof(((cairn_graph_edge *)0)->kind) == 1);
CAIRN_ASSERT(offsetof(cairn_graph_edge, reserved) == 17 && sizeof(((cairn_graph_edge *)0)->reserved) == 3);
CAIRN_ASSERT(sizeof(cairn_graph_header) == 64);
CAIRN_ASSERT(offsetof(cairn_graph_header, run_id) == 0 && sizeof(((cairn_graph_header *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_graph_header, content_revision) == 8 && sizeof(((cairn_graph_header *)0)->content_revision) == 8);
CAIRN_ASSERT(offsetof(cairn_graph_header, timestamp_ns) == 16 && sizeof(((cairn_graph_header *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_graph_header, published_ns) == 24 && sizeof(((cairn_graph_header *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_graph_header, count) == 32 && sizeof(((cairn_graph_header *)0)->count) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_header, total) == 36 && sizeof(((cairn_graph_header *)0)->total) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_header, map_id) == 40 && sizeof(((cairn_graph_header *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_header, reset_counter) == 44 && sizeof(((cairn_graph_header *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_header, map_revision) == 48 && sizeof(((cairn_graph_header *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_graph_header, clock) == 52 && sizeof(((cairn_graph_header *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_graph_header, map_mode) == 53 && sizeof(((cairn_graph_header *)0)->map_mode) == 1);
CAIRN_ASSERT(offsetof(cairn_graph_header, reserved) == 54 && sizeof(((cairn_graph_header *)0)->reserved) == 10);
CAIRN_ASSERT(sizeof(cairn_frame_header) == 48);
CAIRN_ASSERT(offsetof(cairn_frame_header, run_id) == 0 && sizeof(((cairn_frame_header *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_frame_header, sequence) == 8 && sizeof(((cairn_frame_header *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_frame_header, timestamp_ns) == 16 && sizeof(((cairn_frame_header *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_frame_header, arrival_ns) == 24 && sizeof(((cairn_frame_header *)0)->arrival_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_frame_header, width) == 32 && sizeof(((cairn_frame_header *)0)->width) == 4);
CAIRN_ASSERT(offsetof(cairn_frame_header, height) == 36 && sizeof(((cairn_frame_header *)0)->height) == 4);
CAIRN_ASSERT(offsetof(cairn_frame_header, stride) == 40 && sizeof(((cairn_frame_header *)0)->stride) == 4);
CAIRN_ASSERT(offsetof(cairn_frame_header, clock) == 44 && sizeof(((cairn_frame_header *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_frame_header, reserved) == 45 && sizeof(((cairn_frame_header *)0)->reserved) == 3);
CAIRN_ASSERT(sizeof(cairn_encoded_header) == 192);
CAIRN_ASSERT(offsetof(cairn_encoded_header, run_id) == 0 && sizeof(((cairn_encoded_header *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_encoded_header, sequence) == 8 && sizeof(((cairn_encoded_header *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_encoded_header, timestamp_ns) == 16 && sizeof(((cairn_encoded_header *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_encoded_header, arrival_ns) == 24 && sizeof(((cairn_encoded_header *)0)->arrival_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_encoded_header, focal_px) == 32 && sizeof(((cairn_encoded_header *)0)->focal_px) == 16);
CAIRN_ASSERT(offsetof(cairn_encoded_header, centre_px) == 48 && sizeof(((cairn_encoded_header *)0)->centre_px) == 16);
CAIRN_ASSERT(offsetof(cairn_encoded_header, distortion) == 64 && sizeof(((cairn_encoded_header *)0)->distortion) == 40);
CAIRN_ASSERT(offsetof(cairn_encoded_header, camera_position) == 104 && sizeof(((cairn_encoded_header *)0)->camera_position) == 24);
CAIRN_ASSERT(offsetof(cairn_encoded_header, camera_orientation) == 128 && sizeof(((cairn_encoded_header *)0)->camera_orientation) == 32);
CAIRN_ASSERT(offsetof(cairn_encoded_header, width) == 160 && sizeof(((cairn_encoded_header *)0)->width) == 4);
CAIRN_ASSERT(offsetof(cairn_encoded_header, height) == 164 && sizeof(((cairn_encoded_header *)0)->height) == 4);
CAIRN_ASSERT(offsetof(cairn_encoded_header, stride) == 168 && sizeof(((cairn_encoded_header *)0)->stride) == 4);
CAIRN_ASSERT(offsetof(cairn_encoded_header, format) == 172 && sizeof(((cairn_encoded_header *)0)->format) == 1);
CAIRN_ASSERT(offsetof(cairn_encoded_header, clock) == 173 && sizeof(((cairn_encoded_header *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_encoded_header, intrinsics) == 174 && sizeof(((cairn_encoded_header *)0)->intrinsics) == 1);
CAIRN_ASSERT(offsetof(cairn_encoded_header, lens_model) == 175 && sizeof(((cairn_encoded_header *)0)->lens_model) == 1);
CAIRN_ASSERT(offsetof(cairn_encoded_header, reserved) == 176 && sizeof(((cairn_encoded_header *)0)->reserved) == 16);
CAIRN_ASSERT(sizeof(cairn_feature) == 24);
CAIRN_ASSERT(offsetof(cairn_feature, track) == 0 && sizeof(((cairn_feature *)0)->track) == 8);
CAIRN_ASSERT(offsetof(cairn_feature, position) == 8 && sizeof(((cairn_feature *)0)->position) == 8);
CAIRN_ASSERT(offsetof(cairn_feature, age) == 16 && sizeof(((cairn_feature *)0)->age) == 4);
CAIRN_ASSERT(offsetof(cairn_feature, landmark) == 20 && sizeof(((cairn_feature *)0)->landmark) == 4);
CAIRN_ASSERT(sizeof(cairn_features_header) == 56);
CAIRN_ASSERT(offsetof(cairn_features_header, run_id) == 0 && sizeof(((cairn_features_header *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_features_header, sequence) == 8 && sizeof(((cairn_features_header *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_features_header, timestamp_ns) == 16 && sizeof(((cairn_features_header *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_features_header, arrival_ns) == 24 && sizeof(((cairn_features_header *)0)->arrival_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_features_header, width) == 32 && sizeof(((cairn_features_header *)0)->width) == 4);
CAIRN_ASSERT(offsetof(cairn_features_header, height) == 36 && sizeof(((cairn_features_header *)0)->height) == 4);
CAIRN_ASSERT(offsetof(cairn_features_header, count) == 40 && sizeof(((cairn_features_header *)0)->count) == 4);
CAIRN_ASSERT(offsetof(cairn_features_header, total) == 44 && sizeof(((cairn_features_header *)0)->total) == 4);
CAIRN_ASSERT(offsetof(cairn_features_header, clock) == 48 && sizeof(((cairn_features_header *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_features_header, reserved) == 49 && sizeof(((cairn_features_header *)0)->reserved) == 7);
CAIRN_ASSERT(sizeof(cairn_command) == 576);
CAIRN_ASSERT(offsetof(cairn_command, kind) == 0 && sizeof(((cairn_command *)0)->kind) == 4);
CAIRN_ASSERT(offsetof(cairn_command, path_len) == 4 && sizeof(((cairn_command *)0)->path_len) == 4);
CAIRN_ASSERT(offsetof(cairn_command, path) == 8 && sizeof(((cairn_command *)0)->path) == 512);
CAIRN_ASSERT(offsetof(cairn_command, position) == 520 && sizeof(((cairn_command *)0)->position) == 24);
CAIRN_ASSERT(offsetof(cairn_command, orientation) == 544 && sizeof(((cairn_command *)0)->orientation) == 32);
CAIRN_ASSERT(sizeof(cairn_command_reply) == 520);
CAIRN_ASSERT(offsetof(cairn_command_reply, code) == 0 && sizeof(((cairn_command_reply *)0)->code) == 4);
CAIRN_ASSERT(offsetof(cairn_command_reply, message_len) == 4 && sizeof(((cairn_command_reply *)0)->message_len) == 4);
CAIRN_ASSERT(offsetof(cairn_command_reply, message) == 8 && sizeof(((cairn_command_reply *)0)->message) == 512);
CAIRN_ASSERT(sizeof(cairn_wheel_odometry) == 96);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, sequence) == 0 && sizeof(((cairn_wheel_odometry *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, timestamp_ns) == 8 && sizeof(((cairn_wheel_odometry *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, interval_start_ns) == 16 && sizeof(((cairn_wheel_odometry *)0)->interval_start_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, linear_x_mps) == 24 && sizeof(((cairn_wheel_odometry *)0)->linear_x_mps) == 8);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, linear_y_mps) == 32 && sizeof(((cairn_wheel_odometry *)0)->linear_y_mps) == 8);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, angular_z_radps) == 40 && sizeof(((cairn_wheel_odometry *)0)->angular_z_radps) == 8);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, variance) == 48 && sizeof(((cairn_wheel_odometry *)0)->variance) == 24);
CAIRN_ASSERT(offsetof(cairn_wheel_odometry, reserved) == 72 && sizeof(((cairn_wheel_odometry *)0)->reserved) == 24);
CAIRN_ASSERT(sizeof(cairn_obstacles) == 11016);
CAIRN_ASSERT(offsetof(cairn_obstacles, run_id) == 0 && sizeof(((cairn_obstacles *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_obstacles, sequence) == 8 && sizeof(((cairn_obstacles *)0)->sequence) == 8);
CAIRN_ASSERT(offsetof(cairn_obstacles, timestamp_ns) == 16 && sizeof(((cairn_obstacles *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_obstacles, published_ns) == 24 && sizeof(((cairn_obstacles *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_obstacles, position) == 32 && sizeof(((cairn_obstacles *)0)->position) == 24);
CAIRN_ASSERT(offsetof(cairn_obstacles, orientation) == 56 && sizeof(((cairn_obstacles *)0)->orientation) == 32);
CAIRN_ASSERT(offsetof(cairn_obstacles, angle_min) == 88 && sizeof(((cairn_obstacles *)0)->angle_min) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, angle_increment) == 92 && sizeof(((cairn_obstacles *)0)->angle_increment) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, range_min) == 96 && sizeof(((cairn_obstacles *)0)->range_min) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, range_max) == 100 && sizeof(((cairn_obstacles *)0)->range_max) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, robot_height) == 104 && sizeof(((cairn_obstacles *)0)->robot_height) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, scale_sigma) == 108 && sizeof(((cairn_obstacles *)0)->scale_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, map_id) == 112 && sizeof(((cairn_obstacles *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, reset_counter) == 116 && sizeof(((cairn_obstacles *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, map_revision) == 120 && sizeof(((cairn_obstacles *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, count) == 124 && sizeof(((cairn_obstacles *)0)->count) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, total) == 128 && sizeof(((cairn_obstacles *)0)->total) == 4);
CAIRN_ASSERT(offsetof(cairn_obstacles, told) == 132 && sizeof(((cairn_obstacles *)0)->told) == 1);
CAIRN_ASSERT(offsetof(cairn_obstacles, clock) == 133 && sizeof(((cairn_obstacles *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_obstacles, reserved) == 134 && sizeof(((cairn_obstacles *)0)->reserved) == 2);
CAIRN_ASSERT(offsetof(cairn_obstacles, range) == 136 && sizeof(((cairn_obstacles *)0)->range) == 720);
CAIRN_ASSERT(offsetof(cairn_obstacles, sigma) == 856 && sizeof(((cairn_obstacles *)0)->sigma) == 720);
CAIRN_ASSERT(offsetof(cairn_obstacles, free_from) == 1576 && sizeof(((cairn_obstacles *)0)->free_from) == 720);
CAIRN_ASSERT(offsetof(cairn_obstacles, free) == 2296 && sizeof(((cairn_obstacles *)0)->free) == 720);
CAIRN_ASSERT(offsetof(cairn_obstacles, points) == 3016 && sizeof(((cairn_obstacles *)0)->points) == 8000);
CAIRN_ASSERT(sizeof(cairn_tag) == 88);
CAIRN_ASSERT(offsetof(cairn_tag, position) == 0 && sizeof(((cairn_tag *)0)->position) == 24);
CAIRN_ASSERT(offsetof(cairn_tag, orientation) == 24 && sizeof(((cairn_tag *)0)->orientation) == 32);
CAIRN_ASSERT(offsetof(cairn_tag, size) == 56 && sizeof(((cairn_tag *)0)->size) == 4);
CAIRN_ASSERT(offsetof(cairn_tag, edge) == 60 && sizeof(((cairn_tag *)0)->edge) == 4);
CAIRN_ASSERT(offsetof(cairn_tag, position_sigma) == 64 && sizeof(((cairn_tag *)0)->position_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_tag, orientation_sigma) == 68 && sizeof(((cairn_tag *)0)->orientation_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_tag, id) == 72 && sizeof(((cairn_tag *)0)->id) == 4);
CAIRN_ASSERT(offsetof(cairn_tag, sightings) == 76 && sizeof(((cairn_tag *)0)->sightings) == 4);
CAIRN_ASSERT(offsetof(cairn_tag, family) == 80 && sizeof(((cairn_tag *)0)->family) == 1);
CAIRN_ASSERT(offsetof(cairn_tag, is_dock) == 81 && sizeof(((cairn_tag *)0)->is_dock) == 1);
CAIRN_ASSERT(offsetof(cairn_tag, reserved) == 82 && sizeof(((cairn_tag *)0)->reserved) == 6);
CAIRN_ASSERT(sizeof(cairn_tags) == 1472);
CAIRN_ASSERT(offsetof(cairn_tags, run_id) == 0 && sizeof(((cairn_tags *)0)->run_id) == 8);
CAIRN_ASSERT(offsetof(cairn_tags, content_revision) == 8 && sizeof(((cairn_tags *)0)->content_revision) == 8);
CAIRN_ASSERT(offsetof(cairn_tags, timestamp_ns) == 16 && sizeof(((cairn_tags *)0)->timestamp_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_tags, published_ns) == 24 && sizeof(((cairn_tags *)0)->published_ns) == 8);
CAIRN_ASSERT(offsetof(cairn_tags, count) == 32 && sizeof(((cairn_tags *)0)->count) == 4);
CAIRN_ASSERT(offsetof(cairn_tags, map_id) == 36 && sizeof(((cairn_tags *)0)->map_id) == 4);
CAIRN_ASSERT(offsetof(cairn_tags, reset_counter) == 40 && sizeof(((cairn_tags *)0)->reset_counter) == 4);
CAIRN_ASSERT(offsetof(cairn_tags, map_revision) == 44 && sizeof(((cairn_tags *)0)->map_revision) == 4);
CAIRN_ASSERT(offsetof(cairn_tags, scale_sigma) == 48 && sizeof(((cairn_tags *)0)->scale_sigma) == 4);
CAIRN_ASSERT(offsetof(cairn_tags, scale) == 52 && sizeof(((cairn_tags *)0)->scale) == 1);
CAIRN_ASSERT(offsetof(cairn_tags, scale_source) == 53 && sizeof(((cairn_tags *)0)->scale_source) == 1);
CAIRN_ASSERT(offsetof(cairn_tags, clock) == 54 && sizeof(((cairn_tags *)0)->clock) == 1);
CAIRN_ASSERT(offsetof(cairn_tags, map_mode) == 55 && sizeof(((cairn_tags *)0)->map_mode) == 1);
CAIRN_ASSERT(offsetof(cairn_tags, reserved) == 56 && sizeof(((cairn_tags *)0)->reserved) == 8);
CAIRN_ASSERT(offsetof(cairn_tags, tags) == 64 && sizeof(((cairn_tags *)0)->tags) == 1408);
#undef CAIRN_ASSERT
