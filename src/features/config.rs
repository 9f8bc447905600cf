//! `[features]` of the configuration.

/// Which corner detector the feature thread uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DetectorKind {
    /// FAST-9 segment test with non-maximum suppression.
    #[default]
    Fast,
    /// SUSAN, 37-pixel mask, exponential response.
    Susan,
}

/// Corners and tracks.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct FeaturesConfig {
    pub detector: DetectorKind,
    /// Brightness difference of a corner where the picture is rich, grey levels; poor cells go down to `min_threshold`. 2.0..=100.0.
    pub threshold: f32,
    /// Lowest brightness difference that a poor cell is searched with, grey levels. 1.0..=100.0.
    pub min_threshold: f32,
    /// Side of a cell of the detection grid, px; one corner a cell is started. 12..=200.
    pub cell_px: usize,
    /// Tracks followed at once, at the most. 50..=2000.
    pub max_tracks: usize,
    /// Smallest eigenvalue of a corner's structure tensor, grey^2/px^2; weaker ones, down to 1, only where tracks are few. 0.1..=1000.0.
    pub min_eigenvalue: f32,
    /// Correlation of a track's patches in two frames. 0.3..=0.99.
    pub min_ncc: f32,
    /// Forward-backward error of a track, px. 0.05..=3.0.
    pub max_return_px: f32,
}

impl Default for FeaturesConfig {
    fn default() -> Self {
        Self {
            detector: DetectorKind::Fast,
            threshold: 20.0,
            min_threshold: 6.0,
            cell_px: 32,
            max_tracks: 300,
            min_eigenvalue: 8.0,
            min_ncc: 0.8,
            max_return_px: 0.5,
        }
    }
}

impl FeaturesConfig {
    /// First value out of its range: key, value with unit, and what is allowed.
    pub fn validate(&self) -> Result<(), (&'static str, String, String)> {
        let check = |key, value: f64, low: f64, high: f64, unit: &str| {
            if value >= low && value <= high {
                return Ok(());
            }
            let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
            Err((key, format!("{value}{unit}"), format!("must lie in {low}..={high}{unit}")))
        };
        check("threshold", self.threshold.into(), 2.0, 100.0, "grey levels")?;
        check("min_threshold", self.min_threshold.into(), 1.0, self.threshold.into(), "grey levels")?;
        check("cell_px", self.cell_px as f64, 12.0, 200.0, "px")?;
        check("max_tracks", self.max_tracks as f64, 50.0, 2000.0, "")?;
        check("min_eigenvalue", self.min_eigenvalue.into(), 0.1, 1000.0, "grey^2/px^2")?;
        check("min_ncc", self.min_ncc.into(), 0.3, 0.99, "")?;
        check("max_return_px", self.max_return_px.into(), 0.05, 3.0, "px")
    }
}
