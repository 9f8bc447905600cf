//! The chain: two pictures to corners, matches, epipolar geometry, relative pose and points.
//!
//! Input: two grey pictures, the cameras if they are known, [`Options`]. Output: [`TwoView`]: everything that every step
//! gave, with its time, and one [`Outcome`] that says how far the chain came and why it ended there.
//! F is estimated on undistorted pixels (`K` times the undistorted normalised point) when cameras are given and on the
//! pictures' own pixels otherwise; [`TwoView::undistorted`] says which. Points are undistorted, pictures never.
//! Where that gives no model, or one of few matches, it is tried again with simulated tilts of both pictures ([`Views`]).
//! A guided round matches again along the lines of the first F, and estimates F once more from the union.
//! Every random draw comes from one seed: the same input gives the same numbers (times aside).
//!
//! Cost: 50 to 500 ms for 640x480, with tilted views 0.5 to 4 s. Deliberately not here: reading files, drawing, printing.

mod epipolar;
#[cfg(test)]
mod tests;
mod turn;
mod views;

use std::time::Instant;

use nalgebra::{Matrix3, Vector2};

pub use self::epipolar::Epipolar;
use self::epipolar::epipolar;
pub use self::views::{FirstTry, Views};
use super::adjustment::Observation;
use super::detect::{Corners, Detection, add_tilted, detect};
use super::guided::{Guidance, correlate_along_lines, descriptor_distance, gradient_distance, match_along_lines};
use super::pairing::{Matcher, Matching, Pair, align_pairs, pair_corners, polish_pair, polish_pairs};
use super::pose::{LINE_SIGMAS, PoseInput, PoseSteps, median, pose_steps};
use crate::features::matching::SAME_CORNER_PX;
use crate::geometry::LensModel;
use crate::geometry::camera_model::CameraModel;
use crate::geometry::epipolar::sampson_squared;
use crate::geometry::fundamental::Degeneracy;
use crate::geometry::two_view::TwoViewFailure;
use crate::image::GreyImage;

/// Fewer matches are not tried: seven make an F, and one that nothing confirms.
pub const MIN_MATCHES: usize = 8;

/// What can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    pub detection: Detection,
    pub matching: Matching,
    /// Of matchers that know no tilt (attributes, correlation, flow): never.
    pub views: Views,
    /// One sigma of a corner's place, pixels; an inlier lies within 1.96 of it.
    pub sigma_px: f64,
    /// Match again along the epipolar lines.
    pub guided: bool,
    pub seed: u64,
    /// Give the best motion found even where nothing makes it stand out from chance; the outcome stays what it is.
    pub always_answer: bool,
}

/// The cameras of both pictures.
#[derive(Debug, Clone, PartialEq)]
pub struct Cameras {
    pub a: CameraModel,
    pub b: CameraModel,
}

/// How far the chain came.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case", tag = "name")]
pub enum Outcome {
    /// Pose and points.
    Reconstructed,
    /// Epipolar geometry; no camera was given, so no more can be had.
    FundamentalOnly,
    /// Both files show the very same pixels.
    IdenticalPictures,
    /// Hardly anything to see in one of the pictures.
    TooFewCorners { first: usize, second: usize },
    /// Hardly anything of one picture found in the other.
    TooFewMatches { matches: usize, needed: usize },
    /// No epipolar geometry stands out from chance.
    NoModel { matches: usize },
    /// A homography explains the matches and no camera says more: F is one of many.
    Plane { on_plane: usize },
    /// A rotation explains the matches: the camera turned and did not move. Without a camera: or it saw a plane, moving just so.
    PureRotation { angle_deg: Option<f64> },
    /// The camera moved too little for how far away things are.
    LowParallax { median_deg: f64 },
    /// Two motions explain the matches equally well, as a plane allows.
    Ambiguous,
    /// Epipolar geometry, but no motion puts enough points in front of both cameras.
    NoPose { reason: String },
}

impl Outcome {
    /// Is there what was asked for?
    pub fn is_success(&self) -> bool {
        matches!(self, Self::Reconstructed | Self::FundamentalOnly)
    }

