use super::Se3;
use super::frames::{First, Second};
use nalgebra::{Matrix3, SMatrix, Vector2, Vector3};
pub struct TwoViewOptions {
    pub seed: u64,
    pub f: f64,
}
impl TwoViewOptions {
    pub fn new(f: f64) -> Self {
        Self { seed: 0, f }
    }
}
pub struct TwoView {
    pub second_from_first: Se3<Second, First>,
    pub points: Vec<Option<Vector3<f64>>>,
}
pub fn reconstruct_two_views(a: &[Vector2<f64>], b: &[Vector2<f64>], o: &TwoViewOptions) -> Result<TwoView, ()> {
    let mut st = o.seed.wrapping_mul(0x9E3779B97F4A7C15) | 1;
    let mut rnd = |n: usize| {
        st ^= st << 13;
        st ^= st >> 7;
        st ^= st << 17;
        (st >> 33) as usize % n
    };
    let fit = |idx: &[usize]| -> Matrix3<f64> {
        let mut m = SMatrix::<f64, 9, 9>::zeros();
        for &i in idx {
            let (x, y) = (a[i], b[i]);
            let r = SMatrix::<f64, 9, 1>::from_column_slice(&[
                y.x * x.x,
                y.x * x.y,
                y.x,
                y.y * x.x,
                y.y * x.y,
                y.y,
                x.x,
                x.y,
                1.0,
            ]);
            m += r * r.transpose();
        }
        let e = m.symmetric_eigen();
        let k = e.eigenvalues.imin();
        let v = e.eigenvectors.column(k);
        let f = Matrix3::new(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8]);
        let s = f.svd(true, true);
        s.u.unwrap() * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0)) * s.v_t.unwrap()
    };
    let res = |e: &Matrix3<f64>, i: usize| {
        let (x, y) = (a[i].push(1.0), b[i].push(1.0));
        let l = e * x;
        let l2 = e.transpose() * y;
        let d = y.dot(&l);
        d * d / (l.x * l.x + l.y * l.y + l2.x * l2.x + l2.y * l2.y)
    };
    let th = (1.5 / o.f).powi(2);
    let mut best = (0, Vec::new());
    for _ in 0..300 {
        let idx: Vec<usize> = (0..8).map(|_| rnd(a.len())).collect();
        let e = fit(&idx);
        let inl: Vec<usize> = (0..a.len()).filter(|&i| res(&e, i) < th).collect();
        if inl.len() > best.0 {
            best = (inl.len(), inl);
        }
    }
    if best.0 < 50 {
        return Err(());
    }
    for _ in 0..5 {
        let e = fit(&best.1);
        best.1 = (0..a.len()).filter(|&i| res(&e, i) < th).collect();
        if best.1.len() < 50 {
            return Err(());
        }
    }
    let e = fit(&best.1);
    let s = e.svd(true, true);
    let (mut u, mut vt) = (s.u.unwrap(), s.v_t.unwrap());
    if u.determinant() < 0.0 {
        u = -u
    }
    if vt.determinant() < 0.0 {
        vt = -vt
    }
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let mut sols = vec![];
    for r in [u * w * vt, u * w.transpose() * vt] {
        for sg in [1.0, -1.0] {
            let t: Vector3<f64> = u.column(2) * sg;
            let pose: Se3<Second, First> = Se3::from_matrix(&r, t);
            let mut n = 0;
            let mut pts = vec![None; a.len()];
            for &i in &best.1 {
                let d1 = a[i].push(1.0).normalize();
                let d2 = (r.transpose() * b[i].push(1.0)).normalize();
                let base = -(r.transpose() * t);
                let c = d1.dot(&d2);
                let s2 = 1.0 - c * c;
                if s2 < (0.7f64.to_radians()).sin().powi(2) {
                    continue;
                }
                let (b1, b2) = (base.dot(&d1), base.dot(&d2));
                let s1 = (b1 - c * b2) / s2;
                let q2 = (c * b1 - b2) / s2;
                if s1 > 0.0 && q2 > 0.0 {
                    n += 1;
                    pts[i] = Some((d1 * s1 + base + d2 * q2) * 0.5);
                }
            }
            sols.push((n, pose, pts));
        }
    }
    sols.sort_by_key(|s| std::cmp::Reverse(s.0));
    if sols[0].0 < 50 || sols[1].0 * 10 > sols[0].0 * 7 {
        return Err(());
    }
    let s = sols.swap_remove(0);
    Ok(TwoView { second_from_first: s.1, points: s.2 })
}
