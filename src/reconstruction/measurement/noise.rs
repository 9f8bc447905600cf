//! How exactly places are found in this camera's pictures.
//!
//! Gates, weights and covariances are in standard deviations of a found place, and what that is differs by a factor of four between cameras: bundle
//! adjustments leave 0.13 to 0.21 px of sharp pictures, 0.36 to 0.52 px where a hand turns a webcam (robust standard deviations, medians of eleven
//! recordings). By one value for all, 0.8 px, corners that are none pass as landmarks with the former: where an edge crosses another one behind it, say.
//! Three of four rooms of the simulator's `desk_sweep` bent by it.
//!
//! In: what an adjustment leaves ([`AdjustmentResult::noise_px`](crate::reconstruction::adjust::job::AdjustmentResult::noise_px)). Out: the standard deviation of a place in a new frame, px at
//! full resolution. It is a property of the camera and outlasts the map. Chosen on half of the derived recordings (`tests/results/derived.py`).

/// Standard deviation of a found place, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceNoise {
    log_sigma_px: f64,
    most_px: f64,
    /// Adjustments that have told it.
    told: u32,
}

/// A place in a new frame is off by so many times what an adjustment leaves of those that it has fitted itself to: 1.4 to 2.5 in the median of a recording.
const BEYOND_FIT: f64 = 2.5;
/// Never smaller than this, px: what is left of a fit does not show where all of it is off.
const LEAST_PX: f64 = 0.4;
/// Adjustments that it is the mean of, the newest counting most: neighbouring ones have most observations in common.
const ADJUSTMENTS: u32 = 5;

impl PlaceNoise {
    /// Before anything is known: between the least and the most that there is.
    pub fn new(most_px: f64) -> Self {
        let log_sigma_px = 0.5 * (LEAST_PX.min(most_px).ln() + most_px.ln());
        Self { log_sigma_px, most_px, told: 0 }
    }

    pub fn sigma_px(&self) -> f64 {
        self.log_sigma_px.exp()
    }

    /// Takes what an adjustment left: the robust standard deviation of its residuals, px, if it could tell.
    pub fn learn(&mut self, left_px: Option<f64>) {
        let Some(left_px) = left_px else { return };
        let sigma_px = (BEYOND_FIT * left_px).clamp(LEAST_PX.min(self.most_px), self.most_px);
        if sigma_px > 0.0 {
            self.told = (self.told + 1).min(ADJUSTMENTS);
            self.log_sigma_px += (sigma_px.ln() - self.log_sigma_px) / f64::from(self.told);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_follows_what_adjustments_leave_within_its_bounds() {
        let after = |left_px: f64| {
            let mut noise = PlaceNoise::new(0.8);
            (0..60).for_each(|_| noise.learn(Some(left_px)));
            noise.sigma_px()
        };
        let first = PlaceNoise::new(0.8).sigma_px();
        assert!((0.5..0.6).contains(&first), "{first}");
        assert!((after(0.2) - 0.5).abs() < 1e-3);
        assert!((after(0.05) - 0.4).abs() < 1e-3, "a lucky fit");
        assert!((after(3.0) - 0.8).abs() < 1e-3, "no more than is said");
        assert!((after(f64::NAN) - first).abs() < 1e-12);
        assert!((PlaceNoise::new(0.2).sigma_px() - 0.2).abs() < 1e-12, "less than the least is held");
    }
}