    /// One sentence.
    pub fn sentence(&self) -> String {
        match self {
            Self::Reconstructed => "relative pose and points reconstructed".into(),
            Self::FundamentalOnly => {
                "stopped after F: without --camera the focal lengths are unknown, and with them angles and depths"
                    .into()
            }
            Self::IdenticalPictures => "the two pictures are identical: nothing moved, so nothing can be said".into(),
            Self::TooFewCorners { first, second } => {
                format!("too few corners: {first} in the first picture, {second} in the second")
            }
            Self::TooFewMatches { matches, needed } => {
                format!("too few matches: {matches}, at least {needed} are needed")
            }
            Self::NoModel { matches } => {
                format!("no model: no epipolar geometry of {matches} matches stands out from chance")
            }
            Self::Plane { on_plane } => {
                format!(
                    "a plane: one homography explains {on_plane} matches, so F is one of many; a camera would tell more"
                )
            }
            Self::PureRotation { angle_deg: Some(angle) } => {
                format!("pure rotation: a turn of {angle:.2} degrees explains the matches, so there is no translation")
            }
            Self::PureRotation { angle_deg: None } => {
                "pure rotation, or a plane that looks like one: a turn of a usual camera explains the matches, so F is one of many; \
                 without --camera the two cannot be told apart"
                    .into()
            }
            Self::LowParallax { median_deg } => {
                format!("low parallax: {median_deg:.3} degrees in the median, the camera moved too little")
            }
            Self::Ambiguous => {
                "ambiguous: two motions explain the matches, as a plane allows; a third view would tell".into()
            }
            Self::NoPose { reason } => format!("no pose: {reason}"),
        }
    }
}

/// Everything that came out.
#[derive(Debug, Clone)]
pub struct TwoView {
    pub corners: [Corners; 2],
    /// Matches, with a guided round those of both.
    pub pairs: Vec<Pair>,
    /// How many of them the first matching gave.
    pub unguided: usize,
    /// Matches left out because their pixel has no undistorted place under the camera's model, or lies more than 50 degrees off the axis
    /// of a wide-angle lens.
    pub outside_lens: usize,
    /// Each match's places in undistorted pixels; the pictures' own pixels without cameras.
    pub ideal: Vec<[Vector2<f64>; 2]>,
    /// Whether `ideal` and F are in undistorted pixels.
    pub undistorted: bool,
    pub epipolar: Option<Epipolar>,
    pub pose: Option<PoseSteps>,
    pub outcome: Outcome,
    /// What came without tilted views, where it was tried again with them.
    pub first_try: Option<FirstTry>,
    /// Each step's name and milliseconds.
    pub times: Vec<(&'static str, f64)>,
}

impl TwoView {
    /// One a match: inlier of the pose if there is one, otherwise of F.
    pub fn inliers(&self) -> Vec<bool> {
        let pose = self.pose.as_ref().and_then(|p| p.solution.as_ref()).map(|s| s.inliers.clone());
        pose.or_else(|| self.epipolar.as_ref().map(|e| e.estimate.inliers.clone()))
            .unwrap_or_else(|| vec![false; self.pairs.len()])
    }

    /// The epipolar geometry at the chain's end, in the pixels of [`TwoView::ideal`]: that of the motion where there is one, otherwise
    /// that of the matches alone. Cameras leave five numbers open and not seven, so a hundredth of a pixel that the matches are
    /// wrong by, all in one part of a picture, bends it less.
    pub fn fundamental(&self) -> Option<Matrix3<f64>> {
        let solution = self.pose.as_ref().and_then(|p| p.solution.as_ref());
        solution.and_then(|s| s.fundamental).or_else(|| self.epipolar.as_ref().map(|e| e.estimate.fundamental))
    }

    /// Sampson distance of each match from [`Self::fundamental`], pixels; NaN for a pair of epipoles. Nothing without it.
    pub fn residuals_px(&self) -> Vec<f64> {
        let Some(f) = self.fundamental() else { return Vec::new() };
        self.ideal.iter().map(|[a, b]| sampson_squared(&f, a, b).sqrt()).collect()
    }

