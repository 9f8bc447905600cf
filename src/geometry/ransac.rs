//! The one robust loop: every model of this room is estimated by it.
//!
//! Data with outliers -> model, inlier mask, statistics; `None` when no model stands out from chance.
//! - Random samples without replacement (Fischler & Bolles 1981) from a seeded generator.
//! - MSAC score (Torr & Zisserman 2000): `sum min(r² / T², 1)`, lower is better, and its evaluation stops as soon as it
//!   is worse than the best; where the data's noise is not one, averaged over thresholds ([`Cost`]). Each new best is locally
//!   optimised (Chum, Matas, Kittler 2003) by the estimator's non-minimal refit. With many models of nearly equal score several
//!   searches are run and their refined models compared.
//! - Stops when a sample better than the best would have been found with the asked confidence; bounded by
//!   `max_iterations` whatever the data.
//! - A model is told from an accident by its expected number of false alarms (Moisan & Stival 2004), the least of those at the
//!   thresholds of its cost: the chance that random data contain any model with as many inliers. So pure noise gives `None`,
//!   however good its best fit looks.
//!
//! The [`Workspace`] keeps every buffer: a warm one allocates nothing. Residuals and thresholds are in the estimator's
//! unit. Cost: `iterations * models * data * residual`, the last factor cut by the early stop.

use super::random::Random;

/// Largest sample of any estimator.
const MAX_SAMPLE: usize = 8;

/// What the loop needs to know of a problem.
pub trait Estimator {
    /// What is estimated.
    type Model: Clone;
    /// Data in a minimal sample, at most 8.
    const SAMPLE_SIZE: usize;

    /// Number of data.
    fn data_count(&self) -> usize;
    /// Every model that fits the sample exactly (pushed to `models`, which comes empty); none for a degenerate sample.
    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Self::Model>);
    /// Squared residual of one datum.
    fn residual_squared(&self, model: &Self::Model, datum: usize) -> f64;
    /// A better model for these inliers of `model`, or `None`.
    fn refit(&self, model: &Self::Model, inliers: &[usize]) -> Option<Self::Model>;
    /// Probability that a datum that has nothing to do with a model is within `threshold` of it.
    fn chance(&self, threshold: f64) -> f64;
}

/// How the loop runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RansacOptions {
    /// Largest residual of an inlier, in the estimator's unit. About 2 to 2.5 sigma of the noise.
    pub threshold: f64,
    /// The same of the most exact data that there may be, as a share of it; 1 where all are alike ([`Cost`]).
    pub least_share: f64,
    /// Probability of having drawn an outlier-free sample when the loop stops early.
    pub confidence: f64,
    pub min_iterations: usize,
    pub max_iterations: usize,
    /// A search starts afresh after so many samples, and the best of all searches counts: once a model is well refined, samples that could be
    /// refined to a better one are no longer better by themselves.
    pub search_iterations: usize,
    /// Refits of each new best model; 0 switches local optimisation off.
    pub local_iterations: usize,
    /// Refits to random subsets of a new best model's inliers.
    pub inner_samples: usize,
    /// Data of a local refit, spread evenly over the inliers; the last refit takes all.
    pub local_data: usize,
    /// Models with fewer inliers are no models.
    pub min_inliers: usize,
    /// Largest accepted log10 of the expected number of false alarms. Positive infinity accepts everything.
    pub max_log10_false_alarms: f64,
    /// Same seed, same data: same result.
    pub seed: u64,
}

impl RansacOptions {
    /// The usual settings at a threshold: fast, for hundreds of matches of a video.
    pub fn new(threshold: f64) -> Self {
        Self {
            threshold,
            least_share: 1.0,
            confidence: 0.9999,
            min_iterations: 50,
            max_iterations: 5000,
            search_iterations: usize::MAX,
            local_iterations: 4,
            inner_samples: 5,
            local_data: 150,
            min_inliers: 0,
            max_log10_false_alarms: -3.0,
            seed: 1,
        }
    }

    /// What a datum costs.
    pub fn cost(&self) -> Cost {
        Cost::new(self.least_share * self.threshold, self.threshold)
    }

    /// The settings for a single pair with few or poor matches, where the best model and not the first good one is
    /// wanted: several milliseconds.
    pub fn thorough(threshold: f64) -> Self {
        Self { min_iterations: 1000, inner_samples: 20, max_iterations: 20_000, ..Self::new(threshold) }
    }
}

