//! Nonlinear least squares: Levenberg-Marquardt with robust losses, the one of the whole house.
//!
//! A problem says how it is linearised (normal equations at a state), what a state costs, and how a step moves a state
//! (so rotations and directions stay what they are); [`minimise`] does the rest. Normal equations say how they are solved: a handful of
//! parameters as one small matrix ([`NormalEquations`]), a camera and many poses or points by elimination ([`arrow`]), a map by
//! its own (`reconstruction::adjust`). Marquardt's scaled damping with
//! Nielsen's update (Madsen, Nielsen, Tingleff: Methods for non-linear least squares problems, 2004). For a handful of
//! parameters everything is of fixed size and on the stack. Cost then: a linearisation an iteration, a cost evaluation a trial, an N x N Cholesky.
//!
//! Not here: constraints, covariances.

pub mod arrow;

use nalgebra::{SMatrix, SVector};

/// What a squared residual costs, and how much it weighs in the normal equations (iteratively reweighted).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Loss {
    /// `s`: Gaussian noise, no outliers.
    Squared,
    /// Linear beyond the given residual (Huber 1964); a start far off still pulls.
    Huber(f64),
    /// Logarithmic with the given scale: outliers fade.
    Cauchy(f64),
}

impl Loss {
    /// `(rho(s), rho'(s))` of a squared residual `s`.
    #[inline]
    pub fn evaluate(&self, s: f64) -> (f64, f64) {
        match *self {
            Loss::Squared => (s, 1.0),
            Loss::Huber(k) => {
                if s <= k * k {
                    (s, 1.0)
                } else {
                    let r = s.sqrt();
                    (2.0 * k * r - k * k, k / r)
                }
            }
            Loss::Cauchy(k) => {
                let scale = k * k;
                (scale * (s / scale).ln_1p(), scale / (scale + s))
            }
        }
    }
}

/// Normal equations at one state, which can be solved.
pub trait Damped {
    /// The parameters' step: a vector, or several where some of them are eliminated.
    type Step;

    /// The step at this damping, and by how much the linearised cost falls with it; `None` if they are not positive definite.
    fn solve(&self, damping: f64) -> Option<(Self::Step, f64)>;

    /// Euclidean length of a step.
    fn length(step: &Self::Step) -> f64;
}

/// Marquardt's damping of a block, with `least_pivot` added to every pivot, so that what nothing depends on stays where
/// it is.
pub fn damped<const N: usize>(block: &SMatrix<f64, N, N>, damping: f64, least_pivot: f64) -> SMatrix<f64, N, N> {
    let mut block = *block;
    for i in 0..N {
        block[(i, i)] += damping * block[(i, i)] + least_pivot;
    }
    block
}

/// `JᵀWJ` and `JᵀWr` at one state.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalEquations<const N: usize> {
    pub hessian: SMatrix<f64, N, N>,
    pub gradient: SVector<f64, N>,
}

impl<const N: usize> Default for NormalEquations<N> {
    fn default() -> Self {
        Self { hessian: SMatrix::zeros(), gradient: SVector::zeros() }
    }
}

impl<const N: usize> NormalEquations<N> {
    /// Adds one residual with its row of the Jacobian and its weight. Fills the lower triangle of the
    /// Hessian only: it is the one that [`minimise`] reads.
    #[inline]
    pub fn add(&mut self, row: &SVector<f64, N>, residual: f64, weight: f64) {
        for c in 0..N {
            let wc = weight * row[c];
            self.gradient[c] += wc * residual;
            for r in c..N {
                self.hessian[(r, c)] += wc * row[r];
            }
        }
    }
}

impl<const N: usize> Damped for NormalEquations<N> {
    type Step = SVector<f64, N>;

    #[inline]
    fn solve(&self, damping: f64) -> Option<(SVector<f64, N>, f64)> {
        let diagonal = self.hessian.diagonal();
        // A parameter that nothing depends on still gets a pivot.
        let floor = 1e-12 * diagonal.max() + f64::MIN_POSITIVE;
        let mut damped = self.hessian;
        for i in 0..N {
            damped[(i, i)] += damping * diagonal[i].max(floor) + floor;
        }
        let delta = -nalgebra::Cholesky::new(damped)?.solve(&self.gradient);
        let predicted = -delta.dot(&self.gradient)
            + delta.iter().zip(diagonal.iter()).map(|(d, h)| d * d * damping * h.max(floor)).sum::<f64>();
        Some((delta, predicted))
    }

