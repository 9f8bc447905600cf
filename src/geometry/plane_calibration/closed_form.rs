//! Camera and poses from the homographies of a plane, without a start.
//!
//! With `H = K [r1 r2 t]` up to scale and `B = K⁻ᵀ K⁻¹`, every view gives `h1ᵀ B h2 = 0` and `h1ᵀ B h1 = h2ᵀ B h2` (Zhang 2000,
//! eq. 3 and 4). Without skew B has five entries, and two views fix them. With the principal point in the middle two remain
//! (1/fx², 1/fy²), which is steadier when the views say little. Distortion is not known yet, so this is a start only.
//!
//! A wide-angle lens bends the board so much that no homography fits its pixels. There the ideal equidistant lens of each of a row of
//! focal lengths is undone first; what remains of it is a plane seen by a unit pinhole ([`equidistant_pose`]).

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::adjust::Pose;
use super::projection::Intrinsics;
use super::view::View;
use crate::geometry::homography::dlt;
use crate::geometry::rotation::rotation_nearest;

/// Focal lengths in picture widths that are tried when nothing else helps.
const GUESSES: [f64; 5] = [0.9, 0.6, 1.4, 0.4, 2.2];

/// Focal lengths of wide-angle lenses in picture widths: 640 px wide, 105 degrees across at the largest, 360 at the smallest.
const WIDE_GUESSES: [f64; 8] = [0.45, 0.36, 0.55, 0.29, 0.68, 0.23, 0.85, 0.18];
/// Farther off the axis a point of a start is taken to be at this angle, rad.
const WIDEST_START: f64 = 1.4;

/// Starts `[fx, fy, cx, cy]`, the most trustworthy first.
pub fn candidates(homographies: &[Option<Matrix3<f64>>], (width, height): (u32, u32)) -> Vec<[f64; 4]> {
    let longer = f64::from(width.max(height));
    let middle = Vector2::new(0.5 * (f64::from(width) - 1.0), 0.5 * (f64::from(height) - 1.0));
    // Pixels from the middle in picture sizes: entries of B of like magnitude.
    let scale = 1.0 / longer;
    let normal = Matrix3::new(scale, 0.0, -middle.x * scale, 0.0, scale, -middle.y * scale, 0.0, 0.0, 1.0);
    let normalised: Vec<Matrix3<f64>> =
        homographies.iter().flatten().map(|h| normal * h).map(|h| h / h.norm()).collect();
    let back = |[fx, fy, cx, cy]: [f64; 4]| [fx * longer, fy * longer, cx * longer + middle.x, cy * longer + middle.y];
    let plausible = |c: &[f64; 4]| {
        let focal = |f: f64| (0.15..=15.0).contains(&f);
        focal(c[0]) && focal(c[1]) && (0.6..1.7).contains(&(c[0] / c[1])) && c[2].abs() < 0.35 && c[3].abs() < 0.35
    };
    let mut found: Vec<[f64; 4]> =
        [zhang(&normalised), centred(&normalised)].into_iter().flatten().filter(plausible).collect();
    found.extend(GUESSES.map(|f| [f, f, 0.0, 0.0]));
    found.into_iter().map(back).collect()
}

/// Coefficients of `hiᵀ B hj` in (B11, B22, B13, B23, B33).
fn constraint(h: &Matrix3<f64>, i: usize, j: usize) -> SVector<f64, 5> {
    let (a, b) = (h.column(i), h.column(j));
    SVector::from([a[0] * b[0], a[1] * b[1], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1], a[2] * b[2]])
}

/// fx fy cx cy in the homographies' unit.
fn zhang(homographies: &[Matrix3<f64>]) -> Option<[f64; 4]> {
    let mut normal = SMatrix::<f64, 5, 5>::zeros();
    for h in homographies {
        for row in [constraint(h, 0, 1), constraint(h, 0, 0) - constraint(h, 1, 1)] {
            normal += row * row.transpose();
        }
    }
    let eigen = normal.try_symmetric_eigen(1e-15, 200)?;
    let (least, _) = eigen.eigenvalues.argmin();
    let b = eigen.eigenvectors.column(least);
    let (b11, b22, b13, b23, b33) = (b[0], b[1], b[2], b[3], b[4]);
    let (cx, cy) = (-b13 / b11, -b23 / b22);
    let lambda = b33 - b13 * b13 / b11 - b23 * b23 / b22;
    let (fx2, fy2) = (lambda / b11, lambda / b22);
    let camera = [fx2.sqrt(), fy2.sqrt(), cx, cy];
    camera.iter().all(|v| v.is_finite()).then_some(camera)
}

/// The same with the principal point in the middle.
fn centred(homographies: &[Matrix3<f64>]) -> Option<[f64; 4]> {
    let (mut a, mut b) = (Matrix2::zeros(), Vector2::zeros());
    for h in homographies {
        for c in [constraint(h, 0, 1), constraint(h, 0, 0) - constraint(h, 1, 1)] {
            // B11 c0 + B22 c1 = -c4, with B33 = 1.
            let row = Vector2::new(c[0], c[1]);
            a += row * row.transpose();
            b -= row * c[4];
        }
    }
    let x = a.try_inverse()? * b;
    let camera = [(1.0 / x.x).sqrt(), (1.0 / x.y).sqrt(), 0.0, 0.0];
    camera.iter().all(|v| v.is_finite()).then_some(camera)
}

/// Pose of the plane in front of the camera.
pub fn pose(h: &Matrix3<f64>, k: &Intrinsics) -> Option<Pose> {
    let inverse = Matrix3::new(1.0 / k[0], 0.0, -k[2] / k[0], 0.0, 1.0 / k[1], -k[3] / k[1], 0.0, 0.0, 1.0);
    let m = inverse * h;
    let (r1, r2, t) = (m.column(0).into_owned(), m.column(1).into_owned(), m.column(2).into_owned());
    let scale = 2.0 / (r1.norm() + r2.norm()) * if t.z < 0.0 { -1.0 } else { 1.0 };
    let (r1, r2, t): (Vector3<f64>, Vector3<f64>, Vector3<f64>) = (r1 * scale, r2 * scale, t * scale);
    let rotation = rotation_nearest(&Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]))?;
    Some(Pose { rotation, translation: t })
}

/// Starts `[fx, fy, cx, cy]` for a wide-angle lens: equidistant, centred.
pub fn wide_candidates((width, height): (u32, u32)) -> [[f64; 4]; WIDE_GUESSES.len()] {
    let longer = f64::from(width.max(height));
    let (cx, cy) = (0.5 * (f64::from(width) - 1.0), 0.5 * (f64::from(height) - 1.0));
    WIDE_GUESSES.map(|f| [f * longer, f * longer, cx, cy])
}

/// Pose of a view's plane if the lens were ideal equidistant (angle off the axis = distorted radius).
pub fn equidistant_pose(view: &View, k: &Intrinsics) -> Option<Pose> {
    let undone: Vec<Vector2<f64>> = view
        .pixels
        .iter()
        .map(|pixel| {
            let d = Vector2::new((pixel.x - k[2]) / k[0], (pixel.y - k[3]) / k[1]);
            let radius = d.norm();
            if radius > 1e-9 { d * (radius.min(WIDEST_START).tan() / radius) } else { d }
        })
        .collect();
    let unit = Intrinsics::from([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    pose(&dlt(&view.plane, &undone)?, &unit)
}
