//! Rooms of the simulator: kidnapped in one, back on another day, carried to where there is no map, and rooms that look alike.

use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::geometry::random::Random;
use cairn::map::KeyframeId;
use cairn::map::graph::{MapGraph, Tie};

use super::robot::{Outcome, RATE_HZ, Robot, Tally, dark, look_around, shown, simulator, webcam};
use super::{each, number, seeds};

/// A lap around the room's table, and a bit, s.
const LAP_S: f64 = 27.0;
/// The drive's three laps differ by some 10 cm.
const LAPS_S: f64 = 75.0;
/// Frames that a place is looked at after the dark, and on another day.
const KIDNAPPED: u64 = 60;
const ANOTHER_DAY: u64 = 90;

fn frames(seconds: f64) -> u64 {
    (seconds * RATE_HZ) as u64
}

/// Of a room that was driven around once.
struct Room {
    config: SimulatorConfig,
    simulator: Simulator,
    robot: Robot,
    random: Random,
}

impl Room {
    fn mapped(seed: u64) -> Self {
        let config = webcam(Scenario::RoomTour, seed);
        let mut simulator = simulator(&config);
        let mut robot = Robot::new(simulator.camera_model());
        robot.drive(&mut simulator, 0..frames(LAP_S));
        robot.note_map();
        Self { config, simulator, robot, random: Random::new(seed) }
    }

    /// Some frame of any lap.
    fn anywhere(&mut self) -> u64 {
        frames(self.random.uniform(1.0, LAPS_S - 5.0))
    }

    /// The lens is covered for 0.2 to 1 s, or not at all, and then sees another place.
    fn kidnap(&mut self, from: u64, is_covered: bool) -> (Outcome, u64) {
        let before = shown(&mut self.simulator, from).1;
        let place = loop {
            let frame = self.anywhere();
            let there = shown(&mut self.simulator, frame).1;
            let turned = there.rotation.angle_to(&before.rotation).to_degrees();
            if (there.translation - before.translation).norm() > 1.0 || turned > 45.0 {
                break frame;
            }
        };
        let covered = if is_covered { frames(self.random.uniform(0.2, 1.0)) } else { 0 };
        (0..covered).for_each(|_| _ = self.robot.see(&dark(), None));
        let outcome = look_around(&mut self.robot, &mut self.simulator, place..place + KIDNAPPED);
        (outcome, place)
    }
}

fn kidnapped(seed: u64, trials: usize) -> Tally {
    carried_off(seed, trials, true)
}

/// From one frame to the next, as after a camera that stood still or a clock that lies.
fn elsewhere_at_once(seed: u64, trials: usize) -> Tally {
    carried_off(seed, trials, false)
}

fn carried_off(seed: u64, trials: usize, is_covered: bool) -> Tally {
    let mut room = Room::mapped(seed);
    let (mut tally, mut from) = (Tally::default(), frames(LAP_S));
    for trial in 0..trials {
        let (outcome, place) = room.kidnap(from, is_covered);
        if outcome.is_wrong || outcome.after.is_none_or(|n| n > 15) {
            eprintln!("seed {seed}, trial {trial}, to frame {place}: {outcome:?}");
        }
        tally.trials.push(outcome);
        from = place;
    }
    tally
}

fn another_day(seed: u64, trials: usize) -> Tally {
    let mut room = Room::mapped(seed);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("room.map");
    room.robot.save(&file);
    let mut tally = Tally::default();
    for trial in 0..trials {
        let mut config = room.config.clone();
        config.another_day.enabled = true;
        config.another_day.seed = seed * 1000 + trial as u64;
        let mut later = simulator(&config);
        let mut robot = Robot::next_day(&file, later.camera_model(), &room.robot.truths);
        let place = room.anywhere();
        let outcome = look_around(&mut robot, &mut later, place..place + ANOTHER_DAY);
        if outcome.is_wrong || outcome.after.is_none() {
            eprintln!("seed {seed}, trial {trial}, at frame {place}: {outcome:?}");
        }
        tally.trials.push(outcome);
    }
    tally
}

#[test]
fn a_robot_that_was_kidnapped_knows_where_it_is() {
    let tally = kidnapped(3, 6);
    println!("{} of 6 within 15 frames, {}", tally.within(15), tally.errors());
    assert!(tally.within(15) >= 5 && tally.wrong() == 0, "{:?}", tally.trials);
}

#[test]
fn a_robot_that_is_elsewhere_from_one_frame_to_the_next_is_never_told_a_wrong_place() {
    let tally = elsewhere_at_once(3, 10);
    println!("{} of 10 within 15 frames, {}", tally.within(15), tally.errors());
    assert!(tally.within(15) >= 8 && tally.wrong() == 0, "{:?}", tally.trials);
}

#[test]
fn a_room_is_known_on_another_day() {
    let tally = another_day(3, 6);
    println!("{} of 6, {}", tally.within(ANOTHER_DAY as usize), tally.errors());
    assert!(tally.within(ANOTHER_DAY as usize) >= 4 && tally.wrong() == 0, "{:?}", tally.trials);
}

/// Ten trials a room.
fn in_rooms(trials: usize, of: impl Fn(u64, usize) -> Tally + Sync) -> Tally {
    let rooms = seeds(trials.div_ceil(10));
    let first = rooms.start;
    let each_room = each(rooms, |seed| of(seed, 10.min(trials - 10 * (seed - first) as usize)));
    Tally { trials: each_room.into_iter().flat_map(|tally| tally.trials).collect() }
}

