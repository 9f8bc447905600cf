//! A camera that nobody has calibrated, on the simulator: the lens is found from the motion where the motion shows it, and where it
//! does not that is said. The long form (`cargo test --release --test uncalibrated -- --ignored --nocapture`) counts over 50 clips how often the
//! focal length is within one and two of the standard deviations that are said of it.

use std::collections::BTreeMap;

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::geometry::alignment::align;
use cairn::geometry::frames::World;
use cairn::image::GreyImage;
use cairn::reconstruction::{
    Counters, FOUND_SIGMA, InlineWorker, LensEstimate, LensKnowledge, LensPrior, Reconstruction, ReconstructionConfig,
    guessed_camera,
};
use cairn::trajectory::{TrajectorySpool, read_tum};

/// A simulated webcam of this focal length (picture widths), 15 pictures a second.
fn webcam(scenario: Scenario, focal_widths: f64) -> SimulatorConfig {
    let mut config = SimulatorConfig::ideal(scenario);
    config.lens.focal_widths = focal_widths;
    config.lens.distortion = true;
    config.noise.enabled = true;
    config.rate_hz = 15.0;
    config.texel_mm = 4.0;
    config
}

/// What was said of a lens.
struct Clip {
    lens: LensEstimate,
    /// Error of log focal length in the end, and the largest one while it was called found, in standard deviations as said then.
    off: f64,
    worst: f64,
    /// Shares of the frames with a pose, and with one of more than half the best quality.
    tracked: f64,
    good: f64,
    counters: Counters,
    /// Share of the frames that are in the largest map in the end, and the error of their positions after Sim(3), RMSE, as a share of the path.
    whole: f64,
    error: f64,
}

/// What is said of the lens after so many seconds, begun with 60 degrees across and no other knowledge.
fn found(config: &SimulatorConfig, seconds: f64) -> LensEstimate {
    watched(config, seconds).lens
}

