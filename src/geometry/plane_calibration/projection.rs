//! Pixels of camera points, and their derivatives by the camera and by a pose, for both lens models.
//!
//! The same formulas as [`LensModel`]'s, without its limits of validity: on its way an adjustment may pass
//! through a lens that folds. Points beyond 90 degrees off the axis are fine for the wide-angle model: the angle is taken from the
//! point itself and not from the plane z = 1.

use nalgebra::{SVector, Vector2, Vector3, Vector6};

use crate::geometry::LensModel;
use crate::geometry::lens_model::brandt;

/// Numbers of a camera at the most.
pub const PARAMETERS: usize = 9;
/// fx fy cx cy and the coefficients of the lens; those that a lens does not have are zero.
pub type Intrinsics = SVector<f64, PARAMETERS>;

/// Which lens model the coefficients are of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LensKind {
    /// k1 k2 p1 p2 k3
    #[default]
    RadialTangential,
    /// k1 k2 k3 k4
    KannalaBrandt,
}

impl std::str::FromStr for LensKind {
    type Err = String;

    /// By the names of our calibration files.
    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "radial_tangential" => Ok(Self::RadialTangential),
            "kannala_brandt" | "fisheye" => Ok(Self::KannalaBrandt),
            _ => Err(format!("`{name}` is neither radial_tangential nor kannala_brandt (OpenCV's fisheye)")),
        }
    }
}

impl LensKind {
    /// Names of the camera's numbers, in their order.
    pub fn parameter_names(self) -> &'static [&'static str] {
        match self {
            Self::RadialTangential => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"],
            Self::KannalaBrandt => &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
        }
    }

    /// The lens of these numbers.
    pub fn lens_model(self, k: &Intrinsics) -> LensModel {
        match self {
            Self::RadialTangential => LensModel::RadialTangential([k[4], k[5], k[6], k[7], k[8]]),
            Self::KannalaBrandt => LensModel::KannalaBrandt([k[4], k[5], k[6], k[7]]),
        }
    }

    /// Pixel of a camera point; `None` behind a pinhole camera, or at the camera itself.
    pub fn project(self, k: &Intrinsics, p: &Vector3<f64>) -> Option<Vector2<f64>> {
        match self {
            Self::RadialTangential => project_brown(k, p),
            Self::KannalaBrandt => {
                let across = p.x.hypot(p.y);
                let scale = if across > 1e-12 * p.z {
                    brandt(&coefficients(k), across.atan2(p.z)).0 / across
                } else if p.z > 0.0 {
                    1.0 / p.z
                } else {
                    return None;
                };
                Some(Vector2::new(k[0] * scale * p.x + k[2], k[1] * scale * p.y + k[3]))
            }
        }
    }

    /// Pixel, and its derivatives by the intrinsics (2x9) and by the pose's perturbation (2x6), row by row.
    #[allow(clippy::type_complexity)]
    pub fn project_jacobian(
        self,
        k: &Intrinsics,
        p: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, [SVector<f64, PARAMETERS>; 2], [Vector6<f64>; 2])> {
        match self {
            Self::RadialTangential => brown_jacobian(k, p),
            Self::KannalaBrandt => brandt_jacobian(k, p),
        }
    }
}

fn coefficients(k: &Intrinsics) -> [f64; 4] {
    [k[4], k[5], k[6], k[7]]
}

fn project_brown(k: &Intrinsics, p: &Vector3<f64>) -> Option<Vector2<f64>> {
    if !(p.z > 0.0) {
        return None;
    }
    let (x, y) = (p.x / p.z, p.y / p.z);
    let s = x * x + y * y;
    let radial = 1.0 + s * (k[4] + s * (k[5] + s * k[8]));
    let xd = x * radial + 2.0 * k[6] * x * y + k[7] * (s + 2.0 * x * x);
    let yd = y * radial + k[6] * (s + 2.0 * y * y) + 2.0 * k[7] * x * y;
    Some(Vector2::new(k[0] * xd + k[2], k[1] * yd + k[3]))
}

