//! One place in a picture against one place in the world.
//!
//! In: a world point, where it was seen (undistorted, plane z = 1), the pixels that a step there counts as and their standard deviation.
//! Out: the residual in standard deviations and its derivatives. Poses and bundles are fitted to this one measurement.

pub mod inverse_distance;
pub mod noise;
pub mod rolling_shutter;

use nalgebra::{Matrix2, Matrix3, Matrix6, Vector2, Vector3, Vector6};

use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3, median};
use crate::map::{AssumedDistance, Observation};
use inverse_distance::Ray;

/// Points nearer to the image plane, or behind it, are not seen, map units.
pub(crate) const NEAREST: f64 = 1e-6;

/// Price of a place behind the camera in squared outlier limits: a step that does this is no gain.
pub(crate) const BEHIND_CAMERA: f64 = 100.0;

/// Standard deviation of a place in either of two views that tracks over many frames join, px.
pub const TWO_VIEW_SIGMA_PX: f64 = 1.0;

/// 95 % limit of chi-square with two degrees of freedom.
pub const CHI2_2D_95: f64 = 5.991;

/// 99.9 % limit of chi-square with two degrees of freedom: several views must all agree, of poses that are not exact.
const CHI2_2D_999: f64 = 13.816;

/// One landmark seen in the frame.
#[derive(Debug, Clone, Copy)]
pub struct Correspondence {
    /// World coordinates, map units.
    pub point: Vector3<f64>,
    /// Undistorted observation on the plane z = 1.
    pub normalised: Vector2<f64>,
    /// Square root of the information of `normalised`: standard deviations that a step on that plane counts as.
    pub sqrt_information: Matrix2<f64>,
    /// Where only this is known of the point: its distance is eliminated at whatever pose the pair is compared with.
    pub ray: Option<Ray>,
}

/// What a pair says of a pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Residual {
    /// Standard deviations.
    pub e: Vector2<f64>,
    /// The point in camera coordinates, map units.
    pub p: Vector3<f64>,
    /// Standard deviations that a step on the plane z = 1 counts as.
    pub scale: Matrix2<f64>,
}

impl Residual {
    /// Its derivative by the pose: [`jacobian_rows`]. Of a pair on a ray with the distance eliminated, to first order (the approximation of
    /// Kaufman 1975 to variable projection).
    #[inline]
    pub fn rows(&self) -> ([f64; 6], [f64; 6]) {
        jacobian_rows(&self.p, &self.scale)
    }
}

impl Correspondence {
    /// `pixel_scale`: pixels that steps on the plane z = 1 count as there ([`CameraModel::pixel_scale`]); `inv_sigma_px`: one over the
    /// standard deviation of a place in the picture, 1/px.
    pub fn new(point: Vector3<f64>, normalised: Vector2<f64>, pixel_scale: Matrix2<f64>, inv_sigma_px: f64) -> Self {
        Self { point, normalised, sqrt_information: pixel_scale * inv_sigma_px, ray: None }
    }

    /// What it tells of a pose near `pose` when its point is uncertain itself: `e' W e`, `W = (I + J P J')⁻¹` with P the point's
    /// covariance (world axes, map units²) and J the derivative of the residual by the point. The residual is whitened once, so everything
    /// that follows (loss, outliers, information) is in standard deviations of the innovation. Unchanged where P is not known.
    pub fn with_uncertain_point(self, pose: &Se3<Camera, World>, covariance: &Matrix3<f64>) -> Self {
        let p = pose.transform(&self.point);
        if !(p.z > NEAREST) {
            return self;
        }
        let (jx, jy) = jacobian_rows(&p, &self.sqrt_information);
        let world_from_camera = pose.rotation.inverse();
        let (x, y) = (
            world_from_camera * Vector3::new(jx[3], jx[4], jx[5]),
            world_from_camera * Vector3::new(jy[3], jy[4], jy[5]),
        );
        let (px, py) = (covariance * x, covariance * y);
        self.whitened(&Matrix2::new(x.dot(&px), x.dot(&py), x.dot(&py), y.dot(&py)))
    }

    /// The same with what the uncertainty adds to the residual's covariance, in squares of its standard deviation.
    fn whitened(self, added: &Matrix2<f64>) -> Self {
        let whitening = (Matrix2::identity() + added).cholesky().and_then(|c| c.l().try_inverse());
        match whitening.filter(|w| w.iter().all(|v| v.is_finite())) {
            Some(whitening) => Self { sqrt_information: whitening * self.sqrt_information, ..self },
            None => self,
        }
    }

    /// What a keyframe saw of `point`, as its middle row's pose would have seen it, for a readout time in seconds.
    pub fn observed(point: Vector3<f64>, seen: &Observation, camera: &CameraModel, readout_s: f64) -> Self {
        Self::new(point, seen.at_middle_row(readout_s), camera.pixel_scale(&seen.normalised), seen.inv_sigma_px)
    }

