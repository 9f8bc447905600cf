//! Epipolar geometry of two pictures by one camera that nobody calibrated.
//!
//! Matched points (pixels from the middle of the pictures) and an F near the best -> the F of least Sampson distance among those that
//! one camera can have made: `F = D [t]x R D`, `D = diag(1/f, 1/f, 1)` with the same unknown focal length f in both pictures, square pixels and
//! the principal point in the middle. Six numbers instead of F's seven, and a shape that real cameras have.
//! Why: on what hardly shows the seventh number (a sideways motion, small depths) it soaks up the last hundredths of a pixel that all
//! matches of a part of the picture are wrong by, and turns epipolar lines by tenths of a degree (Hartley & Zisserman, 2nd ed., 11.7 and
//! 19.3, on constraints by partial knowledge of the cameras). The sixth does the same where nothing holds it: f is then anything from a
//! twentieth to twenty times half the picture, so what is believed of cameras counts as one more measurement (`FOCAL_BELIEF`). Whether
//! the matches allow all that is the caller's to ask: [`sampson_cost`] of both.
//! Cost: four starts of a few iterations, 2 ms for 300 matches.
//!
//! It deliberately does not tell the focal length: where the six numbers help most, it is what the matches do not show.

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::epipolar::{sampson_cost, sampson_normal_equations};
use super::essential::{Motion, decompose};
use super::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};

/// Focal lengths that the search starts from, over half the picture's longer side: fields of view of 90 to 30 degrees across.
const START_FOCALS: [f64; 4] = [1.0, 1.5, 2.2, 3.7];
/// A focal length is believed to be twice half the picture's longer side, to a factor whose logarithm has this sigma: 79 to 34 degrees across
/// within one sigma, 107 to 21 within two, as webcams, telephones and photographers' cameras have.
const FOCAL_BELIEF: [f64; 2] = [2.0, 0.5];

/// Motion and logarithm of the focal length.
#[derive(Debug, Clone, Copy)]
struct OneCamera {
    motion: Motion,
    log_focal: f64,
}

impl OneCamera {
    /// `D`.
    fn inverse_intrinsics(&self) -> Matrix3<f64> {
        let w = (-self.log_focal).exp();
        Matrix3::from_diagonal(&Vector3::new(w, w, 1.0))
    }

    fn matrix(&self) -> Matrix3<f64> {
        let d = self.inverse_intrinsics();
        d * self.motion.essential() * d
    }

    /// dF by the six parameters, column by column of F.
    fn directions(&self) -> SMatrix<f64, 9, 6> {
        let d = self.inverse_intrinsics();
        let of_motion = self.motion.directions();
        let mut out = SMatrix::<f64, 9, 6>::zeros();
        for k in 0..5 {
            let e = Matrix3::from_column_slice(of_motion.column(k).into_owned().as_slice());
            out.column_mut(k).copy_from_slice((d * e * d).as_slice());
        }
        // dD / d log f = -diag(1, 1, 0) D
        let plane = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0));
        let f = self.matrix();
        out.column_mut(5).copy_from_slice((-(plane * f + f * plane)).as_slice());
        out
    }
}

struct Problem<I> {
    matches: I,
    loss: Loss,
    /// Squared sigma of a distance: what a belief weighs.
    variance: f64,
}

impl OneCamera {
    /// The focal length's distance from what is believed of it, in sigmas.
    fn belief(&self) -> f64 {
        (self.log_focal - FOCAL_BELIEF[0].ln()) / FOCAL_BELIEF[1]
    }
}

impl<I: Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone> LeastSquares for Problem<I> {
    type State = OneCamera;
    type Normal = NormalEquations<6>;

    fn linearise(&self, state: &OneCamera) -> NormalEquations<6> {
        let mut normal =
            sampson_normal_equations(&state.matrix(), &state.directions(), self.matches.clone(), &self.loss);
        normal.hessian[(5, 5)] += self.variance / (FOCAL_BELIEF[1] * FOCAL_BELIEF[1]);
        normal.gradient[5] += self.variance * state.belief() / FOCAL_BELIEF[1];
        normal
    }

    fn cost(&self, state: &OneCamera) -> f64 {
        sampson_cost(&state.matrix(), self.matches.clone(), &self.loss) + self.variance * state.belief().powi(2)
    }

    fn step(&self, state: &OneCamera, delta: &SVector<f64, 6>) -> OneCamera {
        let motion = state.motion.moved(&delta.fixed_rows::<5>(0).into_owned());
        OneCamera { motion, log_focal: state.log_focal + delta[5] }
    }
}

