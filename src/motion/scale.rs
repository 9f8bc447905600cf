//! The length of a map unit in metres, from everything that tells it.

/// What a scale is told by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ScaleSource {
    Wheels,
    Height,
    Tag,
}

/// One source's word on how long a map unit is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScaleMeasurement {
    pub source: ScaleSource,
    /// ln(metres per map unit).
    pub log_metres_per_unit: f64,
    /// Its standard deviation (0.01: 1 %).
    pub sigma: f64,
}