    #[inline]
    fn length(step: &SVector<f64, N>) -> f64 {
        step.norm()
    }
}

/// A least squares problem.
pub trait LeastSquares {
    /// What is estimated.
    type State;
    type Normal: Damped;

    /// Normal equations at a state.
    fn linearise(&self, state: &Self::State) -> Self::Normal;

    /// Cost alone; infinite where the state makes no sense.
    fn cost(&self, state: &Self::State) -> f64;

    /// The state moved by a step of the parameters.
    fn step(&self, state: &Self::State, delta: &<Self::Normal as Damped>::Step) -> Self::State;
}

/// When to stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LmOptions {
    /// Accepted and rejected steps together.
    pub max_iterations: usize,
    /// Share of the cost below which an improvement no longer counts.
    pub relative_cost: f64,
    /// Length of a step below which it no longer counts, in the problem's parameters.
    pub step_norm: f64,
    /// Damping at the start, as a share of the Hessian's diagonal.
    pub initial_damping: f64,
}

impl Default for LmOptions {
    fn default() -> Self {
        Self { max_iterations: 20, relative_cost: 1e-10, step_norm: 1e-12, initial_damping: 1e-4 }
    }
}

/// How it went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LmSummary {
    pub initial_cost: f64,
    pub final_cost: f64,
    /// Trials, accepted and rejected.
    pub iterations: usize,
    /// Stopped because nothing improved any more, not because the iterations ran out.
    pub converged: bool,
}

/// Damping after a step was rejected, at the least.
const LEAST_AFTER_REJECTION: f64 = 1e-4;

