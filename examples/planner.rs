//! A planner in five lines. It may be started before the daemon, and survives the daemon's restarts.
//!
//! `cargo run --example planner --no-default-features --features client`

use std::time::Duration;

use cairn::client::{Client, ClientError};

fn main() -> Result<(), ClientError> {
    // One daemon a camera: CAIRN_PREFIX says which, `cairn` unless it is set.
    let mut poses = Client::from_environment()?.poses();
    // Sleeps until the next pose; ends only by an error, which says what is wrong and what to do.
    while let Some(pose) = poses.next().transpose()? {
        // Only a pose that was tracked, and just now, may steer a robot. Metres only where `scale` says so.
        let usable = pose.is_usable(Duration::from_millis(200));
        println!("{:?} {:?} -> {}", pose.position, pose.orientation, if usable { "drive" } else { "stop" });
    }
    Ok(())
}