#[test]
#[ignore = "a table of results; an hour with its hundreds of trials"]
fn table() {
    let trials = number("TRIALS", 100);
    let all = [
        ("kidnapped", in_rooms(trials, kidnapped)),
        ("elsewhere at once", in_rooms(trials, elsewhere_at_once)),
        ("another day", in_rooms(trials, another_day)),
    ];
    println!(
        "\n| trial | trials | within 15 frames | within 30 | within 60 | within 90 | wrong | largest error, median and most |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|");
    for (name, tally) in all {
        let within = [15, 30, 60, 90].map(|n| tally.within(n).to_string()).join(" | ");
        println!("| {name} | {} | {within} | {} | {} |", tally.trials.len(), tally.wrong(), tally.errors());
    }
}

/// What became of a long drive.
#[derive(Debug, Default)]
struct Drive {
    maps: usize,
    joined: u64,
    /// Loops that were closed, and those between places that are none.
    loops: u64,
    wrong_loops: usize,
    /// RMSE of the keyframes of the last map after Sim(3), share of their way.
    error: f64,
}

/// The two ends of a loop show the same place, so they are nearer than this, m; rooms are 6 m apart.
const SAME_PLACE_M: f64 = 3.0;

fn judged(robot: &mut Robot) -> Drive {
    robot.reconstruction.finish();
    let counters = robot.reconstruction.counters();
    let mut graph = MapGraph::default();
    robot.reconstruction.graph(&mut graph, KeyframeId(0), usize::MAX);
    let truth = |id: KeyframeId| {
        let taken = robot.reconstruction.keyframe(id)?.timestamp_ns;
        Some(robot.truths.get(&taken)?.translation)
    };
    let ties = graph.edges.iter().filter(|e| e.tie != Tie::Covisible);
    let apart = ties.filter_map(|e| Some((truth(e.from)? - truth(e.to)?).norm()));
    let wrong_loops = apart.filter(|metres| *metres > SAME_PLACE_M).count();
    let (standing, rmse) = robot.standing(true).expect("a map");
    Drive {
        maps: robot.reconstruction.maps(),
        joined: counters.maps_joined,
        loops: counters.loops_closed,
        wrong_loops,
        error: rmse / standing.way_m,
    }
}

/// Maps the first of three rooms, is carried in the dark to somewhere on the way back, and drives from there.
fn carried(seed: u64) -> Drive {
    let config = SimulatorConfig { speed: 2.0, ..webcam(Scenario::ThreeRooms, seed) };
    let mut simulator = simulator(&config);
    let mut robot = Robot::new(simulator.camera_model());
    let mut random = Random::new(seed);
    robot.drive(&mut simulator, 0..frames(random.uniform(9.0, 13.0)));
    (0..frames(random.uniform(0.2, 2.0))).for_each(|_| _ = robot.see(&dark(), None));
    // The last frame of the whole way that lies so far into the second or third room.
    let x = random.uniform(-1.0, 7.0);
    let end = frames(72.0);
    let at = |frame| simulator.trajectory().pose_at(simulator.timestamp_ns(frame)).translation.x;
    let back = (0..end).rev().find(|frame| at(*frame) > x).unwrap();
    robot.drive(&mut simulator, back..end);
    judged(&mut robot)
}

fn look_alike(seed: u64) -> Drive {
    let config = SimulatorConfig { speed: 2.0, ..webcam(Scenario::LookAlike, seed) };
    let mut simulator = simulator(&config);
    let mut robot = Robot::new(simulator.camera_model());
    robot.drive(&mut simulator, 0..frames(72.0));
    judged(&mut robot)
}

#[test]
fn carried_into_an_unmapped_room_and_back_it_has_one_map() {
    let drive = carried(3);
    println!("{drive:?}");
    assert!(drive.maps == 1 && drive.joined >= 1 && drive.wrong_loops == 0 && drive.error < 0.02, "{drive:?}");
}

#[test]
#[ignore = "a table of results"]
fn drives() {
    let trials = number("TRIALS", 100);
    println!(
        "\n| drive | runs | one map at the end | joins | loops closed | runs with one | wrong loops or joins | RMSE of keyframes, % of the way: median, most |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|");
    for (name, of) in [
        ("rooms that look alike", look_alike as fn(u64) -> Drive),
        ("carried into an unmapped room", carried as fn(u64) -> Drive),
    ] {
        let mut errors = Vec::new();
        let (mut one, mut joins, mut loops, mut with, mut wrong) = (0, 0, 0, 0, 0);
        let driven = each(seeds(trials), |seed| {
            let drive = of(seed);
            eprintln!("seed {seed}: {drive:?}");
            drive
        });
        for drive in driven {
            one += usize::from(drive.maps == 1);
            joins += drive.joined;
            loops += drive.loops;
            with += usize::from(drive.loops > 0);
            wrong += drive.wrong_loops;
            errors.push(100.0 * drive.error);
        }
        errors.sort_by(f64::total_cmp);
        let (median, most) = (errors[errors.len() / 2], errors[errors.len() - 1]);
        println!("| {name} | {trials} | {one} | {joins} | {loops} | {with} | {wrong} | {median:.2}, {most:.2} |");
    }
}
