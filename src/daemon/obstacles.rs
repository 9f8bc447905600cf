//! A scan of what stands around the robot, from reconstruction to the wire.

use super::outlet::Outlet;
use crate::map::Around;
use crate::messages::{OBSTACLES_NO_FLOOR, OBSTACLES_NO_POSE, OBSTACLES_NOT_METRIC, OBSTACLES_TOLD};
use crate::motion::floor::ScaleConfig;
use crate::motion::obstacles::{ObstaclesConfig, Scan};
use crate::publish::{MapContext, PublishError, ScanContext};
use crate::reconstruction::{NoScan, Reconstruction};

/// Makes a scan and sends it, or says why there is none.
pub fn tell(
    outlet: &mut Outlet,
    reconstruction: &mut Reconstruction,
    config: &ObstaclesConfig,
    scale: &ScaleConfig,
    sequence: u64,
    map: MapContext,
) -> Result<(), PublishError> {
    let robot_height_m = config.height_m(scale);
    let body_from_camera = outlet.body_from_camera();
    let (map_id, map_scale) = (reconstruction.map_id(), reconstruction.scale());
    let made = reconstruction.obstacles(config, robot_height_m, &body_from_camera);
    let told = match made {
        Ok(_) => OBSTACLES_TOLD,
        Err(NoScan::NoPose) => OBSTACLES_NO_POSE,
        Err(NoScan::NotMetric) => OBSTACLES_NOT_METRIC,
        Err(NoScan::NoFloor) => OBSTACLES_NO_FLOOR,
    };
    let context = ScanContext { sequence, map_id: map_id.0, map, robot_height_m, told };
    outlet.obstacles(made.ok(), map_id, map_scale, &context)
}

/// What stands around the robot now, for a picture; nothing where that is not known.
pub fn around(
    outlet: &Outlet,
    reconstruction: &mut Reconstruction,
    config: &ObstaclesConfig,
    scale: &ScaleConfig,
) -> Around {
    let scan = reconstruction.obstacles(config, config.height_m(scale), &outlet.body_from_camera());
    scan.map_or_else(|_| Around::default(), Scan::around)
}
