//! Where a planner has put a map, also when that is lost and found again.

use cairn::config::MountConfig;
use cairn::daemon::Outlet;
use cairn::frame::Clock;
use cairn::geometry::Se3;
use cairn::map::MapId;
use cairn::messages::Pose;
use nalgebra::{UnitQuaternion, Vector3};

use crate::support::{Place, connect, estimate, next};

#[test]
fn a_map_that_was_put_somewhere_lies_there_again_once_it_is_a_part_of_the_next_one() {
    let place = Place::new();
    let publisher = place.publisher();
    let mount = MountConfig::default();
    let mut outlet = Outlet::new(publisher.poses, publisher.map, publisher.frames, &mount, Clock::Monotonic);
    let mut poses = place.client().poses();
    connect(&mut poses);
    let mut seen = |outlet: &mut Outlet, map: u32| -> Pose {
        let frame = cairn::reconstruction::PoseEstimate { map: MapId(map), ..estimate(3) };
        outlet.pose(&frame, 0).expect("published");
        next(&mut poses)
    };
    assert_eq!(seen(&mut outlet, 0).position, [3.0, 0.0, 0.0]);
    let quarter = UnitQuaternion::from_scaled_axis(Vector3::z() * std::f64::consts::FRAC_PI_2);
    outlet.set_pose(&Se3::new(quarter, Vector3::new(10.0, -4.0, 0.0))).expect("a pose of now");
    let is_put = |pose: &Pose| {
        let [x, y, z] = pose.position;
        (Vector3::new(x, y, z) - Vector3::new(10.0, -4.0, 0.0)).norm() < 1e-9
    };
    assert!(is_put(&seen(&mut outlet, 0)));
    assert!(!is_put(&seen(&mut outlet, 1)), "nobody has said where the next map is");
    outlet.follow_join(MapId(5), MapId(1));
    assert!(!is_put(&seen(&mut outlet, 1)), "another map");
    outlet.follow_join(MapId(0), MapId(1));
    assert!(is_put(&seen(&mut outlet, 1)));
}
