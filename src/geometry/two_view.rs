//! A first map from two views: relative pose and points, or the reason why there is none.
//!
//! Matched points, undistorted and normalised -> `second_from_first` with unit translation, points in the first camera's
//! coordinates (unit: the baseline), inliers, parallax, votes.
//! 1. An essential matrix and a homography are estimated side by side, and the best rotation alone.
//! 2. The rotation explains the matches: standing still or turning on the spot, no map.
//! 3. Scores of both models, truncated chi-square over both pictures (Mur-Artal, Montiel, Tardos: ORB-SLAM, 2015, eq.
//!    2-3); `S_H / (S_H + S_E) > 0.45` chooses the homography: a plane, or little parallax.
//! 4. Every motion of both models is refined over the matches that agree with it: near their epipolar line, and in front
//!    of both cameras or too far for that to show. The one with most support must have enough points at enough parallax,
//!    and stand out from the runner-up: two motions that are about as good, as a plane allows, are both returned, for a
//!    third view to choose.
//!
//! Cost: about 4 ms for 300 matches. Not here: full adjustment (the caller's), more than two views.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::Se3;
use super::epipolar::{line_distances_squared, sampson_squared};
use super::essential::{EssentialOptions, decompose, essential_of, estimate_essential, refine_motion};
use super::frames::{First, Second};
use super::homography::{TwoWay, apply, estimate_homography};
use super::homography_decomposition::{PlaneMotions, decompose_homography};
use super::least_squares::{LmOptions, Loss};
use super::point_set::all_finite;
use super::ransac::{RansacOptions, Workspace};
use super::rotation::estimate_rotation;
use super::statistics::median;
use super::triangulation::{intersect, nearest_match};

/// 95 % points of chi-square with one and with two degrees of freedom.
const CHI2_LINE: f64 = 3.84;
const CHI2_POINT: f64 = 5.99;
/// Motions closer than this, radians of rotation plus radians between the translations, are one and the same.
const SAME_MOTION: f64 = 0.1;

/// How [`reconstruct_two_views`] works.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoViewOptions {
    /// Standard deviation of a point in one picture, normalised units (pixels / focal length).
    pub sigma: f64,
    /// Fewer matches are not tried.
    pub min_matches: usize,
    /// Points in front of both cameras at `min_parallax_rad` or more.
    pub min_points: usize,
    pub min_parallax_rad: f64,
    /// Share of the matches of the best model that a rotation alone must leave unexplained.
    pub min_off_rotation: f64,
    /// `S_H / (S_H + S_E)` above which the scene counts as a plane.
    pub homography_ratio: f64,
    /// A runner-up with a larger share of the winner's votes (points in front of both cameras) *and* of its support
    /// (how many matches fit, and how well) makes the pair ambiguous.
    pub max_runner_up_votes: f64,
    pub max_runner_up_support: f64,
    /// Cameras that turned farther than this are not believed: they hardly share a view, but false matches often agree on
    /// a half turn.
    pub max_rotation_rad: f64,
    pub confidence: f64,
    pub max_iterations: usize,
    pub seed: u64,
}

impl TwoViewOptions {
    /// The usual settings of a video's first map; `sigma_px` is about 1, less for sub-pixel tracks.
    pub fn new(sigma_px: f64, focal_px: f64) -> Self {
        Self {
            sigma: sigma_px / focal_px,
            min_matches: 60,
            min_points: 50,
            min_parallax_rad: 1f64.to_radians(),
            min_off_rotation: 0.1,
            homography_ratio: 0.45,
            max_runner_up_votes: 0.75,
            max_runner_up_support: 0.95,
            max_rotation_rad: std::f64::consts::FRAC_PI_2,
            confidence: 0.9999,
            max_iterations: 2000,
            seed: 1,
        }
    }

    /// The settings for one pair of pictures that a person chose, down to a dozen matches.
    pub fn single_pair(sigma_px: f64, focal_px: f64) -> Self {
        Self {
            min_matches: 10,
            min_points: 8,
            min_parallax_rad: 0.5f64.to_radians(),
            max_iterations: 10_000,
            ..Self::new(sigma_px, focal_px)
        }
    }
}

/// Which model fits the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TwoViewModel {
    /// Depth in the scene.
    Essential,
    /// A plane.
    Homography,
}

