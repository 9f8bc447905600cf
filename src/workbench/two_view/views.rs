//! When tilted views are simulated, and which of two tries counts.
//!
//! Input: what the pictures gave as they are. Output: whether to try again with tilted views of both ([`add_tilted`]), and the try that has
//! more to say. Where a surface is seen at slants that differ by more than 40 degrees or so, descriptors no longer agree; where it is not, views
//! only cost time. So by default they are for the pairs that end without a model, or with one that few matches stand for.
//! Cost: a picture of 640x480 has nine views, 6000 to 10000 corners; a pair 2 to 4 s with histograms of gradients, 0.5 s with binary descriptors.
//!
//! Deliberately not here: the views themselves (`scales`), matching them (`pairing`).

use super::result::{FirstTry, Outcome, TwoView};

/// Models that fewer matches stand for are looked for again: four for each number of F.
const FEW_INLIERS: usize = 30;

/// Is more wanted than the pictures as they are gave?
pub(super) fn wants_more(result: &TwoView) -> bool {
    match result.outcome {
        Outcome::TooFewMatches { .. } | Outcome::NoModel { .. } | Outcome::NoPose { .. } => true,
        _ if result.outcome.is_success() => support(result) < FEW_INLIERS,
        // Nothing that views could help with; what a plane leaves open, the less exact places of views would close wrongly.
        _ => false,
    }
}

/// A success before what is none, then what more inliers of a model stand for; of equals that with views. Its corners' time is the first
/// try's, who found them; what else the other try took is a step of its own.
pub(super) fn better(first: TwoView, second: TwoView) -> TwoView {
    let rank = |r: &TwoView| (r.outcome.is_success(), support(r));
    let kept = rank(&first) > rank(&second);
    let [matches, inliers] = [first.pairs.len(), inliers(&first)];
    let first_try = FirstTry { outcome: first.outcome.clone(), matches, inliers, kept };
    let mut out = if kept {
        let mut out = first;
        out.times.push(("with tilted views", second.total_ms()));
        out
    } else {
        let corners = first.times.iter().find(|(step, _)| *step == "corners").copied();
        let spent = ("without tilted views", first.total_ms() - corners.map_or(0.0, |c| c.1));
        let mut out = second;
        out.times.splice(0..0, corners.into_iter().chain([spent]));
        out
    };
    out.first_try = Some(first_try);
    out
}

fn inliers(result: &TwoView) -> usize {
    result.inliers().iter().filter(|i| **i).count()
}

/// Inliers of a model; none where nothing stands out from chance.
fn support(result: &TwoView) -> usize {
    match result.outcome {
        Outcome::IdenticalPictures
        | Outcome::TooFewCorners { .. }
        | Outcome::TooFewMatches { .. }
        | Outcome::NoModel { .. }
        | Outcome::NoPose { .. } => 0,
        _ => inliers(result),
    }
}