/// Buffers of the loop, kept between calls.
#[derive(Debug, Clone)]
pub struct Workspace<M> {
    models: Vec<M>,
    inliers: Vec<usize>,
    mask: Vec<bool>,
}

impl<M> Default for Workspace<M> {
    fn default() -> Self {
        Self { models: Vec::new(), inliers: Vec::new(), mask: Vec::new() }
    }
}

impl<M> Workspace<M> {
    /// Inlier mask of the last model, one a datum.
    pub fn mask(&self) -> &[bool] {
        &self.mask
    }

    /// Indices of the last model's inliers, ascending.
    pub fn inliers(&self) -> &[usize] {
        &self.inliers
    }
}

/// The model and how it was found. Its inliers are in the workspace.
#[derive(Debug, Clone, PartialEq)]
pub struct Consensus<M> {
    pub model: M,
    pub inlier_count: usize,
    /// Samples drawn.
    pub iterations: usize,
    /// Sum of all data's [`Cost`].
    pub score: f64,
    /// log10 of the expected number of models as good as this one in random data.
    pub log10_false_alarms: f64,
}

/// Runs the loop.
pub fn estimate<E: Estimator>(
    estimator: &E,
    options: &RansacOptions,
    workspace: &mut Workspace<E::Model>,
) -> Option<Consensus<E::Model>> {
    const { assert!(E::SAMPLE_SIZE >= 1 && E::SAMPLE_SIZE <= MAX_SAMPLE, "samples of 1 to 8 data") };
    workspace.mask.clear();
    workspace.inliers.clear();
    let count = estimator.data_count();
    // Written so that a NaN threshold fails.
    if count < E::SAMPLE_SIZE || !(options.threshold > 0.0 && options.threshold.is_finite()) {
        return None;
    }
    let mut random = Random::new(options.seed);
    let mut best: Option<(E::Model, f64)> = None;
    let mut needed = options.max_iterations;
    let mut iterations = 0;
    let mut current: Option<(E::Model, f64)> = None;
    while iterations < needed.max(options.min_iterations).min(options.max_iterations) {
        if iterations % options.search_iterations.max(1) == 0 {
            current = None;
        }
        iterations += 1;
        let mut sample = [0; MAX_SAMPLE];
        let sample = &mut sample[..E::SAMPLE_SIZE];
        random.sample_distinct(count, sample);
        workspace.models.clear();
        estimator.solve_minimal(sample, &mut workspace.models);
        let mut improved = false;
        for model in &workspace.models {
            let limit = current.as_ref().map_or(f64::INFINITY, |b| b.1);
            if let Some(score) = score(estimator, model, &options.cost(), limit) {
                current = Some((model.clone(), score));
                improved = true;
            }
        }
        if let (true, Some(found)) = (improved, current.as_mut()) {
            let rounds = options.local_iterations;
            optimise(estimator, options, found, rounds, options.local_data, &mut workspace.inliers);
            resample(estimator, options, found, &mut random, workspace);
            if best.as_ref().is_some_and(|b| b.1 <= found.1) {
                continue;
            }
            collect_inliers(estimator, &found.0, options.threshold, &mut workspace.inliers);
            needed = iterations_needed(workspace.inliers.len(), count, E::SAMPLE_SIZE, options.confidence);
            best = Some(found.clone());
        }
    }
    let mut best = best?;
    optimise(estimator, options, &mut best, 2 * options.local_iterations, usize::MAX, &mut workspace.inliers);
    let (model, score) = best;
    let log10_false_alarms = judge(estimator, &model, options, workspace)?;
    Some(Consensus { model, inlier_count: workspace.inliers.len(), iterations, score, log10_false_alarms })
}

/// Ratio of one threshold that a model is judged at to the next.
const STEP_OF_THRESHOLDS: f64 = 1.25;

