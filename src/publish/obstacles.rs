//! `PREFIX/obstacles`: what stands around the robot, made only while somebody subscribes.

use crate::frame::monotonic_ns;
use crate::messages::{OBSTACLE_POINTS, OBSTACLES_TOLD, Obstacles};
use crate::motion::obstacles::{RANGE_MAX_M, Scan};

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
    /// What is higher is not in the way, m; smaller than this radius is the robot itself, m.
    pub robot_height_m: f64,
    pub robot_radius_m: f64,
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
        let (_, scale_sigma, _) = conversion.scale.to_wire();
        let mut message = Obstacles {
            run_id: self.run_id,
            sequence: context.sequence,
            timestamp_ns: context.map.timestamp_ns,
            published_ns: now_ns,
            range_min: context.robot_radius_m as f32,
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
        if let Some(scan) = scan {
            let map_from_scan = conversion.map_from_optical() * scan.world_from_scan;
            (message.position, message.orientation) = convert::to_wire(&map_from_scan);
            message.told = OBSTACLES_TOLD;
            (message.range, message.sigma, message.free) = (scan.range_m, scan.sigma_m, scan.free_m);
            for (place, point) in message.points.iter_mut().zip(&scan.points) {
                let [x, y, z] = point.position;
                *place = [x, y, z, point.sigma];
            }
            message.count = count(scan.points.len().min(OBSTACLE_POINTS));
            message.total = count(scan.total);
        }
        self.port.send(message).map(|_| ())
    }
}
