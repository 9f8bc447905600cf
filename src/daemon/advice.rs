//! What to do about a fault: one line for each name of [`error::names`](crate::messages::error::names), in the log and in `cairn doctor`.

/// What somebody at the robot can do about a fault of this name.
pub fn advice(fault: &str) -> &'static str {
    match fault {
        "NO_CAMERA" => "plug the camera in; `cairn doctor` says what keeps it closed. It is found again by itself",
        "NO_FRAMES" => "the camera is open and silent: plug it in anew, into another port or without a hub",
        "NO_FEATURES" => "the picture is empty: uncover the lens, give it light, focus it",
        "LOW_FEATURES" => {
            "too little to see: more light, a wider lens, or away from the bare wall; tracking may be lost soon"
        }
        "DROPPED_FRAMES" => {
            "the machine is too slow (lower camera.rate_hz or the size, stop what else runs), or the driver loses frames (cable, port)"
        }
        "CORRUPT_FRAMES" => "a bad cable or a full USB bus: another cable, another port, or a smaller picture",
        "BAD_CALIBRATION" => "calibrate this camera at this size: `cairn calibrate --camera auto`",
        "BAD_TIMESTAMP" => "the driver's clock jumps: another camera or kernel, if it does not stay rare",
        "STALLED_STAGE" => "a stage hangs, the record that follows names it; the watchdog starts the daemon anew",
        "MAPPING_LATE" => "the map is adjusted too late: lower reconstruction.adjusted_keyframes",
        "LOST" => {
            "go back to where the camera has been, or move on: a new map begins, and is joined to this one when it is seen again"
        }
        "SAVE_FAILED" => "look at free space and permissions of the file that the record before names",
        "LOW_RATE" => {
            "the camera gives fewer frames than it granted: more light, camera.dynamic_rate = false, a fixed exposure"
        }
        "SCALE_ASSUMED" => {
            "a turn on the spot left all known distances behind: see a place from before it again, turn in an arc, or use a wider lens"
        }
        "WHEELS_SILENT" => {
            "the base's driver has stopped telling of its wheels: is it running? It is heard again by itself"
        }
        "WHEELS_WRONG" => {
            "the records before name what is wrong: stamps must be CLOCK_MONOTONIC, speeds m/s and rad/s, from one driver alone"
        }
        "WHEELS_LATE" => "have the driver send at once and 20 to 100 times a second; a busy machine loses its messages",
        "PUBLISH_FAILED" => "the record before says why; if /dev/shm is full, `cairn doctor` shows by what",
        "UNCALIBRATED" => "the lens is a guess: `cairn calibrate --camera auto`, or turn and move the camera",
        _ => "a fault of a newer version: `cairn doctor` of that version knows it",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::error;

    #[test]
    fn every_fault_has_its_own_advice() {
        let names: Vec<_> = error::names((1 << 19) - 1).collect();
        assert!(names.len() >= 19 && !names.contains(&"UNKNOWN"), "{names:?}");
        for name in &names {
            assert_ne!(advice(name), advice("UNKNOWN"), "{name}");
        }
    }
}