fn watched(config: &SimulatorConfig, seconds: f64) -> Clip {
    let focal = config.camera_model().expect("a camera").focal_px().ln();
    let (mut worst, mut tracked, mut good) = (0.0f64, 0u32, 0u32);
    let mut simulator = Simulator::new(config, Pacing::LockStep).expect("simulator");
    let guess = guessed_camera(config.width, config.height, 60.0).expect("a camera");
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction =
        Reconstruction::with_lens(&ReconstructionConfig::default(), &guess, LensPrior::UNKNOWN, worker, true);
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let folder = tempfile::tempdir().unwrap();
    let mut spool = TrajectorySpool::create(folder.path()).unwrap();
    let (mut events, mut truth) = (Vec::new(), Vec::new());
    let frames = (seconds * config.rate_hz) as u64;
    for sequence in 0..frames {
        simulator.render(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        truth.push((features.timestamp_ns, simulator.trajectory().pose_at(features.timestamp_ns).translation));
        let pose = reconstruction.track(&features);
        let said = reconstruction.lens().knowledge;
        reconstruction.map(&features, &mut feedback);
        stage.feedback(&feedback);
        reconstruction.take_trajectory_events(&mut events);
        events.drain(..).for_each(|event| spool.record(&event).unwrap());
        let lens = reconstruction.lens();
        if lens.knowledge == LensKnowledge::Estimated {
            worst = worst.max((lens.camera.focal_px().ln() - focal).abs() / lens.focal_sigma);
        }
        tracked += u32::from(pose.world_from_camera.is_some());
        good += u32::from(pose.quality > 0.5);
        assert!(pose.quality <= 0.5 || said != LensKnowledge::Guessed, "a guessed lens gives no good pose: {pose:?}");
    }
    reconstruction.finish();
    reconstruction.take_trajectory_events(&mut events);
    events.drain(..).for_each(|event| spool.record(&event).unwrap());
    let path = folder.path().join("trajectory.txt");
    let written = spool.write_tum(&path, &reconstruction.keyframe_poses()).unwrap();
    let poses = if written.poses_written > 0 { read_tum(&path).unwrap() } else { Vec::new() };
    let poses: BTreeMap<i64, _> = poses.iter().map(|p| (p.timestamp_ns, p.world_from_camera.translation)).collect();
    let way: f64 = truth.windows(2).map(|w| (w[1].1 - w[0].1).norm()).sum();
    let (from, to): (Vec<_>, Vec<_>) = truth.iter().filter_map(|(t, truth)| Some((*poses.get(t)?, *truth))).unzip();
    let error = align::<World, World>(&from, &to, true).map_or(f64::NAN, |alignment| alignment.rmse / way);
    let lens = reconstruction.lens();
    let share = |n: u32| f64::from(n) / frames as f64;
    Clip {
        off: lens.camera.focal_px().ln() - focal,
        lens,
        worst,
        tracked: share(tracked),
        good: share(good),
        counters: reconstruction.counters(),
        whole: from.len() as f64 / frames as f64,
        error,
    }
}

/// Error of the focal length as a share of it.
fn error(lens: &LensEstimate, focal_widths: f64) -> f64 {
    (lens.camera.focal_px() / (focal_widths * f64::from(lens.camera.width))).ln()
}

fn is_found_by_hand_held(focal_widths: f64) {
    let lens = found(&webcam(Scenario::HandHeld, focal_widths), 9.0);
    let off = error(&lens, focal_widths);
    println!("{focal_widths} widths: {off:+.3} off, sigma {:.3}, {:?}", lens.focal_sigma, lens.knowledge);
    assert_eq!(lens.knowledge, LensKnowledge::Estimated, "{lens:?}");
    assert!(off.abs() <= 0.03f64.max(lens.focal_sigma), "{focal_widths} widths: {off:+.3} off, {lens:?}");
}

#[test]
fn a_wide_lens_is_found_from_the_motion() {
    is_found_by_hand_held(0.6);
}

#[test]
fn a_usual_lens_is_found_from_the_motion() {
    is_found_by_hand_held(0.82);
}

#[test]
fn a_narrow_lens_is_found_from_the_motion() {
    is_found_by_hand_held(1.15);
}

#[test]
fn what_was_seen_through_a_wrong_lens_is_in_the_map_once_the_lens_is_known() {
    let drives = [(Scenario::RoomTour, 100.0, 909), (Scenario::HandHeld, 38.0, 912), (Scenario::RoomTour, 38.0, 912)];
    for (scenario, view_deg, seed) in drives {
        let config = SimulatorConfig { seed, ..webcam(scenario, widths(view_deg)) };
        let Clip { counters, whole, error, .. } = watched(&config, 14.0);
        let at =
            format!("{scenario:?}, {view_deg} degrees, seed {seed}: {whole:.3} in one map, {error:.4} of the path");
        println!("{at}");
        assert!(
            counters.resets > 0 && counters.maps_joined > 0,
            "{at}: no map was begun with a wrong lens: {counters:?}"
        );
        assert!(whole > 0.97 && error < 0.008, "{at}");
    }
}

/// Not found, said so, and right within two of the standard deviations that are said.
fn is_not_observable(scenario: Scenario, focal_widths: f64, seconds: f64) {
    let lens = found(&webcam(scenario, focal_widths), seconds);
    let off = error(&lens, focal_widths);
    println!("{scenario:?}: {off:+.3} off, sigma {:.3}, {:?}", lens.focal_sigma, lens.knowledge);
    assert_eq!(lens.knowledge, LensKnowledge::Guessed, "{scenario:?}: {lens:?}");
    assert!(
        lens.focal_sigma > FOUND_SIGMA && off.abs() < 2.0 * lens.focal_sigma,
        "{scenario:?}: {off:+.3} off, {lens:?}"
    );
}

/// Focal length in picture widths of a lens that sees so many degrees across.
fn widths(view_deg: f64) -> f64 {
    0.5 / (0.5 * view_deg).to_radians().tan()
}

/// Seen through a lens that is not the supposed one a turn looks like parallax.
#[test]
fn turning_on_the_spot_begins_no_map_whatever_the_lens() {
    for (view_deg, seed) in [(37.0, 2), (60.0, 1), (75.0, 1), (90.0, 1)] {
        let config = SimulatorConfig { seed, ..webcam(Scenario::PureRotation, widths(view_deg)) };
        let clip = watched(&config, 6.0);
        let (lens, sigma) = (clip.lens.knowledge, clip.lens.focal_sigma);
        assert_eq!((lens, clip.tracked), (LensKnowledge::Guessed, 0.0), "{view_deg} degrees, seed {seed}");
        assert!(clip.off.abs() < 3.0 * sigma, "{view_deg} degrees: {:+.3} off, sigma {sigma:.3}", clip.off);
    }
}

/// Motions that show the focal length poorly, and lenses far from the supposed one: what is called found is so.
#[test]
fn a_hard_motion_is_never_silently_wrong() {
    for (scenario, view_deg, seed, seconds) in
        [(Scenario::DeskOrbit, 37.0, 3, 11.0), (Scenario::DeskOrbit, 90.0, 1, 10.0), (Scenario::Square, 45.0, 1, 11.0)]
    {
        let config = SimulatorConfig { seed, ..webcam(scenario, widths(view_deg)) };
        let Clip { lens, off, worst, .. } = watched(&config, seconds);
        println!("{scenario:?} {view_deg} degrees: {off:+.3} off, sigma {:.3}, worst {worst:.1}", lens.focal_sigma);
        let at = format!("{scenario:?}, {view_deg} degrees, seed {seed}: {off:+.3} off, worst {worst:.2}, {lens:?}");
        assert!(worst < 2.5 && off.abs() < 2.0 * lens.focal_sigma, "{at}");
    }
}

/// Ordinary webcams (blur, rolling shutter, exposure) in rooms that nothing was chosen with.
#[test]
#[ignore = "takes minutes"]
fn what_is_said_of_the_focal_length_is_honest() {
    let clips = [
        (Scenario::HandHeld, 9.0),
        (Scenario::DeskOrbit, 12.0),
        (Scenario::RoomTour, 15.0),
        (Scenario::Square, 20.0),
        (Scenario::Corridor, 10.0),
        (Scenario::PureRotation, 6.0),
    ];
    let (mut count, mut within, mut found, mut worst_of_all) = (0, [0; 2], 0, 0.0f64);
    let mut off_when_found = Vec::new();
    println!(
        "\n| clip | off % | published sigma % | said | largest error while found, sigmas | tracked % | of good quality % |"
    );
    println!("|---|---:|---:|---|---:|---:|---:|");
    for (seed, view_deg) in [11, 12].into_iter().flat_map(|s| [37.0, 45.0, 60.0, 75.0, 90.0].map(|v| (s, v))) {
        for (scenario, seconds) in clips {
            let mut config =
                SimulatorConfig { scenario, seed, rate_hz: 15.0, texel_mm: 4.0, ..SimulatorConfig::default() };
            config.lens.focal_widths = widths(view_deg);
            let Clip { lens, off, worst, tracked, good, .. } = watched(&config, seconds);
            let said = lens.focal_sigma;
            println!(
                "| {} {view_deg:.0}° seed {seed} | {:+.2} | {:.2} | {} | {worst:.2} | {:.0} | {:.0} |",
                scenario.name(),
                100.0 * off,
                100.0 * said,
                lens.knowledge.name().to_uppercase(),
                100.0 * tracked,
                100.0 * good
            );
            if scenario == Scenario::PureRotation {
                assert_eq!(tracked, 0.0, "a map of a turn");
                continue;
            }
            count += 1;
            within = [within[0] + u32::from(off.abs() <= said), within[1] + u32::from(off.abs() <= 2.0 * said)];
            if lens.knowledge == LensKnowledge::Estimated {
                found += 1;
                off_when_found.push(100.0 * off.abs());
            }
            worst_of_all = worst_of_all.max(worst);
        }
    }
    let [one, two] = within.map(|n| 100.0 * f64::from(n) / f64::from(count));
    off_when_found.sort_unstable_by(f64::total_cmp);
    let median = off_when_found.get(off_when_found.len() / 2).copied().unwrap_or(f64::NAN);
    let most = off_when_found.last().copied().unwrap_or(f64::NAN);
    println!(
        "\n| clips that are no turns | found | found ones off, median % | at most % | within one sigma % | within two % | largest error while found, sigmas |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|");
    println!("| {count} | {found} | {median:.1} | {most:.1} | {one:.0} | {two:.0} | {worst_of_all:.2} |");
    assert!(one > 60.0 && two > 92.0 && worst_of_all < 3.0 && 2 * found > count);
}

/// A drive along a corridor hardly turns: whatever the lens, it stays a guess, or what is called found is right.
#[test]
fn driving_straight_ahead_is_never_silently_wrong() {
    for focal_widths in [0.6, 0.82, 1.3] {
        let Clip { lens, off, worst, .. } = watched(&webcam(Scenario::Corridor, focal_widths), 4.0);
        println!("corridor, {focal_widths} widths: {off:+.3} off, sigma {:.3}, {:?}", lens.focal_sigma, lens.knowledge);
        let at = format!("{focal_widths} widths: {off:+.3} off, worst {worst:.2}, {lens:?}");
        assert!(worst < 2.0 && off.abs() < 2.0 * lens.focal_sigma, "{at}");
    }
}

#[test]
fn gliding_sideways_without_turning_shows_no_focal_length() {
    is_not_observable(Scenario::Sideways, 0.82, 5.0);
}

#[test]
fn standing_still_shows_nothing() {
    is_not_observable(Scenario::Standing, 1.0, 2.0);
}

#[test]
fn a_kept_estimate_is_where_the_next_start_begins() {
    let first = found(&webcam(Scenario::HandHeld, 0.6), 9.0);
    let centre = first.centre_sigma_px[0].max(first.centre_sigma_px[1]) / f64::from(first.camera.width);
    let prior = LensPrior::kept(first.focal_sigma, centre);
    let worker = Box::new(InlineWorker::default());
    let config = ReconstructionConfig::default();
    let next = Reconstruction::with_lens(&config, &first.camera, prior, worker, true).lens();
    assert_eq!((next.knowledge, &next.camera), (LensKnowledge::Estimated, &first.camera));
    assert!((next.focal_sigma - first.focal_sigma).abs() < 1e-12, "{} and {}", next.focal_sigma, first.focal_sigma);
}
