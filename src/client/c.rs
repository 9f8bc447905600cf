//! The client for C and C++: `clients/c/cairn.h` is made from this file and from [`crate::messages`] (`tests/header.rs`).
//!
//! Built as a shared library by
//! `cargo rustc --release --lib --crate-type cdylib --no-default-features --features c`.
//!
//! In: a handle, a timeout (ns), a place for the answer. Out: [`MESSAGE`], [`NOTHING`] or [`ERROR`]; the reason of the latter by
//! `cairn_error`. Poses and health are copied (448 and 512 bytes); map, keyframes and pictures are views of shared memory that
//! must be released. A handle is used by one thread at a time; several handles may live in several threads.
//!
//! Does not: start threads, install signal handlers, unwind into C, keep anything global but the last error of each thread.

use core::ffi::{CStr, c_char};
use std::cell::RefCell;
use std::ffi::CString;
use std::time::Duration;

use super::{
    Client, ClientError, FeatureLists, Features, Frame, Frames, Graphs, Healths, Keyframes, KeyframesSnapshot, Map,
    MapSnapshot, ObstacleScans, Poses, Subscription, TagLists, Topic, WheelPublisher, monotonic_ns,
};
use crate::messages::{
    Command, CommandReply, Feature, FeaturesHeader, FrameHeader, Health, Keyframe, KeyframesHeader, Landmark,
    MapHeader, Pose,
};

/// Grows when a function or a message of this header changes or goes; compare it with `cairn_abi_version()`.
pub const ABI_VERSION: u32 = 2;

/// There is a message, and it is where it was to be put.
pub const MESSAGE: i32 = 1;
/// There was none in that time.
pub const NOTHING: i32 = 0;
/// It cannot work, and waiting will not help: see `cairn_error()`.
pub const ERROR: i32 = -1;

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::default();
}

fn failed(reason: &str) -> i32 {
    // Messages have no zero bytes; one that had would be cut.
    let text = CString::new(reason.split('\0').next().unwrap_or_default()).unwrap_or_default();
    LAST_ERROR.with(|last| *last.borrow_mut() = text);
    ERROR
}

/// A connection to one daemon.
pub struct Handle {
    client: Client,
    poses: Poses,
    health: Healths,
    map: Map,
    keyframes: Keyframes,
    frames: Option<Frames>,
    features: Option<FeatureLists>,
    graphs: Option<Graphs>,
    obstacles: Option<ObstacleScans>,
    tags: Option<TagLists>,
    wheels: Option<WheelPublisher>,
}

/// A map in shared memory; never changes. Two may be held at a time.
#[repr(C)]
pub struct MapView {
    /// What the landmarks are a picture of.
    pub header: *const MapHeader,
    /// `count` landmarks.
    pub landmarks: *const Landmark,
    pub count: usize,
    /// For `cairn_map_release`.
    pub held: *mut MapHold,
}

