//! `cairn twoview`: two pictures to a 3D plot, each step visible.

mod drawing;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use super::session::print;
use super::{CliError, exit_code};
use crate::calibration;
use crate::features::attributes::Direction;
use crate::geometry::{CameraModel, Se3};
use crate::workbench::compare::pairs::listed;
use crate::workbench::detect::Keypoint;
use crate::workbench::pairing::Pair;
use crate::workbench::pose::{CANDIDATES, FourMotions};
use crate::workbench::report;
use crate::workbench::two_view::reconstruct_from_pairs;
use crate::workbench::{
    Cameras, Detection, Detector, Matcher, Matching, Options, Picture, PictureError, TwoView, Views, reconstruct,
};

/// Two pictures to corners, matches, epipolar geometry, relative pose and points, each step in the open
///
/// Prints each step's numbers and writes corners_a.png, corners_b.png, attributes.png, matches.png, epipolar.png, twoview.json, and with a
/// camera motions.png, distances.png, points.ply and scene.png. Without a camera it stops after F. Exit code 3: the pictures give no model or no pose; which of
/// the reasons it was stands on the last line and as outcome in twoview.json.
#[derive(Debug, Clone, clap::Args)]
pub struct TwoViewArgs {
    /// First picture: JPEG, PNG, PGM or PPM
    #[arg(value_name = "A")]
    pub first: PathBuf,
    /// Second picture
    #[arg(value_name = "B")]
    pub second: PathBuf,
    /// Calibration of the camera: a TOML of ours, a YAML of OpenCV, ROS, Kalibr or EuRoC, or the nine numbers of K as text
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Calibration of the second picture's camera, where it is another one
    #[arg(long, value_name = "FILE", requires = "camera")]
    pub camera_b: Option<PathBuf>,
    /// Folder for pictures, twoview.json and points.ply; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub output: PathBuf,
    /// Take the matches from a text, "xa ya xb yb" or "xa ya 1 xb yb 1" a line, instead of finding corners
    #[arg(long, value_name = "FILE", conflicts_with_all = ["detector", "matcher", "scales", "corners", "views", "guided"])]
    pub matches: Option<PathBuf>,
    #[command(flatten)]
    pub method: MethodArgs,
}

/// Steps that can be chosen.
#[derive(Debug, Clone, clap::Args)]
pub struct MethodArgs {
    /// Corner detector
    #[arg(long, value_enum, default_value = "fast")]
    pub detector: Detector,
    /// How corners are matched
    #[arg(long, value_enum, default_value = "gradients")]
    pub matcher: Matcher,
    /// Scales that are searched, each 1.2 times smaller than the one before, 1 to 16 [default: by the matcher]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=16))]
    pub scales: Option<u8>,
    /// Most corners of a picture
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u32).range(8..=20_000))]
    pub corners: u32,
    /// Simulate tilted views of both pictures, for surfaces that are seen at very different slants (seconds; of 20,000 corners, minutes)
    #[arg(long, value_enum, default_value = "auto")]
    pub views: Views,
    /// One sigma of a corner's place, px; inliers lie within 1.96 of it
    #[arg(long, value_name = "PX", default_value_t = 1.0, value_parser = positive_px)]
    pub sigma: f64,
    /// Match again along the epipolar lines
    #[arg(long)]
    pub guided: bool,
    /// Seed of everything random: same pictures, options and seed, same numbers
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// Pixels that make sense as a standard deviation.
pub fn positive_px(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if (0.05..=20.0).contains(&v) => Ok(v),
        _ => Err("must be a number of pixels from 0.05 to 20".into()),
    }
}

impl MethodArgs {
    /// What the chain is told.
    pub fn options(&self) -> Options {
        Options {
            detection: Detection {
                detector: self.detector,
                scales: self.scales.map_or(self.matcher.default_scales(), usize::from),
                max_corners: self.corners as usize,
            },
            matching: Matching::new(self.matcher),
            views: self.views,
            sigma_px: self.sigma,
            guided: self.guided,
            seed: self.seed,
            always_answer: false,
        }
    }
}

/// A picture that cannot be used.
pub fn picture_error(error: &PictureError) -> CliError {
    let code = match error {
        PictureError::Read { .. } => exit_code::NO_INPUT,
        PictureError::Corrupt { .. } => exit_code::DATA,
    };
    CliError::new(code, error.to_string())
}