    /// Median of [`Self::residuals_px`] over the inliers, pixels; NaN without any.
    pub fn median_px(&self) -> f64 {
        let all = self.residuals_px();
        let mut of_inliers: Vec<f64> = all.iter().zip(&self.inliers()).filter(|(_, i)| **i).map(|(r, _)| *r).collect();
        median(&mut of_inliers)
    }

    /// Milliseconds of all steps.
    pub fn total_ms(&self) -> f64 {
        self.times.iter().map(|(_, ms)| ms).sum()
    }
}

/// Runs the chain.
pub fn reconstruct(first: &GreyImage, second: &GreyImage, cameras: Option<&Cameras>, options: &Options) -> TwoView {
    let views = if options.matching.matcher.knows_tilt() { options.views } else { Views::None };
    let mut chain = Chain::new();
    let mut corners = [detect(first, &options.detection), detect(second, &options.detection)];
    chain.done("corners");
    let identical = first == second;
    let few = corners.iter().any(|c| c.keypoints.len() < MIN_MATCHES);
    let tilt = |chain: &mut Chain, corners: &mut [Corners; 2]| {
        add_tilted(&mut corners[0], first, &options.detection);
        add_tilted(&mut corners[1], second, &options.detection);
        chain.done("tilted views");
    };
    if views == Views::Affine && !identical && !few {
        tilt(&mut chain, &mut corners);
    }
    let result = chain.after_corners(corners, identical, cameras, options);
    if views != Views::Auto || !views::wants_more(&result) {
        return result;
    }
    let mut chain = Chain::new();
    let mut corners = result.corners.clone();
    tilt(&mut chain, &mut corners);
    let again = chain.after_corners(corners, identical, cameras, options);
    views::better(result, again)
}

/// Estimates from matches that came from elsewhere (a file's), without pictures; `size_px` of each is its uncertainty.
pub fn reconstruct_from_pairs(pairs: Vec<Pair>, cameras: Option<&Cameras>, options: &Options) -> TwoView {
    let mut out = TwoView::of([Corners::default(), Corners::default()], pairs, cameras);
    let options = Options { guided: false, ..*options };
    let mut chain = Chain::new();
    let outcome = chain.continue_with_matches(&mut out, cameras, &options);
    TwoView { outcome, times: chain.times, ..out }
}

/// Undistorted pixel of a pixel; none where the plane of a wide-angle lens is stretched, as F and E weigh all places alike.
fn ideal_pixel(camera: &CameraModel, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
    let n = camera.undistort(pixel).filter(|n| camera.is_central(n))?;
    Some(Vector2::new(camera.fx * n.x + camera.cx, camera.fy * n.y + camera.cy))
}

impl TwoView {
    /// Corners and matches, with nothing estimated yet.
    fn of(corners: [Corners; 2], pairs: Vec<Pair>, cameras: Option<&Cameras>) -> Self {
        let mut out = Self {
            unguided: pairs.len(),
            corners,
            pairs,
            outside_lens: 0,
            ideal: Vec::new(),
            undistorted: cameras.is_some(),
            epipolar: None,
            pose: None,
            outcome: Outcome::IdenticalPictures,
            first_try: None,
            times: Vec::new(),
        };
        out.keep_undistortable(cameras);
        out
    }

    /// Drops the matches that the lens model does not reach and sets the places of the others.
    fn keep_undistortable(&mut self, cameras: Option<&Cameras>) {
        let ideal = |p: &Pair| match cameras {
            Some(c) => Some([ideal_pixel(&c.a, &p.a)?, ideal_pixel(&c.b, &p.b)?]),
            None => Some([p.a, p.b]),
        };
        let before = self.pairs.len();
        let kept: Vec<(Pair, [Vector2<f64>; 2])> =
            std::mem::take(&mut self.pairs).into_iter().filter_map(|p| ideal(&p).map(|i| (p, i))).collect();
        (self.pairs, self.ideal) = kept.into_iter().unzip();
        self.outside_lens += before - self.pairs.len();
    }
}

/// The chain's clock and the steps after detection.
struct Chain {
    times: Vec<(&'static str, f64)>,
    last: Instant,
}

impl Chain {
    fn new() -> Self {
        Self { times: Vec::new(), last: Instant::now() }
    }

