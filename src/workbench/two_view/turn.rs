//! Without a camera: did it only turn?
//!
//! Input: the matches, in the pictures' own pixels, and the F that was found. Output: the homography of a turn that leaves F nothing to
//! explain, and how many matches are on it; nothing where F says more than that.
//! Two things must hold. The flow that a turn with an unknown lens and shutter (`geometry::unknown_turn`) leaves of F's inliers is in the median
//! below what a corner is uncertain by. And those beside it agree with F no more often than badly placed ones would. A repeated texture is
//! matched a period off, along F's lines where it is a row: so a match whose patch is found again where the turn puts it is no witness,
//! nor is one that the turn puts outside of the picture.
//!
//! Cost: 20 ms, and 20 us a match beside the turn. Not here: turns where the camera is known (`geometry::two_view`).

use nalgebra::{Matrix2, Matrix3, Vector2};

use super::result::{Options, TwoView};
use crate::geometry::fundamental::FundamentalEstimate;
use crate::geometry::ransac::RansacOptions;
use crate::geometry::unknown_turn::{UnknownTurn, fit_unknown_turn, shows_parallax};
use crate::workbench::pairing::Pair;
use crate::workbench::polish::likeness;
use crate::workbench::pose::{LINE_SIGMAS, median};

/// Largest median flow that a turn may leave, sigmas of a corner's place. Turns leave up to 0.55 through usual lenses and shutters; motions with
/// a parallax of a degree or more that depth does not show leave more than 0.7.
const MAX_LEFT_SIGMAS: f64 = 0.6;
/// A patch is found again with this share of the correlation that it was matched with: a match is where its patch fits best.
const ENOUGH: f64 = 0.9;
/// Places are searched so far around, pixels of the scale.
const NEAR_PX: f64 = 1.5;
/// The fit's noise is not taken for less, pixels: lens and shutter are known to no more.
const MIN_FIT_PX: f64 = 0.2;

/// See the module. `middle` of both pictures; `limit_px`: that of an inlier of F.
pub(super) fn turn_of_unknown_camera(
    out: &TwoView,
    estimate: &FundamentalEstimate,
    middle: Vector2<f64>,
    (noise_px, limit_px): (f64, f64),
    options: &Options,
) -> Option<(Matrix3<f64>, usize)> {
    let matches: Vec<_> = out.ideal.iter().map(|[a, b]| (*a, *b)).collect();
    let inliers: Vec<_> = matches.iter().zip(&estimate.inliers).filter(|(_, i)| **i).map(|(m, _)| *m).collect();
    let turn = fit_unknown_turn(&inliers, middle, middle.amax() + 0.5, noise_px.min(options.sigma_px).max(MIN_FIT_PX))?;
    let mut left: Vec<f64> = inliers.iter().map(|(a, b)| turn.displacement(a, b)).collect();
    // Written so that NaN fails.
    if !(median(&mut left) <= MAX_LEFT_SIGMAS * options.sigma_px) {
        return None;
    }
    // As a match on a plane: a transfer error has two dimensions and the noise of both pictures.
    let least = 2.0 * LINE_SIGMAS * options.sigma_px;
    let on_turn = left.iter().filter(|d| **d <= least).count();
    let distances: Vec<f64> = matches
        .iter()
        .zip(&out.pairs)
        .map(|((a, b), pair)| {
            let distance = turn.displacement(a, b);
            if distance > least && is_found_again(out, pair, &turn) { 0.0 } else { distance }
        })
        .collect();
    let rule = RansacOptions::thorough(limit_px);
    (!shows_parallax(&estimate.fundamental, &matches, &distances, least, &rule)).then(|| (turn.homography(), on_turn))
}

/// Is the patch of a match as good as where it was matched also where the turn puts it, for all that can be seen?
fn is_found_again(out: &TwoView, pair: &Pair, turn: &UnknownTurn) -> bool {
    let found = || {
        let [first, second] = &out.corners;
        let own = first.keypoints.get(pair.first)?.size_px;
        let size_px = own.max(pair.second.and_then(|j| second.keypoints.get(j)).map_or(own, |k| k.size_px));
        let (from, to) = (first.nearest_scale(size_px)?, second.nearest_scale(size_px)?);
        let place = |a: Vector2<f64>| turn.place(&a, &pair.b);
        let there = place(pair.a)?;
        let map =
            Matrix2::from_columns(&[place(pair.a + Vector2::x())? - there, place(pair.a + Vector2::y())? - there]);
        let alike = |b: &Vector2<f64>| likeness(&from.image, &to.image, &from.local(&pair.a), &to.local(b), &map);
        // Where a search may have gone half the way to the match, the two places are one.
        let apart = (there - pair.b).norm() > 2.0 * NEAR_PX * to.size_px();
        // What the turn puts outside of the picture cannot be asked.
        let Some(again) = alike(&there) else { return Some(true) };
        Some(apart && again >= ENOUGH * alike(&pair.b)?)
    };
    found().unwrap_or(false)
}
