//! The robot under the camera: what its configuration says of it, and what is logged of it once its motion has told the rest.

use tracing::info;

use crate::config::MountConfig;
use crate::geometry::ros_from_optical;
use crate::motion::hand_eye::Robot;

/// What a mount tells of the base: all that is said of it is taken for known. A translation alone is that of a camera that looks forward.
pub fn given(mount: &MountConfig) -> Robot {
    let said = &mount.body_from_camera;
    let lever = said.translation_m != [0.0; 3];
    let rotation = lever || said.rpy_deg.is_some() || said.quaternion_xyzw.is_some();
    let given = mount.body_from_camera();
    let mounted = Robot::mounted(given.rotation, given.translation.xy());
    let mut robot = Robot::unknown();
    if rotation {
        robot.base_from_camera = mounted.base_from_camera;
        robot.sigma[..3].copy_from_slice(&mounted.sigma[..3]);
    }
    if lever {
        robot.lever_m = mounted.lever_m;
        robot.sigma[3..5].copy_from_slice(&mounted.sigma[3..5]);
    }
    robot
}

/// The record beside that of a map that wheels made metric.
pub fn tell(robot: &Robot) {
    let (roll, pitch, yaw) = (robot.base_from_camera * ros_from_optical().inverse()).euler_angles();
    info!(
        roll_deg = roll.to_degrees(),
        pitch_deg = pitch.to_degrees(),
        yaw_deg = yaw.to_degrees(),
        lever_x_m = robot.lever_m.x,
        lever_y_m = robot.lever_m.y,
        yaw_factor = robot.yaw_factor,
        time_offset_ms = 1e3 * robot.time_offset_s,
        sigma = format!("{:.4?}", robot.sigma),
        "camera on the base, by its motion"
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::BodyFromCamera;

    #[test]
    fn what_the_mount_says_is_known_and_the_rest_is_not() {
        let of = |translation_m, rpy_deg| {
            given(&MountConfig { body_from_camera: BodyFromCamera { translation_m, rpy_deg, quaternion_xyzw: None } })
        };
        assert_eq!(of([0.0; 3], None), Robot::unknown());
        let turned = of([0.0; 3], Some([0.0, 20.0, 0.0]));
        assert!(turned.sigma[0] < 1e-3 && turned.sigma[3] > 0.5, "the lever is found");
        let all = of([0.1, 0.02, 0.3], None);
        assert!(all.sigma[2] < 1e-3 && all.sigma[4] < 1e-3 && all.lever_m.x == 0.1 && all.yaw_factor == 1.0);
    }
}
