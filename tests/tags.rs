//! Tags on the walls of the simulator's room, through the daemon's own stages in lock-step and over its wire: where it says that they are, and a dock.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig, WallTag};
use cairn::client::Client;
use cairn::config::Config;
use cairn::daemon::{Calibration, Outlet, Outputs, Parts, Status, Supply, lockstep};
use cairn::frame::Clock;
use cairn::geometry::Se3;
use cairn::geometry::frames::{Body, Camera, World};
use cairn::messages::{Endpoint, Pose, Tag, Tags, map_mode};
use cairn::motion::tag::TagConfig;
use cairn::motion::tag::dock::DockConfig;
use cairn::publish::convert::from_wire;
use cairn::publish::{Limits, Publisher};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Services of one test; removes what iceoryx2 keeps in /dev/shm for good.
struct Place {
    folder: tempfile::TempDir,
    ipc_prefix: String,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::Builder::new().prefix("ctag").tempdir_in("/tmp").expect("folder");
        let ipc_prefix = format!("{}_", folder.path().file_name().expect("name").to_string_lossy().replace('.', ""));
        Self { folder, ipc_prefix }
    }

    fn endpoint(&self) -> Endpoint {
        let endpoint = Endpoint::new("robot").and_then(|e| e.with_root(self.folder.path()));
        endpoint.and_then(|e| e.with_ipc_prefix(&self.ipc_prefix)).expect("endpoint")
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.ipc_prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// What a planner has heard, and the truth.
struct Heard {
    poses: Vec<Pose>,
    tags: Tags,
    truth: Simulator,
    /// The configuration's mount.
    body_from_camera: Se3<Body, Camera>,
}

impl Heard {
    /// The robot at a frame's time.
    fn true_body(&self, timestamp_ns: i64) -> Se3<World, Body> {
        self.truth.trajectory().pose_at(timestamp_ns) * self.body_from_camera.inverse()
    }

    /// A tag with the axes of a robot that looks straight at it.
    fn true_tag(&self, id: u32) -> Se3<World, Body> {
        let tag: &WallTag = self.truth.tags().iter().find(|tag| u32::from(tag.id) == id).expect("on a wall");
        let axes = Matrix3::from_columns(&[tag.right.cross(&tag.down), -tag.right, -tag.down]);
        Se3::new(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)), tag.middle)
    }
}

fn published<F>(position: &[f64; 3], orientation: &[f64; 4]) -> Se3<F, Body> {
    from_wire(position, orientation).expect("finite").relabel()
}

/// A camera held before a wall with a tag, 12 s.
fn look(dock: DockConfig) -> Heard {
    let mut simulation = SimulatorConfig {
        scenario: Scenario::HandHeld,
        seed: 5,
        width: 480,
        height: 360,
        rate_hz: 15.0,
        duration_s: 12.0,
        ..SimulatorConfig::default()
    };
    simulation.tags.enabled = true;
    let tag = TagConfig { size_m: simulation.tags.size_m, dock, ..TagConfig::default() };
    let config = Config { tag, ..Config::default() };
    config.validate().expect("valid");
    let simulator = Simulator::new(&simulation, Pacing::LockStep).expect("simulator");
    let truth = Simulator::new(&simulation, Pacing::LockStep).expect("simulator");
    let place = Place::new();
    let limits = Limits { frame_bytes: 480 * 360, ..Limits::default() };
    let publisher = Publisher::open(&place.endpoint(), &limits).expect("publisher");
    let outlet = Outlet::new(publisher.poses, publisher.map, publisher.frames, &config.mount, Clock::Recording);
    let client = Client::with_endpoint(place.endpoint()).expect("client");
    let (mut poses, mut tags) = (client.poses(), client.tags());
    let body_from_camera = config.mount.body_from_camera();
    let parts = Parts {
        calibration: Calibration::known(simulator.camera_model().clone(), "simulator".into()),
        config,
        supply: Supply::Once(Box::new(simulator)),
        outlet: Some(outlet.with_tags(publisher.tags)),
        outputs: Outputs { trajectory: None, live_trajectory: None, odometry: None, map: None, overview: None },
        spool_folder: None,
        keep_lens: None,
        map_file: None,
        maps: None,
        status: Arc::new(Status::default()),
    };
    let (mut heard_poses, mut heard_tags) = (Vec::new(), Tags::default());
    let mut listen = |patience| {
        while let Some(pose) = poses.wait(patience).expect("poses") {
            heard_poses.push(pose);
        }
        heard_tags = tags.wait(patience).expect("tags").unwrap_or(heard_tags);
    };
    listen(Duration::from_millis(300));
    lockstep::run(parts, &AtomicBool::new(false), &mut |_| {
        listen(Duration::ZERO);
        true
    })
    .expect("starts");
    listen(Duration::from_millis(1));
    Heard { poses: heard_poses, tags: heard_tags, truth, body_from_camera }
}