    /// Notes the time since the last step's end.
    fn done(&mut self, step: &'static str) {
        let now = Instant::now();
        self.times.push((step, (now - self.last).as_secs_f64() * 1e3));
        self.last = now;
    }

    /// Everything from the corners on.
    fn after_corners(
        mut self,
        corners: [Corners; 2],
        identical: bool,
        cameras: Option<&Cameras>,
        options: &Options,
    ) -> TwoView {
        let pairs = pair_corners(&corners[0], &corners[1], &options.matching);
        self.done("matches");
        let mut out = TwoView::of(corners, pairs, cameras);
        let [first, second] = [&out.corners[0], &out.corners[1]].map(|c| c.keypoints.len());
        let outcome = if first.min(second) < MIN_MATCHES {
            Outcome::TooFewCorners { first, second }
        } else if identical {
            Outcome::IdenticalPictures
        } else {
            self.continue_with_matches(&mut out, cameras, options)
        };
        TwoView { outcome, times: self.times, ..out }
    }

    fn continue_with_matches(&mut self, out: &mut TwoView, cameras: Option<&Cameras>, options: &Options) -> Outcome {
        let matches = out.pairs.len();
        if matches < MIN_MATCHES {
            return Outcome::TooFewMatches { matches, needed: MIN_MATCHES };
        }
        out.epipolar = epipolar(out, options);
        self.done("fundamental matrix");
        if options.guided && out.epipolar.is_some() {
            self.guide(out, cameras, options);
        }
        let Some(cameras) = cameras else {
            return match out.epipolar.as_ref().map(|e| e.estimate.degeneracy) {
                None => Outcome::NoModel { matches },
                Some(Degeneracy::Plane { on_plane, .. }) => Outcome::Plane { on_plane },
                Some(Degeneracy::PureRotation { .. }) => Outcome::PureRotation { angle_deg: None },
                Some(_) => Outcome::FundamentalOnly,
            };
        };
        let steps = pose(out, cameras, options);
        self.done("pose and points");
        let outcome = outcome_of(&steps, out.pairs.len());
        out.pose = Some(steps);
        outcome
    }