/// A calibration that fits the picture.
fn load_camera(path: &Path, picture: &Picture) -> Result<CameraModel, CliError> {
    let (width, height) = (picture.grey.width as u32, picture.grey.height as u32);
    let config = |message: String| CliError::new(exit_code::CONFIG, message);
    if let Some([fx, _, cx, _, fy, cy, ..]) = plain_matrix(path) {
        return CameraModel::new(width, height, fx, fy, cx, cy, [0.0; 5])
            .map_err(|e| config(format!("{}: {e}", path.display())));
    }
    let camera = calibration::load_camera(path).map_err(|e| {
        let code = if path.exists() { exit_code::CONFIG } else { exit_code::NO_INPUT };
        CliError::new(code, e.to_string())
    })?;
    if (camera.width, camera.height) != (width, height) {
        return Err(config(format!(
            "{}: is for pictures of {}x{} px, but {} has {width}x{height} px",
            path.display(),
            camera.width,
            camera.height,
            picture.path.display(),
        )));
    }
    Ok(camera)
}

/// A text of nine numbers and nothing else is K, row by row, of the picture as it is.
fn plain_matrix(path: &Path) -> Option<[f64; 9]> {
    const LONGEST: u64 = 1000;
    if !path.is_file() || std::fs::metadata(path).ok()?.len() > LONGEST {
        return None;
    }
    let text = std::fs::read_to_string(path).ok()?;
    let numbers: Vec<f64> = text.split_whitespace().map(|n| n.parse().ok()).collect::<Option<_>>()?;
    let k: [f64; 9] = numbers.try_into().ok()?;
    Some(k.map(|v| v / k[8]))
}

/// Runs the command.
pub fn run(args: &TwoViewArgs) -> Result<ExitCode, CliError> {
    let first = Picture::load(&args.first).map_err(|e| picture_error(&e))?;
    let second = Picture::load(&args.second).map_err(|e| picture_error(&e))?;
    let cameras = match &args.camera {
        None => None,
        Some(path) => {
            let a = load_camera(path, &first)?;
            let b = load_camera(args.camera_b.as_ref().unwrap_or(path), &second)?;
            Some(Cameras { a, b })
        }
    };
    std::fs::create_dir_all(&args.output).map_err(|e| {
        CliError::new(exit_code::CANNOT_CREATE, format!("cannot make the folder {}: {e}", args.output.display()))
    })?;
    let options = args.method.options();
    let result = match &args.matches {
        None => reconstruct(&first.grey, &second.grey, cameras.as_ref(), &options),
        Some(path) => {
            let listed = listed(path).map_err(|e| {
                let code = if path.exists() { exit_code::DATA } else { exit_code::NO_INPUT };
                CliError::new(code, e.to_string())
            })?;
            let pairs = listed.iter().enumerate().map(|(i, [a, b])| Pair::given(i, *a, *b)).collect();
            reconstruct_from_pairs(pairs, cameras.as_ref(), &options)
        }
    };
    print(&text(&result, &options, args.matches.is_some(), cameras.as_ref()))?;
    write_files(args, &result, &options, [&first, &second], cameras.as_ref())?;
    Ok(if result.outcome.is_success() { ExitCode::SUCCESS } else { ExitCode::from(exit_code::NO_MODEL) })
}

fn write_files(
    args: &TwoViewArgs,
    result: &TwoView,
    options: &Options,
    pictures: [&Picture; 2],
    cameras: Option<&Cameras>,
) -> Result<(), CliError> {
    let cannot = |e: String| CliError::new(exit_code::CANNOT_CREATE, e);
    let names = pictures.map(|p| p.path.display().to_string());
    let sizes = pictures.map(|p| (p.grey.width, p.grey.height));
    let document = report::document(result, [&names[0], &names[1]], sizes, options);
    report::write_json(&args.output.join("twoview.json"), &document).map_err(|e| cannot(e.to_string()))?;
    if let Some(solution) = result.pose.as_ref().and_then(|p| p.solution.as_ref()) {
        let points: Vec<_> = solution.points.iter().flatten().copied().collect();
        report::write_ply(&args.output.join("points.ply"), &points, &solution.second_from_first)
            .map_err(|e| cannot(e.to_string()))?;
    }
    drawing::write(&args.output, result, pictures, cameras).map_err(|e| cannot(e.to_string()))
}