/// Pose and points of two views.
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewReconstruction {
    /// Translation of unit length.
    pub second_from_first: Se3<Second, First>,
    /// One a match, in the first camera's coordinates; `None` for outliers and points too far to be placed.
    pub points: Vec<Option<Vector3<f64>>>,
    pub model: TwoViewModel,
    /// One a match: agrees with the motion (in front of both cameras, or too far for that to show).
    pub inliers: Vec<bool>,
    pub inlier_count: usize,
    /// Matches with a point.
    pub votes: usize,
    /// The same for the best other motion.
    pub votes_runner_up: usize,
    /// Median angle between the two rays of a point, radians.
    pub median_parallax_rad: f64,
    /// Points at `min_parallax_rad` or more.
    pub wide_points: usize,
    /// S_H / (S_H + S_E).
    pub homography_ratio: f64,
}

/// Why two views give no map.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TwoViewFailure {
    #[error("{count} matches: at least {needed} are needed")]
    TooFewMatches { count: usize, needed: usize },
    #[error("{first} points in the first picture and {second} in the second: every point needs a partner")]
    LengthMismatch { first: usize, second: usize },
    #[error("a coordinate is not a finite number")]
    NotFinite,
    #[error("no motion explains the matches")]
    NoModel,
    /// The camera turned and did not move.
    #[error("a rotation of {angle_rad:.4} rad alone explains the matches")]
    PureRotation { angle_rad: f64 },
    /// The camera stood still, or moved too little for the distance of the scene.
    #[error("{wide_points} points with enough parallax, median {median_rad:.5} rad: the camera moved too little")]
    LowParallax { median_rad: f64, wide_points: usize },
    #[error("{count} points in front of both cameras: at least {needed} are needed")]
    TooFewPoints { count: usize, needed: usize },
    /// Two motions explain the matches about equally well, as a plane allows: a third view must choose.
    #[error("two motions explain the matches: {} and {} votes", best.votes, runner_up.votes)]
    Ambiguous { best: Box<TwoViewReconstruction>, runner_up: Box<TwoViewReconstruction> },
}

/// Pose and points of two views, or why not.
pub fn reconstruct_two_views(
    x1: &[Vector2<f64>],
    x2: &[Vector2<f64>],
    options: &TwoViewOptions,
) -> Result<TwoViewReconstruction, TwoViewFailure> {
    let count = x1.len();
    if count != x2.len() {
        return Err(TwoViewFailure::LengthMismatch { first: count, second: x2.len() });
    }
    if !all_finite(x1) || !all_finite(x2) {
        return Err(TwoViewFailure::NotFinite);
    }
    if count < options.min_matches.max(5) {
        return Err(TwoViewFailure::TooFewMatches { count, needed: options.min_matches.max(5) });
    }
    let views = Views { x1, x2, options };
    let ransac = RansacOptions {
        confidence: options.confidence,
        max_iterations: options.max_iterations,
        seed: options.seed,
        ..RansacOptions::new(CHI2_LINE.sqrt() * options.sigma)
    };
    // A transfer error has two dimensions, and the noise of both pictures.
    let transfer = RansacOptions { threshold: (2.0 * CHI2_POINT).sqrt() * options.sigma, ..ransac };
    // A scene of depth has none: then the search runs to its end, which need not be far.
    let plane_search = RansacOptions { max_iterations: options.max_iterations.min(600), ..transfer };
    let plane = estimate_homography(x1, x2, &plane_search);
    let essential_options = EssentialOptions { ransac, min_off_rotation: options.min_off_rotation };
    let essential = estimate_essential(x1, x2, &essential_options);

    let explained = plane.as_ref().map_or(0, |p| p.inlier_count).max(essential.as_ref().map_or(0, |e| e.inlier_count));
    views.reject_rotation(&transfer, explained)?;
    let plane = plane.and_then(|p| TwoWay::new(&p.homography));
    let score_h = plane.as_ref().map_or(0.0, |h| views.score_homography(h));
    let score_e = essential.as_ref().map_or(0.0, |e| views.score_essential(&e.essential));
    // No model at all makes this NaN.
    let ratio = score_h / (score_h + score_e);
    if ratio.is_nan() {
        return Err(TwoViewFailure::NoModel);
    }

    let model = if ratio > options.homography_ratio { TwoViewModel::Homography } else { TwoViewModel::Essential };
    // The motions of both models stand: a plane has a second motion that holds its points as well, and the search for
    // the essential matrix may have ended in it.
    let mut motions: Vec<Se3<Second, First>> = Vec::new();
    if let Some(PlaneMotions::Four(four)) = plane.and_then(|h| decompose_homography(&h.forward, 1e-9)) {
        motions.extend(four.iter().map(|m| Se3::new(m.rotation, m.translation.normalize())));
    }
    if let Some(parts) = essential.as_ref().and_then(|e| decompose(&e.essential)) {
        motions.extend(parts.candidates);
    }
    motions.retain(|m| m.rotation.angle() <= options.max_rotation_rad);
    views.choose(&motions, model, ratio)
}

