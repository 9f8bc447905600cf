//! Detectors and matchers compared on pairs of pictures: the study's last aim.
//!
//! Input: [`Task`]s ([`pairs`]) and the ways to compare. Output: a [`Comparison`]: a [`Score`] for every way on every pair, and a
//! [`Summary`] for each way; as Markdown ([`table`]) and JSON. No data set is known by name; what a pair can tell is what its files
//! hold. Cost: the chain's, once for each way and pair.

pub mod mat5;
pub mod pairs;
pub mod score;
pub mod table;

use serde::Serialize;

use super::detect::{Detection, Detector};
use super::pairing::{Matcher, Matching, Pair};
use super::picture::{Picture, PictureError};
use super::pose::median;
use super::two_view::{Options, Views, reconstruct, reconstruct_from_pairs};
pub use pairs::{SequenceRule, Task};
pub use score::Score;

/// A pose is right within these errors, degrees: of the rotation, and of the translation's direction.
pub const RIGHT_DEG: (f64, f64) = (5.0, 10.0);

/// What is compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub detectors: Vec<Detector>,
    pub matchers: Vec<Matcher>,
    /// `None`: the matcher's own.
    pub scales: Option<usize>,
    pub max_corners: usize,
    pub sigma_px: f64,
    pub guided: bool,
    pub views: Views,
    pub seed: u64,
    /// As a program that always answers would: the best motion found, even where it is no better than chance.
    pub always_answer: bool,
}

/// One way over all pairs. Medians are over the pairs that the figure exists for; errors count a pair without a pose as 180
/// degrees.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    pub detector: Detector,
    pub matcher: Matcher,
    pub pairs: usize,
    pub corners: f64,
    pub repeatability: Option<f64>,
    pub matches: f64,
    pub correct: Option<f64>,
    /// Correct / matches, median.
    pub precision: Option<f64>,
    pub inlier_share: Option<f64>,
    /// Pairs with a model or pose, of all.
    pub with_model: usize,
    /// Pairs whose pose is right, of those that could have one.
    pub right: Option<(usize, usize)>,
    pub rotation_error_deg: Option<f64>,
    pub direction_error_deg: Option<f64>,
    pub annotated_px: Option<f64>,
    pub corners_ms: f64,
    pub total_ms: f64,
}

/// Everything.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    pub summaries: Vec<Summary>,
    pub scores: Vec<Score>,
}

impl Plan {
    fn options(&self, detector: Detector, matcher: Matcher) -> Options {
        Options {
            detection: Detection {
                detector,
                scales: self.scales.unwrap_or(matcher.default_scales()),
                max_corners: self.max_corners,
            },
            matching: Matching::new(matcher),
            views: self.views,
            sigma_px: self.sigma_px,
            guided: self.guided,
            seed: self.seed,
            always_answer: self.always_answer,
        }
    }
}

/// Runs every way on every pair; `progress` hears of each pair.
pub fn compare(
    tasks: &[Task],
    plan: &Plan,
    mut progress: impl FnMut(usize, &Task),
) -> Result<Comparison, PictureError> {
    let mut scores = Vec::new();
    for (index, task) in tasks.iter().enumerate() {
        progress(index, task);
        let first = Picture::load(&task.first)?;
        let second = Picture::load(&task.second)?;
        let sizes = [&first, &second].map(|p| (p.grey.width, p.grey.height));
        for detector in &plan.detectors {
            for matcher in &plan.matchers {
                let options = plan.options(*detector, *matcher);
                let result = reconstruct(&first.grey, &second.grey, task.cameras.as_ref(), &options);
                scores.push(score::score(task, Some((*detector, *matcher)), &result, sizes));
            }
        }
        if !task.listed.is_empty() {
            let options = plan.options(Detector::Fast, Matcher::Descriptors);
            let pairs = task.listed.iter().enumerate().map(|(i, [a, b])| Pair::given(i, *a, *b)).collect();
            let result = reconstruct_from_pairs(pairs, task.cameras.as_ref(), &options);
            scores.push(score::score(task, None, &result, sizes));
        }
    }
    let mut summaries = Vec::new();
    for detector in &plan.detectors {
        for matcher in &plan.matchers {
            let own: Vec<&Score> =
                scores.iter().filter(|s| s.detector == Some(*detector) && s.matcher == Some(*matcher)).collect();
            summaries.push(summary(*detector, *matcher, &own));
        }
    }
    Ok(Comparison { summaries, scores })
}

fn summary(detector: Detector, matcher: Matcher, scores: &[&Score]) -> Summary {
    let middle = |value: &dyn Fn(&Score) -> Option<f64>| {
        let mut all: Vec<f64> = scores.iter().filter_map(|s| value(s)).filter(|v| v.is_finite()).collect();
        (!all.is_empty()).then(|| median(&mut all))
    };
    let known = |value: &dyn Fn(&Score) -> Option<f64>| middle(value).unwrap_or(0.0);
    let possible = scores.iter().filter(|s| s.wants_pose).count();
    let right = |s: &&&Score| {
        s.rotation_error_deg.is_some_and(|r| r <= RIGHT_DEG.0)
            && s.direction_error_deg.is_some_and(|d| d <= RIGHT_DEG.1)
    };
    let with_missing = |value: Option<f64>, s: &Score| s.wants_pose.then(|| value.unwrap_or(180.0));
    Summary {
        detector,
        matcher,
        pairs: scores.len(),
        corners: known(&|s| Some(0.5 * (s.corners[0] + s.corners[1]) as f64)),
        repeatability: middle(&|s| s.repeatability),
        matches: known(&|s| Some(s.matches as f64)),
        correct: middle(&|s| s.correct.map(|c| c as f64)),
        precision: middle(&|s| s.correct.filter(|_| s.matches > 0).map(|c| c as f64 / s.matches as f64)),
        inlier_share: middle(&|s| s.inlier_share),
        with_model: scores.iter().filter(|s| s.inlier_share.is_some()).count(),
        right: (possible > 0).then(|| (scores.iter().filter(right).count(), possible)),
        rotation_error_deg: middle(&|s| with_missing(s.rotation_error_deg, s)),
        direction_error_deg: middle(&|s| with_missing(s.direction_error_deg, s)),
        annotated_px: middle(&|s| s.annotated_px),
        corners_ms: known(&|s| Some(s.corners_ms)),
        total_ms: known(&|s| Some(s.total_ms)),
    }
}
