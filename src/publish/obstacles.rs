//! `PREFIX/obstacles`: what stands around the robot, made only while somebody subscribes.

use crate::frame::monotonic_ns;
use crate::messages::{OBSTACLE_POINTS, OBSTACLES_TOLD, Obstacles};
use crate::motion::obstacles::{RANGE_MAX_M, RANGE_MIN_M, Scan};

use super::ports::Port;
use super::{Conversion, MapContext, PublishError, convert, count};

/// Pause between two scans, ns: a planner of a small robot asks no oftener.
const PAUSE_NS: i64 = 150_000_000;

/// See module.
#[derive(Debug)]
pub struct ObstaclesPublisher {
    pub(super) port: Port<Obstacles, ()>,
    pub(super) run_id: u64,
    sent_ns: Option<i64>,
}

/// What a scan says of itself besides the scan.
#[derive(Debug, Clone, Copy)]
pub struct ScanContext {
    pub sequence: u64,
    pub map_id: u32,
    pub map: MapContext,
    /// What is higher is not in the way, m.
    pub robot_height_m: f64,
    /// Why there is none: one of [`Obstacles::told`].
    pub told: u8,
}

impl ObstaclesPublisher {
    pub(super) fn new(port: Port<Obstacles, ()>, run_id: u64) -> Self {
        Self { port, run_id, sent_ns: None }
    }

    /// Somebody wants scans.
    pub fn is_wanted(&self) -> bool {
        self.port.subscribers() > 0
    }

    /// The last one was long enough ago.
    pub fn is_due(&self) -> bool {
        self.is_wanted() && self.sent_ns.is_none_or(|sent| monotonic_ns().saturating_sub(sent) >= PAUSE_NS)
    }

    /// Sends a scan, or that there is none.
    pub fn publish(
        &mut self,
        scan: Option<&Scan>,
        conversion: &Conversion,
        context: &ScanContext,
    ) -> Result<(), PublishError> {
        let now_ns = monotonic_ns();
        self.sent_ns = Some(now_ns);
        let message = Obstacles { run_id: self.run_id, published_ns: now_ns, ..message(scan, conversion, context) };
        self.port.send(message).map(|_| ())
    }
}

/// Without what only the sender knows (run, time of sending).
fn message(scan: Option<&Scan>, conversion: &Conversion, context: &ScanContext) -> Obstacles {
    let (_, scale_sigma, _) = conversion.scale.to_wire();
    let mut message = Obstacles {
        sequence: context.sequence,
        timestamp_ns: context.map.timestamp_ns,
        range_min: RANGE_MIN_M as f32,
        range_max: RANGE_MAX_M as f32,
        robot_height: context.robot_height_m as f32,
        scale_sigma,
        map_id: context.map_id,
        reset_counter: context.map.reset_counter,
        map_revision: context.map.map_revision,
        told: context.told,
        clock: convert::clock(conversion.clock),
        ..Obstacles::default()
    };
    let Some(scan) = scan else { return message };
    let map_from_scan = conversion.map_from_optical() * scan.world_from_scan;
    (message.position, message.orientation) = convert::to_wire(&map_from_scan);
    message.told = OBSTACLES_TOLD;
    (message.range, message.sigma) = (scan.range_m, scan.sigma_m);
    (message.free_from, message.free) = (scan.free_from_m, scan.free_m);
    for (place, point) in message.points.iter_mut().zip(&scan.points) {
        let [x, y, z] = point.position;
        *place = [x, y, z, point.sigma];
    }
    message.count = count(scan.points.len().min(OBSTACLE_POINTS));
    message.total = count(scan.total);
    message
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::geometry::Se3;
    use crate::messages::{OBSTACLE_BEARINGS, OBSTACLES_NO_FLOOR};
    use crate::motion::obstacles::{BEARINGS, InTheWay, MOST_POINTS, bearing_rad};

    const CONTEXT: ScanContext = ScanContext {
        sequence: 7,
        map_id: 2,
        map: MapContext { timestamp_ns: 9, reset_counter: 1, map_revision: 3, map_mode: 0 },
        robot_height_m: 0.4,
        told: OBSTACLES_NO_FLOOR,
    };

    #[test]
    fn without_a_scan_nothing_is_far_and_nothing_free() {
        let none = message(None, &Conversion::default(), &CONTEXT);
        assert_eq!((none.told_name(), none.is_told(), none.sequence, none.count), ("NO_FLOOR", false, 7, 0));
        assert!(none.range.iter().all(|v| v.is_nan()) && none.free.iter().all(|v| *v == 0.0));
        assert!(none.position.iter().all(|v| v.is_nan()));
    }

    #[test]
    fn a_scan_of_the_world_is_one_of_the_map_as_published() {
        assert_eq!((BEARINGS, MOST_POINTS), (OBSTACLE_BEARINGS, OBSTACLE_POINTS));
        // Forward is the world's z, left its -x, up its -y.
        let axes = Matrix3::from_columns(&[Vector3::z(), -Vector3::x(), -Vector3::y()]);
        let mut scan =
            Scan { world_from_scan: Se3::from_matrix(&axes, Vector3::new(1.0, 0.5, 3.0)), total: 9, ..Scan::default() };
        (scan.range_m[90], scan.sigma_m[90], scan.free_m[90]) = (2.0, 0.02, 1.8);
        scan.points.push(InTheWay { position: [2.0, 0.0, 0.3], sigma: 0.02 });
        let told = message(Some(&scan), &Conversion::default(), &CONTEXT);
        assert!(told.is_told() && told.position.iter().zip([3.0, -1.0, -0.5]).all(|(a, b)| (a - b).abs() < 1e-9));
        assert!((told.orientation[3] - 1.0).abs() < 1e-9, "{:?}", told.orientation);
        assert_eq!((told.range[90], told.free[90], told.count, told.total), (2.0, 1.8, 1, 9));
        assert_eq!(told.in_the_way(), [[2.0, 0.0, 0.3, 0.02]]);
        assert!(told.range[0].is_nan() && told.points[1][0].is_nan());
        for bearing in [0, 90, 179] {
            assert!((f64::from(told.angle(bearing)) - bearing_rad(bearing)).abs() < 1e-5);
        }
    }
}
