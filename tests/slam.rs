//! The whole chain of steps, without threads, on the simulator: what comes out is the simulator's truth.

use std::collections::BTreeMap;

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::geometry::Se3;
use cairn::geometry::alignment::align;
use cairn::geometry::frames::{Camera, World};
use cairn::image::GreyImage;
use cairn::reconstruction::{
    Counters, InlineWorker, PoseEstimate, Reconstruction, ReconstructionConfig, TrackingState,
};
use cairn::trajectory::{TrajectorySpool, read_tum};

struct Run {
    estimates: Vec<PoseEstimate>,
    /// Every frame that has a pose, by time, as the map knows it at the end.
    trajectory: BTreeMap<i64, Se3<World, Camera>>,
    truth: Vec<(i64, Se3<World, Camera>)>,
    counters: Counters,
    readout_s: f64,
    /// Keyframes in all maps, at the most.
    most_keyframes: usize,
}

/// Lock-step over `frames` pictures; `edit` may spoil each one.
fn run(config: &SimulatorConfig, frames: u64, edit: impl FnMut(u64, &mut GreyImage)) -> Run {
    run_in_order(config, 0..frames, edit)
}

/// The same with the simulator's pictures in any order, at its rate.
fn run_in_order(
    config: &SimulatorConfig,
    order: impl IntoIterator<Item = u64>,
    edit: impl FnMut(u64, &mut GreyImage),
) -> Run {
    run_configured(config, &ReconstructionConfig::default(), order, edit)
}

