//! A camera: intrinsics and a lens.
//!
//! Point in camera coordinates (x right, y down, z forward; map unit) -> undistorted normalised point `n = (x/z, y/z)`
//! -> distorted normalised point (by the [`LensModel`]: pinhole with radial-tangential distortion, or Kannala-Brandt for wide-angle
//! lenses) -> pixel `(fx x_d + cx, fy y_d + cy)`, and back. The valid radius of the lens is computed once, in [`CameraModel::new`].
//!
//! Undistorted points lie on the plane z = 1 whatever the lens, so rays 90 degrees off the axis and beyond do not exist here.
//!
//! # The plane z = 1 off the axis of a wide-angle lens
//! At the angle t off the axis the plane is stretched by `1/cos² t` along the radius and `1/cos t` across it: one pixel is 4 units of its
//! middle at 60 degrees and 8.5 at 70. Errors on it are turned to pixels by [`CameraModel::pixel_scale`], which for a
//! pinhole lens is the focal lengths (its own distortion is a few percent) and for a wide-angle one the lens's Jacobian at the
//! place. Steps that weigh all points of the plane alike (two-view geometry, P3P) take the points of [`CameraModel::is_central`] only.
//!
//! Cost: `project` about 10 ns, 40 ns for a wide-angle lens; `undistort` about 100 ns.
//!
//! Deliberately not here: uncertainties (they belong to the calibration), skew, rolling shutter.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};

use super::lens_model::LensModel;

/// Square of the radius on z = 1 (50 degrees) up to which the plane of a wide-angle lens counts as even: there one pixel is 2.4 units
/// of the middle along the radius.
const CENTRAL_RADIUS_SQUARED: f64 = 1.42;

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
    pub lens: LensModel,
    /// Square of the valid radius, in undistorted normalised coordinates.
    valid_radius_squared: f64,
}

impl CameraModel {
    /// Checks the numbers. `lens`: a [`LensModel`], or k1 k2 p1 p2 k3 for a radial-tangential one (no unit); the rest is in pixels.
    pub fn new(
        width: u32,
        height: u32,
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        lens: impl Into<LensModel>,
    ) -> Result<Self, CameraModelError> {
        let lens = lens.into();
        if width == 0 || height == 0 {
            return Err(CameraModelError::EmptyPicture { width, height });
        }
        for (key, value) in [("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy)] {
            if !value.is_finite() {
                return Err(CameraModelError::NotFinite { key, value, unit: "px" });
            }
        }
        for (&key, &value) in lens.names().iter().zip(lens.coefficients()) {
            if !value.is_finite() {
                return Err(CameraModelError::NotFinite { key, value, unit: "(no unit)" });
            }
        }
        for (key, value) in [("fx", fx), ("fy", fy)] {
            if value <= 0.0 {
                return Err(CameraModelError::NotPositive { key, value, unit: "px" });
            }
        }
        let radius = lens.valid_radius();
        Ok(Self { width, height, fx, fy, cx, cy, lens, valid_radius_squared: radius * radius })
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
        let d = self.lens.distort(n);
        Some(Vector2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy))
    }

    /// Undistorted normalised point of a pixel; `None` when no point inside the valid radius projects there.
    pub fn undistort(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let target = Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        self.lens.undistort(&target, self.valid_radius_squared)
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
        let (a, b, c) = self.lens.jacobian_parts(n);
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

    /// Equal parts of the picture, four columns and three rows, that tell how far over it something lies.
    pub const PARTS: usize = 12;

    /// Which of the [`PARTS`](Self::PARTS) of the picture a pixel is in, counted row by row; the nearest one for a pixel outside.
    pub fn part_of(&self, pixel: &Vector2<f64>) -> usize {
        let (columns, rows) = (4, Self::PARTS / 4);
        let share = |at: f64, size: u32, parts: usize| {
            ((at / f64::from(size) * parts as f64).max(0.0) as usize).min(parts.saturating_sub(1))
        };
        share(pixel.y, self.height, rows) * columns + share(pixel.x, self.width, columns)
    }

    /// Can every pixel of the picture be undistorted? The four corners are the farthest from the axis. `false` tells of
    /// a calibration that was fitted to corners near the middle only. Pixels of a wide-angle lens beyond
    /// [`MAX_ANGLE_DEG`](super::lens_model::MAX_ANGLE_DEG) (the corners of a circular fisheye picture, too) do not count against it,
    /// as long as it is one to one up to there.
    pub fn covers_picture(&self) -> bool {
        self.covers(0.0)
    }

    /// The same but for so much of the picture at each side, as a share of it.
    pub fn covers(&self, border: f64) -> bool {
        if self.lens.is_wide_angle() && self.lens.is_unfolded() {
            return true;
        }
        let (right, bottom) = (f64::from(self.width) - 1.0, f64::from(self.height) - 1.0);
        let (low, high) = (border, 1.0 - border);
        [(low, low), (high, low), (low, high), (high, high)]
            .into_iter()
            .all(|(x, y)| self.undistort(&Vector2::new(x * right, y * bottom)).is_some())
    }

    /// Pixels that small steps on the plane z = 1 near `n` count as (2x2): the focal lengths for a pinhole lens, the lens's Jacobian
    /// at `n` for a wide-angle one.
    #[inline]
    pub fn pixel_scale(&self, n: &Vector2<f64>) -> Matrix2<f64> {
        match self.lens {
            LensModel::RadialTangential(_) => Matrix2::new(self.fx, 0.0, 0.0, self.fy),
            LensModel::KannalaBrandt(_) => {
                let (a, b, c) = self.lens.jacobian_parts(n);
                Matrix2::new(self.fx * a, self.fx * b, self.fy * b, self.fy * c)
            }
        }
    }

    /// Length of a small step on the plane z = 1 at `n`, pixels.
    pub fn pixels(&self, n: &Vector2<f64>, step: &Vector2<f64>) -> f64 {
        match self.lens {
            LensModel::RadialTangential(_) => step.norm() * self.focal_px(),
            LensModel::KannalaBrandt(_) => (self.pixel_scale(n) * step).norm(),
        }
    }

    /// Is `n` where steps on the plane z = 1 are worth about as many pixels as in its middle? Everywhere for a pinhole lens, up to 50
    /// degrees off the axis for a wide-angle one.
    pub fn is_central(&self, n: &Vector2<f64>) -> bool {
        !self.lens.is_wide_angle() || n.norm_squared() <= CENTRAL_RADIUS_SQUARED
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
            self.lens,
        )
    }

    /// False for NaN.
    #[inline]
    fn in_valid_radius(&self, n: &Vector2<f64>) -> bool {
        n.norm_squared() <= self.valid_radius_squared
    }
}

/// (x/z, y/z) of a point in front of the camera.
#[inline]
fn normalised(point: &Vector3<f64>) -> Option<Vector2<f64>> {
    (point.z > 0.0).then(|| Vector2::new(point.x / point.z, point.y / point.z))
}

#[cfg(test)]
mod tests;