#[allow(clippy::type_complexity)]
fn brown_jacobian(
    k: &Intrinsics,
    p: &Vector3<f64>,
) -> Option<(Vector2<f64>, [SVector<f64, PARAMETERS>; 2], [Vector6<f64>; 2])> {
    if !(p.z > 0.0) {
        return None;
    }
    let iz = 1.0 / p.z;
    let (x, y) = (p.x * iz, p.y * iz);
    let s = x * x + y * y;
    let (s2, s3) = (s * s, s * s * s);
    let radial = 1.0 + k[4] * s + k[5] * s2 + k[8] * s3;
    let xy2 = 2.0 * x * y;
    let (tx, ty) = (s + 2.0 * x * x, s + 2.0 * y * y);
    let xd = x * radial + k[6] * xy2 + k[7] * tx;
    let yd = y * radial + k[6] * ty + k[7] * xy2;
    let pixel = Vector2::new(k[0] * xd + k[2], k[1] * yd + k[3]);
    let (fx, fy) = (k[0], k[1]);
    let du = SVector::from([xd, 0.0, 1.0, 0.0, fx * x * s, fx * x * s2, fx * xy2, fx * tx, fx * x * s3]);
    let dv = SVector::from([0.0, yd, 0.0, 1.0, fy * y * s, fy * y * s2, fy * ty, fy * xy2, fy * y * s3]);
    // By the normalised point: symmetric.
    let slope2 = 2.0 * (k[4] + 2.0 * k[5] * s + 3.0 * k[8] * s2);
    let a = radial + slope2 * x * x + 2.0 * k[6] * y + 6.0 * k[7] * x;
    let b = slope2 * x * y + 2.0 * (k[6] * x + k[7] * y);
    let c = radial + slope2 * y * y + 6.0 * k[6] * y + 2.0 * k[7] * x;
    // d(x, y) by the perturbation of the camera point.
    let dx = Vector6::new(-x * y, 1.0 + x * x, -y, iz, 0.0, -x * iz);
    let dy = Vector6::new(-1.0 - y * y, x * y, x, 0.0, iz, -y * iz);
    Some((pixel, [du, dv], [(dx * a + dy * b) * fx, (dx * b + dy * c) * fy]))
}

#[allow(clippy::type_complexity)]
fn brandt_jacobian(
    k: &Intrinsics,
    p: &Vector3<f64>,
) -> Option<(Vector2<f64>, [SVector<f64, PARAMETERS>; 2], [Vector6<f64>; 2])> {
    let across = p.x.hypot(p.y);
    let square = p.norm_squared();
    let (fx, fy) = (k[0], k[1]);
    // (xd, yd), its derivatives by k1..k4 as multiples of the direction, and by the point.
    let (direction, radius, angle, dxd, dyd) = if across > 1e-12 * p.z {
        let angle = across.atan2(p.z);
        let (radius, slope) = brandt(&coefficients(k), angle);
        let d = Vector2::new(p.x / across, p.y / across);
        // The angle by the point: along the direction z / |p|², along the axis -across / |p|².
        let (along, axial) = (slope * p.z / square, -slope * across / square);
        let round = radius / across;
        let dxd = Vector3::new(along * d.x * d.x + round * d.y * d.y, (along - round) * d.x * d.y, axial * d.x);
        let dyd = Vector3::new((along - round) * d.x * d.y, along * d.y * d.y + round * d.x * d.x, axial * d.y);
        (d, radius, angle, dxd, dyd)
    } else if p.z > 0.0 {
        let iz = 1.0 / p.z;
        (Vector2::zeros(), 0.0, 0.0, Vector3::new(iz, 0.0, 0.0), Vector3::new(0.0, iz, 0.0))
    } else {
        return None;
    };
    let (xd, yd) = (radius * direction.x, radius * direction.y);
    let powers = [3, 5, 7, 9].map(|n| angle.powi(n));
    let row = |f: f64, e: f64| powers.map(|power| f * e * power);
    let (ku, kv) = (row(fx, direction.x), row(fy, direction.y));
    let du = SVector::from([xd, 0.0, 1.0, 0.0, ku[0], ku[1], ku[2], ku[3], 0.0]);
    let dv = SVector::from([0.0, yd, 0.0, 1.0, kv[0], kv[1], kv[2], kv[3], 0.0]);
    // d p = w x p + v: by w it is p x (d / d p).
    let pose = |f: f64, d: &Vector3<f64>| {
        let turn = p.cross(d);
        Vector6::new(turn.x, turn.y, turn.z, d.x, d.y, d.z) * f
    };
    Some((Vector2::new(fx * xd + k[2], fy * yd + k[3]), [du, dv], [pose(fx, &dxd), pose(fy, &dyd)]))
}