/// Keeps a map in shared memory.
pub struct MapHold(#[expect(dead_code, reason = "held until it is dropped")] MapSnapshot);

/// The keyframes in shared memory; never change. Two may be held at a time.
#[repr(C)]
pub struct KeyframesView {
    /// What the keyframes are a picture of.
    pub header: *const KeyframesHeader,
    /// `count` keyframes.
    pub keyframes: *const Keyframe,
    pub count: usize,
    /// For `cairn_keyframes_release`.
    pub held: *mut KeyframesHold,
}

/// Keeps keyframes in shared memory.
pub struct KeyframesHold(#[expect(dead_code, reason = "held until it is dropped")] KeyframesSnapshot);

/// A grey picture in shared memory; never changes. Two may be held at a time.
#[repr(C)]
pub struct FrameView {
    /// Size, stride and time of the picture.
    pub header: *const FrameHeader,
    /// Rows of `header->stride` bytes, `size` bytes in all.
    pub pixels: *const u8,
    pub size: usize,
    /// For `cairn_frame_release`.
    pub held: *mut FrameHold,
}

/// Keeps a picture in shared memory.
pub struct FrameHold(#[expect(dead_code, reason = "held until it is dropped")] Frame);

/// What was found in a picture, in shared memory; never changes. Two may be held at a time.
#[repr(C)]
pub struct FeaturesView {
    /// Which picture, and how many features.
    pub header: *const FeaturesHeader,
    /// `count` features.
    pub features: *const Feature,
    pub count: usize,
    /// For `cairn_features_release`.
    pub held: *mut FeaturesHold,
}

/// Keeps features in shared memory.
pub struct FeaturesHold(#[expect(dead_code, reason = "held until it is dropped")] Features);

/// `ABI_VERSION` of the library.
#[unsafe(no_mangle)] // SAFETY: every name begins with `cairn_` and is defined once, here.
pub extern "C" fn cairn_abi_version() -> u32 {
    ABI_VERSION
}

/// CLOCK_MONOTONIC now, ns.
#[unsafe(no_mangle)] // SAFETY: as above
pub extern "C" fn cairn_monotonic_ns() -> i64 {
    monotonic_ns()
}

/// Why the last call of this thread failed, and what to do about it. Valid until the thread's next failure; never null.
#[unsafe(no_mangle)] // SAFETY: as above
pub extern "C" fn cairn_error() -> *const c_char {
    LAST_ERROR.with(|last| last.borrow().as_ptr())
}

/// The daemon with this prefix, which need not run yet; null: the one that CAIRN_PREFIX names, or "cairn". Returns null on
/// failure.
///
/// # Safety
/// `prefix` is null or a string that ends in a zero.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_connect(prefix: *const c_char) -> *mut Handle {
    let client = if prefix.is_null() {
        Client::from_environment()
    } else {
        // SAFETY: not null, and the caller promises that it ends in a zero.
        match unsafe { CStr::from_ptr(prefix) }.to_str() {
            Ok(prefix) => Client::connect(prefix),
            Err(_) => {
                failed("the prefix is not UTF-8");
                return core::ptr::null_mut();
            }
        }
    };
    match client {
        Ok(client) => {
            let (poses, health, map, keyframes) = (client.poses(), client.health(), client.map(), client.keyframes());
            // What costs the daemon something is asked for first.
            Box::into_raw(Box::new(Handle {
                client,
                poses,
                health,
                map,
                keyframes,
                frames: None,
                features: None,
                graphs: None,
                obstacles: None,
                tags: None,
                wheels: None,
            }))
        }
        Err(error) => {
            failed(&error.to_string());
            core::ptr::null_mut()
        }
    }
}

/// Ends a connection. Views taken from it stay valid until they are released.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`, and is not used any more.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_close(client: *mut Handle) {
    if !client.is_null() {
        // SAFETY: it came out of `Box::into_raw` in `cairn_connect`, and the caller gives it up.
        drop(unsafe { Box::from_raw(client) });
    }
}

/// Puts the outcome of a read where the caller wants it.
///
/// # Safety
/// `out` is null or may be written.
unsafe fn hand_over<T, O>(item: Result<Option<T>, ClientError>, out: *mut O, convert: impl FnOnce(T) -> O) -> i32 {
    if out.is_null() {
        return failed("there is no place for the answer: null");
    }
    match item {
        Ok(Some(item)) => {
            // SAFETY: not null, and the caller promises that it may be written.
            unsafe { out.write(convert(item)) };
            MESSAGE
        }
        Ok(None) => NOTHING,
        Err(error) => failed(&error.to_string()),
    }
}

/// The newest message if it has not been read yet, else the next one within `timeout`.
fn newest<T: Topic>(subscription: &mut Subscription<T>, timeout: Duration) -> Result<Option<T::Item>, ClientError> {
    let mut newest = subscription.wait(timeout)?;
    // Of borrowed ones the queue holds a single message, and only so many may be held.
    while !T::BORROWS && newest.is_some() {
        match subscription.try_next()? {
            None => break,
            later => newest = later,
        }
    }
    Ok(newest)
}

macro_rules! handle {
    ($client:ident) => {{
        // SAFETY: the caller promises a handle from `cairn_connect` that nobody else uses now; null is looked at here.
        match unsafe { $client.as_mut() } {
            Some(handle) => handle,
            None => return failed("there is no client: null"),
        }
    }};
}

mod graph;
mod obstacles;
mod tags;
mod wheels;

/// The newest pose, without waiting; the same one again while no newer has come (look at `cairn_pose_is_usable`). A client that
/// has had none yet waits up to 0.4 s, once, for the last pose of a daemon that is there.
///
/// # Safety
/// `client` comes from `cairn_connect`; `pose` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_pose_latest(client: *mut Handle, pose: *mut Pose) -> i32 {
    let latest = handle!(client).poses.latest_within(Duration::from_millis(400)).map(|pose| pose.copied());
    // SAFETY: the caller's promise.
    unsafe { hand_over(latest, pose, |pose| pose) }
}

/// The oldest pose that has not been read, waiting for it if need be: every pose in order. Ends early, with `CAIRN_NOTHING`, when
/// a signal comes.
///
/// # Safety
/// `client` comes from `cairn_connect`; `pose` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_pose_wait(client: *mut Handle, timeout_ns: u64, pose: *mut Pose) -> i32 {
    let item = handle!(client).poses.wait(Duration::from_nanos(timeout_ns));
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, pose, |pose| pose) }
}

