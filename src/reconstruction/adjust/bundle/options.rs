//! What a bundle adjustment takes as given, and what is asked of it.

use crate::geometry::least_squares::Loss;
use crate::reconstruction::measurement::CHI2_2D_95;

/// Passes; outliers are judged after each.
pub(super) const PASSES: usize = 2;
/// Added to every pivot, squared standard deviations per squared unit (rad, map units): what no observation holds stays where it is. The
/// information of one pixel on one unit of the map is some 1e5.
pub(super) const LEAST_PIVOT: f64 = 1e-9;
/// Relative damping that holds what nothing holds (the scale, a point that one camera sees) while the rest is marginalised:
/// far below what any of it costs, far above the loss of digits. The first at which the system is positive definite.
pub(super) const GAUGE_DAMPING: [f64; 3] = [1e-9, 1e-7, 1e-5];
/// Scale of Cauchy's loss in standard deviations of what is left of places. (2.385 where noise is normal and least squares may lose 5 % of their efficiency:
/// Holland and Welsch 1977; of what is left, as fits hide a part of the noise. Over the derived
/// recordings errors are 4 % smaller than with Huber's loss at the outlier limit, between bare walls by a fifth and more; at 2.4 a car's drift grows by a quarter.)
pub(super) const LOSS_SCALE: f64 = 3.6;
/// The smallest noise that is believed, in supposed standard deviations: what is left of a fit does not show where all of it is off. (As `measurement::noise`
/// believes no less: half of what is supposed, for three times what is left.)
pub(super) const LEAST_NOISE: f64 = 1.0 / 6.0;
/// Loss of what something beside the picture says (lengths, the floor): doubted from so many standard deviations on.
pub(super) const LOSS_BESIDE_PICTURE: Loss = Loss::Cauchy(2.0);
/// Information on what is taken as known, in shares of the largest there is: far above any, far below the loss of digits.
pub(super) const KNOWN: f64 = 1e6;

/// What is asked of an adjustment.
#[derive(Debug, Clone, Copy)]
pub struct BundleOptions {
    /// Levenberg-Marquardt steps in each pass, at the most. A number and not a time, so that a replay gives the same bits.
    pub steps: usize,
    /// The outlier limit, squared and sigma-scaled; Huber's limit where the noise is not told.
    pub outlier_chi2: f64,
    /// What is left of places is theirs: while the lens is a guess it is the lens's, which none of them may be doubted for.
    pub is_lens_known: bool,
    /// A step that lowers the cost by less than this share ends the pass: the next keyframe's adjustment goes on from there.
    pub relative_gain: f64,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { steps: 5, outlier_chi2: CHI2_2D_95, is_lens_known: true, relative_gain: 1e-3 }
    }
}
