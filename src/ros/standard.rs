//! The messages of ROS 2's own packages that recordings hold: names and fields as in its interface definitions.

use super::schema::{Byte, Bytes, message};

message!(
    /// Unix time.
    Time, "builtin_interfaces/msg/Time", { sec: i32, nanosec: u32 }
);

impl Time {
    /// From ns since 1970. Times that a message cannot hold (before 1901, from 2038 on) become the nearest that it can.
    pub fn from_ns(ns: i64) -> Self {
        let nanosec = u32::try_from(ns.rem_euclid(1_000_000_000)).unwrap_or(0);
        let seconds = ns.div_euclid(1_000_000_000);
        Self { sec: i32::try_from(seconds).unwrap_or(if seconds < 0 { i32::MIN } else { i32::MAX }), nanosec }
    }
}

message!(
    /// When and in which frame.
    Header<'a>, "std_msgs/msg/Header", { stamp: Time, frame_id: &'a str }
);
message!(
    /// m.
    Point, "geometry_msgs/msg/Point", { x: f64, y: f64, z: f64 }
);
message!(
    /// m, m/s or rad/s.
    Vector3, "geometry_msgs/msg/Vector3", { x: f64, y: f64, z: f64 }
);
message!(
    /// Of unit length.
    Quaternion, "geometry_msgs/msg/Quaternion", { x: f64, y: f64, z: f64, w: f64 }
);

impl From<[f64; 3]> for Point {
    fn from([x, y, z]: [f64; 3]) -> Self {
        Self { x, y, z }
    }
}

impl From<[f64; 3]> for Vector3 {
    fn from([x, y, z]: [f64; 3]) -> Self {
        Self { x, y, z }
    }
}

impl From<[f64; 4]> for Quaternion {
    fn from([x, y, z, w]: [f64; 4]) -> Self {
        Self { x, y, z, w }
    }
}

message!(Pose, "geometry_msgs/msg/Pose", { position: Point, orientation: Quaternion });
message!(
    /// Covariance row by row, in the axes of the header's frame.
    PoseWithCovariance, "geometry_msgs/msg/PoseWithCovariance", { pose: Pose, covariance: [f64; 36] }
);
message!(
    /// In the header's frame.
    PoseWithCovarianceStamped<'a>, "geometry_msgs/msg/PoseWithCovarianceStamped",
    { header: Header<'a>, pose: PoseWithCovariance }
);
message!(
    /// In the header's frame.
    PoseStamped<'a>, "geometry_msgs/msg/PoseStamped", { header: Header<'a>, pose: Pose }
);
message!(
    /// A way, in the header's frame.
    Path<'a>, "nav_msgs/msg/Path", { header: Header<'a>, poses: Vec<PoseStamped<'a>> }
);
message!(Twist, "geometry_msgs/msg/Twist", { linear: Vector3, angular: Vector3 });
message!(TwistWithCovariance, "geometry_msgs/msg/TwistWithCovariance", { twist: Twist, covariance: [f64; 36] });
message!(
    /// Pose in the header's frame, twist in the child's.
    Odometry<'a>, "nav_msgs/msg/Odometry",
    { header: Header<'a>, child_frame_id: &'a str, pose: PoseWithCovariance, twist: TwistWithCovariance }
);
message!(
    /// In the axes of the header's frame.
    TwistWithCovarianceStamped<'a>, "geometry_msgs/msg/TwistWithCovarianceStamped",
    { header: Header<'a>, twist: TwistWithCovariance }
);
message!(Transform, "geometry_msgs/msg/Transform", { translation: Vector3, rotation: Quaternion });
message!(
    /// The child's place in the header's frame.
    TransformStamped<'a>, "geometry_msgs/msg/TransformStamped",
    { header: Header<'a>, child_frame_id: &'a str, transform: Transform }
);
message!(TfMessage<'a>, "tf2_msgs/msg/TFMessage", { transforms: Vec<TransformStamped<'a>> });
message!(
    /// A JPEG's or PNG's bytes.
    CompressedImage<'a>, "sensor_msgs/msg/CompressedImage", { header: Header<'a>, format: &'a str, data: Bytes<'a> }
);
message!(
    RegionOfInterest, "sensor_msgs/msg/RegionOfInterest",
    { x_offset: u32, y_offset: u32, height: u32, width: u32, do_rectify: bool }
);
message!(
    /// `k` all zero: not calibrated.
    CameraInfo<'a>, "sensor_msgs/msg/CameraInfo",
    {
        header: Header<'a>, height: u32, width: u32, distortion_model: &'a str, d: Vec<f64>, k: [f64; 9], r: [f64; 9],
        p: [f64; 12], binning_x: u32, binning_y: u32, roi: RegionOfInterest,
    }
);
message!(
    /// `datatype`: [`POINT_UINT32`], [`POINT_FLOAT32`].
    PointField<'a>, "sensor_msgs/msg/PointField", { name: &'a str, offset: u32, datatype: u8, count: u32 }
);
/// `PointField.UINT32`.
pub const POINT_UINT32: u8 = 6;
/// `PointField.FLOAT32`.
pub const POINT_FLOAT32: u8 = 7;
message!(
    PointCloud2<'a>, "sensor_msgs/msg/PointCloud2",
    {
        header: Header<'a>, height: u32, width: u32, fields: Vec<PointField<'a>>, is_bigendian: bool, point_step: u32,
        row_step: u32, data: Bytes<'a>, is_dense: bool,
    }
);
message!(
    /// A turn of ranges, m, from `angle_min` to the left; NaN is nothing known, +Inf would be nothing there.
    LaserScan<'a>, "sensor_msgs/msg/LaserScan",
    {
        header: Header<'a>, angle_min: f32, angle_max: f32, angle_increment: f32, time_increment: f32, scan_time: f32,
        range_min: f32, range_max: f32, ranges: Vec<f32>, intensities: Vec<f32>,
    }
);
message!(KeyValue, "diagnostic_msgs/msg/KeyValue", { key: &'static str, value: String });
message!(
    /// `level`: 0 fine, 1 a warning, 2 an error, 3 stale.
    DiagnosticStatus<'a>, "diagnostic_msgs/msg/DiagnosticStatus",
    { level: Byte, name: &'a str, message: String, hardware_id: &'a str, values: Vec<KeyValue> }
);
message!(DiagnosticArray<'a>, "diagnostic_msgs/msg/DiagnosticArray", { header: Header<'a>, status: Vec<DiagnosticStatus<'a>> });
