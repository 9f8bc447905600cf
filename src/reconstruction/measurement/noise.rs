//! How exactly places are found in this camera's pictures, against what is supposed (`sigma_px`).
//!
//! What is supposed is right where a hand turns a webcam with a rolling shutter: bundle adjustments leave 0.36 to 0.52 px there, and 0.13 to 0.21 px in
//! sharp pictures (robust standard deviations, medians of eleven recordings). In sharp pictures a limit that is right for the webcam lets corners pass as
//! landmarks that are none: where an edge crosses another one behind it, say. Three of four rooms of the
//! simulator's `desk_sweep` bent by it.
//!
//! In: what adjustments leave ([`AdjustmentResult::noise`](crate::reconstruction::adjust::job::AdjustmentResult)). Out: the limit beyond which a place is an
//! outlier, and in a frame weighs less from. Standard deviations stay what is supposed: covariances and the lens are fitted so. Known of the camera, it
//! outlasts the map, not the run; who only locates learns nothing.

use super::CHI2_2D_95;

/// Standard deviation of a found place as a share of the supposed one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceNoise {
    log_share: f64,
    /// Adjustments that have told it.
    told: u32,
}

/// A place in a new frame is off by so many times what an adjustment leaves of those that it has fitted itself to: 1.4 to 2.5 in the median of a
/// recording, and not all of its errors are normal. (With 2.5 errors are 3 % smaller over half A of the derived recordings, but of the recordings
/// themselves a quick hand's is lost once.)
const BEYOND_FIT: f64 = 3.0;
/// The smallest share that is believed: what is left of a fit does not show where all of it is off.
const LEAST: f64 = 0.5;
/// The newest adjustment weighs one over this in the mean, once there were so many: neighbouring ones have most observations in common.
const ADJUSTMENTS: u32 = 5;

impl Default for PlaceNoise {
    /// As supposed.
    fn default() -> Self {
        Self { log_share: 0.0, told: 0 }
    }
}

impl PlaceNoise {
    pub fn share(&self) -> f64 {
        self.log_share.exp()
    }

    /// Limit of a squared residual, in supposed standard deviations, that 95 % of places keep.
    pub fn outlier_chi2(&self) -> f64 {
        CHI2_2D_95 * self.share().powi(2)
    }

    /// Takes what an adjustment left, if it could tell: the robust standard deviation of its residuals, in supposed ones.
    pub fn learn(&mut self, left: Option<f64>) {
        let Some(left) = left.filter(|left| left.is_finite()) else { return };
        self.told = (self.told + 1).min(ADJUSTMENTS);
        self.log_share += ((BEYOND_FIT * left).clamp(LEAST, 1.0).ln() - self.log_share) / f64::from(self.told);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_follows_what_adjustments_leave_within_its_bounds() {
        let after = |left: Option<f64>| {
            let mut noise = PlaceNoise::default();
            (0..60).for_each(|_| noise.learn(left));
            noise.share()
        };
        assert!((after(Some(0.2)) - 0.2 * BEYOND_FIT).abs() < 1e-6);
        assert!((after(Some(0.05)) - 0.5).abs() < 1e-6, "a lucky fit");
        assert!((after(Some(3.0)) - 1.0).abs() < 1e-6, "no more than is supposed");
        assert_eq!([after(Some(f64::NAN)), after(None)], [1.0; 2]);
        let mut noise = PlaceNoise::default();
        noise.learn(Some(0.1));
        assert!((noise.outlier_chi2() - CHI2_2D_95 / 4.0).abs() < 1e-9, "the first word is all that is known");
    }
}