fn run_configured(
    config: &SimulatorConfig,
    reconstruction: &ReconstructionConfig,
    order: impl IntoIterator<Item = u64>,
    mut edit: impl FnMut(u64, &mut GreyImage),
) -> Run {
    let mut simulator = Simulator::new(config, Pacing::LockStep).unwrap();
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(reconstruction, &camera, worker, true);
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let (mut estimates, mut events, mut truth) = (Vec::new(), Vec::new(), Vec::new());
    let mut most_keyframes = 0;
    for (sequence, shown) in (0..).zip(order) {
        simulator.render(shown, &mut picture);
        edit(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        truth.push((features.timestamp_ns, simulator.trajectory().pose_at(simulator.timestamp_ns(shown))));
        estimates.push(reconstruction.track(&features));
        reconstruction.map(&features, &mut feedback);
        most_keyframes = most_keyframes.max(reconstruction.total_keyframes());
        stage.feedback(&feedback);
        reconstruction.take_trajectory_events(&mut events);
    }
    reconstruction.finish();
    reconstruction.take_trajectory_events(&mut events);
    let folder = tempfile::tempdir().unwrap();
    let mut spool = TrajectorySpool::create(folder.path()).unwrap();
    events.iter().for_each(|event| spool.record(event).unwrap());
    let path = folder.path().join("trajectory.txt");
    let written = spool.write_tum(&path, &reconstruction.keyframe_poses()).unwrap();
    let poses = if written.poses_written > 0 { read_tum(&path).unwrap() } else { Vec::new() };
    let trajectory = poses.iter().map(|p| (p.timestamp_ns, p.world_from_camera)).collect();
    let (counters, readout_s) = (reconstruction.counters(), reconstruction.readout_s());
    Run { estimates, trajectory, truth, counters, readout_s, most_keyframes }
}

/// Coverage (0..=1), and error after Sim(3), RMSE, as a share of the path.
fn judge(run: &Run) -> (f64, f64) {
    let (mut from, mut to) = (Vec::new(), Vec::new());
    for (t, truth) in &run.truth {
        if let Some(pose) = run.trajectory.get(t) {
            from.push(pose.translation);
            to.push(truth.translation);
        }
    }
    let path: f64 = run.truth.windows(2).map(|w| (w[1].1.translation - w[0].1.translation).norm()).sum();
    let coverage = from.len() as f64 / run.truth.len() as f64;
    match align::<World, World>(&from, &to, true) {
        Ok(alignment) => (coverage, alignment.rmse / path),
        Err(_) => (coverage, f64::INFINITY),
    }
}

fn webcam(scenario: Scenario) -> SimulatorConfig {
    SimulatorConfig { seed: 3, ..SimulatorConfig::everything(scenario) }
}

#[test]
fn a_robots_tour_is_tracked_within_two_percent_of_its_path() {
    let run = run(&webcam(Scenario::RoomTour), 300, |_, _| {});
    let (coverage, error) = judge(&run);
    assert!(coverage > 0.95, "coverage {coverage}");
    assert!(error < 0.02, "error {error} of the path");
}

#[test]
fn every_published_pose_rests_on_enough_landmarks_and_no_other_frame_has_one() {
    let run = run(&webcam(Scenario::HandHeld), 150, |_, _| {});
    let mut tracked = 0;
    for e in &run.estimates {
        assert_eq!(e.world_from_camera.is_some(), e.state == TrackingState::Tracking);
        assert_eq!(e.odom_from_camera.is_some(), e.state == TrackingState::Tracking);
        match e.state {
            TrackingState::Tracking => {
                tracked += 1;
                assert!(e.landmarks >= 15 && e.landmarks <= e.landmarks_sought);
                assert!(e.covariance.iter().all(|v| v.is_finite()) && e.covariance.cholesky().is_some());
            }
            _ => assert!(e.covariance.iter().all(|v| v.is_nan()) && e.landmarks == 0 && e.quality == 0.0),
        }
        assert_eq!(e.orientation.is_some(), e.state == TrackingState::Orientation);
        if e.state == TrackingState::Orientation {
            assert_eq!(tracked, 0, "only before the first map");
        }
    }
    assert!(tracked > 100, "{tracked} tracked");
}

#[test]
fn two_runs_give_the_same_bits() {
    let bits = |run: &Run| -> Vec<u64> {
        let published = run.estimates.iter().filter_map(|e| e.world_from_camera.as_ref());
        let poses = published.chain(run.trajectory.values()).flat_map(|p| {
            p.translation.iter().chain(p.rotation.coords.iter()).map(|v| v.to_bits()).collect::<Vec<_>>()
        });
        poses.collect()
    };
    let config = webcam(Scenario::HandHeld);
    let (a, b) = (run(&config, 100, |_, _| {}), run(&config, 100, |_, _| {}));
    assert!(a.trajectory.len() > 50);
    assert_eq!(bits(&a), bits(&b));
}

#[test]
fn turning_on_the_spot_and_standing_still_start_no_map() {
    for scenario in [Scenario::PureRotation, Scenario::Standing] {
        let run = run(&webcam(scenario), 120, |_, _| {});
        assert!(run.estimates.iter().all(|e| e.world_from_camera.is_none()), "{scenario:?}: a false start");
        assert!(run.trajectory.is_empty(), "{scenario:?}: an orientation is no pose");
    }
}

/// Error of an orientation since the first frame of its reset counter, rad, and its square in standard deviations; `None` without one.
fn orientation_error(run: &Run, i: usize) -> Option<(f64, f64)> {
    let told = run.estimates[i].orientation?;
    let since = |e: &PoseEstimate| e.orientation.is_some() && e.reset_counter == run.estimates[i].reset_counter;
    let first = run.estimates.iter().position(since)?;
    let truth = run.truth[first].1.rotation.inverse() * run.truth[i].1.rotation;
    let e = (told.first_from_camera.inverse() * truth).scaled_axis();
    let squared = told.covariance.try_inverse().map_or(f64::INFINITY, |inverse| e.dot(&(inverse * e)));
    Some((e.norm(), squared))
}

#[test]
fn turning_on_the_spot_tells_the_orientation_as_well_as_it_says() {
    let (mut outside_all, mut told_all) = (0, 0);
    for seed in 3..6 {
        let mut config = SimulatorConfig { seed, ..SimulatorConfig::everything(Scenario::PureRotation) };
        // Somebody who walks by and fills half of the picture may be taken for the world.
        config.occluder.enabled = false;
        let run = run(&config, 240, |_, _| {});
        let errors: Vec<(f64, f64)> = (0..240).filter_map(|i| orientation_error(&run, i)).collect();
        let largest = errors.iter().map(|e| e.0).fold(0.0, f64::max);
        // 95 % of chi-square with three degrees of freedom.
        let outside = errors.iter().filter(|e| e.1 > 7.81).count();
        let restarts = run.estimates[239].reset_counter;
        println!(
            "seed {seed}: {} told, {restarts} restarts, largest error {largest} rad, {outside} outside",
            errors.len()
        );
        assert!(errors.len() >= 230 && restarts == 0, "seed {seed}: {} of 240 told, {restarts} restarts", errors.len());
        assert!(largest < 0.05, "seed {seed}: {largest} rad");
        (outside_all, told_all) = (outside_all + outside, told_all + errors.len());
    }
    // What is wrong of a lens is so in all frames of a run, so only runs together tell.
    assert!(outside_all * 10 <= told_all, "{outside_all} of {told_all} outside");
}

#[test]
fn a_map_goes_on_with_the_orientation_before_it() {
    let run = run(&webcam(Scenario::HandHeld), 150, |_, _| {});
    let start = run.estimates.iter().position(|e| e.state == TrackingState::Tracking).expect("a start");
    assert!(start > 1 && run.estimates[start - 1].orientation.is_some());
    assert_eq!(run.estimates[start].reset_counter, run.estimates[start - 1].reset_counter);
    for i in [start, 149] {
        let truth = run.truth[0].1.rotation.inverse() * run.truth[i].1.rotation;
        let smooth = run.estimates[i].odom_from_camera.expect("tracked").rotation;
        assert!(smooth.angle_to(&truth) < 0.03, "frame {i}: {} rad", smooth.angle_to(&truth));
    }
}

#[test]
fn darkness_before_the_start_tells_no_orientation_and_what_follows_is_unrelated() {
    let run = run(&webcam(Scenario::PureRotation), 60, |sequence, picture| {
        if (20..30).contains(&sequence) {
            picture.data.fill(3);
        }
    });
    let dark = &run.estimates[20..30];
    assert!(dark.iter().all(|e| e.state == TrackingState::Initializing && e.orientation.is_none()));
    assert_eq!((run.estimates[19].reset_counter, run.estimates[59].reset_counter), (0, 1));
    assert_eq!(run.estimates[59].state, TrackingState::Orientation);
    assert_eq!(run.counters.resets, 0, "no map was dropped");
}

#[test]
fn a_covered_lens_is_told_as_lost_and_found_again_in_the_same_map() {
    let dark = 120..140;
    let run = run(&webcam(Scenario::HandHeld), 200, |sequence, picture| {
        if dark.contains(&sequence) {
            picture.data.fill(3);
        }
    });
    let states: Vec<TrackingState> = run.estimates.iter().map(|e| e.state).collect();
    assert_eq!(states[119], TrackingState::Tracking);
    assert!(states[120..140].iter().all(|s| *s == TrackingState::Lost), "{:?}", &states[115..145]);
    let back = states[140..].iter().position(|s| *s == TrackingState::Tracking);
    assert!(back.is_some_and(|frames| frames < 30), "found again after {back:?} frames");
    assert_eq!((run.counters.resets, run.estimates[199].reset_counter), (0, 0));
    let (_, error) = judge(&run);
    assert!(error < 0.02, "error {error} of the path");
}

/// Every keyframe shares landmarks with every other one there, so none is far.
#[test]
fn a_map_at_its_limits_in_one_room_tracks_on_and_is_found_again() {
    let config = ReconstructionConfig {
        max_keyframes: 30,
        detailed_keyframes: 20,
        // None is redundant: whatever goes, goes for the limit.
        redundant_share: 1.0,
        keyframe_parallax_deg: 1.0,
        ..ReconstructionConfig::default()
    };
    let dark = 260..270;
    let run = run_configured(&webcam(Scenario::HandHeld), &config, 0..320, |sequence, picture| {
        if dark.contains(&sequence) {
            picture.data.fill(3);
        }
    });
    let Counters { keyframes_made, keyframes_culled, resets, .. } = run.counters;
    let (coverage, error) = judge(&run);
    println!("{keyframes_made} keyframes made, {keyframes_culled} gone; coverage {coverage}, error {error}");
    assert!(run.most_keyframes <= 30 && keyframes_made > 60, "{} at once of {keyframes_made}", run.most_keyframes);
    assert!(run.estimates[40..260].iter().all(|e| e.state == TrackingState::Tracking));
    let back = run.estimates[270..].iter().position(|e| e.state == TrackingState::Tracking);
    assert!(back.is_some_and(|frames| frames < 10) && resets == 0, "found again after {back:?} frames");
    assert!(error < 0.02, "error {error} of the path");
}

#[test]
fn a_view_that_comes_back_upside_down_is_known() {
    // The principal point is the picture's middle, so a camera that rolls by 180 degrees sees this.
    let config = SimulatorConfig { seed: 3, ..SimulatorConfig::ideal(Scenario::HandHeld) };
    let run = run(&config, 160, |sequence, picture| {
        if sequence >= 130 {
            picture.data.reverse();
        }
    });
    let states: Vec<TrackingState> = run.estimates.iter().map(|e| e.state).collect();
    let back = states[130..].iter().position(|s| *s == TrackingState::Tracking);
    assert!(back.is_some_and(|frames| frames < 3), "known after {back:?} frames");
    assert_eq!(run.counters.resets, 0);
    let turned = |i: usize| run.estimates[i].world_from_camera.map(|p| p.rotation);
    let roll = turned(129).zip(turned(140)).map(|(a, b)| a.angle_to(&b));
    assert!(roll.is_some_and(|angle| angle > 3.0), "rolled by {roll:?} rad");
}

#[test]
fn a_map_that_was_lost_is_joined_when_its_place_is_seen_again() {
    let config = SimulatorConfig { seed: 3, ..SimulatorConfig::ideal(Scenario::RoomTour) };
    // Carried off to another part of the room, and from there back to where it was.
    let run = run_in_order(&config, (0..120).chain((90..330).rev()), |_, _| {});
    let (coverage, error) = judge(&run);
    let Counters { resets, maps_joined, .. } = run.counters;
    assert_eq!((resets, maps_joined), (1, 1));
    assert_eq!(run.estimates.last().map(|e| (e.map.0, e.reset_counter)), Some((1, 1)), "the numbers do not go back");
    let revisions: Vec<u32> = run.estimates.iter().map(|e| e.map_revision).collect();
    assert!(revisions.is_sorted() && revisions[0] == 0, "{revisions:?}");
    assert!((1..=2).contains(&revisions[revisions.len() - 1]), "the join, and the adjustment after it: {revisions:?}");
    assert!(coverage > 0.9, "one trajectory: {coverage}");
    assert!(error < 0.02, "error {error} of the path");
    // Nothing jumps at the join, as the present map is the larger one by then: from frame to frame the pose moves as the camera does.
    let published: Vec<_> = run.estimates.iter().filter(|e| e.map.0 == 1).filter_map(|e| e.world_from_camera).collect();
    let steps: Vec<f64> = published.windows(2).map(|w| (w[1].translation - w[0].translation).norm()).collect();
    let mean = steps.iter().sum::<f64>() / steps.len() as f64;
    let longest = steps.iter().copied().fold(0.0, f64::max);
    assert!(longest < 6.0 * mean, "a step of {longest}, {mean} on average");
}

#[test]
fn readout_time_of_a_rolling_shutter_is_learnt() {
    for readout_ms in [0.0, 20.0] {
        let mut config = SimulatorConfig { seed: 5, ..SimulatorConfig::ideal(Scenario::HandHeld) };
        config.rolling_shutter.enabled = readout_ms > 0.0;
        config.rolling_shutter.readout_ms = f64::max(readout_ms, 1.0);
        let run = run(&config, 240, |_, _| {});
        let learnt_ms = run.readout_s * 1e3;
        assert!((learnt_ms - readout_ms).abs() < 4.0, "learnt {learnt_ms} ms instead of {readout_ms} ms");
    }
}

#[test]
fn a_loop_takes_the_drift_back_and_leaves_the_smooth_pose_alone() {
    // A lap and a bit around the table, quickly. Where a map has hardly drifted by then, as in the first one, its ends are tied and nothing is moved.
    let drives = [2, 1].map(|seed| {
        let config = SimulatorConfig { rate_hz: 15.0, speed: 2.0, seed, ..SimulatorConfig::default() };
        [true, false].map(|loops| {
            run_configured(&config, &ReconstructionConfig { loops, ..Default::default() }, 0..270, |_, _| {})
        })
    });
    let closed = drives.each_ref().map(|[closed, open]| loop_is_known(closed, open));
    assert!(closed.contains(&true), "none was closed");
}

/// That a drive without looking for loops ends farther off; whether its loop was closed, or only tied.
fn loop_is_known(closed: &Run, open: &Run) -> bool {
    let ((coverage, error), (_, without)) = (judge(closed), judge(open));
    let Counters { loops_closed, loops_tied, .. } = closed.counters;
    assert!(loops_closed + loops_tied >= 1 && open.counters.loops_closed == 0, "{:?}", closed.counters);
    // A thousandth of the way, whatever the drift is: a share of that would ask for less the more a map drifts.
    assert!(coverage > 0.95 && error < without.min(0.001), "{error} of the path, {without} without the loop");
    let revisions: Vec<u32> = closed.estimates.iter().map(|e| e.map_revision).collect();
    let last = revisions.last().copied().unwrap_or_default();
    assert!(revisions.is_sorted() && (last > 1) == (loops_closed > 0), "the loop, and the adjustment after it: {last}");
    // Odom goes on in steps like those before, in the new unit.
    let odom: Vec<_> = closed.estimates.iter().filter_map(|e| e.odom_from_camera).collect();
    let longest = odom.windows(2).map(|w| (w[1].translation - w[0].translation).norm()).fold(0.0, f64::max);
    let before = open.estimates.iter().filter_map(|e| e.odom_from_camera).collect::<Vec<_>>();
    let usual = before.windows(2).map(|w| (w[1].translation - w[0].translation).norm()).fold(0.0, f64::max);
    assert!(longest < 3.0 * usual, "a step of {longest}, {usual} without");
    loops_closed > 0
}