/// Collects the inliers of `model` into the workspace and returns its log10 number of false alarms; `None` when it
/// does not stand out. For models that were refined after the loop.
pub fn judge<E: Estimator>(
    estimator: &E,
    model: &E::Model,
    options: &RansacOptions,
    workspace: &mut Workspace<E::Model>,
) -> Option<f64> {
    let count = estimator.data_count();
    collect_inliers(estimator, model, options.threshold, &mut workspace.inliers);
    workspace.mask.clear();
    workspace.mask.resize(count, false);
    workspace.inliers.iter().for_each(|&i| workspace.mask[i] = true);
    let inliers = workspace.inliers.len();
    // The number of false alarms has the choice of a threshold in it already.
    let steps = ((1.0 / options.least_share).ln() / STEP_OF_THRESHOLDS.ln()).clamp(0.0, 100.0);
    let false_alarms = (0..=steps as i32).map(|k| {
        let threshold = options.threshold / STEP_OF_THRESHOLDS.powi(k);
        let is_within = |i: &&usize| estimator.residual_squared(model, **i) <= threshold * threshold;
        let within = if k == 0 { inliers } else { workspace.inliers.iter().filter(is_within).count() };
        log10_false_alarms(within, count, E::SAMPLE_SIZE, estimator.chance(threshold))
    });
    let false_alarms = false_alarms.fold(f64::INFINITY, f64::min);
    let accepted = inliers >= options.min_inliers.max(E::SAMPLE_SIZE) && false_alarms <= options.max_log10_false_alarms;
    accepted.then_some(false_alarms)
}

/// What a residual costs: MSAC's `min(r² / t², 1)`, averaged over the thresholds t from `least` to `most` with their logarithm uniform, as
/// of a noise that is known to no more than its order (Barath, Noskova, Matas: Marginalizing sample consensus, PAMI 2022). One for an
/// outlier; with `least = most` MSAC itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cost {
    least_squared: f64,
    most_squared: f64,
    /// ln(most / least)
    range: f64,
}

impl Cost {
    /// Thresholds in the unit of the residuals; `least` down to a thousandth of `most`.
    pub fn new(least: f64, most: f64) -> Self {
        let least = least.max(1e-3 * most).min(most);
        Self { least_squared: least * least, most_squared: most * most, range: (most / least).ln() }
    }

    pub fn msac(threshold: f64) -> Self {
        Self::new(threshold, threshold)
    }

    /// Of a squared residual, times the largest threshold squared. One that is not a number counts as an outlier.
    #[inline]
    fn scaled(&self, squared: f64) -> f64 {
        // f64::min drops a NaN.
        let squared = squared.min(self.most_squared);
        if self.least_squared == self.most_squared {
            return squared;
        }
        // The integral of min(r² / t², 1) / t from least to most.
        let sum = if squared < self.least_squared {
            0.5 * squared * (1.0 / self.least_squared - 1.0 / self.most_squared)
        } else {
            0.5 * ((squared / self.least_squared).ln() + 1.0 - squared / self.most_squared)
        };
        sum * self.most_squared / self.range
    }
}

/// Sum of the data's [`Cost`], or `None` as soon as it is not below `limit`.
#[inline]
pub fn score<E: Estimator>(estimator: &E, model: &E::Model, cost: &Cost, limit: f64) -> Option<f64> {
    let limit = limit * cost.most_squared;
    let count = estimator.data_count();
    let mut sum = 0.0;
    let mut next = 0;
    while next < count {
        let end = (next + 16).min(count);
        for datum in next..end {
            sum += cost.scaled(estimator.residual_squared(model, datum));
        }
        if sum >= limit {
            return None;
        }
        next = end;
    }
    Some(sum / cost.most_squared)
}

/// Refits `best` (a model and its score) to its own inliers while that lowers the score. `inliers` is a buffer.
pub fn optimise<E: Estimator>(
    estimator: &E,
    options: &RansacOptions,
    best: &mut (E::Model, f64),
    rounds: usize,
    data: usize,
    inliers: &mut Vec<usize>,
) {
    for _ in 0..rounds {
        collect_inliers(estimator, &best.0, REFIT_WIDTH * options.threshold, inliers);
        if inliers.len() <= E::SAMPLE_SIZE {
            return;
        }
        let found = inliers.len();
        if found > data {
            for i in 0..data {
                inliers[i] = inliers[i * found / data];
            }
            inliers.truncate(data);
        }
        let Some(model) = estimator.refit(&best.0, inliers) else { return };
        let Some(score) = score(estimator, &model, &options.cost(), best.1) else { return };
        let gain = best.1 - score;
        *best = (model, score);
        if gain < 1e-3 * score {
            return;
        }
    }
}

