//! The part of the client for C that asks what stands around the robot.

use std::time::Duration;

use super::{Handle, failed, hand_over, newest};
use crate::messages::Obstacles;

/// The newest scan of what stands around the robot and where the floor is seen free, waiting for it if need be. From the first call until
/// `cairn_close` or `cairn_obstacles_stop` the daemon makes scans, about six a second.
///
/// # Safety
/// `client` comes from `cairn_connect`; `obstacles` may be written.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_obstacles_wait(client: *mut Handle, timeout_ns: u64, obstacles: *mut Obstacles) -> i32 {
    let handle = handle!(client);
    let scans = handle.obstacles.get_or_insert_with(|| handle.client.obstacles());
    let item = newest(scans, Duration::from_nanos(timeout_ns));
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, obstacles, |scan| scan) }
}

/// No more scans are wanted.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_obstacles_stop(client: *mut Handle) {
    // SAFETY: the caller's promise; null is looked at.
    if let Some(handle) = unsafe { client.as_mut() } {
        handle.obstacles = None;
    }
}
