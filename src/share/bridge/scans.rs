//! Where a scan is on the robot: by the pose of its own frame.
//!
//! A scan comes some time after the pose of its frame, and by then the map may have been corrected: its place is one in the corrected map, while that
//! frame's transforms are those of the map before. So it is told on the body, of which the correction knows nothing, and only where pose and scan are of
//! one map. The next scan is there 0.15 s later.

use std::collections::VecDeque;

use crate::messages::{Obstacles, Pose, Transform};
use crate::ros::standard::Time;
use crate::share::frames::{Place, scan_place};

/// Poses that are remembered: a second of a fast camera.
const POSES: usize = 64;

/// In which coordinates a place is, and of which frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Which {
    run_id: u64,
    sequence: u64,
    map_id: u32,
    reset_counter: u32,
    map_revision: u32,
}

/// The last poses.
#[derive(Debug, Default)]
pub struct LastPoses {
    poses: VecDeque<(Which, Transform, Time)>,
}

impl LastPoses {
    /// `stamp`: with which its transforms were sent.
    pub fn add(&mut self, pose: &Pose, place: &Place, stamp: &Time) {
        let Pose { run_id, sequence, map_id, reset_counter, map_revision, .. } = *pose;
        if self.poses.len() == POSES {
            self.poses.pop_front();
        }
        let which = Which { run_id, sequence, map_id, reset_counter, map_revision };
        self.poses.push_back((which, place.map_from_body, stamp.clone()));
    }

    /// `body_from_scan`, and the stamp of the scan's frame; `None` without a place, or without a pose of the same frame and map.
    pub fn body_from_scan(&self, obstacles: &Obstacles) -> Option<(Transform, Time)> {
        let map_from_scan = scan_place(obstacles)?;
        let Obstacles { run_id, sequence, map_id, reset_counter, map_revision, .. } = *obstacles;
        let wanted = Which { run_id, sequence, map_id, reset_counter, map_revision };
        let (_, map_from_body, stamp) = self.poses.iter().rev().find(|(which, ..)| *which == wanted)?;
        Some((map_from_body.inverse() * map_from_scan, stamp.clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{OBSTACLES_NO_FLOOR, OBSTACLES_TOLD};

    fn place(x: f64, yaw: f64) -> Transform {
        Transform { position: [x, 0.0, 0.0], orientation: [0.0, 0.0, (yaw / 2.0).sin(), (yaw / 2.0).cos()] }
    }

    #[test]
    fn a_scan_is_placed_by_the_pose_of_its_own_frame_in_its_own_map() {
        let mut last = LastPoses::default();
        for sequence in 0..200 {
            let map_revision = u32::from(sequence >= 190);
            let pose = Pose { run_id: 3, sequence, map_revision, ..Pose::default() };
            // With the correction the robot is 10 m off.
            let at = place(sequence as f64 + 10.0 * f64::from(map_revision), std::f64::consts::FRAC_PI_2);
            let stamp = Time::from_ns(sequence as i64);
            last.add(&pose, &Place { map_from_body: at, odom_from_body: at }, &stamp);
        }
        assert_eq!(last.poses.len(), POSES);
        let told = |sequence: u64, map_revision, x: f64| {
            let Transform { position, orientation } = place(x, 0.0);
            Obstacles {
                run_id: 3,
                sequence,
                map_revision,
                told: OBSTACLES_TOLD,
                position,
                orientation,
                ..Default::default()
            }
        };
        // A metre before the body's place in the map, which is at its right: the body looks to the left.
        let (body_from_scan, stamp) = last.body_from_scan(&told(189, 0, 190.0)).expect("placed");
        let expected = [0.0, -1.0, 0.0];
        assert!(body_from_scan.position.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{body_from_scan:?}");
        assert_eq!(stamp, Time::from_ns(189));
        // The same scan after a correction that the pose of its frame did not know: nowhere, rather than 10 m off.
        assert!(last.body_from_scan(&told(189, 1, 200.0)).is_none());
        assert!(last.body_from_scan(&told(190, 1, 201.0)).is_some());
        for other in [
            Obstacles { run_id: 4, ..told(195, 1, 205.0) },
            Obstacles { reset_counter: 1, ..told(195, 1, 205.0) },
            Obstacles { told: OBSTACLES_NO_FLOOR, ..told(195, 1, 205.0) },
            told(20, 0, 21.0),
        ] {
            assert!(last.body_from_scan(&other).is_none());
        }
    }
}