/// The state of least cost near `start`, and how it went. A start without a finite cost comes back as it is.
pub fn minimise<P: LeastSquares>(problem: &P, start: P::State, options: &LmOptions) -> (P::State, LmSummary) {
    let mut state = start;
    let cost = problem.cost(&state);
    let mut summary = LmSummary { initial_cost: cost, final_cost: cost, iterations: 0, converged: false };
    if !cost.is_finite() {
        return (state, summary);
    }
    let mut normal = problem.linearise(&state);
    let (mut damping, mut growth) = (options.initial_damping, 2.0);
    while summary.iterations < options.max_iterations {
        summary.iterations += 1;
        let Some((delta, predicted_gain)) = normal.solve(damping) else {
            damping = (damping * growth).max(LEAST_AFTER_REJECTION);
            growth *= 2.0;
            continue;
        };
        let small_step = P::Normal::length(&delta) <= options.step_norm;
        let trial = problem.step(&state, &delta);
        let cost = problem.cost(&trial);
        // NaN and infinity are no gain.
        if cost < summary.final_cost {
            let gain = summary.final_cost - cost;
            let small_gain = gain <= options.relative_cost * summary.final_cost;
            state = trial;
            summary.final_cost = cost;
            if small_step || small_gain {
                summary.converged = true;
                break;
            }
            if summary.iterations == options.max_iterations {
                break;
            }
            // Of a whole map they are large: two at once would be most of what its adjustment takes.
            drop(normal);
            normal = problem.linearise(&state);
            let quality = 2.0 * gain / predicted_gain.max(f64::MIN_POSITIVE) - 1.0;
            damping *= (1.0 - quality * quality * quality).clamp(1.0 / 9.0, 2.0);
            growth = 2.0;
        } else {
            if small_step || damping > 1e12 {
                summary.converged = true;
                break;
            }
            // Where hardly anything was damped, a little more of that is the same step.
            damping = (damping * growth).max(LEAST_AFTER_REJECTION);
            growth *= 2.0;
        }
    }
    (state, summary)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector2, Vector3};

    /// y = a exp(b x) + c
    struct Exponential {
        data: Vec<(f64, f64)>,
        loss: Loss,
    }

    impl LeastSquares for Exponential {
        type State = Vector3<f64>;
        type Normal = NormalEquations<3>;
        fn linearise(&self, p: &Self::State) -> NormalEquations<3> {
            let mut normal = NormalEquations::default();
            for &(x, y) in &self.data {
                let e = (p.y * x).exp();
                let r = p.x * e + p.z - y;
                let (_, weight) = self.loss.evaluate(r * r);
                normal.add(&Vector3::new(e, p.x * x * e, 1.0), r, weight);
            }
            normal
        }
        fn cost(&self, p: &Self::State) -> f64 {
            let residual = |&(x, y): &(f64, f64)| p.x * (p.y * x).exp() + p.z - y;
            self.data.iter().map(|d| self.loss.evaluate(residual(d).powi(2)).0).sum()
        }
        fn step(&self, p: &Self::State, delta: &Vector3<f64>) -> Self::State {
            p + delta
        }
    }

    fn samples() -> Vec<(f64, f64)> {
        (0..40).map(|i| f64::from(i) * 0.05).map(|x| (x, 2.0 * (-1.5 * x).exp() + 0.3)).collect()
    }

    #[test]
    fn exact_data_give_the_exact_parameters() {
        let problem = Exponential { data: samples(), loss: Loss::Squared };
        let options = LmOptions { max_iterations: 60, ..LmOptions::default() };
        let (p, summary) = minimise(&problem, Vector3::new(1.0, 0.0, 0.0), &options);
        assert!(summary.converged, "{summary:?}");
        assert!((p - Vector3::new(2.0, -1.5, 0.3)).norm() < 1e-9, "{p} {summary:?}");
    }

    #[test]
    fn robust_losses_forget_outliers() {
        let mut data = samples();
        for i in [3, 11, 17, 29, 36] {
            data[i].1 += 5.0;
        }
        let options = LmOptions { max_iterations: 100, ..LmOptions::default() };
        let fit = |loss| {
            let problem = Exponential { data: data.clone(), loss };
            (minimise(&problem, Vector3::new(1.0, -1.0, 0.0), &options).0 - Vector3::new(2.0, -1.5, 0.3)).norm()
        };
        assert!(fit(Loss::Squared) > 0.3);
        assert!(fit(Loss::Huber(0.01)) < 0.02, "{}", fit(Loss::Huber(0.01)));
        assert!(fit(Loss::Cauchy(0.1)) < 0.01, "{}", fit(Loss::Cauchy(0.1)));
    }

    #[test]
    fn the_weight_is_the_derivative_of_the_cost() {
        for loss in [Loss::Squared, Loss::Huber(0.7), Loss::Cauchy(0.7)] {
            for s in [0.01, 0.3, 0.6, 2.0, 50.0] {
                let h = 1e-6 * s;
                let numeric = (loss.evaluate(s + h).0 - loss.evaluate(s - h).0) / (2.0 * h);
                assert!((numeric - loss.evaluate(s).1).abs() < 1e-8, "{loss:?} at {s}");
            }
        }
    }

    #[test]
    fn a_bad_start_comes_back_and_nothing_hangs() {
        let problem = Exponential { data: vec![(f64::NAN, 1.0)], loss: Loss::Squared };
        let (p, summary) = minimise(&problem, Vector3::new(1.0, 0.0, 0.0), &LmOptions::default());
        assert_eq!((p, summary.iterations), (Vector3::new(1.0, 0.0, 0.0), 0));
        // No data: no gradient, no move.
        let problem = Exponential { data: vec![], loss: Loss::Squared };
        let (p, _) = minimise(&problem, Vector3::new(1.0, 0.0, 0.0), &LmOptions::default());
        assert_eq!(p, Vector3::new(1.0, 0.0, 0.0));
    }

    /// A rotated, badly scaled valley (condition 1e8) is still reached.
    struct Valley;
    impl LeastSquares for Valley {
        type State = Vector2<f64>;
        type Normal = NormalEquations<2>;
        fn linearise(&self, p: &Self::State) -> NormalEquations<2> {
            let mut normal = NormalEquations::default();
            for (row, residual) in self.rows(p) {
                normal.add(&row, residual, 1.0);
            }
            normal
        }
        fn cost(&self, p: &Self::State) -> f64 {
            self.rows(p).iter().map(|(_, r)| r * r).sum()
        }
        fn step(&self, p: &Self::State, delta: &Vector2<f64>) -> Self::State {
            p + delta
        }
    }
    impl Valley {
        fn rows(&self, p: &Vector2<f64>) -> [(Vector2<f64>, f64); 2] {
            // Rosenbrock: 100 (y - x²), 1 - x
            [(Vector2::new(-200.0 * p.x, 100.0), 100.0 * (p.y - p.x * p.x)), (Vector2::new(-1.0, 0.0), 1.0 - p.x)]
        }
    }

    #[test]
    fn a_curved_valley_is_followed_to_its_end() {
        let options = LmOptions { max_iterations: 200, ..LmOptions::default() };
        let (p, summary) = minimise(&Valley, Vector2::new(-1.2, 1.0), &options);
        assert!((p - Vector2::new(1.0, 1.0)).norm() < 1e-8, "{p} {summary:?}");
    }
}
