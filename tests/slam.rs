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
    Counters, InlineWorker, PoseEstimate, Reconstruction, ReconstructionConfig, TrackingState, TrajectoryEvent,
};

struct Run {
    estimates: Vec<PoseEstimate>,
    /// Every frame that has a pose, by time, as the map knows it at the end.
    trajectory: BTreeMap<i64, Se3<World, Camera>>,
    truth: Vec<(i64, Se3<World, Camera>)>,
    counters: Counters,
    readout_s: f64,
}

/// Lock-step over `frames` pictures; `edit` may spoil each one.
fn run(config: &SimulatorConfig, frames: u64, mut edit: impl FnMut(u64, &mut GreyImage)) -> Run {
    let mut simulator = Simulator::new(config, Pacing::LockStep).unwrap();
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(&ReconstructionConfig::default(), &camera, worker, true);
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let (mut estimates, mut events, mut truth) = (Vec::new(), Vec::new(), Vec::new());
    for sequence in 0..frames {
        simulator.render(sequence, &mut picture);
        edit(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        truth.push((features.timestamp_ns, simulator.trajectory().pose_at(features.timestamp_ns)));
        estimates.push(reconstruction.track(&features));
        reconstruction.map(&features, &mut feedback);
        stage.feedback(&feedback);
        reconstruction.take_trajectory_events(&mut events);
    }
    reconstruction.finish();
    reconstruction.take_trajectory_events(&mut events);
    let mut known: BTreeMap<_, _> = reconstruction.keyframe_poses().into_iter().collect();
    for event in events.iter().rev() {
        if let TrajectoryEvent::KeyframeRemoved { keyframe, parent, parent_from_keyframe, .. } = event
            && let Some(pose) = known.get(parent).copied()
        {
            let moved = pose.relabel::<World, cairn::geometry::frames::Keyframe>() * *parent_from_keyframe;
            known.insert(*keyframe, moved.relabel());
        }
    }
    let mut trajectory = BTreeMap::new();
    for event in &events {
        if let TrajectoryEvent::Pose { timestamp_ns, keyframe, keyframe_from_camera, .. } = event
            && let Some(pose) = known.get(keyframe)
        {
            let pose = pose.relabel::<World, cairn::geometry::frames::Keyframe>() * *keyframe_from_camera;
            trajectory.insert(*timestamp_ns, pose);
        }
    }
    Run { estimates, trajectory, truth, counters: reconstruction.counters(), readout_s: reconstruction.readout_s() }
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
    }
    assert!(tracked > 100, "{tracked} tracked");
}

#[test]
fn two_runs_give_the_same_bits() {
    let bits = |run: &Run| -> Vec<u64> {
        let poses = run.trajectory.values().flat_map(|p| {
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
        assert!(run.estimates.iter().all(|e| e.state == TrackingState::Initializing), "{scenario:?}: a false start");
        assert!(run.trajectory.is_empty());
    }
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
