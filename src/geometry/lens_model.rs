//! Lens models: what a lens does to the undistorted normalised point `n = (x/z, y/z)`, and back. No unit; pixels are
//! [`CameraModel`](super::CameraModel)'s.
//!
//! **Radial-tangential** (Brown-Conrady, coefficients in OpenCV's order k1 k2 p1 p2 k3), with `s = |n|²`:
//!
//! ```text
//! x_d = n_x (1 + k1 s + k2 s² + k3 s³) + 2 p1 n_x n_y + p2 (s + 2 n_x²)
//! y_d = n_y (1 + k1 s + k2 s² + k3 s³) + p1 (s + 2 n_y²) + 2 p2 n_x n_y
//! ```
//!
//! **Kannala-Brandt** (Kannala & Brandt, A generic camera model and calibration method for conventional, wide-angle, and fish-eye
//! lenses, PAMI 2006, eq. 6 with the first coefficient in the focal length), with the angle off the axis `t = atan |n|`:
//!
//! ```text
//! (x_d, y_d) = r_d n / |n|,   r_d = t + k1 t³ + k2 t⁵ + k3 t⁷ + k4 t⁹
//! ```
//!
//! Order and meaning of k1 k2 k3 k4 are those of OpenCV's `fisheye` module and of `equidistant` in Kalibr, EuRoC and ROS.
//!
//! # Valid radius
//! A polynomial fitted inside a picture folds back somewhere outside of it: without a limit a point far off the axis lands in the
//! middle of the picture. The Jacobian of both models is symmetric, so the map is the gradient of a potential; where the Jacobian is
//! positive definite on a whole disc the potential is strictly convex there and the map is one to one.
//! - Radial-tangential: the smaller eigenvalue is at least `min(f'(r), f(r) / r) - 6 r sqrt(p1² + p2²)`,
//!   `f(r) = r (1 + k1 r² + k2 r⁴ + k3 r⁶)`; the valid radius is the first `r` where that bound reaches zero.
//! - Kannala-Brandt: the first angle where `d r_d / d t` reaches zero, and [`MAX_ANGLE_DEG`] at the most: on the plane z = 1 a ray at 85
//!   degrees lies 11 units out, and one at 90 nowhere. So a lens that sees 180 degrees and more can be used, but what it sees
//!   farther than 85 degrees off its axis can not.
//!
//! Cost: a radial-tangential point about 10 ns, one of Kannala-Brandt about 30 ns (an arctangent); back about 100 ns both (Newton,
//! three or four steps; a fixed-point iteration diverges on lenses with a large k3).
//!
//! Deliberately not here: tangential terms of a fisheye lens, lenses without a single centre, rays behind the camera.

use nalgebra::Vector2;

use super::polynomial::real_roots;

/// No pinhole lens sees farther off its axis than this (`tan` of 89.9 degrees).
const MAX_RADIUS: f64 = 573.0;
/// Rays farther off the axis of a Kannala-Brandt lens are not used, degrees.
pub const MAX_ANGLE_DEG: f64 = 85.0;
/// Newton steps of `undistort`; three or four are usual.
const UNDISTORT_ITERATIONS: usize = 40;
/// Below this `|n|²` the first terms of the series in `|n|` are exact to rounding.
const NEAR_AXIS: f64 = 1e-8;

/// A lens and its coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LensModel {
    /// Pinhole with k1 k2 p1 p2 k3.
    RadialTangential([f64; 5]),
    /// Wide-angle or fisheye with k1 k2 k3 k4; all zero is the equidistant lens.
    KannalaBrandt([f64; 4]),
}

impl From<[f64; 5]> for LensModel {
    /// k1 k2 p1 p2 k3.
    fn from(coefficients: [f64; 5]) -> Self {
        Self::RadialTangential(coefficients)
    }
}

impl LensModel {
    /// No distortion at all.
    pub const PINHOLE: Self = Self::RadialTangential([0.0; 5]);

