//! Matches that a simpler model (a plane, a turn) does not explain: do they stand for an epipolar geometry, or are they only placed badly?
//!
//! Of each match its squared distance from F and how far it is from where the simpler model puts it, in one unit -> whether those beside the
//! model agree with F more often than by chance ([`any_cut_stands_out`]). A match beside it need not be a stranger: displaced by
//! d in any direction from a true place, it is near a given line through that place far more often than a stranger is ([`chance_displaced`]).
//!
//! Cost: one pass a cut. It deliberately does not do: finding the plane, the turn or F.

use super::point_set::chance_displaced;
use super::ransac::{self, Estimator, RansacOptions, Workspace};

/// A match as it is judged.
#[derive(Debug, Clone, Copy)]
pub(super) struct Displaced {
    /// Squared distance from F.
    pub residual_squared: f64,
    /// How far from where the simpler model puts it.
    pub distance: f64,
}

/// Matches beside the model, for the count of false alarms.
struct Beside {
    matches: Vec<Displaced>,
    /// Chance of a match that has nothing to do with the scene.
    stranger: f64,
}

impl Estimator for Beside {
    type Model = ();
    /// Beyond the simpler model an F has its epipole: two matches.
    const SAMPLE_SIZE: usize = 2;

    fn data_count(&self) -> usize {
        self.matches.len()
    }

    fn solve_minimal(&self, _: &[usize], _: &mut Vec<()>) {}

    fn residual_squared(&self, (): &(), i: usize) -> f64 {
        self.matches[i].residual_squared
    }

    fn refit(&self, (): &(), _: &[usize]) -> Option<()> {
        None
    }

    /// Chances that are not alike are taken for their mean: their elementary symmetric mean is below its power (Maclaurin).
    fn chance(&self, threshold: f64) -> f64 {
        let chance = |m: &Displaced| chance_displaced(m.distance, threshold).max(self.stranger);
        let sum: f64 = self.matches.iter().map(chance).sum();
        if self.matches.is_empty() { 1.0 } else { sum / self.matches.len() as f64 }
    }
}

/// Do the matches that are farther than one of the `cuts` agree with F more often than chance has it? Near ones agree by chance so often that
/// they can hide what the farther ones say, so each cut is a trial of its own, and is charged as one. `stranger`: the chance of a match
/// that has nothing to do with the scene.
pub(super) fn any_cut_stands_out(
    matches: impl Iterator<Item = Displaced> + Clone,
    cuts: [f64; 3],
    stranger: f64,
    options: &RansacOptions,
) -> bool {
    let trials = (cuts.len() as f64).log10();
    let max_log10_false_alarms = options.max_log10_false_alarms - trials;
    let options = RansacOptions { max_log10_false_alarms, least_share: 1.0, ..*options };
    let mut workspace = Workspace::default();
    cuts.iter().any(|cut| {
        let beside = Beside { matches: matches.clone().filter(|m| m.distance > *cut).collect(), stranger };
        ransac::judge(&beside, &(), &options, &mut workspace).is_some()
    })
}
