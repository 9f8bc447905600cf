//! Is the published covariance honest? The normalised estimation error squared (NEES) against its chi-square band.
//!
//! Input: records of simulated runs. Output: per judged frame `e' P⁻¹ e` for the whole pose (6 degrees of freedom) and for its
//! rotation and translation alone (3 each), and their means with the band that an honest covariance would give.
//!
//! The error is what `messages::Pose` defines: relative to the anchor keyframe, scale removed. With `A` the anchor and `C` the
//! camera, `E = A_from_C(estimated)⁻¹ · A_from_C(true)`, the truth's translation in map units, and `e = [-w, -v]` of the left
//! perturbation of `camera_from_world` that takes the estimate to the truth. The map's unit there is that of the frames within
//! [`SCALE_WINDOW_S`] to either side (a monocular map's scale drifts slowly, and the covariance does not speak of it).
//!
//! The band: with n independent frames, n times the mean NEES is chi-square with `n d` degrees of freedom (Bar-Shalom, Li,
//! Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4). Errors of neighbouring frames are
//! alike, so frames are judged [`JUDGED_EVERY_S`] apart.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use super::drive::{Anchor, Record};

/// Time between two judged frames of a run, s.
pub const JUDGED_EVERY_S: f64 = 1.0;
/// The map's unit is measured over so much time before and after a frame, s.
pub const SCALE_WINDOW_S: f64 = 3.0;

/// NEES of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nees {
    pub pose: f64,
    pub rotation: f64,
    pub translation: f64,
}

/// Motion from the anchor to the camera, estimated and true: `anchor_from_camera`.
fn relative(record: &Record) -> Option<[(nalgebra::UnitQuaternion<f64>, Vector3<f64>); 2]> {
    let Anchor { world_from_camera, truth } = record.anchor?;
    let estimate = world_from_camera.inverse() * record.estimate.world_from_camera?;
    let truth = truth.inverse() * record.truth;
    Some([(estimate.rotation, estimate.translation), (truth.rotation, truth.translation)])
}

/// Map units in a metre around record `at`, from its anchors' neighbourhoods.
fn units_per_metre(records: &[Record], at: usize) -> Option<f64> {
    let record = records.get(at)?;
    let near = |r: &&Record| {
        r.estimate.map == record.estimate.map
            && r.timestamp_ns.abs_diff(record.timestamp_ns) as f64 * 1e-9 <= SCALE_WINDOW_S
    };
    let (mut product, mut square) = (0.0, 0.0);
    for [estimate, truth] in records.iter().filter(near).filter_map(relative) {
        product += estimate.1.dot(&truth.1);
        square += truth.1.norm_squared();
    }
    (square > 1e-6 && product > 0.0).then_some(product / square)
}

/// Error `[w, v]` of frame `at` and its published covariance; `None` if it has no pose, or nothing to measure the map's unit by.
pub fn error(records: &[Record], at: usize) -> Option<(Vector6<f64>, Matrix6<f64>)> {
    let record = records.get(at)?;
    let [estimate, truth] = relative(record)?;
    let scale = units_per_metre(records, at)?;
    // camera_from_anchor: true = exp(w) estimated, then + v.
    let (r_estimate, r_true) = (estimate.0.inverse(), truth.0.inverse());
    let (t_estimate, t_true) = (-(r_estimate * estimate.1), -(r_true * (truth.1 * scale)));
    let turn = r_true * r_estimate.inverse();
    let w = turn.scaled_axis();
    let v = t_true - turn * t_estimate;
    Some((Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z), record.estimate.covariance))
}

/// `e' P⁻¹ e` of an error `[w, v]` and its parts.
fn nees(e: &Vector6<f64>, covariance: &Matrix6<f64>) -> Option<Nees> {
    let (w, v) = (e.fixed_rows::<3>(0).into_owned(), e.fixed_rows::<3>(3).into_owned());
    let block = |i: usize| -> Matrix3<f64> { covariance.fixed_view::<3, 3>(i, i).into_owned() };
    Some(Nees {
        pose: e.dot(&covariance.cholesky()?.solve(e)),
        rotation: w.dot(&block(0).cholesky()?.solve(&w)),
        translation: v.dot(&block(3).cholesky()?.solve(&v)),
    })
}

