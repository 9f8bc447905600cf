//! Two drives through one room, on two days and in two maps, which a command makes one; and two rooms, which it does not.

use std::ops::Range;
use std::path::Path;

use cairn::camera::simulator::{Scenario, SimulatorConfig};
use cairn::map::KeyframeId;
use cairn::map::saved::{Ids, SavedMaps};
use cairn::places::store;
use cairn::reconstruction::PoseEstimate;

use super::number;
use super::robot::{Robot, shown, simulator, webcam};

/// Frames that the robot stands and looks at one place.
const STANDING: u64 = 450;

/// What a daemon reads for a merge.
fn read(file: &Path, robot: &Robot) -> SavedMaps {
    let given = robot.reconstruction.given_ids();
    let saved = store::read_to_locate(file).unwrap().saved;
    let (maps, keyframes, landmarks) = (given.maps + 16, given.keyframes + 1024, given.landmarks + (1 << 17));
    saved.renumbered(Ids { maps, keyframes, landmarks }).unwrap()
}

/// A drive through a room.
#[derive(Clone)]
struct Drive {
    room: SimulatorConfig,
    frames: Range<u64>,
}

impl Drive {
    fn new(seed: u64, frames: Range<u64>) -> Self {
        Self { room: webcam(Scenario::RoomTour, seed), frames }
    }

    /// Under other lamps, a third of the furniture moved.
    fn on_another_day(mut self) -> Self {
        self.room.another_day.enabled = true;
        self.room.another_day.seed = 77 + self.room.seed;
        self
    }

    /// So many days later by the clock.
    fn driven(&self, day: i64) -> Robot {
        let mut simulator = simulator(&self.room);
        let mut robot = Robot::on_day(simulator.camera_model(), day);
        robot.drive(&mut simulator, self.frames.clone());
        robot
    }
}

/// The first third of a lap, and most of the next lap, which is some 10 cm beside it.
const OWN: Range<u64> = 0..360;
const OTHERS: Range<u64> = 960..1480;

/// What came of it.
#[derive(Debug)]
struct Merged {
    joined: u64,
    /// Frames until then.
    after: u64,
    /// Of the other drive's keyframes in the present map, which was laid on the truth by its own keyframes: largest error, m.
    worst_m: f64,
    way_m: f64,
}

/// Merges the map of one drive with that of another, whose robot stands where it came to.
fn merged(own: &Drive, others: &Drive) -> Merged {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("other.map");
    let mut other = others.driven(1);
    other.save(&file);
    let bytes = std::fs::read(&file).unwrap();
    let mut robot = own.driven(0);
    let (picture, truth) = shown(&mut simulator(&own.room), own.frames.end);
    let before: PoseEstimate = robot.see(&picture, Some(truth));
    robot.note_map();
    let keyframes: Vec<KeyframeId> = robot.reconstruction.keyframe_poses().into_iter().map(|(id, _)| id).collect();
    let saved = read(&file, &robot);
    robot.reconstruction.merge(saved).unwrap();
    let (mut after, mut last) = (0, before.clone());
    while robot.reconstruction.counters().maps_joined == 0 && after < STANDING {
        last = robot.see(&picture, Some(truth));
        after += 1;
    }
    // Adjusted together.
    (0..30).for_each(|_| last = robot.see(&picture, Some(truth)));
    assert_eq!(std::fs::read(&file).unwrap(), bytes, "it is left as it is");
    assert_eq!((last.map, last.reset_counter, last.state), (before.map, before.reset_counter, before.state));
    robot.truths.extend(other.truths);
    let (standing, _) = robot.standing(false).unwrap();
    let (metres, _) = standing.error(&last.world_from_camera.unwrap(), &truth);
    assert!(metres < 0.05 * standing.way_m, "where the robot stands: {metres} m");
    let new = robot.reconstruction.keyframe_poses().into_iter().filter(|(id, _)| !keyframes.contains(id));
    let off = new.filter_map(|(id, pose)| {
        let taken = robot.reconstruction.keyframe(id)?.timestamp_ns;
        Some(standing.error(&pose, robot.truths.get(&taken)?).0)
    });
    let worst_m = off.fold(0.0, f64::max);
    Merged { joined: robot.reconstruction.counters().maps_joined, after, worst_m, way_m: standing.way_m }
}

#[test]
fn two_drives_through_one_room_become_one_map_while_the_robot_stands() {
    let merged = merged(&Drive::new(3, OWN), &Drive::new(3, OTHERS));
    println!("{merged:?}");
    assert!(merged.joined == 1 && merged.after < STANDING && merged.worst_m < 0.05 * merged.way_m, "{merged:?}");
}

#[test]
fn two_rooms_stay_two_maps() {
    let merged = merged(&Drive::new(3, OWN), &Drive::new(4, OTHERS));
    println!("{merged:?}");
    assert_eq!(merged.joined, 0);
}

#[test]
#[ignore = "a table of results"]
fn merges() {
    for seed in super::seeds(number("TRIALS", 10)) {
        let own = Drive::new(seed, OWN);
        let next_lap = Drive::new(seed, OTHERS);
        println!("seed {seed}: next lap {:?}", merged(&own, &next_lap));
        println!("seed {seed}: another day {:?}", merged(&own, &next_lap.on_another_day()));
        println!("seed {seed}: another room {:?}", merged(&own, &Drive::new(seed + 1000, OTHERS)));
    }
}