fn tag(heard: &Heard, id: u32) -> Tag {
    *heard.tags.seen().iter().find(|tag| tag.id == id).unwrap_or_else(|| panic!("no tag {id}: {:?}", heard.tags.seen()))
}

#[test]
fn a_tag_on_the_wall_is_told_where_it_is() {
    let heard = look(DockConfig::default());
    let tag = tag(&heard, 1);
    assert!(tag.is_placed() && tag.size == 0.16 && tag.is_dock == 0 && tag.sightings >= 3, "{tag:?}");
    assert_eq!((heard.tags.scale, heard.tags.map_mode), (cairn::messages::SCALE_METRIC, 0));
    // In the axes of the robot, as no truth has the map's own.
    let pose = heard.poses.iter().rfind(|pose| pose.is_tracking()).expect("tracked");
    assert_eq!((pose.map_id, pose.map_revision), (heard.tags.map_id, heard.tags.map_revision));
    let map_from_body: Se3<World, Body> = published(&pose.position, &pose.orientation);
    let told: Se3<Body, Body> = map_from_body.inverse() * published::<World>(&tag.position, &tag.orientation);
    let truth: Se3<Body, Body> = heard.true_body(pose.timestamp_ns).inverse() * heard.true_tag(1);
    let (away, off) = (truth.translation.norm(), (told.translation - truth.translation).norm());
    let turned = told.rotation.angle_to(&truth.rotation);
    println!(
        "tag 1, {away:.3} m away: {off:.4} m and {:.2} degrees off; said {:.4} m, {:.2} degrees; edge {:.4} m, seen by {} keyframes",
        turned.to_degrees(),
        tag.position_sigma,
        tag.orientation_sigma.to_degrees(),
        tag.edge,
        tag.sightings
    );
    assert!(off < 0.03 * away, "{off} m of {away} m");
    assert!(turned < 0.05, "{turned} rad");
    assert!((tag.edge / tag.size - 1.0).abs() < 0.02, "{} m is to be {} m", tag.edge, tag.size);
    assert!(tag.position_sigma < 0.02 && tag.orientation_sigma < 0.05, "{tag:?}");
}

#[test]
fn with_a_dock_the_map_is_told_in_its_frame_and_odom_does_not_jump() {
    let dock = DockConfig { enabled: true, id: 1, translation_m: [1.0, 2.0, 0.5], rpy_deg: [0.0, 0.0, 90.0] };
    let heard = look(dock);
    let map_from_dock: Se3<World, Body> = dock.map_from_dock();
    let tag = tag(&heard, 1);
    assert!(tag.is_dock == 1 && heard.tags.map_mode & map_mode::DOCK_FRAME != 0, "{tag:?}");
    let off = (Vector3::from(tag.position) - map_from_dock.translation).norm();
    assert!(off < 0.03, "the dock is told {off} m from where it was said to be");

    let tracked: Vec<&Pose> = heard.poses.iter().filter(|pose| pose.is_tracking() && pose.metric().is_some()).collect();
    let last = tracked.last().expect("metric");
    let metric = tracked.iter().filter(|pose| pose.reset_counter == last.reset_counter);
    let put = metric.clone().filter(|pose| pose.map_revision == last.map_revision).count();
    assert!(put > 20, "{put} poses since the map was put there");
    for pair in metric.collect::<Vec<_>>().windows(2) {
        let step = (Vector3::from(pair[1].odom_position) - Vector3::from(pair[0].odom_position)).norm();
        let seconds = (pair[1].timestamp_ns - pair[0].timestamp_ns) as f64 * 1e-9;
        assert!(step < 1.5 * seconds, "odom jumps by {step} m at {}", pair[1].sequence);
    }
    // Where the robot truly is in the dock's frame.
    let map_from_world: Se3<World, World> = map_from_dock * heard.true_tag(1).inverse();
    let mut worst = (0.0f64, 0.0f64);
    for pose in tracked.iter().filter(|pose| pose.map_revision == last.map_revision) {
        let truth: Se3<World, Body> = map_from_world * heard.true_body(pose.timestamp_ns);
        let told: Se3<World, Body> = published(&pose.position, &pose.orientation);
        let off = (told.translation - truth.translation).norm();
        worst = (worst.0.max(off), worst.1.max(told.rotation.angle_to(&truth.rotation)));
    }
    let mut revisions: Vec<u32> = tracked.iter().map(|pose| pose.map_revision).collect();
    revisions.dedup();
    println!(
        "{put} of {} poses in the dock's frame as last put, revision {} of {revisions:?}: at most {:.3} m and {:.2} degrees off",
        heard.poses.len(),
        last.map_revision,
        worst.0,
        worst.1.to_degrees()
    );
    assert!(worst.0 < 0.08 && worst.1 < 0.05, "{} m, {} rad", worst.0, worst.1);
}
