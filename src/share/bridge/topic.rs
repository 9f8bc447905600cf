//! What a bridge sends: topics, types, quality of service.

use super::names::{INITIAL_POSE, Qos, Robot, Type};

/// See module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Topic {
    Odometry,
    Tf,
    TfStatic,
    Pose,
    Points,
    Scan,
    Diagnostics,
    CameraInfo,
    Image,
}

impl Topic {
    pub const ALL: [Self; 9] = [
        Self::Odometry,
        Self::Tf,
        Self::TfStatic,
        Self::Pose,
        Self::Points,
        Self::Scan,
        Self::Diagnostics,
        Self::CameraInfo,
        Self::Image,
    ];

    /// In [`Self::ALL`].
    pub fn index(self) -> usize {
        self as usize
    }

    /// Below the robot's namespace, as a rate names it, too.
    pub fn word(self) -> &'static str {
        match self {
            Self::Odometry => "odom",
            Self::Tf => "tf",
            Self::TfStatic => "tf_static",
            Self::Pose => "pose",
            Self::Points => "points",
            Self::Scan => "scan",
            Self::Diagnostics => "diagnostics",
            Self::CameraInfo => "camera_info",
            Self::Image => "image/compressed",
        }
    }

    /// Transforms and diagnostics are at the root, where ROS 2's tools look for them; `own_tf` has the transforms in the namespace, as Nav2's launch
    /// files for several robots do.
    pub fn name(self, robot: &Robot, own_tf: bool) -> String {
        match self {
            Self::Diagnostics => format!("/{}", self.word()),
            Self::Tf | Self::TfStatic if !own_tf => format!("/{}", self.word()),
            _ => robot.topic(self.word()),
        }
    }

    pub fn of(self) -> Type {
        let (name, hash) = match self {
            Self::Odometry => {
                ("nav_msgs/msg/Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0")
            }
            Self::Tf | Self::TfStatic => {
                ("tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
            }
            Self::Pose => return INITIAL_POSE,
            Self::Points => {
                ("sensor_msgs/msg/PointCloud2", "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5")
            }
            Self::Scan => {
                ("sensor_msgs/msg/LaserScan", "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828")
            }
            Self::Diagnostics => (
                "diagnostic_msgs/msg/DiagnosticArray",
                "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
            ),
            Self::CameraInfo => {
                ("sensor_msgs/msg/CameraInfo", "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275")
            }
            Self::Image => {
                ("sensor_msgs/msg/CompressedImage", "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a")
            }
        };
        Type { name, hash }
    }

    /// As Nav2's and tf2's own publishers of these have it; a map is kept for who comes late, as map servers do.
    pub fn qos(self) -> Qos {
        match self {
            Self::Odometry | Self::Pose | Self::Diagnostics => Qos::reliable(10),
            Self::Tf => Qos::reliable(100),
            Self::TfStatic | Self::Points => Qos::transient_local(1),
            Self::Scan | Self::CameraInfo | Self::Image => Qos::best_effort(5),
        }
    }

    /// What takes a link so long that poses would wait behind it.
    pub fn is_large(self) -> bool {
        matches!(self, Self::Points | Self::Image)
    }

    /// What is made only while somebody wants it: pictures and scans cost the daemon something, too.
    pub fn is_on_demand(self) -> bool {
        matches!(self, Self::Scan | Self::CameraInfo | Self::Image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_in_the_robots_namespace_or_where_ros_looks_for_them() {
        let robot = Robot::new("robot1").expect("name");
        let names = Topic::ALL.map(|topic| topic.name(&robot, false));
        assert_eq!(
            names,
            [
                "/robot1/odom",
                "/tf",
                "/tf_static",
                "/robot1/pose",
                "/robot1/points",
                "/robot1/scan",
                "/diagnostics",
                "/robot1/camera_info",
                "/robot1/image/compressed",
            ]
        );
        assert_eq!(Topic::TfStatic.name(&robot, true), "/robot1/tf_static");
        assert!(Topic::ALL.iter().enumerate().all(|(i, topic)| topic.index() == i && topic.of().hash.len() == 64));
    }
}
