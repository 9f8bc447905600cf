//! A base's driver in three lines. It may be started before the daemon, and survives the daemon's restarts.
//!
//! `cargo run --example wheels --no-default-features --features client`

use std::time::Duration;

use cairn::client::{Client, ClientError};

/// Stands for the robot's own: the mean speed forward, m/s, and turn to the left, rad/s, since the last time.
fn read_encoders() -> (f64, f64) {
    std::thread::sleep(Duration::from_millis(20));
    (0.3, 0.1)
}

fn main() -> Result<(), ClientError> {
    // One driver a daemon; CAIRN_PREFIX says which, `cairn` unless it is set.
    let mut wheels = Client::from_environment()?.wheels();
    loop {
        let (speed_mps, turn_radps) = read_encoders();
        // Stamped here and now. An error says what is wrong and what to do: another driver is there, another user's daemon.
        wheels.send(speed_mps, 0.0, turn_radps)?;
    }
}