    /// The guided round.
    fn guide(&mut self, out: &mut TwoView, cameras: Option<&Cameras>, options: &Options) {
        let Some(estimate) = out.epipolar.as_ref().map(|e| &e.estimate) else { return };
        // Lines that the matches left open would be confirmed by whatever was found along them.
        if matches!(estimate.degeneracy, Degeneracy::Plane { .. } | Degeneracy::PureRotation { .. }) {
            return;
        }
        let f = estimate.fundamental;
        let places = |corners: &Corners, camera: Option<&CameraModel>| -> Vec<Option<Vector2<f64>>> {
            let place = |p: &Vector2<f64>| camera.map_or(Some(*p), |c| ideal_pixel(c, p));
            corners.keypoints.iter().map(|k| place(&k.position)).collect()
        };
        let ideal = [places(&out.corners[0], cameras.map(|c| &c.a)), places(&out.corners[1], cameras.map(|c| &c.b))];
        let both = [&out.corners[0], &out.corners[1]];
        let band_px = 2.0 * LINE_SIGMAS * options.sigma_px;
        let places = [ideal[0].as_slice(), ideal[1].as_slice()];
        let mut found = match options.matching.matcher {
            Matcher::Descriptors => {
                match_along_lines(both, places, &f, &Guidance::descriptors(band_px), descriptor_distance(both))
            }
            Matcher::Gradients => {
                match_along_lines(both, places, &f, &Guidance::gradients(band_px), gradient_distance(both))
            }
            _ => Vec::new(),
        };
        align_pairs(both[0], both[1], &mut found);
        polish_pairs(both[0], both[1], &mut found);
        // A lens bends the lines; correlation follows straight ones.
        let straight = |c: &Cameras| [&c.a, &c.b].into_iter().all(|c| c.lens == LensModel::PINHOLE);
        if cameras.is_none_or(straight) {
            let along = correlate_along_lines(both, &f, &options.matching.correlation);
            // A place that stays where it was found, on the line, would confirm the line.
            let off_line = |mut pair: Pair| polish_pair(both[0], both[1], &mut pair).then_some(pair);
            found.extend(along.into_iter().filter_map(off_line));
        }
        // A corner that has a match keeps it unless that is no inlier.
        let inliers = out.inliers();
        let taken = |used: fn(&Pair) -> Option<usize>, count: usize| {
            let mut taken = vec![false; count];
            for (pair, inlier) in out.pairs.iter().zip(&inliers) {
                if let (true, Some(slot)) = (*inlier, used(pair).and_then(|i| taken.get_mut(i))) {
                    *slot = true;
                }
            }
            taken
        };
        let first = taken(|p| Some(p.first), ideal[0].len());
        let second = taken(|p| p.second, ideal[1].len());
        let mut first = first;
        let plain = out.corners[0].plain_count();
        let mut more = Vec::new();
        for pair in found {
            // The same corner may have been matched in a tilted view, where it has another number.
            let again = out.pairs.iter().zip(&inliers).any(|(p, inlier)| {
                let reach = f64::from(SAME_CORNER_PX) * p.size_px[0].max(pair.size_px[0]);
                *inlier && p.first >= plain && (p.a - pair.a).norm() <= reach
            });
            let free = !again && !first[pair.first] && pair.second.is_none_or(|j| !second[j]);
            if free && !out.pairs.iter().any(|p| p.first == pair.first && p.second == pair.second) {
                first[pair.first] = true;
                more.push(pair);
            }
        }
        let before = (out.pairs.clone(), out.ideal.clone(), out.epipolar.clone());
        out.pairs.extend(more);
        out.keep_undistortable(cameras);
        out.epipolar = epipolar(out, options);
        match (&mut out.epipolar, &before.2) {
            // What was looked for along lines is no evidence for them: the chance stays that of the first matching.
            (Some(now), Some(first)) if now.estimate.inlier_count >= first.estimate.inlier_count => {
                now.estimate.log10_false_alarms = first.estimate.log10_false_alarms;
            }
            _ => (out.pairs, out.ideal, out.epipolar) = before,
        }
        self.done("guided matches");
    }
}

fn pose(out: &TwoView, cameras: &Cameras, options: &Options) -> PoseSteps {
    let normalised = |camera: &CameraModel, p: &Vector2<f64>| {
        Vector2::new((p.x - camera.cx) / camera.fx, (p.y - camera.cy) / camera.fy)
    };
    let x1: Vec<_> = out.ideal.iter().map(|[a, _]| normalised(&cameras.a, a)).collect();
    let x2: Vec<_> = out.ideal.iter().map(|[_, b]| normalised(&cameras.b, b)).collect();
    let seen: Vec<Observation> = out
        .pairs
        .iter()
        .map(|p| Observation { a: p.a, b: p.b, sigma_px: p.size_px.map(|s| s * options.sigma_px) })
        .collect();
    let fundamental: Option<Matrix3<f64>> = out.epipolar.as_ref().map(|e| e.estimate.fundamental);
    pose_steps(&PoseInput {
        cameras: [&cameras.a, &cameras.b],
        x1: &x1,
        x2: &x2,
        seen: &seen,
        fundamental: fundamental.as_ref(),
        sigma_px: options.sigma_px,
        seed: options.seed,
        always_answer: options.always_answer,
    })
}

fn outcome_of(steps: &PoseSteps, matches: usize) -> Outcome {
    match &steps.judged {
        Ok(_) if steps.solution.is_some() => Outcome::Reconstructed,
        Ok(_) => Outcome::NoPose { reason: "the adjustment found no finite points".into() },
        Err(TwoViewFailure::Ambiguous { .. }) => Outcome::Ambiguous,
        Err(TwoViewFailure::NoModel) => Outcome::NoModel { matches },
        Err(TwoViewFailure::TooFewMatches { count, needed }) => {
            Outcome::TooFewMatches { matches: *count, needed: *needed }
        }
        Err(TwoViewFailure::PureRotation { angle_rad }) => {
            Outcome::PureRotation { angle_deg: Some(angle_rad.to_degrees()) }
        }
        Err(TwoViewFailure::LowParallax { median_rad, .. }) => {
            Outcome::LowParallax { median_deg: median_rad.to_degrees() }
        }
        Err(other) => Outcome::NoPose { reason: other.to_string() },
    }
}
