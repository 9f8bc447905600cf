//! One drive in lock-step, and its figures.

use std::collections::{BTreeMap, VecDeque};

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::geometry::alignment::align;
use cairn::geometry::frames::{Camera, World};
use cairn::geometry::{Se3, ros_from_optical};
use cairn::image::GreyImage;
use cairn::map::MapId;
use cairn::map::scale::MapScale;
use cairn::motion::floor::{ScaleConfig, roll_pitch};
use cairn::motion::hand_eye::Robot;
use cairn::motion::obstacles::{BEARINGS, ObstaclesConfig, bearing_rad};
use cairn::reconstruction::{InlineWorker, Reconstruction, ReconstructionConfig, TrackingState};
use nalgebra::Vector3;

/// Height of the simulator's camera on a driven base, m, and its pitch there as in `[mount]` (positive: nose down), degrees.
pub const HEIGHT_M: f64 = 0.5;
pub const PITCH_DEG: f64 = -2.29;

/// Half of the camera's view in which bearings are judged, rad: all of the picture but its rims.
const VIEW_RAD: f64 = 0.46;
/// An obstacle is asked for up to here, and a bearing on which nothing stands up to the second is truly free and counts as reported where the floor is
/// said to be free up to the third, m.
const OBSTACLE_M: f64 = 3.0;
const FREE_M: f64 = 1.5;
const FREE_TOLD_M: f64 = 1.0;
/// A distance is reported where it is within this of the truth, m and share; a free report is right if nothing stands before its end, but for this, m.
const WITHIN_M: f64 = 0.2;
const WITHIN_SHARE: f64 = 0.1;
const FREE_WITHIN_M: f64 = 0.05;

/// Way over which a published length is compared with the truth, m: long beside what a pose has wrong.
const LATELY_M: f64 = 0.25;

/// The base drives on a floor, seen by a camera that is pitched by 2 degrees.
const STEEP_DEG: f64 = 10.0;

/// A scale that is of use, one sigma.
const SURE: f64 = 0.1;

/// Of bearings, summed over scans.
#[derive(Debug, Default, Clone, Copy)]
pub struct Bearings {
    pub scans: usize,
    /// In view, with something within 3 m, and of these reported.
    pub obstacles: usize,
    pub reported: usize,
    /// In view and truly free, and of these told.
    pub free: usize,
    pub told_free: usize,
    /// All round: free reports, and those with something before their end.
    pub free_reports: usize,
    pub wrong: usize,
    /// Longest that a free report reached beyond what stood there, m.
    pub worst_m: f64,
}

pub struct Driven {
    /// Of the camera until the map became metric, and in all, m.
    pub until_metric_m: Option<f64>,
    pub way_m: f64,
    /// Standard deviation of the scale at the end, a share.
    pub sigma: f64,
    /// By what share the lengths published since the map became metric are wrong.
    pub scale_error: f64,
    /// Metric frames whose scale health calls assumed, and all metric ones.
    pub assumed: (usize, usize),
    /// Frames in which the way of the last half metre was published within 1.96 of the published standard deviations, and all that have such a way
    /// behind them in one metric map.
    pub inside: (usize, usize),
    /// Of these, where no frame of that way was published less sure than [`SURE`].
    pub sure: (usize, usize),
    /// The same of ways that began once a scale had been told anew, and the RMS share by which they are wrong.
    pub sure_anew: (usize, usize),
    pub anew_rms: f64,
    /// Such ways, however sure, that lead more than [`STEEP_DEG`] up or down, and all.
    pub steep: (usize, usize),
    /// Mean share by which the ways of the latter are wrong; NaN without any. Not that of all places where the scale is known: what lies behind a stretch
    /// of an assumed length lies where that puts it.
    pub scale_error_sure: f64,
    /// What was wrong with it in the newest of these, a share.
    pub last_error: f64,
    /// As found at the end, degrees.
    pub roll_pitch_deg: Option<(f64, f64)>,
    /// Keyframes that told a floor, and that told none, by reason.
    pub told: usize,
    pub refused: BTreeMap<String, usize>,
    pub bearings: Bearings,
    /// The longest that mapping took after a frame, and a scan, ms.
    pub map_ms: f64,
    pub scan_ms: f64,
}