/// 1 if the robot may act on this pose: it was tracked, and its frame is no older than `max_age_ns`; else 0.
///
/// # Safety
/// `pose` is null or may be read.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_pose_is_usable(pose: *const Pose, max_age_ns: u64) -> i32 {
    // SAFETY: null is looked at, and otherwise the caller promises that it may be read.
    unsafe { pose.as_ref() }.is_some_and(|pose| pose.is_usable(Duration::from_nanos(max_age_ns))).into()
}

/// 1 if the body's orientation is known, with a position (`CAIRN_STATE_TRACKING`, `CAIRN_STATE_DEAD_RECKONING`) or before there is one (`CAIRN_STATE_ORIENTATION`); then
/// `heading_rad`, unless null, is its angle about the vertical in odom, counter-clockwise from above, rad. Else 0, and nothing is written.
/// It is no leave to drive: ask `cairn_pose_is_usable` for that.
///
/// # Safety
/// `pose` is null or may be read; `heading_rad` is null or may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_pose_heading(pose: *const Pose, heading_rad: *mut f64) -> i32 {
    // SAFETY: null is looked at, and otherwise the caller promises that it may be read.
    let Some(heading) = unsafe { pose.as_ref() }.and_then(Pose::heading_rad) else { return 0 };
    // SAFETY: as above, for writing.
    if let Some(place) = unsafe { heading_rad.as_mut() } {
        *place = heading;
    }
    1
}

/// The pose's covariance as a 6x6 matrix, 36 numbers, order x, y, z, rotation about x, y, z; in the body's axes, or (`in_map_axes` not
/// 0) in the map's, as `nav_msgs/Odometry` and MAVLink want it.
///
/// # Safety
/// `pose` may be read; `matrix` has room for 36 numbers.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_pose_covariance(pose: *const Pose, in_map_axes: i32, matrix: *mut f64) {
    // SAFETY: null is looked at, and otherwise the caller promises that it may be read.
    if let Some(pose) = unsafe { pose.as_ref() }
        && !matrix.is_null()
    {
        let full = if in_map_axes == 0 { pose.covariance_matrix() } else { pose.covariance_in_map_axes() };
        // SAFETY: not null, and the caller promises room for 36 numbers.
        unsafe { core::ptr::copy_nonoverlapping(full.as_flattened().as_ptr(), matrix, 36) };
    }
}

/// Health as it is sent, the newest, waiting for it if need be.
///
/// # Safety
/// `client` comes from `cairn_connect`; `health` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_health_wait(client: *mut Handle, timeout_ns: u64, health: *mut Health) -> i32 {
    let item = newest(&mut handle!(client).health, Duration::from_nanos(timeout_ns));
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, health, |health| health) }
}

/// The next map that has not been read, waiting for it if need be; the first call gives the current one. Release it with
/// `cairn_map_release`.
///
/// # Safety
/// `client` comes from `cairn_connect`; `map` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_map_wait(client: *mut Handle, timeout_ns: u64, map: *mut MapView) -> i32 {
    let item = newest(&mut handle!(client).map, Duration::from_nanos(timeout_ns));
    let view = |map: MapSnapshot| MapView {
        header: map.header(),
        landmarks: map.as_ptr(),
        count: map.len(),
        held: Box::into_raw(Box::new(MapHold(map))),
    };
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, map, view) }
}

/// Gives a map back; the view is empty then. Null and empty views are left alone.
///
/// # Safety
/// `map` is null or was filled by `cairn_map_wait`, and is zeroed or unchanged since.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_map_release(map: *mut MapView) {
    // SAFETY: the caller's promise; what is held came out of `Box::into_raw` and is taken once.
    if let Some(map) = unsafe { map.as_mut() }
        && !map.held.is_null()
    {
        // SAFETY: as above.
        drop(unsafe { Box::from_raw(map.held) });
        *map =
            MapView { header: core::ptr::null(), landmarks: core::ptr::null(), count: 0, held: core::ptr::null_mut() };
    }
}

/// The next keyframes that have not been read, waiting for them if need be. Release them with `cairn_keyframes_release`.
///
/// # Safety
/// `client` comes from `cairn_connect`; `keyframes` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_keyframes_wait(
    client: *mut Handle,
    timeout_ns: u64,
    keyframes: *mut KeyframesView,
) -> i32 {
    let item = newest(&mut handle!(client).keyframes, Duration::from_nanos(timeout_ns));
    let view = |keyframes: KeyframesSnapshot| KeyframesView {
        header: keyframes.header(),
        keyframes: keyframes.as_ptr(),
        count: keyframes.len(),
        held: Box::into_raw(Box::new(KeyframesHold(keyframes))),
    };
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, keyframes, view) }
}

