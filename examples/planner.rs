//! A planner in five lines. It may be started before the daemon, and survives the daemon's restarts.
//!
//! `cargo run --example planner --no-default-features --features client`

use cairn::client::{Client, ClientError, monotonic_ns};

fn main() -> Result<(), ClientError> {
    // One daemon a camera: the prefix says which.
    let mut poses = Client::connect("cairn")?.poses();
    // Sleeps until the next pose; ends only by an error, which says what is wrong and what to do.
    while let Some(pose) = poses.next().transpose()? {
        // Only a pose that was tracked, and just now, may steer a robot. Metres only where `scale` says so.
        let usable = pose.is_tracking() && pose.age_ns(monotonic_ns()) < 200_000_000;
        println!("{:?} {:?} -> {}", pose.position, pose.orientation, if usable { "drive" } else { "stop" });
    }
    Ok(())
}