/// Lock-step over so many seconds; the camera's height is said to be `height_m`. With `scans` made so, one a second is judged.
pub fn drive(config: &SimulatorConfig, seconds: f64, height_m: f64, scans: Option<&ObstaclesConfig>) -> Driven {
    let mut simulator = Simulator::new(config, Pacing::LockStep).unwrap();
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(&ReconstructionConfig::default(), &camera, worker, true);
    let scale = ScaleConfig { camera_height_m: height_m, ..ScaleConfig::default() };
    assert!(scale.validate().is_ok());
    reconstruction.look_for_floor(&scale, &Robot::unknown());
    reconstruction.want_seen_floor(scans.is_some_and(|config| config.seen_floor));
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let (mut events, mut from, mut to) = (Vec::new(), Vec::new(), Vec::new());
    let (mut sure_errors, mut anew_squares, mut was_assumed) = (0.0, 0.0, false);
    let mut last: Option<Vector3<f64>> = None;
    let mut lately = Lately::default();
    let mut driven = Driven {
        until_metric_m: None,
        way_m: 0.0,
        sigma: f64::INFINITY,
        scale_error: f64::NAN,
        assumed: (0, 0),
        inside: (0, 0),
        sure: (0, 0),
        sure_anew: (0, 0),
        anew_rms: f64::NAN,
        steep: (0, 0),
        scale_error_sure: f64::NAN,
        last_error: f64::NAN,
        roll_pitch_deg: None,
        told: 0,
        refused: BTreeMap::new(),
        bearings: Bearings::default(),
        map_ms: 0.0,
        scan_ms: 0.0,
    };
    let verbose = std::env::var_os("FLOOR_VERBOSE").is_some();
    for sequence in 0..(seconds * config.rate_hz) as u64 {
        simulator.render(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        let truth = simulator.trajectory().pose_at(features.timestamp_ns);
        let place = truth.translation;
        driven.way_m += last.replace(place).map_or(0.0, |last| (place - last).norm());
        let estimate = reconstruction.track(&features);
        let tracking = estimate.state == TrackingState::Tracking;
        if let (true, MapScale::Metric { .. }, Some(pose)) = (tracking, estimate.scale, estimate.world_from_camera) {
            from.push(pose.translation);
            to.push(place);
            was_assumed |= reconstruction.scale_is_assumed();
            driven.assumed.0 += usize::from(reconstruction.scale_is_assumed());
            driven.assumed.1 += 1;
        }
        let published = match (estimate.scale, estimate.odom_from_camera.filter(|_| tracking)) {
            (MapScale::Metric { sigma, .. }, Some(odom)) => Some((odom.translation, sigma)),
            _ => None,
        };
        if let Some((error, sigma, up)) = lately.error(estimate.map, published, place) {
            driven.steep.0 += usize::from(up.abs() > STEEP_DEG.to_radians());
            driven.steep.1 += 1;
            driven.inside.0 += usize::from(error.abs() <= 1.96 * sigma);
            driven.inside.1 += 1;
            if sigma < SURE {
                driven.sure.0 += usize::from(error.abs() <= 1.96 * sigma);
                driven.sure.1 += 1;
                sure_errors += error;
                // No way that was sure throughout crosses a turn.
                if was_assumed {
                    driven.sure_anew.0 += usize::from(error.abs() <= 1.96 * sigma);
                    driven.sure_anew.1 += 1;
                    anew_squares += error * error;
                }
            }
            driven.last_error = error.exp() - 1.0;
            if verbose {
                let (assumed, way) = (reconstruction.scale_is_assumed(), driven.way_m);
                println!("{sequence}: {way:.2} m, ln error {error:.3}, sigma {sigma:.3}, assumed {assumed}");
            }
        }
        let begun = std::time::Instant::now();
        reconstruction.map(&features, &mut feedback);
        driven.map_ms = driven.map_ms.max(begun.elapsed().as_secs_f64() * 1e3);
        stage.feedback(&feedback);
        reconstruction.take_trajectory_events(&mut events);
        events.clear();
        if estimate.keyframe {
            match reconstruction.no_floor() {
                None => driven.told += 1,
                Some(reason) => {
                    let reason = format!("{reason:?}");
                    let name = reason.split('(').next().unwrap_or("").to_owned();
                    *driven.refused.entry(name).or_insert(0) += 1;
                }
            }
            if verbose {
                println!(
                    "{sequence}: {:.2} m {:?} {:?}",
                    driven.way_m,
                    reconstruction.no_floor(),
                    reconstruction.floor()
                );
            }
        }
        if reconstruction.scale().is_metric() {
            driven.until_metric_m.get_or_insert(driven.way_m);
        }
        if let Some(how) = scans.filter(|_| tracking && sequence % config.rate_hz.max(1.0) as u64 == 0) {
            judge_scan(&mut reconstruction, how, &simulator, &truth, height_m, &mut driven);
        }
    }
    if let Ok(scaled) = align::<World, World>(&from, &to, true) {
        driven.scale_error = scaled.to_from_from.scale - 1.0;
    }
    driven.scale_error_sure = (sure_errors / driven.sure.1 as f64).exp() - 1.0;
    driven.anew_rms = (anew_squares / driven.sure_anew.1 as f64).sqrt();
    if let MapScale::Metric { sigma, .. } = reconstruction.scale() {
        driven.sigma = sigma;
    }
    driven.roll_pitch_deg = reconstruction.floor().map(|plane| {
        let (roll, pitch) = roll_pitch(&plane.up_camera);
        (roll.to_degrees(), pitch.to_degrees())
    });
    driven
}

/// The newest frames of one map: published place, true one, and standard deviation of the scale.
#[derive(Default)]
struct Lately {
    map: Option<MapId>,
    frames: VecDeque<(Vector3<f64>, Vector3<f64>, f64)>,
}

impl Lately {
    /// ln of how many times too long the chord of the last `LATELY_M` was published, the largest standard deviation since, and how steeply it was said to
    /// lead down in the first camera's axes, rad. A chord, because a published place trembles while the robot stands.
    fn error(
        &mut self,
        map: MapId,
        published: Option<(Vector3<f64>, f64)>,
        truth: Vector3<f64>,
    ) -> Option<(f64, f64, f64)> {
        let Some((published, sigma)) = published.filter(|_| self.map == Some(map)) else {
            *self = Self { map: Some(map), ..Self::default() };
            return None;
        };
        self.frames.push_back((published, truth, sigma));
        let far = |frame: &(Vector3<f64>, Vector3<f64>, f64)| (truth - frame.1).norm() >= LATELY_M;
        let from = self.frames.iter().rposition(far)?;
        let sigma = self.frames.range(from..).map(|frame| frame.2).fold(0.0, f64::max);
        let (place, true_place, _) = self.frames[from];
        let way = published - place;
        Some(((way.norm() / (truth - true_place).norm()).ln(), sigma, (way.y / way.norm()).asin()))
    }
}

fn judge_scan(
    reconstruction: &mut Reconstruction,
    config: &ObstaclesConfig,
    simulator: &Simulator,
    truth: &Se3<World, Camera>,
    height_m: f64,
    driven: &mut Driven,
) {
    let begun = std::time::Instant::now();
    let body_from_camera = Se3::new(ros_from_optical(), Vector3::zeros());
    let Ok(scan) = reconstruction.obstacles(config, height_m, &body_from_camera) else { return };
    driven.scan_ms = driven.scan_ms.max(begun.elapsed().as_secs_f64() * 1e3);
    let axis = truth.rotation * Vector3::z();
    let yaw = axis.y.atan2(axis.x);
    let counts = &mut driven.bearings;
    counts.scans += 1;
    for bearing in 0..BEARINGS {
        let angle = bearing_rad(bearing);
        let direction = Vector3::new((yaw + angle).cos(), (yaw + angle).sin(), 0.0);
        // What stands there, at heights 5 cm apart.
        let heights = (0..).map(|i| 0.07 + 0.05 * f64::from(i)).take_while(|z| *z < height_m);
        let reach = |z: f64| simulator.reach(&Vector3::new(truth.translation.x, truth.translation.y, z), &direction);
        let stands_m = heights.filter_map(reach).fold(f64::INFINITY, f64::min);
        let (range, free) = (f64::from(scan.range_m[bearing]), f64::from(scan.free_m[bearing]));
        if free > 0.0 {
            counts.free_reports += 1;
            if free > stands_m + FREE_WITHIN_M {
                counts.wrong += 1;
                counts.worst_m = counts.worst_m.max(free - stands_m);
            }
        }
        if angle.abs() > VIEW_RAD {
            continue;
        }
        if stands_m < OBSTACLE_M {
            counts.obstacles += 1;
            counts.reported += usize::from((range - stands_m).abs() <= WITHIN_M.max(WITHIN_SHARE * stands_m));
        }
        if stands_m >= FREE_M {
            counts.free += 1;
            counts.told_free += usize::from(free >= FREE_TOLD_M);
        }
    }
}

pub fn room(scenario: Scenario, seed: u64) -> SimulatorConfig {
    SimulatorConfig { seed, rate_hz: 12.0, width: 320, height: 240, scenario, ..Default::default() }
}

/// The same, printed.
pub fn judge(config: &SimulatorConfig, seconds: f64, height_m: f64, scans: Option<&ObstaclesConfig>) -> Driven {
    let driven = drive(config, seconds, height_m, scans);
    let Driven { until_metric_m, way_m, sigma, scale_error, roll_pitch_deg, told, refused, map_ms, .. } = &driven;
    println!(
        "{} {}: {way_m:.1} m, metric after {until_metric_m:.1?} m, scale {:.2} % off, sigma {:.2} %, roll and pitch {roll_pitch_deg:.2?}, \
         floor at {told} keyframes, not at {refused:?}, mapping {map_ms:.1} ms at most",
        config.scenario.name(),
        config.seed,
        100.0 * scale_error,
        100.0 * sigma,
    );
    if let (assumed @ 1.., metric) = driven.assumed {
        println!("    scale assumed in {assumed} of {metric} metric frames");
    }
    let ((inside, lengths), (right, sure)) = (driven.inside, driven.sure);
    let (right_anew, anew) = driven.sure_anew;
    println!(
        "    behind turns sure in {anew}, {right_anew} inside, {:.2} % off RMS; {} of {} ways lead up or down",
        100.0 * driven.anew_rms,
        driven.steep.0,
        driven.steep.1
    );
    println!(
        "    last {LATELY_M} m {:.2} % off; within 1.96 sigma in {inside} of {lengths} frames, in {right} of {sure} with a sigma below {SURE}, which are {:.2} % \
         off in the mean",
        100.0 * driven.last_error,
        100.0 * driven.scale_error_sure
    );
    let b = &driven.bearings;
    if scans.is_some() {
        println!(
            "    {} scans: {} of {} obstacles reported, {} of {} free bearings, {} of {} free reports wrong, {:.2} m at most; {:.1} ms at most",
            b.scans, b.reported, b.obstacles, b.told_free, b.free, b.wrong, b.free_reports, b.worst_m, driven.scan_ms,
        );
    }
    driven
}

/// Of an environment variable, or this.
pub fn word(name: &str, or: &str) -> String {
    std::env::var(name).unwrap_or_else(|_| or.into())
}