/// Gives keyframes back; the view is empty then. Null and empty views are left alone.
///
/// # Safety
/// `keyframes` is null or was filled by `cairn_keyframes_wait`, and is zeroed or unchanged since.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_keyframes_release(keyframes: *mut KeyframesView) {
    // SAFETY: the caller's promise; what is held came out of `Box::into_raw` and is taken once.
    if let Some(keyframes) = unsafe { keyframes.as_mut() }
        && !keyframes.held.is_null()
    {
        // SAFETY: as above.
        drop(unsafe { Box::from_raw(keyframes.held) });
        *keyframes = KeyframesView {
            header: core::ptr::null(),
            keyframes: core::ptr::null(),
            count: 0,
            held: core::ptr::null_mut(),
        };
    }
}

/// The next picture, waiting for it if need be. From the first call until `cairn_close` or `cairn_frames_stop` the daemon makes a
/// copy of every picture for this client. Release it with `cairn_frame_release`.
///
/// # Safety
/// `client` comes from `cairn_connect`; `frame` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_frame_wait(client: *mut Handle, timeout_ns: u64, frame: *mut FrameView) -> i32 {
    let handle = handle!(client);
    let frames = handle.frames.get_or_insert_with(|| handle.client.frames());
    let item = newest(frames, Duration::from_nanos(timeout_ns));
    let view = |frame: Frame| FrameView {
        header: frame.header(),
        pixels: frame.as_ptr(),
        size: frame.len(),
        held: Box::into_raw(Box::new(FrameHold(frame))),
    };
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, frame, view) }
}

/// Gives a picture back; the view is empty then. Null and empty views are left alone.
///
/// # Safety
/// `frame` is null or was filled by `cairn_frame_wait`, and is zeroed or unchanged since.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_frame_release(frame: *mut FrameView) {
    // SAFETY: the caller's promise; what is held came out of `Box::into_raw` and is taken once.
    if let Some(frame) = unsafe { frame.as_mut() }
        && !frame.held.is_null()
    {
        // SAFETY: as above.
        drop(unsafe { Box::from_raw(frame.held) });
        *frame =
            FrameView { header: core::ptr::null(), pixels: core::ptr::null(), size: 0, held: core::ptr::null_mut() };
    }
}

/// No more pictures are wanted.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_frames_stop(client: *mut Handle) {
    // SAFETY: the caller's promise; null is looked at.
    if let Some(handle) = unsafe { client.as_mut() } {
        handle.frames = None;
    }
}

/// What was found in the next picture, waiting for it if need be. From the first call until `cairn_close` or `cairn_features_stop` the
/// daemon tells it. Release it with `cairn_features_release`.
///
/// # Safety
/// `client` comes from `cairn_connect`; `features` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_features_wait(client: *mut Handle, timeout_ns: u64, features: *mut FeaturesView) -> i32 {
    let handle = handle!(client);
    let lists = handle.features.get_or_insert_with(|| handle.client.features());
    let item = newest(lists, Duration::from_nanos(timeout_ns));
    let view = |features: Features| FeaturesView {
        header: features.header(),
        features: features.as_ptr(),
        count: features.len(),
        held: Box::into_raw(Box::new(FeaturesHold(features))),
    };
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, features, view) }
}

/// Gives features back; the view is empty then. Null and empty views are left alone.
///
/// # Safety
/// `features` is null or was filled by `cairn_features_wait`, and is zeroed or unchanged since.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_features_release(features: *mut FeaturesView) {
    // SAFETY: the caller's promise; what is held came out of `Box::into_raw` and is taken once.
    if let Some(features) = unsafe { features.as_mut() }
        && !features.held.is_null()
    {
        // SAFETY: as above.
        drop(unsafe { Box::from_raw(features.held) });
        *features = FeaturesView {
            header: core::ptr::null(),
            features: core::ptr::null(),
            count: 0,
            held: core::ptr::null_mut(),
        };
    }
}

/// No more features are wanted.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_features_stop(client: *mut Handle) {
    // SAFETY: the caller's promise; null is looked at.
    if let Some(handle) = unsafe { client.as_mut() } {
        handle.features = None;
    }
}

/// Sends a command and waits for its reply, which may be a refusal: look at `reply->code`. Zero `command` before it is filled in.
///
/// # Safety
/// `client` comes from `cairn_connect`; `command` may be read and `reply` written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_send_command(
    client: *mut Handle,
    command: *const Command,
    timeout_ns: u64,
    reply: *mut CommandReply,
) -> i32 {
    let handle = handle!(client);
    // SAFETY: null is looked at, and otherwise the caller promises that it may be read.
    let Some(command) = (unsafe { command.as_ref() }) else { return failed("there is no command: null") };
    let answer = handle.client.command(*command, Duration::from_nanos(timeout_ns)).map(Some);
    // SAFETY: the caller's promise.
    unsafe { hand_over(answer, reply, |reply| reply) }
}
