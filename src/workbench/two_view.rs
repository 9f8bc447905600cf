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
mod result;
#[cfg(test)]
mod tests;
mod turn;
mod views;

use std::time::Instant;

use nalgebra::{Matrix3, Vector2};

use self::epipolar::epipolar;
pub use self::result::{Cameras, Epipolar, FirstTry, MIN_MATCHES, Options, Outcome, TwoView, Views};
use super::adjustment::Observation;
use super::detect::{Corners, add_tilted, detect};
use super::guided::{Guidance, correlate_along_lines, descriptor_distance, gradient_distance, match_along_lines};
use super::pairing::{Matcher, Pair, align_pairs, pair_corners, polish_pair, polish_pairs};
use super::pose::{LINE_SIGMAS, PoseInput, PoseSteps, pose_steps};
use crate::features::matching::SAME_CORNER_PX;
use crate::geometry::LensModel;
use crate::geometry::camera_model::CameraModel;
use crate::geometry::fundamental::Degeneracy;
use crate::geometry::two_view::TwoViewFailure;
use crate::image::GreyImage;

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
