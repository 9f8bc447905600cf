//! The part of the client for C that a base's driver uses.

use super::{ClientError, Handle, MESSAGE, NOTHING, failed};
use crate::messages::WheelOdometry;

/// What became of a message of the driver.
fn sent(outcome: Result<bool, ClientError>) -> i32 {
    match outcome {
        Ok(true) => MESSAGE,
        Ok(false) => NOTHING,
        Err(error) => failed(&error.to_string()),
    }
}

/// For the driver of the robot's base: its mean twist since the last call, up to now (REP-103: forward, to the left, turn to the left). To be
/// called 20 to 100 times a second. `CAIRN_MESSAGE` if a daemon is there, `CAIRN_NOTHING` if not, `CAIRN_ERROR` where waiting does not
/// help: another driver tells of the wheels already. Never waits.
///
/// # Safety
/// `client` comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_wheel_send(
    client: *mut Handle,
    linear_x_mps: f64,
    linear_y_mps: f64,
    angular_z_radps: f64,
) -> i32 {
    let handle = handle!(client);
    let wheels = handle.wheels.get_or_insert_with(|| handle.client.wheels());
    sent(wheels.send(linear_x_mps, linear_y_mps, angular_z_radps))
}

/// The same with stamps and variances of the driver's own; `sequence` is filled in here. Fill in every field: what the driver does not know is
/// `CAIRN_UNKNOWN_NS` or NaN.
///
/// # Safety
/// `client` comes from `cairn_connect`; `message` may be read.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_wheel_publish(client: *mut Handle, message: *const WheelOdometry) -> i32 {
    let handle = handle!(client);
    // SAFETY: null is looked at, and otherwise the caller promises that it may be read.
    let Some(message) = (unsafe { message.as_ref() }) else { return failed("there is no message: null") };
    let wheels = handle.wheels.get_or_insert_with(|| handle.client.wheels());
    sent(wheels.publish(message))
}

/// The driver tells no more; another one may.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_wheel_stop(client: *mut Handle) {
    // SAFETY: the caller's promise; null is looked at.
    if let Some(handle) = unsafe { client.as_mut() } {
        handle.wheels = None;
    }
}
