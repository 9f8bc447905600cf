//! Two drives through one room, on two days and in two maps, which a command makes one; and two rooms, which it does not.

use std::path::Path;

use cairn::camera::simulator::Scenario;
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

/// A drive along some frames of a room's tour, so many days later.
fn driven(seed: u64, frames: std::ops::Range<u64>, day: i64) -> Robot {
    let config = webcam(Scenario::RoomTour, seed);
    let mut simulator = simulator(&config);
    let mut robot = Robot::on_day(simulator.camera_model(), day);
    robot.drive(&mut simulator, frames);
    robot
}

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
fn merged(seeds: [u64; 2], frames: [std::ops::Range<u64>; 2]) -> Merged {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("other.map");
    let [own, others] = frames;
    let mut other = driven(seeds[1], others, 1);
    other.save(&file);
    let bytes = std::fs::read(&file).unwrap();
    let mut robot = driven(seeds[0], own.clone(), 0);
    let mut room = simulator(&webcam(Scenario::RoomTour, seeds[0]));
    let (picture, truth) = shown(&mut room, own.end);
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
    let merged = merged([3, 3], [0..360, 180..700]);
    println!("{merged:?}");
    assert!(merged.joined == 1 && merged.after < STANDING && merged.worst_m < 0.05 * merged.way_m, "{merged:?}");
}

#[test]
fn two_rooms_stay_two_maps() {
    let merged = merged([3, 4], [0..360, 0..400]);
    println!("{merged:?}");
    assert_eq!(merged.joined, 0);
}

#[test]
#[ignore = "a table of results"]
fn merges() {
    for seed in super::seeds(number("TRIALS", 10)) {
        println!("seed {seed}: one room {:?}", merged([seed, seed], [0..360, 180..700]));
        println!("seed {seed}: two rooms {:?}", merged([seed, seed + 1000], [0..360, 180..700]));
    }
}