/// What a motion makes of the matches.
struct Tally {
    motion: Se3<Second, First>,
    points: Vec<Option<Vector3<f64>>>,
    inliers: Vec<bool>,
    votes: usize,
    /// `sum 1 - r² / limit` over the inliers: how many there are and how well they fit.
    support: f64,
    parallax: Vec<f64>,
}

struct Views<'a> {
    x1: &'a [Vector2<f64>],
    x2: &'a [Vector2<f64>],
    options: &'a TwoViewOptions,
}

impl Views<'_> {
    fn matches(&self) -> impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone {
        self.x1.iter().copied().zip(self.x2.iter().copied())
    }

    /// An error when a rotation explains (nearly) as many matches as the best model does.
    fn reject_rotation(&self, transfer: &RansacOptions, explained: usize) -> Result<(), TwoViewFailure> {
        let options = RansacOptions { max_iterations: 300, ..*transfer };
        let Some(found) = estimate_rotation(self.x1, self.x2, &options, &mut Workspace::default()) else {
            return Ok(());
        };
        let allowed = explained as f64 * (1.0 - self.options.min_off_rotation);
        if explained > 0 && (found.inlier_count as f64) < allowed {
            return Ok(());
        }
        let angle_rad = (0.5 * (found.model.trace() - 1.0)).clamp(-1.0, 1.0).acos();
        // Did the pictures turn at all?
        let mut flow: Vec<f64> =
            self.matches().map(|(a, b)| (apply(&found.model, &a) - a).norm().max((b - a).norm())).collect();
        if median(&mut flow).unwrap_or(0.0) > options.threshold {
            return Err(TwoViewFailure::PureRotation { angle_rad });
        }
        let mut parallax: Vec<f64> =
            self.matches().map(|(a, b)| (found.model * a.push(1.0)).angle(&b.push(1.0))).collect();
        Err(TwoViewFailure::LowParallax { median_rad: median(&mut parallax).unwrap_or(0.0), wide_points: 0 })
    }

    /// Inverse variance of ORB-SLAM's scores. A distance carries the noise of both pictures, 2 sigma²; twice that, because
    /// with the exact variance a perfect plane would score (5.99 - 2) / (5.99 - 2 + 5.99 - 1) = 0.444 and lose.
    fn score_scale(&self) -> f64 {
        0.25 / (self.options.sigma * self.options.sigma)
    }

    /// ORB-SLAM's score: what is left of chi-square's limit, over both pictures.
    fn score_homography(&self, h: &TwoWay) -> f64 {
        let scale = self.score_scale();
        let kept = |d: f64| if d * scale < CHI2_POINT { CHI2_POINT - d * scale } else { 0.0 };
        self.matches().map(|(a, b)| h.transfer_squared(&a, &b)).map(|(d1, d2)| kept(d1) + kept(d2)).sum()
    }

    fn score_essential(&self, e: &Matrix3<f64>) -> f64 {
        let scale = self.score_scale();
        let kept = |d: f64| if d * scale < CHI2_LINE { CHI2_POINT - d * scale } else { 0.0 };
        self.matches().map(|(a, b)| line_distances_squared(e, &a, &b)).map(|(d1, d2)| kept(d1) + kept(d2)).sum()
    }

    /// Points of the matches that the motion explains.
    fn tally(&self, motion: &Se3<Second, First>) -> Tally {
        let e = essential_of(motion);
        let limit = CHI2_LINE * self.options.sigma * self.options.sigma;
        // Below three sigma of the angle the depth's sign is noise.
        let far = 3.0 * std::f64::consts::SQRT_2 * self.options.sigma;
        let count = self.x1.len();
        let mut tally = Tally {
            motion: *motion,
            points: vec![None; count],
            inliers: vec![false; count],
            votes: 0,
            support: 0.0,
            parallax: vec![],
        };
        for (i, (x1, x2)) in self.matches().enumerate() {
            let squared = sampson_squared(&e, &x1, &x2);
            // Written so that NaN fails.
            if !(squared <= limit) {
                continue;
            }
            let met = nearest_match(&e, &x1, &x2).and_then(|(y1, y2)| intersect(motion, &y1, &y2));
            match met.filter(|m| m.parallax_rad > far) {
                Some(met) if met.depth1 > 0.0 && met.depth2 > 0.0 => {
                    tally.points[i] = Some(met.point);
                    tally.votes += 1;
                    tally.parallax.push(met.parallax_rad);
                }
                // Behind a camera.
                Some(_) => continue,
                // Too far to be placed.
                None => {}
            }
            tally.inliers[i] = true;
            tally.support += 1.0 - squared / limit;
        }
        tally
    }

    /// The motion refined over the matches that agree with it.
    fn refined(&self, tally: Tally) -> Tally {
        let agreeing = tally.inliers.iter().zip(self.matches()).filter(|(i, _)| **i).map(|(_, m)| m);
        let loss = Loss::Cauchy(2.0 * CHI2_LINE.sqrt() * self.options.sigma);
        let better = refine_motion(&tally.motion, agreeing, loss, &LmOptions::default()).map(|m| self.tally(&m));
        better.filter(|b| b.support > tally.support).unwrap_or(tally)
    }

    /// The motion with most support, if it stands out.
    fn choose(
        &self,
        motions: &[Se3<Second, First>],
        model: TwoViewModel,
        homography_ratio: f64,
    ) -> Result<TwoViewReconstruction, TwoViewFailure> {
        let rank = |tallies: &mut Vec<Tally>| tallies.sort_by(|a, b| b.support.total_cmp(&a.support));
        let mut tallies: Vec<Tally> = motions.iter().map(|m| self.tally(m)).collect();
        rank(&mut tallies);
        // Only motions near the best can still win.
        let most = tallies.first().map_or(0.0, |t| t.support);
        let refine = |t: Tally| if 2.0 * t.support >= most { self.refined(self.refined(t)) } else { t };
        let mut tallies: Vec<Tally> = tallies.into_iter().map(refine).collect();
        rank(&mut tallies);
        let mut rest = tallies.into_iter();
        let best = rest.next().ok_or(TwoViewFailure::NoModel)?;
        let runner_up = rest.find(|t| difference(&t.motion, &best.motion) > SAME_MOTION);
        let runner_up_votes = runner_up.as_ref().map_or(0, |t| t.votes);
        let ratios =
            runner_up.as_ref().map_or((0.0, 0.0), |t| (t.votes as f64 / best.votes as f64, t.support / best.support));

        let finish = |t: Tally, other: usize| {
            let mut parallax = t.parallax;
            TwoViewReconstruction {
                second_from_first: t.motion,
                points: t.points,
                model,
                inlier_count: t.inliers.iter().filter(|i| **i).count(),
                inliers: t.inliers,
                votes: t.votes,
                votes_runner_up: other,
                wide_points: parallax.iter().filter(|p| **p >= self.options.min_parallax_rad).count(),
                median_parallax_rad: median(&mut parallax).unwrap_or(0.0),
                homography_ratio,
            }
        };
        let votes = best.votes;
        let best = finish(best, runner_up_votes);
        let needed = self.options.min_points;
        if best.wide_points < needed {
            // Too few points of any parallax, or too little parallax of enough points.
            return Err(if best.inlier_count < needed {
                TwoViewFailure::TooFewPoints { count: best.inlier_count, needed }
            } else {
                TwoViewFailure::LowParallax { median_rad: best.median_parallax_rad, wide_points: best.wide_points }
            });
        }
        match runner_up {
            Some(other)
                if ratios.0 > self.options.max_runner_up_votes && ratios.1 > self.options.max_runner_up_support =>
            {
                Err(TwoViewFailure::Ambiguous { best: Box::new(best), runner_up: Box::new(finish(other, votes)) })
            }
            _ => Ok(best),
        }
    }
}

/// Angle between the rotations plus angle between the translations, radians.
fn difference(a: &Se3<Second, First>, b: &Se3<Second, First>) -> f64 {
    a.rotation.angle_to(&b.rotation) + a.translation.angle(&b.translation)
}

#[cfg(test)]
mod tests;
