//! Cairn: one webcam in, the robot's pose and a sparse map out, in shared memory.
//!
//! This is the architecture: what each room does, what it must not know, and why. `tests/architecture` holds the edges:
//! no room is known by what it knows, and within a room no file is.
//!
//! # Data flow, one direction
//!
//! ```text
//! camera ──► capture thread ──► frame ring ──► feature thread ──► bounded channel ──► reconstruction thread ──► publish ──► planners
//! (v4l2 | recording | simulator) (newest wins)  (decode, pyramid,  (1 or 2 frames)    (pose now, then keyframe,  (iceoryx2)
//!                                                corners, tracks)                      map, adjustment)
//!                                                     ▲                                     │        ▲
//!                                                     └── tracks to forget, by frame ◄──────┘        │
//!                                                                           mapping worker (bundle adjustment on copies)
//! ```
//!
//! One image's journey reads down [`daemon`]: a source's [`grab`](camera::FrameSource::grab) fills a slot of the
//! [`ring`]; [`FeatureStage::step`](features::FeatureStage::step) decodes it, follows the tracks of the frame before and starts
//! new ones; [`Reconstruction::track`](reconstruction::Reconstruction::track) gives the pose, which is published at once;
//! [`Reconstruction::map`](reconstruction::Reconstruction::map) then makes a keyframe of it where that pays.
//! A lock-step replay runs the very same steps in one thread.
//!
//! # How a pose comes about
//! - Frame-to-frame tracks (optical flow on 8x8 patches, started from the motion of a blurred thumbnail) predict the pose.
//! - Landmarks of the covisible keyframes are projected with it and aligned, to sub-pixel places, against templates cut
//!   from the keyframe with the closest view. Templates belong to keyframes, so positions do not drift with the frames.
//! - A robust motion-only adjustment over these gives pose and covariance; the covariance contains the landmarks' own, what of it they
//!   share, and the readout time's.
//! - Seeds (tracks without depth) become landmarks at keyframes, where their rays meet at a degree or more. In a quick turn with few
//!   landmarks they hold a frame's pose across their epipolar lines (`track::seed_rays`), every frame is a keyframe, and tracks on
//!   patterns are followed last (`features::repetition`).
//! - A keyframe that sees fewer than 120 landmarks is completed: corners of its neighbours that never became landmarks, as their tracks were
//!   cut, are looked for in it along their epipolar lines (`keyframe::epipolar`).
//! - What a rolling shutter did to a keyframe is corrected once the frame after it tells how the camera moved there, and the keyframe's pose with it
//!   (`keyframe::motion`).
//! - In a blurred picture what is not found at its own level is measured on coarser ones, as exactly as these are.
//! - A start is a reference view (once its tracks are gone a later one), the newest one and up to eight in between, adjusted together; where
//!   tracks are few, views joined by corners that look alike are tried after those of the tracks (`initialise::untracked`);
//!   it is accepted once the direction of
//!   the first motion is sure enough for how long the camera has moved, and most of the picture agrees with it, so neither standing
//!   nor turning on the spot starts a map, nor (with a calibrated lens) something large that moves past; one that the picture contradicts in its
//!   first second is given up (`consensus::probation`).
//! - The tracks, which know no map, are asked ever after: where most of the picture contradicts the poses for a second, what the map has grown by since
//!   is dropped, and the camera is lost (`consensus::contradiction`).
//! - Until then the tracks alone tell how the camera has turned since the first frame, moving or not (`initialise::orientation`): published
//!   without a position, and gone on with by the odometry of the map.
//! - A turn on the spot goes on where the map's landmarks leave the picture: corners without parallax become landmarks at an assumed
//!   distance, which tracking eliminates at every pose that it compares, from starts in several directions, as what is seen along rays alone fits
//!   more than one motion (`track::pose::minima`); adjustments and planners never see it. The first motion after the turn is found by two
//!   views, and the distances that these tell are assumed from then on (`keyframe::distance_prior` and `keyframe::after_rotation`); log, health
//!   and covariance say what its scale rests on.
//! - Local bundle adjustment runs in the mapping worker on a copy of the map's part, and is merged after a published pose, at
//!   a fixed number of frames later in lock-step (waiting if need be), whenever it is done when live; before the next frame is tracked
//!   where frames come less than nine times a second. Whenever a map of up to
//!   240 keyframes has grown by a third all of it is (global bundle adjustment), and the intrinsics with it.
//! - A camera without a calibration begins with a guess; its lens (distortion included) is refined the same way, at every keyframe of
//!   a small map, and health says how surely it is known. What was found is kept for the next start, by `cli`.
//! - Points are undistorted onto the plane z = 1 whatever the lens, so the geometry knows one kind of camera. That plane is stretched off
//!   the axis of a wide-angle lens; errors on it are weighed by the lens's own pixels there ([`geometry::CameraModel::pixel_scale`]).
//! - A frame that prediction cannot place, or only weakly, is looked for at once by thumbnails and descriptors (P3P) in a bounded number of
//!   keyframes; near the frame before, half the landmarks are asked for that a place anywhere in the map needs.
//! - A map's unit is arbitrary until something beside the picture tells it ([`motion`]). Wheels do so by one least squares problem over a bounded window of
//!   motions that camera and wheels both saw: scale and its drift, mount, yaw rate factor and time offset; motions in which they
//!   contradict are slip. Known to a few per cent, the map becomes metric at once (`reconstruction::metric`): another number, one reset. From then on
//!   the wheels' way holds the distances of keyframes in adjustments, and the step behind a turn on the spot is as long as they say.
//! - A camera that is driven at a known height ([`motion::floor`]) finds the floor among the landmarks: the plane that it moves parallel to, at
//!   one height, with nothing beneath, and that it was driven over. Landmarks weigh by how likely they are the floor's and not a low thing's, by
//!   where their pictures alone have them: adjustments hold the floor, and would make floor of what stands on it. Behind a turn on the spot floor
//!   and tags are asked of that part of the map alone, and what they say makes both parts one (`reconstruction::metric`). While somebody asks
//!   what stands on it ([`motion::obstacles`]), keyframes note after their pose where their pictures show the floor itself, and scans are made of
//!   that and of the map; what is not known is never free.
//! - Once a map is metric, tags (and a chessboard, one large tag) take part in its adjustments as rigid bodies of known size, and the floor by which a camera's
//!   height told the scale as a plane above which cameras keep height and tilt (`reconstruction::adjust`): words on the scale alone let it drift between them.
//! - A tag's place is made anew from the keyframes that saw it whenever it is told. With a dock the daemon moves the frame in which the map is *published*, by one
//!   rigid motion (`daemon::dock`); reconstruction's coordinates and all files stay as they are.
//! - In a metric map a frame that is not found where the last motion leads is looked for where the wheels say; one that the picture cannot place all the same (dark, covered, blurred) has the
//!   pose that they carry on, `DEAD_RECKONING`, within limits of time, way and doubt (`reconstruction::blind`). When the picture is back the smooth pose goes on,
//!   and where nothing of the map is in view the same map does, by a start that is brought in at the dead-reckoned place.
//! - A keyframe goes where three others see its landmarks, or newer ones of the same place see as many others (`keyframe::superseded`): a map of a place that
//!   changes grows little with time. Beyond `max_keyframes` it is thinned.
//! - A map that was lost is kept while the next one grows, recognised from its keyframes as a lost frame is, and joined to it. Neither map number
//!   nor reset counter goes back, and the smooth pose goes on; the frame is that of the larger map, so that what a planner has stored in months stays valid:
//!   the map pose jumps to it, with its revision. (Before, the frame was the present map's: a robot that did not know its rooms at once one morning told them
//!   6 % larger and half a metre off from then on.)
//!   A stored map that a command merges waits in the same way, and older keyframes of the present one are looked for in it as well, so that a robot that stands
//!   need not move (`relocalise::merging`). It has numbers above this run's, so numbers are an order of time within a run only (`map::Numbers`).
//! - What the base's wheels tell (`odometry.txt` beside the pictures, the simulator's base, a driver on `PREFIX/wheel`) waits in one bounded queue
//!   ([`motion::wheel`]); the reconstruction step takes from it, before it tracks a frame, all that ended at that frame's timestamp or earlier.
//! - With `[reconstruction] loops`: a keyframe that shows a place of the same map from long ago is recognised by an index over binary descriptors ([`places`]), verified as a lost frame
//!   is (on a copy, in a thread of its own beside the mapping worker's), and believed when two keyframes tell the same similarity; a pose graph on a copy in the mapping worker then moves the map, not the smooth pose.
//!   The oldest keyframe stays where it is, unless most of the map would have to move for it.
//!
//! # Invariants
//! 1. [`messages`] and [`client`] build alone (`default-features = false, features = ["client"]`).
//! 2. [`geometry`] knows nalgebra, and faer for large normal equations, only: no threads, IO, clock, logging, configuration, unseeded randomness.
//! 3. [`ring`] knows no images; [`features`] knows no map; [`map`] knows no threads; [`reconstruction`] knows no V4L2, ring or
//!    iceoryx2. ([`map`] uses of [`features`] what a keyframe keeps to be known again by: thumbnail, descriptors, gradients of patches.)
//! 4. Of the daemon's process only [`daemon`] spawns threads; [`console`] is another process, with its own. Every stage is also a plain step that a test calls without threads.
//! 5. Camera, recording and simulator come in by one door ([`camera::FrameSource`]).
//! 6. The daemon opens no network socket. What does runs as another process: [`console`], and bridge, fleet and map pull in [`share`].
//! 7. Lock-step replay is deterministic, byte for byte: no clock in a decision, no iteration over hash maps, seeds from frame
//!    numbers, sequential reductions.
//! 8. Every queue and store is bounded and counts what it drops. A trajectory streams to disk as keyframe and relative pose.
//! 9. No heap allocation from the decoded picture to the published pose once warm (`tests/allocations.rs`), but where frames are 0.11 s
//!    or more apart: there an adjusted map is merged first.
//! 10. Unscaled lengths are never called metres: the wire says whether the scale is metric.
//! 11. When tracking is lost the daemon keeps publishing, and says LOST, or DEAD_RECKONING where wheels carry the pose on. No pose is predicted into a trajectory.
//! 12. Release builds run on any machine of the architecture: x86-64 baseline with run-time dispatch, NEON on aarch64.
//!
//! # Where this house differs from its first plan
//! - Corners are detected by the feature thread whenever cells are empty, not on keyframes only: a frame in live operation has
//!   left the feature thread before reconstruction knows that it is a keyframe.
//! - `client/c.rs` has unsafe code, too: C's pointers cannot be checked.
//! - A keyframe copies its frame's pyramid (0.4 MB, 30 us, after the pose is published) instead of holding it, so that the pool of
//!   pyramids never allocates on the path of a pose. At most 18 keyframes are whole, in a pool of their own; of an older one level 0
//!   is reduced to patches around its landmarks (`map/picture.rs`). Of those beyond `detailed_keyframes` that share least with the newest
//!   only small patches, descriptors and a coarse level remain (`map/view.rs`), and packed observations (`map/observations.rs`); of those far from the
//!   robot nothing but what they show, the rest waits in a spool on the disk (`reconstruction/far_pictures.rs`). So a map holds thousands.
//!   Between the decoded picture and its pose no spool is read or written: what is not in memory is not aligned to, and is brought back after the pose
//!   is published. That may delay the next frame by the reads of a slow disk, of 16 pictures at the most (32 more while the
//!   index over places is filled from a map that was loaded).
//! - Two rooms more for recordings: [`share`] is `cairn record`, a process of its own that subscribes like a planner, and [`ros`] the messages of ROS 2 that it
//!   writes and a replay reads, which knows nothing of ours. Both are in the robot's build: to record is what a robot's owner does on the robot.
//!   `share` starts no thread; `cli` has the daemon's room start the one that writes to the disk. In `share/bridge`, `cairn bridge`: the same messages to ROS 2 over
//!   Zenoh, in rmw_zenoh's format; in `share/fleet`, `cairn fleet`: the robots of such a network; in `share/maps`, `cairn map pull`: maps from
//!   one of them to another. Zenoh's own threads and sockets are in these processes alone.
//! - A room more, [`workbench`]: the method step by step on two pictures from files (`cairn twoview`) and on many pairs with known
//!   truth (`cairn compare`). It is no stage of the daemon, needs single pictures, calibrations and truth of several kinds, and
//!   would otherwise put files and clocks into `features` and `geometry`; it knows these two, and only `cli` knows it.
//!
//! - A room more, [`console`]: the web page (`cairn console`), a subscriber of the same services as any planner. It knows the client's side of
//!   the wire alone; what to do about a fault it is told by `cli`, so that page, log and doctor say the same, and how a camera is
//!   calibrated `cli` hands in as well (`console::calibration::Calibrator`), so that page and terminal do the same.
//!
//! # Features
//!
//! | feature | what it is | package |
//! |---|---|---|
//! | `client` | wire types and subscriptions, iceoryx2 only | |
//! | `c` | the same as a C library, for `--crate-type cdylib` | |
//! | `robot` | the daemon: camera, services, calibration, and the commands run, doctor, watch, command, calibrate, record, replay, tag | `cairn` |
//! | `bridge` | that, with the commands bridge, fleet and map pull, and Zenoh | `cairn-bridge` |
//! | `tools` (default) | the whole: also simulator, plot, workbench, evaluation, console, and the commands demo, console, simulate, evaluate, twoview, compare | `cairn-tools` |
//!
//! Each contains those above it but `c`, and `tools` not `bridge`: Zenoh alone builds as long as all the rest. Rooms are left out whole: below `cli`, `cfg` stands at a room's door and hardly anywhere
//! else. The robot's build replays, because a recording gives the same bytes only from the same build on the same kind of processor;
//! it reads and checks the configuration of what it leaves out, so that one file serves both, and answers what it cannot do with one sentence.
//!
//! Planners in other languages live in `clients/`: header and examples for C and C++, a package for Python that talks to
//! iceoryx2 itself. What the wire is stands in `src/messages/WIRE.md`, whose tables are made from the sources, as `cairn.h` is.

