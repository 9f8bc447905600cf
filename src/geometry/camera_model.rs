//! Pinhole camera with radial-tangential distortion (Brown-Conrady, coefficients in the order k1 k2 p1 p2 k3).
//!
//! Point in camera coordinates (x right, y down, z forward; map unit) -> undistorted normalised point `n = (x/z, y/z)`
//! -> pixel, and back. With `s = |n|²`:
//!
//! ```text
//! x_d = n_x (1 + k1 s + k2 s² + k3 s³) + 2 p1 n_x n_y + p2 (s + 2 n_x²)
//! y_d = n_y (1 + k1 s + k2 s² + k3 s³) + p1 (s + 2 n_y²) + 2 p2 n_x n_y
//! pixel = (fx x_d + cx, fy y_d + cy)
//! ```
//!
//! # Valid radius
//! A distortion polynomial fitted inside a picture folds back somewhere outside of it: without a limit a point far
//! off the axis lands in the middle of the picture. The Jacobian of the distortion is symmetric, so the distortion is
//! the gradient of a potential; where the Jacobian is positive definite on a whole disc the potential is strictly
//! convex there and the map is one to one. Its smaller eigenvalue is at least
//! `min(f'(r), f(r) / r) - 6 r sqrt(p1² + p2²)`, `f(r) = r (1 + k1 r² + k2 r⁴ + k3 r⁶)`; the valid radius is the first
//! `r` where that bound reaches zero. It is computed once, in [`CameraModel::new`].
//!
//! Cost: `project` about 10 ns, `undistort` about 100 ns (damped Newton, three or four steps; a fixed-point iteration
//! diverges on lenses with a large k3).
//!
//! Deliberately not here: fisheye models, uncertainties (they belong to the calibration), skew, rolling shutter.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};

use super::polynomial::real_roots;

/// No lens of this model sees farther off its axis than this (`tan` of 89.9 degrees).
const MAX_RADIUS: f64 = 573.0;
/// Newton steps of `undistort`; three or four are usual.
const UNDISTORT_ITERATIONS: usize = 40;

/// Why numbers do not make a camera.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraModelError {
    /// A picture without pixels.
    #[error("picture size {width} x {height} px: both must be at least 1 px")]
    EmptyPicture { width: u32, height: u32 },
    /// NaN or infinite.
    #[error("{key} = {value} {unit}: must be a finite number")]
    NotFinite { key: &'static str, value: f64, unit: &'static str },
    /// Zero or negative where only a positive number makes sense.
    #[error("{key} = {value} {unit}: must be greater than zero")]
    NotPositive { key: &'static str, value: f64, unit: &'static str },
    /// Another aspect: the picture was cropped, and nobody knows where.
    #[error("picture size {to_width} x {to_height} px has another aspect than the calibrated {width} x {height} px")]
    OtherAspect { width: u32, height: u32, to_width: u32, to_height: u32 },
}

/// Intrinsics and distortion of one camera at one picture size. Made by [`CameraModel::new`] only, which also computes
/// the valid radius: change a coefficient by making a new model.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraModel {
    /// Picture size that the intrinsics belong to, pixels.
    pub width: u32,
    pub height: u32,
    /// Focal lengths, pixels.
    pub fx: f64,
    pub fy: f64,
    /// Principal point, pixels; pixel (0, 0) is a pixel's centre.
    pub cx: f64,
    pub cy: f64,
    /// k1 k2 p1 p2 k3.
    pub distortion: [f64; 5],
    /// Square of the valid radius, in undistorted normalised coordinates.
    valid_radius_squared: f64,
}

impl CameraModel {
    /// Checks the numbers. `distortion` is k1 k2 p1 p2 k3 (no unit), the rest is in pixels.
    pub fn new(
        width: u32,
        height: u32,
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        distortion: [f64; 5],
    ) -> Result<Self, CameraModelError> {
        if width == 0 || height == 0 {
            return Err(CameraModelError::EmptyPicture { width, height });
        }
        for (key, value) in [("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy)] {
            if !value.is_finite() {
                return Err(CameraModelError::NotFinite { key, value, unit: "px" });
            }
        }
        for (key, value) in ["k1", "k2", "p1", "p2", "k3"].into_iter().zip(distortion) {
            if !value.is_finite() {
                return Err(CameraModelError::NotFinite { key, value, unit: "(no unit)" });
            }
        }
        for (key, value) in [("fx", fx), ("fy", fy)] {
            if value <= 0.0 {
                return Err(CameraModelError::NotPositive { key, value, unit: "px" });
            }
        }
        let radius = valid_radius(&distortion);
        Ok(Self { width, height, fx, fy, cx, cy, distortion, valid_radius_squared: radius * radius })
    }

    /// Pixel of a point in camera coordinates; `None` behind the camera or outside the valid radius of the distortion.
    /// The pixel may lie outside the picture: see [`CameraModel::contains`].
    #[inline]
    pub fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        self.distort(&normalised(point)?)
    }