/// The NEES of a run's judged frames.
pub fn judge(records: &[Record]) -> Vec<Nees> {
    let mut out = Vec::new();
    let mut next_ns = i64::MIN;
    for (i, record) in records.iter().enumerate() {
        if record.timestamp_ns < next_ns {
            continue;
        }
        if let Some(n) = error(records, i).and_then(|(e, p)| nees(&e, &p)) {
            out.push(n);
            next_ns = record.timestamp_ns + (JUDGED_EVERY_S * 1e9) as i64;
        }
    }
    out
}

/// Mean NEES of one kind and what an honest covariance would give.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Consistency {
    pub frames: usize,
    pub degrees_of_freedom: u32,
    pub mean: f64,
    /// 95 % band of the mean.
    pub band: [f64; 2],
    /// Share of the frames within the 95 % interval of a single frame, and beyond its upper end.
    pub inside_percent: f64,
    pub above_percent: f64,
}

impl Consistency {
    /// `None` of no frames.
    pub fn of(values: &[f64], degrees_of_freedom: u32) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let (n, d) = (values.len() as f64, f64::from(degrees_of_freedom));
        let [low, high] = [chi2_quantile(d, -1.959_964), chi2_quantile(d, 1.959_964)];
        let percent = |f: &dyn Fn(f64) -> bool| 100.0 * values.iter().filter(|v| f(**v)).count() as f64 / n;
        Some(Self {
            frames: values.len(),
            degrees_of_freedom,
            mean: values.iter().sum::<f64>() / n,
            band: [chi2_quantile(n * d, -1.959_964) / n, chi2_quantile(n * d, 1.959_964) / n],
            inside_percent: percent(&|v| v >= low && v <= high),
            above_percent: percent(&|v| v > high),
        })
    }

    /// The mean lies in its band.
    pub fn is_honest(&self) -> bool {
        self.mean >= self.band[0] && self.mean <= self.band[1]
    }
}

/// Quantile of chi-square by Wilson and Hilferty's cube (1931); `z`: the same quantile of the normal distribution. Within 3 %
/// from three degrees of freedom on.
pub fn chi2_quantile(degrees_of_freedom: f64, z: f64) -> f64 {
    let a = 2.0 / (9.0 * degrees_of_freedom);
    degrees_of_freedom * (1.0 - a + z * a.sqrt()).powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_chi_square_are_those_of_the_tables() {
        for (d, z, table) in
            [(3.0, 1.959_964, 9.348), (6.0, 1.959_964, 14.449), (6.0, -1.959_964, 1.237), (60.0, 1.644_854, 79.082)]
        {
            let found = chi2_quantile(d, z);
            assert!((found - table).abs() < 0.03 * table, "{d} degrees of freedom: {found} instead of {table}");
        }
    }

    #[test]
    fn errors_drawn_from_the_covariance_are_honest_and_twice_as_large_ones_are_not() {
        let mut state = 11u64;
        let mut uniform = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut normal = || (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        let mut a = Matrix6::from_fn(|_, _| normal());
        a += Matrix6::identity() * 3.0;
        let covariance = a * a.transpose();
        let mut values = [Vec::new(), Vec::new(), Vec::new()];
        for _ in 0..500 {
            let e = a * Vector6::from_fn(|_, _| normal());
            let n = nees(&e, &covariance).unwrap();
            for (list, value) in values.iter_mut().zip([n.pose, n.rotation, n.translation]) {
                list.push(value);
            }
        }
        for (list, d) in values.iter().zip([6, 3, 3]) {
            let honest = Consistency::of(list, d).unwrap();
            assert!(honest.is_honest() && honest.inside_percent > 90.0, "{honest:?}");
            let doubled: Vec<f64> = list.iter().map(|v| 4.0 * v).collect();
            assert!(!Consistency::of(&doubled, d).unwrap().is_honest());
        }
    }
}