/// See the module. The points are over half the picture's longer side, and so is `sigma`, that of their distances; `None` where nothing finite comes
/// of it. Gives its cost, that of the belief included, and F of unit norm.
pub fn one_camera_fundamental(
    start: &Matrix3<f64>,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone,
    loss: Loss,
    sigma: f64,
    options: &LmOptions,
) -> Option<(f64, Matrix3<f64>)> {
    let mut best: Option<(f64, Matrix3<f64>)> = None;
    for focal in START_FOCALS {
        let k = Matrix3::from_diagonal(&Vector3::new(focal, focal, 1.0));
        // E is ± [t]x R for each of its four motions, so any of them will do.
        let Some(motion) = decompose(&(k * start * k)).and_then(|d| Motion::new(&d.candidates[0])) else { continue };
        let problem = Problem { matches: matches.clone(), loss, variance: sigma * sigma };
        let (found, summary) = minimise(&problem, OneCamera { motion, log_focal: focal.ln() }, options);
        let f = found.matrix();
        let norm = f.norm();
        let usable = norm > 0.0 && norm.is_finite() && summary.final_cost.is_finite();
        if usable && best.is_none_or(|(least, _)| summary.final_cost < least) {
            best = Some((summary.final_cost, f / norm));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::{Scene, Shape};
    use super::*;

    /// Pixels over 500 of a camera with the focal length 800 px.
    fn seen(scene: &Scene) -> Vec<(Vector2<f64>, Vector2<f64>)> {
        scene.x1.iter().zip(&scene.x2).map(|(a, b)| (a * 1.6, b * 1.6)).collect()
    }

    #[test]
    fn df_by_the_six_parameters_equals_numeric_differences() {
        let mut random = Random::new(11);
        for _ in 0..20 {
            let scene = Scene::new(&mut random, Shape::Volume, 8, 0.8);
            let motion = Motion::new(&scene.second_from_first).expect("a motion");
            let state = OneCamera { motion, log_focal: random.uniform(-0.5, 1.0) };
            let problem = Problem { matches: seen(&scene).into_iter(), loss: Loss::Squared, variance: 0.0 };
            let analytic = state.directions();
            for k in 0..6 {
                let h = 1e-6;
                let at = |s: f64| problem.step(&state, &(SVector::<f64, 6>::ith(k, s * h))).matrix();
                let numeric = (at(1.0) - at(-1.0)) / (2.0 * h);
                let column = Matrix3::from_column_slice(analytic.column(k).into_owned().as_slice());
                assert!((numeric - column).norm() < 1e-6, "seed 11 parameter {k}: {numeric} {column}");
            }
        }
    }

    #[test]
    fn a_belief_counts_as_a_measurement_of_the_focal_length_and_pulls_where_its_cost_falls() {
        let none = std::iter::empty::<(Vector2<f64>, Vector2<f64>)>();
        let problem = Problem { matches: none, loss: Loss::Squared, variance: 0.3 };
        let motion = Motion::new(&Scene::new(&mut Random::new(1), Shape::Volume, 8, 0.8).second_from_first);
        let state = OneCamera { motion: motion.expect("a motion"), log_focal: 4f64.ln() };
        let normal = problem.linearise(&state);
        let cost = |s: f64| problem.cost(&OneCamera { log_focal: state.log_focal + s, ..state });
        let numeric = (cost(1e-5) - cost(-1e-5)) / 2e-5;
        assert!((2.0 * normal.gradient[5] - numeric).abs() < 1e-6 && numeric > 0.0, "{numeric}");
        assert!((normal.hessian[(5, 5)] - 0.3 / 0.25).abs() < 1e-12);
    }

    #[test]
    fn one_cameras_matches_give_its_f_from_a_bent_start() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let scene = Scene::new(&mut random, Shape::Volume, 100, 0.8);
            let all = seen(&scene);
            let d = Matrix3::from_diagonal(&Vector3::new(1.0 / 1.6, 1.0 / 1.6, 1.0));
            let motion = Motion::new(&scene.second_from_first).expect("a motion");
            let truth = d * motion.essential() * d;
            let truth = truth / truth.norm();
            let bent = truth + Matrix3::from_fn(|_, _| 0.002 * random.normal());
            let found = one_camera_fundamental(&bent, all.iter().copied(), Loss::Squared, 0.0, &LmOptions::default());
            let (_, found) = found.expect("an F");
            let off = (found - truth).norm().min((found + truth).norm());
            let cost = sampson_cost(&found, all.iter().copied(), &Loss::Squared);
            assert!(off < 1e-5 && cost < 1e-10, "seed {seed}: {off} {cost}");
        }
    }

    #[test]
    fn nonsense_gives_none_or_something_finite() {
        let nan = Matrix3::from_element(f64::NAN);
        let none = std::iter::empty::<(Vector2<f64>, Vector2<f64>)>();
        assert!(one_camera_fundamental(&nan, none.clone(), Loss::Squared, 0.0, &LmOptions::default()).is_none());
        let zero = Matrix3::zeros();
        let found = one_camera_fundamental(&zero, none, Loss::Squared, 0.0, &LmOptions::default());
        assert!(found.is_none_or(|(_, f)| f.iter().all(|v| v.is_finite())));
    }
}
