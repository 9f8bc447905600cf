//! A turn on the spot, seen by a camera that nobody calibrated.
//!
//! Matched points (pixels) and the middle of the pictures -> the turn that explains most of them ([`fit_unknown_turn`]), and whether the
//! matches that it leaves over are a parallax ([`shows_parallax`]).
//! Turning moves the picture by `K R K⁻¹` (Hartley & Zisserman, 2nd ed., 8.4.2) only if lines stay straight and all rows are taken at once. Real
//! lenses and shutters bend that flow by a pixel or two, smoothly, and an F takes the bend for depth. So the turn is fitted together with
//! all that no depth is needed for: one focal length f (the principal point is the middle), one coefficient λ of the lens, `m = x / (1 + λ |x|²)`
//! (Fitzgibbon's division model, CVPR 2001), and for each picture an angular velocity over the rows, `exp(y ω)` before and after R. Each is held to
//! what cameras have: without bounds λ and ω make a tilted plane of a turn.
//! Eleven unknowns, Cauchy's weights, numeric derivatives, three starts. Cost: about 20 ms for 400 matches.
//!
//! It deliberately does not tell the focal length (a few degrees hardly show it), and does not decide: a plane can look like a turn.

use nalgebra::{Matrix3, Rotation3, SVector, Vector2, Vector3};

use super::displaced::{Displaced, any_cut_stands_out};
use super::epipolar::sampson_squared;
use super::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use super::point_set::chance_near_line;
use super::ransac::RansacOptions;
use super::rotation::fit_rotation;

/// Fewer matches leave eleven unknowns too much freedom.
pub const MIN_TURN_MATCHES: usize = 40;
/// Turn, log focal length, λ, ω of the first and of the second picture. Unit of length: half the picture's width.
const UNKNOWNS: usize = 11;
type Unknowns = SVector<f64, UNKNOWNS>;
/// Focal lengths that the search starts from: fields of view of 90, 64 and 42 degrees across.
const START_FOCALS: [f64; 3] = [1.0, 1.6, 2.6];
/// Webcams: 103 to 37 degrees across; a focal length is believed to be 1.6 to a factor of 1.5.
const FOCALS: [f64; 2] = [0.8, 3.0];
const FOCAL_PRIOR: [f64; 2] = [1.6, 0.4];
/// From a fisheye of 150 degrees across the diagonal to a little pincushion.
const LENSES: [f64; 2] = [-0.45, 0.2];
const LENS_SIGMA: f64 = 0.15;
/// Radians that the camera turns while half the picture's width of rows is taken: 150 degrees a second and 20 ms for all of 4:3.
const SHUTTER_SIGMA: f64 = 0.025;
const SHUTTER_LIMIT: f64 = 0.05;
/// Step of the numeric derivatives.
const STEP: f64 = 1e-6;

/// See the module.
#[derive(Debug, Clone, PartialEq)]
pub struct UnknownTurn {
    middle: Vector2<f64>,
    /// Half the picture's width, pixels.
    half: f64,
    lens: Camera,
}

/// The unknowns, in units of half the picture's width.
#[derive(Debug, Clone, PartialEq)]
struct Camera {
    rotation: Matrix3<f64>,
    log_focal: f64,
    lambda: f64,
    shutter: [Vector3<f64>; 2],
}

/// `exp(ω) v` to second order.
fn turned(w: Vector3<f64>, v: Vector3<f64>) -> Vector3<f64> {
    let once = w.cross(&v);
    v + once + w.cross(&once) * 0.5
}

impl Camera {
    fn moved(&self, delta: &Unknowns) -> Self {
        let part = |k: usize| delta.fixed_rows::<3>(k).into_owned();
        let bounded = |w: Vector3<f64>| w.map(|v| v.clamp(-SHUTTER_LIMIT, SHUTTER_LIMIT));
        Self {
            rotation: Rotation3::new(part(0)).matrix() * self.rotation,
            log_focal: (self.log_focal + delta[3]).clamp(FOCALS[0].ln(), FOCALS[1].ln()),
            lambda: (self.lambda + delta[4]).clamp(LENSES[0], LENSES[1]),
            shutter: [bounded(self.shutter[0] + part(5)), bounded(self.shutter[1] + part(8))],
        }
    }