    /// Normalised innovation squared, `e' (I + J P J')⁻¹ e`, at a pose of that covariance (left perturbation) in which this pair had no part
    /// (Bar-Shalom, Li, Kirubarajan 2001, section 5.4); `None` behind the camera.
    pub fn innovation(&self, pose: &Se3<Camera, World>, covariance: &Matrix6<f64>) -> Option<f64> {
        let seen = residual(pose, self)?;
        let (e, (jx, jy)) = (seen.e, seen.rows());
        let (jx, jy) = (Vector6::from(jx), Vector6::from(jy));
        let (cx, cy) = (covariance * jx, covariance * jy);
        let spread = Matrix2::new(1.0 + jx.dot(&cx), jx.dot(&cy), jx.dot(&cy), 1.0 + jy.dot(&cy));
        Some(e.dot(&(spread.try_inverse()? * e)))
    }
}

impl Ray {
    /// The pair for poses near `pose` with the distance eliminated: its point lies at the most likely distance there, where the pair is
    /// linearised, and it is weighted by the covariance of the innovation from the assumed one (an iterated Kalman
    /// update; Bar-Shalom, Li, Kirubarajan 2001, section 10.5.2). `None` behind the camera.
    pub fn eliminate(&self, pose: &Se3<Camera, World>, pair: &Correspondence) -> Option<Correspondence> {
        let AssumedDistance { inverse: mean, sigma } = self.assumed;
        let rotated = pose.rotation * self.direction;
        // Place on the plane z = 1 and its derivative by the inverse distance.
        let see = |inverse: f64| {
            let p = pose.transform(&self.at(inverse));
            let n = p.xy() / p.z;
            (p.z > NEAREST).then(|| (n, (n * rotated.z - rotated.xy()) / (p.z * inverse * inverse)))
        };
        let pixels = |v: &Vector2<f64>| scaled(&pair.sqrt_information, v.x, v.y);
        let (mut inverse, (mut n, mut derivative)) = (mean, see(mean)?);
        for _ in 0..3 {
            let (e, j) = (pixels(&(n - pair.normalised)), pixels(&derivative));
            let gradient = j.dot(&e) + (inverse - mean) / (sigma * sigma);
            let step = gradient / (j.norm_squared() + 1.0 / (sigma * sigma));
            let next = (inverse - step).clamp(0.02 * mean, 10.0 * mean);
            // A step too far lies behind the camera.
            let Some(seen) = see(next) else { break };
            (inverse, (n, derivative)) = (next, seen);
        }
        let j = pixels(&derivative) * sigma;
        let normalised = pair.normalised - derivative * (mean - inverse);
        Some(Correspondence { point: self.at(inverse), normalised, ray: None, ..*pair }.whitened(&(j * j.transpose())))
    }

    /// Whether the observation lies where some likely distance puts it.
    pub fn agrees(&self, pose: &Se3<Camera, World>, seen: &Observation, camera: &CameraModel, readout_s: f64) -> bool {
        let pair = Correspondence::observed(self.point(), seen, camera, readout_s);
        let pair = Correspondence { ray: Some(*self), ..pair };
        residual(pose, &pair).is_some_and(|seen| seen.e.norm_squared() <= CHI2_2D_999)
    }
}

/// `None` behind the camera.
#[inline]
pub(crate) fn residual(pose: &Se3<Camera, World>, pair: &Correspondence) -> Option<Residual> {
    match &pair.ray {
        Some(ray) => residual_of_point(pose, &ray.eliminate(pose, pair)?),
        None => residual_of_point(pose, pair),
    }
}

#[inline]
fn residual_of_point(pose: &Se3<Camera, World>, pair: &Correspondence) -> Option<Residual> {
    let p = pose.transform(&pair.point);
    if !(p.z > NEAREST) {
        return None;
    }
    let iz = 1.0 / p.z;
    let scale = pair.sqrt_information;
    Some(Residual { e: scaled(&scale, p.x * iz - pair.normalised.x, p.y * iz - pair.normalised.y), p, scale })
}

/// A pinhole's scale: the short way then, with the same bits as the long one.
#[inline]
pub(crate) fn is_diagonal(scale: &Matrix2<f64>) -> bool {
    scale.m12 == 0.0 && scale.m21 == 0.0
}

/// A step on the plane z = 1 in standard deviations.
#[inline]
pub(crate) fn scaled(scale: &Matrix2<f64>, x: f64, y: f64) -> Vector2<f64> {
    if is_diagonal(scale) {
        return Vector2::new(scale.m11 * x, scale.m22 * y);
    }
    Vector2::new(scale.m11 * x + scale.m12 * y, scale.m21 * x + scale.m22 * y)
}