#[cfg(feature = "client")]
pub mod client;
#[cfg(feature = "client")]
pub mod messages;

#[cfg(feature = "robot")]
pub mod atomic_file;
#[cfg(feature = "robot")]
pub mod calibration;
#[cfg(feature = "robot")]
pub mod camera;
#[cfg(feature = "robot")]
pub mod cli;
#[cfg(feature = "robot")]
pub mod config;
#[cfg(feature = "tools")]
pub mod console;
#[cfg(feature = "robot")]
pub mod daemon;
#[cfg(feature = "tools")]
pub mod evaluation;
#[cfg(feature = "robot")]
pub mod features;
#[cfg(feature = "robot")]
pub mod frame;
#[cfg(feature = "robot")]
pub mod geometry;
#[cfg(feature = "robot")]
pub mod image;
#[cfg(feature = "robot")]
pub mod map;
#[cfg(feature = "robot")]
pub mod motion;
#[cfg(feature = "robot")]
pub mod places;
#[cfg(feature = "tools")]
pub mod plot;
#[cfg(feature = "robot")]
pub mod publish;
#[cfg(feature = "robot")]
pub mod reconstruction;
#[cfg(feature = "robot")]
pub mod ring;
#[cfg(feature = "robot")]
pub mod ros;
#[cfg(feature = "robot")]
pub mod share;
#[cfg(feature = "robot")]
pub mod telemetry;
#[cfg(feature = "robot")]
pub mod trajectory;
#[cfg(feature = "tools")]
pub mod workbench;