    /// What is believed of the unknowns: each less its mean, over its sigma. The turn itself is free.
    fn beliefs(&self) -> Unknowns {
        let mut out = Unknowns::zeros();
        out[3] = (self.log_focal - FOCAL_PRIOR[0].ln()) / FOCAL_PRIOR[1];
        out[4] = self.lambda / LENS_SIGMA;
        for k in 0..3 {
            out[5 + k] = self.shutter[0][k] / SHUTTER_SIGMA;
            out[8 + k] = self.shutter[1][k] / SHUTTER_SIGMA;
        }
        out
    }

    /// Where the turn puts `a`, seen in the row of `b`; `None` behind the camera and outside of what the lens shows.
    fn place(&self, a: &Vector2<f64>, b: &Vector2<f64>) -> Option<Vector2<f64>> {
        let focal = self.log_focal.exp();
        let ray = (a / ((1.0 + self.lambda * a.norm_squared()) * focal)).push(1.0);
        let ray = self.rotation * turned(self.shutter[0] * a.y, ray);
        let ray = turned(self.shutter[1] * b.y, ray);
        // Written so that NaN fails.
        if !(ray.z > 1e-3) {
            return None;
        }
        let m = ray.xy() * (focal / ray.z);
        let root = 1.0 - 4.0 * self.lambda * m.norm_squared();
        (root >= 0.0).then(|| m * (2.0 / (1.0 + root.sqrt())))
    }
}

struct Problem<'a> {
    matches: &'a [(Vector2<f64>, Vector2<f64>)],
    loss: Loss,
    /// Squared sigma of a displacement: what a belief weighs.
    variance: f64,
}

/// Displacement of a match that the turn puts nowhere.
const NOWHERE: f64 = 2.0;

impl LeastSquares for Problem<'_> {
    type State = Camera;
    type Normal = NormalEquations<UNKNOWNS>;

    fn linearise(&self, state: &Camera) -> NormalEquations<UNKNOWNS> {
        let mut normal = NormalEquations::default();
        // Inwards at a bound, where a step outwards would not move it.
        let nudged: [(Camera, f64); UNKNOWNS] = std::array::from_fn(|k| {
            let there = state.moved(&Unknowns::ith(k, STEP));
            if there == *state { (state.moved(&Unknowns::ith(k, -STEP)), -STEP) } else { (there, STEP) }
        });
        for (a, b) in self.matches {
            let Some(at) = state.place(a, b) else { continue };
            let left = at - b;
            let (_, weight) = self.loss.evaluate(left.norm_squared());
            let mut rows = [Unknowns::zeros(), Unknowns::zeros()];
            for (k, (camera, step)) in nudged.iter().enumerate() {
                let slope = camera.place(a, b).map_or_else(Vector2::zeros, |there| (there - at) / *step);
                (rows[0][k], rows[1][k]) = (slope.x, slope.y);
            }
            normal.add(&rows[0], left.x, weight);
            normal.add(&rows[1], left.y, weight);
        }
        let beliefs = state.beliefs();
        let sigmas = [FOCAL_PRIOR[1], LENS_SIGMA].into_iter().chain([SHUTTER_SIGMA; 6]);
        for (k, sigma) in (3..UNKNOWNS).zip(sigmas) {
            normal.hessian[(k, k)] += self.variance / (sigma * sigma);
            normal.gradient[k] += self.variance * beliefs[k] / sigma;
        }
        normal
    }

    fn cost(&self, state: &Camera) -> f64 {
        let far = |(a, b): &(Vector2<f64>, Vector2<f64>)| {
            let squared = state.place(a, b).map_or(NOWHERE * NOWHERE, |at| (at - b).norm_squared());
            self.loss.evaluate(squared.min(NOWHERE * NOWHERE)).0
        };
        self.matches.iter().map(far).sum::<f64>() + self.variance * state.beliefs().norm_squared()
    }

    fn step(&self, state: &Camera, delta: &Unknowns) -> Camera {
        state.moved(delta)
    }
}

