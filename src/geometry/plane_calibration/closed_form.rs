//! Camera and poses from the homographies of a plane, without a start.
//!
//! With `H = K [r1 r2 t]` up to scale and `B = K⁻ᵀ K⁻¹`, every view gives `h1ᵀ B h2 = 0` and `h1ᵀ B h1 = h2ᵀ B h2` (Zhang 2000,
//! eq. 3 and 4). Without skew B has five entries, and two views fix them. With the principal point in the middle two remain
//! (1/fx², 1/fy²), which is steadier when the views say little. Distortion is not known yet, so this is a start only.

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::adjust::{Intrinsics, Pose};
use crate::geometry::rotation::rotation_nearest;

/// Focal lengths in picture widths that are tried when nothing else helps.
const GUESSES: [f64; 5] = [0.9, 0.6, 1.4, 0.4, 2.2];

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
