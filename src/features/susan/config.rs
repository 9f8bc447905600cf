//! How SUSAN decides: the method's figures as named presets, the default by measurement.
//!
//! Measured (two views of `oxford_graf` under their known homographies, and eight frame pairs 3 to 6 frames apart of four
//! sequences under forward-backward checked dense flow; strongest 500 corners each, a corner counts as repeated within
//! 1.5 px, one to one): suppression and order by the salient degree alone repeat 13 % and 30 %, because the smallest
//! USANs are single noisy pixels and the middle of ramps; by the moment, smoothed, 41 % and 53 %; with edges rejected
//! too 40 % and 54 % at t = 20 (38 % and 52 % at t = 15, 43 % and 54 % at 25). FAST-9 repeats 45 % and 55 %.
//! The paper's own rejection (centre of gravity, contiguity) lowers these figures; it stays off by default.

use super::usan::{MASK_RADIUS, SusanResponse};

/// Largest suppression radius, pixels.
pub const MAX_SUPPRESSION_PX: usize = 16;

/// Why a [`SusanConfig`] cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SusanConfigError {
    #[error("susan.geometric_threshold is {0}, must be above 0 and below 1 (a share of the mask)")]
    Geometric(f32),
    #[error("susan.suppression_px is {0} px, must be 1 to {MAX_SUPPRESSION_PX} px")]
    Suppression(usize),
    #[error("susan.min_centroid_px is {0} px, must be 0 to {MASK_RADIUS} px")]
    Centroid(f32),
}

/// By what corners are compared with their neighbours, and ranked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SusanStrength {
    /// The smallest USAN wins, as in the paper; response = 1 - sd.
    SalientDegree,
    /// Contrast of what is not USAN times the distance of the USAN's centre of gravity, averaged over 3x3 pixels with
    /// weights 1 2 1; response in grey levels times pixels. Noise and ramps have their centre of gravity near the nucleus.
    #[default]
    Moment,
}

/// How SUSAN decides. The brightness threshold t comes with each cell of the grid.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct SusanConfig {
    pub response: SusanResponse,
    /// g: a corner's salient degree is below it; share of the mask.
    pub geometric_threshold: f32,
    pub strength: SusanStrength,
    /// Look at the picture smoothed by 1 2 1 both ways.
    pub smooth: bool,
    /// Half the side of the square in which only the strongest stays a corner, pixels.
    pub suppression_px: usize,
    /// A corner's USAN has its centre of gravity at least this far from the nucleus, pixels; 0 = not asked.
    /// Noise and thin lines through the nucleus are near 0.
    pub min_centroid_px: f32,
    /// A corner's USAN reaches without a gap from the nucleus, towards its centre of gravity, to the mask's edge.
    pub contiguous: bool,
    /// A corner's USAN does not go on both ways across the direction to its centre of gravity: that is an edge's.
    pub reject_edges: bool,
}

impl Default for SusanConfig {
    fn default() -> Self {
        Self {
            response: SusanResponse::Exponential,
            geometric_threshold: 0.5,
            strength: SusanStrength::Moment,
            smooth: true,
            suppression_px: 2,
            min_centroid_px: 0.0,
            contiguous: false,
            reject_edges: true,
        }
    }
}

impl SusanConfig {
    /// Brightness threshold to use with the preset [`Self::default`], grey levels.
    pub const DEFAULT_T: u8 = 20;
    /// Brightness threshold to use with the study's presets, grey levels.
    pub const STUDY_T: u8 = 90;

    /// The study's figures: hard step, g = 0.4, with t = 90; smallest USAN wins.
    pub fn study() -> Self {
        Self {
            response: SusanResponse::Step,
            geometric_threshold: 0.4,
            strength: SusanStrength::SalientDegree,
            smooth: false,
            suppression_px: 3,
            reject_edges: false,
            ..Self::default()
        }
    }

    /// Whether false corners are told by more than the area.
    pub(super) fn asks(&self) -> bool {
        self.min_centroid_px > 0.0 || self.contiguous || self.reject_edges
    }

    /// Fails when a value is out of its range.
    pub fn check(&self) -> Result<(), SusanConfigError> {
        if !(self.geometric_threshold > 0.0 && self.geometric_threshold < 1.0) {
            return Err(SusanConfigError::Geometric(self.geometric_threshold));
        }
        if !(1..=MAX_SUPPRESSION_PX).contains(&self.suppression_px) {
            return Err(SusanConfigError::Suppression(self.suppression_px));
        }
        if !(0.0..=MASK_RADIUS as f32).contains(&self.min_centroid_px) {
            return Err(SusanConfigError::Centroid(self.min_centroid_px));
        }
        Ok(())
    }
}