/// Rows of d e / d delta at camera point `p`: tangent `[rotation, translation]`, `p' = exp(w) p + v`.
#[inline]
pub(crate) fn jacobian_rows(p: &Vector3<f64>, scale: &Matrix2<f64>) -> ([f64; 6], [f64; 6]) {
    let iz = 1.0 / p.z;
    let (u, v) = (p.x * iz, p.y * iz);
    // d(u, v)/dp = iz [1 0 -u; 0 1 -v]; dp/dw = -[p]x, dp/dv = I.
    if is_diagonal(scale) {
        let (fx, fy) = (scale.m11, scale.m22);
        return (
            [-fx * u * v, fx * (1.0 + u * u), -fx * v, fx * iz, 0.0, -fx * u * iz],
            [-fy * (1.0 + v * v), fy * u * v, fy * u, 0.0, fy * iz, -fy * v * iz],
        );
    }
    let row = |a: f64, b: f64| {
        [
            -a * u * v - b * (1.0 + v * v),
            a * (1.0 + u * u) + b * u * v,
            -a * v + b * u,
            a * iz,
            b * iz,
            -a * u * iz - b * v * iz,
        ]
    };
    (row(scale.m11, scale.m12), row(scale.m21, scale.m22))
}

/// Median of distances, map units; `None` where that is none.
pub(crate) fn middle_distance(distances: &mut [f64]) -> Option<f64> {
    median(distances).filter(|distance| distance.is_finite() && *distance > NEAREST)
}

#[inline]
pub(crate) fn accumulate(h: &mut Matrix6<f64>, jx: &[f64; 6], jy: &[f64; 6], w: f64) {
    for c in 0..6 {
        let (a, b) = (w * jx[c], w * jy[c]);
        for r in 0..=c {
            h[(r, c)] += jx[r] * a + jy[r] * b;
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::geometry::random::Random;

    fn case(random: &mut Random, scale: Matrix2<f64>) -> (Se3<Camera, World>, Correspondence, Matrix3<f64>) {
        let mut vector = || Vector3::from_fn(|_, _| random.uniform(-1.0, 1.0));
        let pose = Se3::new(UnitQuaternion::from_scaled_axis(vector()), vector());
        let p = vector() + Vector3::new(0.0, 0.0, 3.0);
        let root = Matrix3::from_columns(&[vector(), vector(), vector()]) * 0.05;
        let normalised = p.xy() / p.z + vector().xy() * 0.01;
        let pair = Correspondence::new(pose.inverse().transform(&p), normalised, scale, 1.25);
        (pose, pair, root * root.transpose())
    }

    #[test]
    fn a_whitened_residual_counts_as_the_innovation_does() {
        let mut random = Random::new(5);
        for scale in [Matrix2::new(500.0, 0.0, 0.0, 510.0), Matrix2::new(210.0, -80.0, -81.0, 130.0)] {
            for _ in 0..20 {
                let (pose, pair, covariance) = case(&mut random, scale);
                let at = |point: Vector3<f64>| {
                    let p = pose.transform(&point);
                    scale * (p.xy() / p.z - pair.normalised)
                };
                // The reference: px, with a numeric derivative by the point.
                let step = |i: usize| Vector3::ith(i, 1e-6);
                let slope = |i: usize| (at(pair.point + step(i)) - at(pair.point - step(i))) / 2e-6;
                let j = nalgebra::Matrix2x3::from_columns(&[slope(0), slope(1), slope(2)]);
                let spread = Matrix2::identity() * 1.25f64.powi(-2) + j * covariance * j.transpose();
                let e = at(pair.point);
                let expected = e.dot(&(spread.try_inverse().unwrap() * e));
                let whitened = residual(&pose, &pair.with_uncertain_point(&pose, &covariance)).unwrap().e;
                let off = whitened.norm_squared() / expected - 1.0;
                assert!(off.abs() < 1e-6, "{} instead of {expected}", whitened.norm_squared());
            }
        }
    }

    #[test]
    fn what_is_not_known_or_not_seen_changes_nothing() {
        let (pose, pair, covariance) = case(&mut Random::new(6), Matrix2::new(500.0, 0.0, 0.0, 510.0));
        let unknown = pair.with_uncertain_point(&pose, &Matrix3::from_element(f64::NAN));
        assert_eq!(unknown.sqrt_information, pair.sqrt_information);
        let behind = Correspondence { point: pose.inverse().transform(&Vector3::new(0.1, 0.2, -1.0)), ..pair };
        assert_eq!(behind.with_uncertain_point(&pose, &covariance).sqrt_information, pair.sqrt_information);
        assert!(residual(&pose, &behind).is_none());
        assert!(residual(&pose, &Correspondence { point: Vector3::from_element(f64::NAN), ..pair }).is_none());
    }
}
