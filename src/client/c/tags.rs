//! The part of the client for C that asks where the tags are.

use std::time::Duration;

use super::{Handle, failed, hand_over, newest};
use crate::messages::Tags;

/// The newest word on where the map's tags are, waiting for it if need be. From the first call until `cairn_close` or `cairn_tags_stop` the
/// daemon tells it with every map.
///
/// # Safety
/// `client` comes from `cairn_connect`; `tags` may be written.
#[unsafe(no_mangle)] // SAFETY: every name begins with `cairn_` and is defined once, here.
pub unsafe extern "C" fn cairn_tags_wait(client: *mut Handle, timeout_ns: u64, tags: *mut Tags) -> i32 {
    let handle = handle!(client);
    let lists = handle.tags.get_or_insert_with(|| handle.client.tags());
    let item = newest(lists, Duration::from_nanos(timeout_ns));
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, tags, |told| told) }
}

/// No more tags are wanted.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_tags_stop(client: *mut Handle) {
    // SAFETY: the caller's promise; null is looked at.
    if let Some(handle) = unsafe { client.as_mut() } {
        handle.tags = None;
    }
}