    /// Pixel of an undistorted normalised point (x/z, y/z); `None` outside the valid radius.
    #[inline]
    pub fn distort(&self, n: &Vector2<f64>) -> Option<Vector2<f64>> {
        if !self.in_valid_radius(n) {
            return None;
        }
        let d = self.distort_normalised(n);
        Some(Vector2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy))
    }

    /// Undistorted normalised point of a pixel; `None` when no point inside the valid radius projects there.
    pub fn undistort(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let target = Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        if self.distortion == [0.0; 5] {
            return self.in_valid_radius(&target).then_some(target);
        }
        if !(target.x.is_finite() && target.y.is_finite()) {
            return None;
        }
        // Start at the distorted point, or inside the disc when that is outside of it.
        let start_radius = target.norm();
        let limit = 0.95 * self.valid_radius();
        let mut n = if start_radius > limit { target * (limit / start_radius) } else { target };
        let mut residual = self.distort_normalised(&n) - target;
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
                let trial_residual = self.distort_normalised(&trial) - target;
                let trial_cost = trial_residual.norm_squared();
                if self.in_valid_radius(&trial) && trial_cost < cost {
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

    /// Pixel and d pixel / d point in camera coordinates (2x3), distortion included.
    pub fn project_jacobian(&self, point: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let n = normalised(point)?;
        let (pixel, j) = self.distort_jacobian(&n)?;
        // d n / d point = 1/z [1 0 -n_x; 0 1 -n_y]
        let iz = 1.0 / point.z;
        let (a, b, c, d) = (j.m11 * iz, j.m12 * iz, j.m21 * iz, j.m22 * iz);
        Some((pixel, Matrix2x3::new(a, b, -(a * n.x + b * n.y), c, d, -(c * n.x + d * n.y))))
    }

    /// Pixel and d pixel / d undistorted normalised point (2x2).
    pub fn distort_jacobian(&self, n: &Vector2<f64>) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let pixel = self.distort(n)?;
        let (a, b, c) = self.jacobian_parts(n);
        Some((pixel, Matrix2::new(self.fx * a, self.fx * b, self.fy * b, self.fy * c)))
    }

    /// Undistorted normalised point of a pixel and d normalised / d pixel (2x2).
    pub fn undistort_jacobian(&self, pixel: &Vector2<f64>) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let n = self.undistort(pixel)?;
        let (_, jacobian) = self.distort_jacobian(&n)?;
        Some((n, jacobian.try_inverse()?))
    }

    /// Mean focal length, pixels: turns normalised residuals into pixels.
    pub fn focal_px(&self) -> f64 {
        0.5 * (self.fx + self.fy)
    }

    /// Largest |(x/z, y/z)| up to which the distortion is one to one.
    pub fn valid_radius(&self) -> f64 {
        self.valid_radius_squared.sqrt()
    }

    /// Is the pixel at least `border_px` inside the outermost pixel centres? False for NaN.
    #[inline]
    pub fn contains(&self, pixel: &Vector2<f64>, border_px: f64) -> bool {
        pixel.x >= border_px
            && pixel.y >= border_px
            && pixel.x <= f64::from(self.width) - 1.0 - border_px
            && pixel.y <= f64::from(self.height) - 1.0 - border_px
    }

    /// Can every pixel of the picture be undistorted? The four corners are the farthest from the axis. `false` tells of
    /// a calibration that was fitted to corners near the middle only.
    pub fn covers_picture(&self) -> bool {
        let (right, bottom) = (f64::from(self.width) - 1.0, f64::from(self.height) - 1.0);
        [(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)]
            .into_iter()
            .all(|(x, y)| self.undistort(&Vector2::new(x, y)).is_some())
    }

    /// The same lens with its picture resampled to another size of the same aspect (to one pixel of rounding).
    /// The pixel grid's outer border scales, so a pixel centre moves by `(c + 1/2) s - 1/2`.
    pub fn scaled(&self, to_width: u32, to_height: u32) -> Result<Self, CameraModelError> {
        let (width, height) = (self.width, self.height);
        if to_width == 0 || to_height == 0 {
            return Err(CameraModelError::EmptyPicture { width: to_width, height: to_height });
        }
        let sx = f64::from(to_width) / f64::from(width);
        let sy = f64::from(to_height) / f64::from(height);
        let off_px = ((sx - sy) * f64::from(height)).abs().min(((sx - sy) * f64::from(width)).abs());
        if off_px > 1.0 {
            return Err(CameraModelError::OtherAspect { width, height, to_width, to_height });
        }
        Self::new(
            to_width,
            to_height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
        )
    }

    /// False for NaN.
    #[inline]
    fn in_valid_radius(&self, n: &Vector2<f64>) -> bool {
        n.norm_squared() <= self.valid_radius_squared
    }

    /// Distorted normalised point, unchecked.
    #[inline]
    fn distort_normalised(&self, n: &Vector2<f64>) -> Vector2<f64> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let s = n.norm_squared();
        let radial = 1.0 + s * (k1 + s * (k2 + s * k3));
        let xy2 = 2.0 * n.x * n.y;
        Vector2::new(
            n.x * radial + p1 * xy2 + p2 * (s + 2.0 * n.x * n.x),
            n.y * radial + p1 * (s + 2.0 * n.y * n.y) + p2 * xy2,
        )
    }

    /// The symmetric Jacobian `[a b; b c]` of `distort_normalised`.
    #[inline]
    fn jacobian_parts(&self, n: &Vector2<f64>) -> (f64, f64, f64) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let s = n.norm_squared();
        let radial = 1.0 + s * (k1 + s * (k2 + s * k3));
        let slope2 = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3));
        (
            radial + slope2 * n.x * n.x + 2.0 * p1 * n.y + 6.0 * p2 * n.x,
            slope2 * n.x * n.y + 2.0 * (p1 * n.x + p2 * n.y),
            radial + slope2 * n.y * n.y + 6.0 * p1 * n.y + 2.0 * p2 * n.x,
        )
    }
}