    /// The coefficients, in the model's order.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::RadialTangential(k) => k,
            Self::KannalaBrandt(k) => k,
        }
    }

    /// Their names, as files have them.
    pub fn names(&self) -> &'static [&'static str] {
        match self {
            Self::RadialTangential(_) => &["k1", "k2", "p1", "p2", "k3"],
            Self::KannalaBrandt(_) => &["k1", "k2", "k3", "k4"],
        }
    }

    /// The model's name in our files.
    pub fn name(&self) -> &'static str {
        match self {
            Self::RadialTangential(_) => "radial_tangential",
            Self::KannalaBrandt(_) => "kannala_brandt",
        }
    }

    /// Is it the wide-angle model?
    #[inline]
    pub fn is_wide_angle(&self) -> bool {
        matches!(self, Self::KannalaBrandt(_))
    }

    /// Largest |n| up to which the lens is one to one.
    pub(super) fn valid_radius(&self) -> f64 {
        match self {
            Self::RadialTangential(k) => brown_radius(k),
            Self::KannalaBrandt(k) => brandt_angle(k).tan(),
        }
    }

    /// Nothing folds before the limit that the model itself has.
    pub(super) fn is_unfolded(&self) -> bool {
        match self {
            Self::RadialTangential(k) => brown_radius(k) >= MAX_RADIUS,
            Self::KannalaBrandt(k) => brandt_angle(k) >= MAX_ANGLE_DEG.to_radians(),
        }
    }

    /// Distorted point, unchecked.
    #[inline]
    pub(super) fn distort(&self, n: &Vector2<f64>) -> Vector2<f64> {
        match self {
            Self::RadialTangential([k1, k2, p1, p2, k3]) => {
                let s = n.norm_squared();
                let radial = 1.0 + s * (k1 + s * (k2 + s * k3));
                let xy2 = 2.0 * n.x * n.y;
                Vector2::new(
                    n.x * radial + p1 * xy2 + p2 * (s + 2.0 * n.x * n.x),
                    n.y * radial + p1 * (s + 2.0 * n.y * n.y) + p2 * xy2,
                )
            }
            Self::KannalaBrandt(k) => {
                let s = n.norm_squared();
                if s < NEAR_AXIS {
                    return n * (1.0 + (k[0] - 1.0 / 3.0) * s);
                }
                let r = s.sqrt();
                n * (brandt(k, r.atan()).0 / r)
            }
        }
    }

    /// The symmetric Jacobian `[a b; b c]` of the distortion.
    #[inline]
    pub(super) fn jacobian_parts(&self, n: &Vector2<f64>) -> (f64, f64, f64) {
        match self {
            Self::RadialTangential([k1, k2, p1, p2, k3]) => {
                let s = n.norm_squared();
                let radial = 1.0 + s * (k1 + s * (k2 + s * k3));
                let slope2 = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3));
                (
                    radial + slope2 * n.x * n.x + 2.0 * p1 * n.y + 6.0 * p2 * n.x,
                    slope2 * n.x * n.y + 2.0 * (p1 * n.x + p2 * n.y),
                    radial + slope2 * n.y * n.y + 6.0 * p1 * n.y + 2.0 * p2 * n.x,
                )
            }
            Self::KannalaBrandt(k) => {
                // q = r_d / r; J = q I + (dq/dr / r) n nᵀ.
                let s = n.norm_squared();
                let (q, bend) = if s < NEAR_AXIS {
                    let c = k[0] - 1.0 / 3.0;
                    (1.0 + c * s, 2.0 * c)
                } else {
                    let r = s.sqrt();
                    let (radius, slope) = brandt(k, r.atan());
                    let q = radius / r;
                    (q, (slope / (1.0 + s) - q) / s)
                };
                (q + bend * n.x * n.x, bend * n.x * n.y, q + bend * n.y * n.y)
            }
        }
    }

    /// Undistorted point of a distorted one; `None` when no point inside the valid radius goes there.
    pub(super) fn undistort(&self, target: &Vector2<f64>, valid_radius_squared: f64) -> Option<Vector2<f64>> {
        match self {
            Self::RadialTangential(k) if *k == [0.0; 5] => {
                (target.norm_squared() <= valid_radius_squared).then_some(*target)
            }
            Self::RadialTangential(_) => self.undistort_by_newton(target, valid_radius_squared),
            Self::KannalaBrandt(k) => undistort_brandt(k, target, valid_radius_squared.sqrt().atan()),
        }
    }

    /// In two dimensions, for radial and tangential terms together.
    fn undistort_by_newton(&self, target: &Vector2<f64>, valid_radius_squared: f64) -> Option<Vector2<f64>> {
        if !(target.x.is_finite() && target.y.is_finite()) {
            return None;
        }
        // Start at the distorted point, or inside the disc when that is outside of it.
        let start_radius = target.norm();
        let limit = 0.95 * valid_radius_squared.sqrt();
        let mut n = if start_radius > limit { target * (limit / start_radius) } else { *target };
        let mut residual = self.distort(&n) - target;
        let mut cost = residual.norm_squared();
        for _ in 0..UNDISTORT_ITERATIONS {
            // 1e-15 of a focal length: the rounding of the polynomial itself.
            if cost < 1e-30 {
                break;
            }
            let (a, b, c) = self.jacobian_parts(&n);
            let det = a * c - b * b;
            let step = Vector2::new(c * residual.x - b * residual.y, a * residual.y - b * residual.x) / det;
            // The Jacobian is positive definite on the disc, so a short enough step lowers the residual.
            let mut scale = 1.0;
            let mut improved = false;
            for _ in 0..20 {
                let trial = n - step * scale;
                let trial_residual = self.distort(&trial) - target;
                let trial_cost = trial_residual.norm_squared();
                if trial.norm_squared() <= valid_radius_squared && trial_cost < cost {
                    (n, residual, cost, improved) = (trial, trial_residual, trial_cost, true);
                    break;
                }
                scale *= 0.5;
            }
            if !improved {
                break;
            }
        }
        // 1e-11 focal lengths is far below any use; a target outside the image of the disc stays far above it.
        (cost < 1e-22 * (1.0 + target.norm_squared())).then_some(n)
    }
}