/// The steps' numbers for a person; `listed`: the matches come from a file.
fn text(result: &TwoView, options: &Options, listed: bool, cameras: Option<&Cameras>) -> String {
    let mut out = String::new();
    let ms = |step: &str| result.times.iter().find(|(name, _)| *name == step).map_or(0.0, |(_, ms)| *ms);
    let mut line = |name: &str, value: String| out.push_str(&format!("{name:<18}{value}\n"));
    if listed {
        line("matches", format!("{} from the list", result.unguided));
    } else {
        if let Some(first) = &result.first_try {
            line(
                "first try",
                format!(
                    "{} matches, {} inliers, {}; once more with tilted views{}  ({:.1} ms)",
                    first.matches,
                    first.inliers,
                    first.outcome.sentence(),
                    if first.kept { ", which show no more: what follows is this try's" } else { "" },
                    ms(if first.kept { "with tilted views" } else { "without tilted views" })
                ),
            );
        }
        let [a, b] = &result.corners;
        let plain = a.scales.iter().filter(|s| s.is_plain()).count();
        line(
            "corners",
            format!(
                "{} and {} of {} and {} found by {} at {} scale{}  ({:.1} ms)",
                a.plain_count(),
                b.plain_count(),
                a.found,
                b.found,
                options.detection.detector.name(),
                plain,
                if plain == 1 { "" } else { "s" },
                ms("corners")
            ),
        );
        if plain < a.scales.len() {
            let more = [a, b].map(|c| c.keypoints.len() - c.plain_count());
            line("tilted views", format!("{} and {} corners more  ({:.1} ms)", more[0], more[1], ms("tilted views")));
        }
        for (name, corners) in [("attributes", a), ("", b)] {
            line(name, kept(&corners.keypoints[..corners.plain_count()]));
        }
        line(
            "matches",
            format!("{} by {}  ({:.1} ms)", result.unguided, options.matching.matcher.name(), ms("matches")),
        );
    }
    if result.outside_lens > 0 {
        line(
            "",
            format!(
                "{} left out: the lens model does not reach their pixels (of a wide-angle lens: more than 50 degrees off its axis)",
                result.outside_lens
            ),
        );
    }
    if options.guided {
        let more = result.pairs.len().saturating_sub(result.unguided);
        line("guided matches", format!("{more} more along the lines  ({:.1} ms)", ms("guided matches")));
    }
    if let Some(e) = &result.epipolar {
        let f = &e.estimate;
        line(
            "F",
            format!(
                "{} inliers of {}, median {:.2} px, {} samples, log10 false alarms {:.0}  ({:.1} ms)",
                f.inlier_count,
                result.pairs.len(),
                e.median_px,
                f.iterations,
                f.log10_false_alarms,
                ms("fundamental matrix")
            ),
        );
        let pixels = if result.undistorted { "undistorted pixels" } else { "the pictures' own pixels" };
        line("", format!("x_B^T F x_A = 0 in {pixels}; degeneracy: {}", degeneracy(&f.degeneracy)));
        if e.one_camera {
            line(
                "",
                "F is that of one camera for both pictures, which explains the matches about as well as any F".into(),
            );
        }
        matrix(&mut line, &f.fundamental);
    }
    if let (Some(pose), Some(_)) = (&result.pose, cameras) {
        if let Some([_, s2, s3]) = pose.singular_values {
            line("E from F and K", format!("singular values 1, {s2:.4}, {s3:.1e}, forced to 1, 1, 0"));
        }
        for (name, four) in [("  its motions", &pose.from_fundamental), ("E by five points", &pose.five_point)] {
            match four {
                Some(four) => {
                    line(name, candidates(four));
                    if name == "  its motions" {
                        (0..4).for_each(|k| line("", motion(four, k)));
                    }
                }
                None => line(name, "none".into()),
            }
        }
        match &pose.judged {
            Ok(found) => line(
                "judge",
                format!(
                    "{:?}, {} points with enough parallax, runner-up {} of {} votes",
                    found.model, found.wide_points, found.votes_runner_up, found.votes
                )
                .to_lowercase(),
            ),
            Err(reason) => line("judge", reason.to_string()),
        }
        if let Some(s) = &pose.solution {
            let inliers = s.inliers.iter().filter(|i| **i).count();
            line(
                "adjustment",
                format!(
                    "from {}: {inliers} inliers, {} points, {:.3} -> {:.3} px RMS in {} steps  ({:.1} ms)",
                    s.origin,
                    s.points.iter().flatten().count(),
                    s.adjusted.rms_before_px,
                    s.adjusted.rms_after_px,
                    s.adjusted.iterations,
                    ms("pose and points")
                ),
            );
            let (t, angle) = (s.second_from_first.translation, s.second_from_first.rotation.angle().to_degrees());
            line(
                "second_from_first",
                format!(
                    "turned by {angle:.3} +- {:.3} degrees, t = [{:.4} {:.4} {:.4}] +- {:.3} degrees",
                    s.adjusted.sigma_rotation_rad.to_degrees(),
                    t.x,
                    t.y,
                    t.z,
                    s.adjusted.sigma_direction_rad.to_degrees()
                ),
            );
            let mut far: Vec<f64> = s.points.iter().flatten().map(|p| p.norm()).collect();
            far.sort_unstable_by(f64::total_cmp);
            if let [nearest, .., farthest] = far[..] {
                line(
                    "triangulation",
                    format!(
                        "{} points, {nearest:.2} to {farthest:.2} baselines away, {:.2} in the median; the adjustment moved them by {:.1} %",
                        far.len(),
                        far[far.len() / 2],
                        100.0 * s.linear_difference
                    ),
                );
            }
            line("parallax", format!("{:.2} degrees in the median", s.median_parallax_rad.to_degrees()));
            if let Some(f) = &s.fundamental {
                line(
                    "F of the motion",
                    format!(
                        "median {:.2} px; this is the F of twoview.json and of the lines drawn",
                        result.median_px()
                    ),
                );
                matrix(&mut line, f);
            }
        }
    }
    line("outcome", format!("{}  ({:.0} ms)", result.outcome.sentence(), result.total_ms()));
    out
}

