//! Messages of the wire as ROS 2's own, field by field as WIRE.md has it. Pure: no frame, time or topic is chosen here.

use crate::messages::{
    self, EncodedHeader, Health, Landmark, LensModel, OBSTACLE_BEARINGS, Obstacles, Pose, State, Transform,
    WheelOdometry,
};
use crate::ros::standard::{self as ros, Header};
use crate::ros::{Byte, Bytes};

pub fn is_finite(t: &Transform) -> bool {
    t.position.iter().chain(&t.orientation).all(|v| v.is_finite())
}

/// Bytes of a landmark, on the wire and in a cloud.
const LANDMARK_BYTES: u32 = size_of::<Landmark>() as u32;

pub fn landmark_bytes(landmarks: &[Landmark]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(size_of_val(landmarks));
    for l in landmarks {
        let [x, y, z] = l.position;
        bytes.extend_from_slice(&l.id.to_le_bytes());
        bytes.extend_from_slice(&l.observations.to_le_bytes());
        [x, y, z, l.sigma].iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
    }
    bytes
}

/// `data`: what [`landmark_bytes`] makes of so many landmarks.
pub fn point_cloud<'a>(data: &'a [u8], landmarks: usize, header: Header<'a>) -> ros::PointCloud2<'a> {
    let field = |name, offset, datatype| ros::PointField { name, offset, datatype, count: 1 };
    let width = u32::try_from(landmarks).unwrap_or(u32::MAX);
    ros::PointCloud2 {
        header,
        height: 1,
        width,
        fields: vec![
            field("id", 0, ros::POINT_UINT32),
            field("observations", 4, ros::POINT_UINT32),
            field("x", 8, ros::POINT_FLOAT32),
            field("y", 12, ros::POINT_FLOAT32),
            field("z", 16, ros::POINT_FLOAT32),
            field("sigma", 20, ros::POINT_FLOAT32),
        ],
        is_bigendian: false,
        point_step: LANDMARK_BYTES,
        row_step: width.saturating_mul(LANDMARK_BYTES),
        data: Bytes(data),
        is_dense: true,
    }
}

/// Not known, as nav_msgs says it.
const UNKNOWN: f64 = -1.0;

fn unknown_covariance() -> [f64; 36] {
    let mut unknown = [0.0; 36];
    unknown[0] = UNKNOWN;
    unknown
}

/// Variance of a velocity that is not known, m²/s² and rad²/s². ROS has no sign for it: a message of zeros says that the robot stands, and of a covariance
/// that begins with -1 `robot_localization` takes 1 for the first variance and 1e-9 for the others. What is so large no filter hears; Nav2 reads no covariance of velocities.
const UNKNOWN_VELOCITY: f64 = 1e6;

fn twist(pose: &Pose) -> ros::TwistWithCovariance {
    let known = |v: [f64; 3]| if v.iter().all(|v| v.is_finite()) { Some(v) } else { None };
    let (linear, angular) = (known(pose.linear_velocity), known(pose.angular_velocity));
    let mut covariance = unknown_covariance();
    if linear.is_none() || angular.is_none() {
        (0..6).for_each(|i| covariance[7 * i] = UNKNOWN_VELOCITY);
    }
    let [linear, angular] = [linear, angular].map(|v| v.unwrap_or_default().into());
    ros::TwistWithCovariance { twist: ros::Twist { linear, angular }, covariance }
}

/// `place`: the pose's in the map or in odom, in whose axes its covariance is then.
pub fn pose_with_covariance(pose: &Pose, place: &Transform) -> ros::PoseWithCovariance {
    // The method turns into the axes of whatever the orientation leads to.
    let turned = Pose { orientation: place.orientation, ..*pose }.covariance_in_map_axes();
    let mut covariance = [0.0; 36];
    covariance.iter_mut().zip(turned.iter().flatten()).for_each(|(to, from)| *to = *from);
    if covariance.iter().any(|v| !v.is_finite()) {
        covariance = unknown_covariance();
    }
    let pose = ros::Pose { position: place.position.into(), orientation: place.orientation.into() };
    ros::PoseWithCovariance { pose, covariance }
}

pub fn odometry<'a>(
    pose: &Pose,
    odom_from_body: &Transform,
    header: Header<'a>,
    child_frame_id: &'a str,
) -> ros::Odometry<'a> {
    ros::Odometry { header, child_frame_id, pose: pose_with_covariance(pose, odom_from_body), twist: twist(pose) }
}

/// `None` before anything is known of the lens. One that is only a guess is not told as a calibration: `k` is zero then, as ROS has it.
pub fn camera_info<'a>(header: &EncodedHeader, ros_header: Header<'a>) -> Option<ros::CameraInfo<'a>> {
    let ([fx, fy], [cx, cy]) = (header.focal_px, header.centre_px);
    if ![fx, fy, cx, cy].iter().chain(&header.distortion).all(|v| v.is_finite()) {
        return None;
    }
    let is_known = header.intrinsics != messages::INTRINSICS_GUESSED;
    let (distortion_model, d) = match LensModel::from_wire(header.lens_model) {
        LensModel::RadialTangential => ("plumb_bob", header.distortion.to_vec()),
        LensModel::KannalaBrandt => ("equidistant", header.distortion[..4].to_vec()),
        LensModel::Unknown(_) => return None,
    };
    let k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
    let p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
    Some(ros::CameraInfo {
        header: ros_header,
        height: header.height,
        width: header.width,
        distortion_model,
        d: if is_known { d } else { Vec::new() },
        k: if is_known { k } else { [0.0; 9] },
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: if is_known { p } else { [0.0; 12] },
        binning_x: 0,
        binning_y: 0,
        roi: ros::RegionOfInterest { x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false },
    })
}