/// Refits to random subsets of the inliers of `best` (the inner samples of LO-RANSAC): the few false inliers that hold a
/// wrong model together are not in all of them.
fn resample<E: Estimator>(
    estimator: &E,
    options: &RansacOptions,
    best: &mut (E::Model, f64),
    random: &mut Random,
    workspace: &mut Workspace<E::Model>,
) {
    for _ in 0..options.inner_samples {
        collect_inliers(estimator, &best.0, options.threshold, &mut workspace.inliers);
        let count = workspace.inliers.len();
        let size = (count / 2).min(2 * E::SAMPLE_SIZE);
        if size <= E::SAMPLE_SIZE {
            return;
        }
        // Partial Fisher-Yates shuffle.
        for i in 0..size {
            let j = i + random.below(count - i);
            workspace.inliers.swap(i, j);
        }
        let Some(model) = estimator.refit(&best.0, &workspace.inliers[..size]) else { continue };
        if let Some(score) = score(estimator, &model, &options.cost(), best.1) {
            *best = (model, score);
            optimise(estimator, options, best, options.local_iterations, options.local_data, &mut workspace.inliers);
        }
    }
}

/// Width of a refit's inliers in thresholds. The threshold cuts off the tail of the noise; estimates from the cut set are
/// biased towards the model that chose it, measurably (a third more error of an essential matrix's motion).
pub const REFIT_WIDTH: f64 = 1.5;

/// Indices of the data within `threshold` of the model, ascending.
pub fn collect_inliers<E: Estimator>(estimator: &E, model: &E::Model, threshold: f64, inliers: &mut Vec<usize>) {
    inliers.clear();
    let squared = threshold * threshold;
    inliers.extend((0..estimator.data_count()).filter(|&i| estimator.residual_squared(model, i) <= squared));
}

/// Samples to draw so that one of them is free of outliers with the given confidence.
fn iterations_needed(inliers: usize, count: usize, sample: usize, confidence: f64) -> usize {
    let clean: f64 = (0..sample).map(|i| inliers.saturating_sub(i) as f64 / (count - i) as f64).product();
    if clean <= 0.0 {
        return usize::MAX;
    }
    if clean >= 1.0 {
        return 1;
    }
    // `as` saturates.
    ((1.0 - confidence).max(1e-300).ln() / (-clean).ln_1p()).ceil().max(1.0) as usize
}