/// Three rows.
fn matrix(line: &mut impl FnMut(&str, String), m: &nalgebra::Matrix3<f64>) {
    for r in 0..3 {
        line("", format!("{:>13.5e} {:>13.5e} {:>13.5e}", m[(r, 0)], m[(r, 1)], m[(r, 2)]));
    }
}

fn degeneracy(d: &crate::geometry::fundamental::Degeneracy) -> String {
    use crate::geometry::fundamental::Degeneracy as D;
    match d {
        D::None => "none".into(),
        D::DominantPlane { on_plane, .. } => format!("a plane holds {on_plane} inliers, the others fix the epipole"),
        D::Plane { on_plane, .. } => format!("a plane explains {on_plane} inliers, F is one of many"),
        D::PureRotation { on_plane, .. } => {
            format!("a homography that a mere turn can make explains {on_plane} inliers, F is one of many")
        }
    }
}

/// What is kept of a picture's corners, together.
fn kept(corners: &[Keypoint]) -> String {
    let attributes: Vec<_> = corners.iter().filter_map(|k| k.attributes).collect();
    let spread = |values: &mut dyn Iterator<Item = f32>, digits: usize| {
        let mut sorted: Vec<f32> = values.collect();
        sorted.sort_unstable_by(f32::total_cmp);
        match sorted[..] {
            [] => "none".into(),
            [low, .., high] => {
                format!("{low:.digits$} to {high:.digits$}, median {:.digits$}", sorted[sorted.len() / 2])
            }
            [one] => format!("{one:.digits$}"),
        }
    };
    let grey = spread(&mut attributes.iter().map(|a| f32::from(a.grey)), 0);
    let degree = spread(&mut attributes.iter().map(|a| a.salient_degree), 2);
    let count = |wanted: fn(&Direction) -> bool| attributes.iter().filter(|a| wanted(&a.direction)).count();
    format!(
        "grey level {grey}; salient degree {degree}; {} point one way, {} both ways, {} nowhere",
        count(|d| matches!(d, Direction::Towards(_))),
        count(|d| matches!(d, Direction::Axis(_))),
        count(|d| matches!(d, Direction::Undefined))
    )
}

/// One of the four, as a motion of the second camera.
fn motion(four: &FourMotions, k: usize) -> String {
    let Se3 { rotation, translation: t, .. } = &four.candidates[k];
    let angle = rotation.angle().to_degrees();
    format!("{} turned by {angle:7.3} degrees, t = [{:7.4} {:7.4} {:7.4}]", CANDIDATES[k], t.x, t.y, t.z)
}

fn candidates(four: &FourMotions) -> String {
    let each: Vec<String> =
        (0..4).map(|k| format!("{} {}/{}", CANDIDATES[k], four.votes[k], four.one_point_counts[k])).collect();
    let by_one = four.by_one_point.map_or("none", |k| CANDIDATES[k]);
    let winner = CANDIDATES[four.winner()];
    format!(
        "{} inliers; votes/one-point rules: {}; one point says {by_one}, votes say {winner}",
        four.inliers,
        each.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workbench::Outcome;

    #[test]
    fn outcomes_that_give_nothing_have_an_exit_code_of_their_own() {
        assert!(Outcome::Reconstructed.is_success() && Outcome::FundamentalOnly.is_success());
        assert!(!Outcome::NoModel { matches: 9 }.is_success() && !Outcome::Ambiguous.is_success());
        let others = [
            exit_code::FAILURE,
            exit_code::USAGE,
            exit_code::DATA,
            exit_code::NO_INPUT,
            exit_code::UNAVAILABLE,
            exit_code::CANNOT_CREATE,
            exit_code::CONFIG,
            0,
        ];
        assert!(!others.contains(&exit_code::NO_MODEL));
    }
}