/// `diagnostic_msgs/DiagnosticStatus`: levels.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

pub fn diagnostics<'a>(health: &Health, prefix: &'a str) -> ros::DiagnosticStatus<'a> {
    let state = State::from_wire(health.state);
    let faults: Vec<&str> = messages::error::names(health.errors).collect();
    let modes: Vec<&str> = messages::map_mode::names(health.map_mode).collect();
    use messages::error::{BAD_CALIBRATION, LOST, NO_CAMERA, NO_FRAMES, STALLED_STAGE};
    let level = match health.errors {
        0 => OK,
        e if e & (NO_CAMERA | NO_FRAMES | BAD_CALIBRATION | STALLED_STAGE | LOST) != 0 => ERROR,
        _ => WARN,
    };
    let message =
        if faults.is_empty() { state.name().into() } else { format!("{}: {}", state.name(), faults.join(" ")) };
    let end_to_end = &health.stages[messages::stage::END_TO_END];
    let value = |key, value: String| ros::KeyValue { key, value };
    ros::DiagnosticStatus {
        level: Byte(level),
        name: "cairn: pose and map",
        message,
        hardware_id: prefix,
        values: vec![
            value("state", state.name().into()),
            value("faults", faults.join(" ")),
            value("map_mode", modes.join(" ")),
            value("frames_captured", health.frames_captured.to_string()),
            value("frames_tracked", health.frames_tracked.to_string()),
            value("frames_dropped", health.frames_dropped.to_string()),
            value("landmarks", health.landmarks.to_string()),
            value("keyframes", health.keyframes.to_string()),
            value("resets", health.resets.to_string()),
            value("latency_p95_ms", format!("{:.1}", end_to_end.p95_ms)),
        ],
    }
}

/// Unknown is NaN there as here.
pub fn laser_scan<'a>(obstacles: &Obstacles, header: Header<'a>) -> ros::LaserScan<'a> {
    ros::LaserScan {
        header,
        angle_min: obstacles.angle_min,
        angle_max: obstacles.angle(OBSTACLE_BEARINGS - 1),
        angle_increment: obstacles.angle_increment,
        time_increment: 0.0,
        scan_time: 0.0,
        range_min: obstacles.range_min,
        range_max: obstacles.range_max,
        ranges: obstacles.range.to_vec(),
        intensities: Vec::new(),
    }
}

/// `None` where a reading is not finite. A variance of zero is not known, as drivers have it; what a base on a floor does not do is zero.
pub fn wheel_twist(wheel: &WheelOdometry) -> Option<ros::TwistWithCovariance> {
    let [x, y, yaw] = [wheel.linear_x_mps, wheel.linear_y_mps, wheel.angular_z_radps];
    if ![x, y, yaw].iter().all(|v| v.is_finite()) {
        return None;
    }
    let mut covariance = [0.0; 36];
    for (i, variance) in [0, 7, 35].into_iter().zip(wheel.variance) {
        covariance[i] = if variance.is_finite() { variance } else { 0.0 };
    }
    let twist = ros::Twist { linear: [x, y, 0.0].into(), angular: [0.0, 0.0, yaw].into() };
    Some(ros::TwistWithCovariance { twist, covariance })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{INTRINSICS_CALIBRATED, INTRINSICS_GUESSED, LENS_KANNALA_BRANDT};

    #[test]
    fn a_velocity_that_is_not_known_does_not_pass_for_standing() {
        let known = Pose { linear_velocity: [0.4, 0.0, -0.1], angular_velocity: [0.0, 0.0, 0.3], ..Pose::default() };
        let told = twist(&known);
        assert_eq!((told.twist.linear.x, told.twist.angular.z), (0.4, 0.3));
        assert_eq!((told.covariance[0], told.covariance[1..].iter().sum::<f64>()), (-1.0, 0.0));
        for unknown in
            [Pose { linear_velocity: [f64::NAN; 3], ..known }, Pose { angular_velocity: [f64::NAN; 3], ..known }]
        {
            let told = twist(&unknown);
            let all = [told.twist.linear, told.twist.angular].map(|v| [v.x, v.y, v.z]).concat();
            assert!(all.iter().all(|v| v.is_finite()), "{all:?}");
            for (i, variance) in told.covariance.iter().enumerate() {
                assert_eq!(*variance, if i % 7 == 0 { UNKNOWN_VELOCITY } else { 0.0 }, "{i}");
            }
        }
    }

    #[test]
    fn a_guessed_lens_is_no_calibration() {
        let known = EncodedHeader {
            focal_px: [500.0; 2],
            centre_px: [320.0, 240.0],
            distortion: [0.1, 0.2, 0.3, 0.4, 0.0],
            intrinsics: INTRINSICS_CALIBRATED,
            lens_model: LENS_KANNALA_BRANDT,
            ..EncodedHeader::default()
        };
        let header = || Header { stamp: ros::Time::from_ns(0), frame_id: "camera" };
        let info = camera_info(&known, header()).expect("a camera");
        assert_eq!((info.distortion_model, info.d.len(), info.k[0]), ("equidistant", 4, 500.0));
        let guess = camera_info(&EncodedHeader { intrinsics: INTRINSICS_GUESSED, ..known }, header()).expect("told");
        assert_eq!((guess.d.len(), guess.k), (0, [0.0; 9]));
    }
}