/// log10 of the expected number of models with at least `inliers` of `count` random data within the threshold.
fn log10_false_alarms(inliers: usize, count: usize, sample: usize, chance: f64) -> f64 {
    if inliers <= sample || !(chance > 0.0) {
        return f64::INFINITY;
    }
    let choose = |n: usize, k: usize| (0..k).map(|i| ((n - i) as f64 / (k - i) as f64).log10()).sum::<f64>();
    let free = (inliers - sample) as f64;
    ((count - sample) as f64).log10()
        + choose(count, inliers.min(count - inliers))
        + choose(inliers, sample)
        + free * chance.min(1.0).log10()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// y = a x + b, the plainest problem with every part of the trait.
    struct Line {
        points: Vec<(f64, f64)>,
    }

    impl Estimator for Line {
        type Model = (f64, f64);
        const SAMPLE_SIZE: usize = 2;
        fn data_count(&self) -> usize {
            self.points.len()
        }
        fn solve_minimal(&self, sample: &[usize], models: &mut Vec<(f64, f64)>) {
            let (p, q) = (self.points[sample[0]], self.points[sample[1]]);
            if (p.0 - q.0).abs() > 1e-9 {
                let a = (q.1 - p.1) / (q.0 - p.0);
                models.push((a, p.1 - a * p.0));
            }
        }
        fn residual_squared(&self, model: &(f64, f64), datum: usize) -> f64 {
            let (x, y) = self.points[datum];
            (model.0 * x + model.1 - y).powi(2)
        }
        fn refit(&self, _: &(f64, f64), inliers: &[usize]) -> Option<(f64, f64)> {
            let n = inliers.len() as f64;
            let mean = |f: &dyn Fn((f64, f64)) -> f64| inliers.iter().map(|&i| f(self.points[i])).sum::<f64>() / n;
            let (mx, my) = (mean(&|p| p.0), mean(&|p| p.1));
            let a = mean(&|p| (p.0 - mx) * (p.1 - my)) / mean(&|p| (p.0 - mx) * (p.0 - mx));
            Some((a, my - a * mx))
        }
        fn chance(&self, threshold: f64) -> f64 {
            2.0 * threshold / 20.0
        }
    }

    fn line(seed: u64, inliers: usize, outliers: usize) -> Line {
        let mut random = Random::new(seed);
        let mut points = Vec::new();
        for _ in 0..inliers {
            let x = random.uniform(-10.0, 10.0);
            points.push((x, 0.5 * x + 1.0 + 0.05 * random.normal()));
        }
        for _ in 0..outliers {
            points.push((random.uniform(-10.0, 10.0), random.uniform(-10.0, 10.0)));
        }
        Line { points }
    }

    #[test]
    fn the_cost_is_msac_averaged_over_the_logarithm_of_the_threshold() {
        let (least, most) = (0.3f64, 2.0f64);
        let cost = |c: &Cost, r: f64| c.scaled(r * r) / c.most_squared;
        for r in [0.0, 0.1, 0.299, 0.301, 1.0, 1.999, 2.001, 50.0] {
            let at = |k: usize| least * (most / least).powf((k as f64 + 0.5) / 10_000.0);
            let mean = (0..10_000).map(|k| cost(&Cost::msac(at(k)), r)).sum::<f64>() / 10_000.0;
            let found = cost(&Cost::new(least, most), r);
            assert!((found - mean).abs() < 1e-3, "{r}: {found} {mean}");
        }
        assert!((cost(&Cost::new(least, most), f64::NAN) - 1.0).abs() < 1e-12);
        assert!((cost(&Cost::msac(most), 1.0) - 0.25).abs() < 1e-15);
    }

    #[test]
    fn half_outliers_do_not_move_the_line() {
        for seed in 0..20 {
            let problem = line(seed, 100, 100);
            let mut workspace = Workspace::default();
            let found = estimate(&problem, &RansacOptions::new(0.125), &mut workspace).expect("a line");
            // sigma of the slope 0.05 / (10 * 5.8), of the offset 0.005
            assert!(
                (found.model.0 - 0.5).abs() < 0.004 && (found.model.1 - 1.0).abs() < 0.03,
                "seed {seed}: {found:?}"
            );
            assert_eq!(found.inlier_count, workspace.mask().iter().filter(|m| **m).count());
            assert!((95..115).contains(&found.inlier_count), "seed {seed}: {found:?}");
            assert!(found.iterations < 200, "seed {seed}: {found:?}");
        }
    }

    #[test]
    fn noise_gives_no_model() {
        for seed in 0..50 {
            let mut workspace = Workspace::default();
            let found = estimate(&line(seed, 0, 200), &RansacOptions::new(0.125), &mut workspace);
            assert!(found.is_none(), "seed {seed}: {found:?}");
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_bits() {
        let problem = line(3, 60, 90);
        let run = || estimate(&problem, &RansacOptions::new(0.125), &mut Workspace::default());
        assert_eq!(run(), run());
        assert!(run().is_some());
    }

    #[test]
    fn too_few_data_and_bad_thresholds_give_none() {
        let mut workspace = Workspace::default();
        assert!(estimate(&line(1, 1, 0), &RansacOptions::new(0.1), &mut workspace).is_none());
        assert!(estimate(&line(1, 50, 0), &RansacOptions::new(f64::NAN), &mut workspace).is_none());
        assert!(estimate(&line(1, 50, 0), &RansacOptions::new(0.0), &mut workspace).is_none());
        let mut options = RansacOptions::new(0.1);
        options.min_inliers = 51;
        assert!(estimate(&line(1, 50, 0), &options, &mut workspace).is_none());
    }

    #[test]
    fn iterations_follow_the_inlier_share() {
        assert_eq!(iterations_needed(100, 100, 5, 0.99), 1);
        // 0.5^5 = 1/32: ln 0.01 / ln(31/32) = 145.05
        assert!((140..170).contains(&iterations_needed(500, 1000, 5, 0.99)));
        assert!(iterations_needed(3, 1000, 5, 0.99) > 1_000_000_000);
    }
}