/// First radius where the lower bound of the Jacobian's eigenvalues reaches zero (see the module's header).
fn brown_radius(&[k1, k2, p1, p2, k3]: &[f64; 5]) -> f64 {
    if [k1, k2, p1, p2, k3] == [0.0; 5] {
        return MAX_RADIUS;
    }
    let tangential = -6.0 * p1.hypot(p2);
    let along = [1.0, tangential, 3.0 * k1, 0.0, 5.0 * k2, 0.0, 7.0 * k3];
    let across = [1.0, tangential, k1, 0.0, k2, 0.0, k3];
    let first = |p: &[f64; 7]| real_roots(p).as_slice().iter().copied().find(|r| *r > 0.0).unwrap_or(MAX_RADIUS);
    // A hair inside of the fold itself, where Newton's step is still defined.
    (first(&along).min(first(&across)) * (1.0 - 1e-9)).min(MAX_RADIUS)
}

/// `r_d` at an angle off the axis (rad), and its derivative by that angle.
#[inline]
pub(super) fn brandt(&[k1, k2, k3, k4]: &[f64; 4], angle: f64) -> (f64, f64) {
    let s = angle * angle;
    let radius = angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))));
    let slope = 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)));
    (radius, slope)
}

/// Largest angle off the axis (rad) up to which `r_d` grows, [`MAX_ANGLE_DEG`] at the most.
fn brandt_angle(&[k1, k2, k3, k4]: &[f64; 4]) -> f64 {
    let slope = [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4];
    let fold = real_roots(&slope).as_slice().iter().copied().find(|s| *s > 0.0).map_or(f64::INFINITY, f64::sqrt);
    (fold * (1.0 - 1e-9)).min(MAX_ANGLE_DEG.to_radians())
}

/// One unknown, the angle: `r_d` grows up to `limit` (rad), so Newton's steps are kept inside a bracket.
fn undistort_brandt(k: &[f64; 4], target: &Vector2<f64>, limit: f64) -> Option<Vector2<f64>> {
    // A hair inside, so that the answer distorts again whatever was rounded.
    let (radius, limit) = (target.norm(), limit * (1.0 - 1e-12));
    // NaN is refused here.
    if !(radius <= brandt(k, limit).0) {
        return None;
    }
    if radius == 0.0 {
        return Some(Vector2::zeros());
    }
    let (mut low, mut high) = (0.0, limit);
    let mut angle = radius.min(limit);
    for _ in 0..UNDISTORT_ITERATIONS {
        let (value, slope) = brandt(k, angle);
        let error = value - radius;
        if error > 0.0 {
            high = angle;
        } else {
            low = angle;
        }
        let step = angle - error / slope;
        let next = if step > low && step < high { step } else { 0.5 * (low + high) };
        let done = (next - angle).abs() < 1e-16 || error == 0.0;
        if error != 0.0 {
            angle = next;
        }
        if done {
            break;
        }
    }
    Some(target * (angle.tan() / radius))
}