impl UnknownTurn {
    /// Where the turn puts a place of the first picture, pixels of the second; a rolling shutter takes it when it takes the row of `second`.
    pub fn place(&self, first: &Vector2<f64>, second: &Vector2<f64>) -> Option<Vector2<f64>> {
        let unit = |x: &Vector2<f64>| (x - self.middle) / self.half;
        self.lens.place(&unit(first), &unit(second)).map(|at| at * self.half + self.middle)
    }

    /// Pixels from there to where it was matched; infinite where the turn puts it nowhere.
    pub fn displacement(&self, first: &Vector2<f64>, second: &Vector2<f64>) -> f64 {
        self.place(first, second).map_or(f64::INFINITY, |at| (at - second).norm())
    }

    /// `K R K⁻¹` without lens and shutter, of unit norm.
    pub fn homography(&self) -> Matrix3<f64> {
        let focal = self.lens.log_focal.exp() * self.half;
        let k = Matrix3::new(focal, 0.0, self.middle.x, 0.0, focal, self.middle.y, 0.0, 0.0, 1.0);
        let inverse = k.try_inverse().unwrap_or_else(Matrix3::identity);
        let h = k * self.lens.rotation * inverse;
        h / h.norm()
    }
}

/// The turn that explains most of the matches, some of which may be wrong. `half_width` of the pictures and `sigma` of a point in
/// one of them in the matches' unit. `None` of too few, or where nothing finite comes of it.
pub fn fit_unknown_turn(
    matches: &[(Vector2<f64>, Vector2<f64>)],
    middle: Vector2<f64>,
    half_width: f64,
    sigma: f64,
) -> Option<UnknownTurn> {
    let finite = |v: &Vector2<f64>| v.iter().all(|x| x.is_finite());
    let all: Vec<_> = matches.iter().map(|(a, b)| ((a - middle) / half_width, (b - middle) / half_width)).collect();
    if all.len() < MIN_TURN_MATCHES || !all.iter().all(|(a, b)| finite(a) && finite(b)) {
        return None;
    }
    let sigma = std::f64::consts::SQRT_2 * sigma / half_width;
    let problem = Problem { matches: &all, loss: Loss::Cauchy(2.0 * sigma), variance: sigma * sigma };
    let options = LmOptions { max_iterations: 30, relative_cost: 1e-4, ..LmOptions::default() };
    let mut best: Option<(f64, Camera)> = None;
    for focal in START_FOCALS {
        let ray = |x: &Vector2<f64>| (x / focal).push(1.0).normalize();
        let Some(rotation) = fit_rotation(all.iter().map(|(a, b)| (ray(a), ray(b)))) else { continue };
        let start = Camera { rotation, log_focal: focal.ln(), lambda: 0.0, shutter: [Vector3::zeros(); 2] };
        let (found, summary) = minimise(&problem, start, &options);
        if summary.final_cost.is_finite() && best.as_ref().is_none_or(|(least, _)| summary.final_cost < *least) {
            best = Some((summary.final_cost, found));
        }
    }
    best.map(|(_, lens)| UnknownTurn { middle, half: half_width, lens })
}

/// Distances at which [`shows_parallax`] looks, in the least.
const CUTS: [f64; 3] = [1.0, 2.0, 4.0];

/// Do the matches beside a turn agree with F more often than matches that are only placed badly would? `distances`: of each match from where
/// the turn puts it; those that are to be left out are not above `least`.
pub fn shows_parallax(
    f: &Matrix3<f64>,
    matches: &[(Vector2<f64>, Vector2<f64>)],
    distances: &[f64],
    least: f64,
    options: &RansacOptions,
) -> bool {
    let (x1, x2): (Vec<_>, Vec<_>) = matches.iter().copied().unzip();
    let stranger = chance_near_line(&x1, options.threshold).max(chance_near_line(&x2, options.threshold));
    let displaced = matches
        .iter()
        .zip(distances)
        .map(|((a, b), distance)| Displaced { residual_squared: sampson_squared(f, a, b), distance: *distance });
    any_cut_stands_out(displaced, CUTS.map(|cut| cut * least), stranger, options)
}

#[cfg(test)]
mod tests;