/// (x/z, y/z) of a point in front of the camera.
#[inline]
fn normalised(point: &Vector3<f64>) -> Option<Vector2<f64>> {
    (point.z > 0.0).then(|| Vector2::new(point.x / point.z, point.y / point.z))
}

/// First radius where the lower bound of the Jacobian's eigenvalues reaches zero (see the module's header).
fn valid_radius(&[k1, k2, p1, p2, k3]: &[f64; 5]) -> f64 {
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Lenses of real cameras: none, a strong pincushion with k3 = 1.16, a barrel, one that folds inside 60 degrees.
    fn cameras() -> Vec<CameraModel> {
        [
            (525.0, 525.0, 319.5, 239.5, [0.0; 5]),
            (517.306408, 516.469215, 318.643040, 255.313989, [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]),
            (458.654, 457.296, 367.215, 248.375, [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0]),
            (420.0, 421.0, 330.0, 236.0, [-0.35, 0.02, 0.001, -0.002, 0.0]),
        ]
        .into_iter()
        .map(|(fx, fy, cx, cy, d)| CameraModel::new(640, 480, fx, fy, cx, cy, d).expect("valid numbers"))
        .collect()
    }

    #[test]
    fn undistort_inverts_distort_over_the_whole_picture() {
        for camera in cameras() {
            let mut defined = 0;
            for v in (0..480).step_by(9) {
                for u in (0..640).step_by(9) {
                    let pixel = Vector2::new(f64::from(u), f64::from(v));
                    if let Some(n) = camera.undistort(&pixel) {
                        let back = camera.distort(&n).expect("inside the valid radius");
                        assert!((back - pixel).norm() < 1e-8, "{camera:?} {pixel} -> {n} -> {back}");
                        defined += 1;
                    }
                }
            }
            assert_eq!(camera.covers_picture(), defined == 54 * 72, "{camera:?}: {defined} pixels");
            // The last lens folds inside this picture: its corners have no preimage.
            assert!(defined > 54 * 72 * 7 / 10, "{camera:?}: {defined}");
        }
    }

    #[test]
    fn distort_inverts_undistort_up_to_the_valid_radius() {
        for camera in cameras() {
            let radius = camera.valid_radius().min(2.0);
            for i in 0..400 {
                let angle = f64::from(i) * 0.37;
                let n = Vector2::new(angle.cos(), angle.sin()) * (radius * 0.999 * f64::from(i) / 400.0);
                let pixel = camera.distort(&n).expect("inside the valid radius");
                let back = camera.undistort(&pixel).expect("a pixel of a valid point");
                assert!((back - n).norm() < 1e-7, "{:?} {n} -> {back}", camera.distortion);
            }
        }
    }

    #[test]
    fn points_beyond_the_fold_do_not_project() {
        let camera = CameraModel::new(640, 480, 420.0, 420.0, 320.0, 240.0, [-0.35, 0.02, 0.0, 0.0, 0.0]).expect("ok");
        // f'(r) = 1 - 1.05 s + 0.1 s² = 0
        let fold = ((1.05 - (1.05f64 * 1.05 - 0.4).sqrt()) / 0.2).sqrt();
        assert!((camera.valid_radius() - fold).abs() < 1e-8, "{} and {fold}", camera.valid_radius());
        assert!(camera.project(&Vector3::new(fold * 0.999, 0.0, 1.0)).is_some());
        assert!(camera.project(&Vector3::new(fold * 1.001, 0.0, 1.0)).is_none());
        // No point at all lands farther out than the fold's image.
        let rim = camera.distort(&Vector2::new(fold * 0.999999, 0.0)).expect("inside");
        assert!(camera.undistort(&Vector2::new(rim.x + 1.0, 240.0)).is_none());
    }

    #[test]
    fn behind_the_camera_and_nan_do_not_project() {
        for camera in cameras() {
            assert!(camera.project(&Vector3::new(0.1, 0.1, 0.0)).is_none());
            assert!(camera.project(&Vector3::new(0.1, 0.1, -1.0)).is_none());
            assert!(camera.project(&Vector3::new(f64::NAN, 0.1, 1.0)).is_none());
            assert!(camera.project(&Vector3::new(0.1, 0.1, f64::NAN)).is_none());
            assert!(camera.undistort(&Vector2::new(f64::NAN, 0.0)).is_none());
            assert!(camera.undistort(&Vector2::new(f64::INFINITY, 0.0)).is_none());
            assert!(!camera.contains(&Vector2::new(f64::NAN, 5.0), 0.0));
        }
    }

    #[test]
    fn jacobians_equal_numeric_differences() {
        let h = 1e-6;
        for camera in cameras() {
            for point in
                [Vector3::new(0.3, -0.2, 1.5), Vector3::new(-0.9, 0.5, 2.0), Vector3::new(0.05, 0.6, 1.1)].iter()
            {
                let (pixel, j) = camera.project_jacobian(point).expect("visible");
                assert_eq!(pixel, camera.project(point).expect("visible"));
                for k in 0..3 {
                    let mut step = Vector3::zeros();
                    step[k] = h;
                    let plus = camera.project(&(point + step)).expect("visible");
                    let minus = camera.project(&(point - step)).expect("visible");
                    let numeric = (plus - minus) / (2.0 * h);
                    // 500 px times the third derivative times h², and rounding 1e-13 * 500 / h.
                    assert!((numeric - j.column(k)).norm() < 1e-5, "{k}: {numeric} and {j}");
                }
            }
        }
    }

    #[test]
    fn bad_numbers_are_named() {
        let make = |w, fx, cy, k3| CameraModel::new(w, 480, fx, 500.0, 320.0, cy, [0.0, 0.0, 0.0, 0.0, k3]);
        assert_eq!(make(0, 500.0, 240.0, 0.0), Err(CameraModelError::EmptyPicture { width: 0, height: 480 }));
        assert!(matches!(make(640, -3.0, 240.0, 0.0), Err(CameraModelError::NotPositive { key: "fx", .. })));
        assert!(matches!(make(640, 500.0, f64::NAN, 0.0), Err(CameraModelError::NotFinite { key: "cy", .. })));
        let error = make(640, 500.0, 240.0, f64::INFINITY).expect_err("infinite k3");
        assert!(error.to_string().contains("k3 = inf"), "{error}");
    }

    #[test]
    fn scaling_moves_pixels_as_resampling_does() {
        for camera in cameras() {
            let half = camera.scaled(320, 240).expect("same aspect");
            let n = Vector2::new(0.21, -0.13);
            let (full, small) = (camera.distort(&n).expect("inside"), half.distort(&n).expect("inside"));
            assert!(((full.x + 0.5) * 0.5 - 0.5 - small.x).abs() < 1e-9);
            assert!(((full.y + 0.5) * 0.5 - 0.5 - small.y).abs() < 1e-9);
            assert!(matches!(camera.scaled(640, 360), Err(CameraModelError::OtherAspect { .. })));
            assert!(camera.scaled(0, 0).is_err());
        }
    }
}
