//! What a map's lengths are, and who says so.

/// What a scale is told by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ScaleSource {
    Wheels,
    Height,
    Tag,
}

/// Sources; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ScaleSources(u8);

impl ScaleSources {
    pub fn with(self, source: ScaleSource) -> Self {
        Self(self.0 | 1 << source as u8)
    }

    pub fn contains(self, source: ScaleSource) -> bool {
        self.0 & 1 << source as u8 != 0
    }
}

impl std::fmt::Display for ScaleSources {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names = [(ScaleSource::Wheels, "WHEELS"), (ScaleSource::Height, "HEIGHT"), (ScaleSource::Tag, "TAG")];
        let names: Vec<&str> = names.into_iter().filter(|n| self.contains(n.0)).map(|n| n.1).collect();
        f.write_str(&names.join("+"))
    }
}

/// What a map's lengths are.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum MapScale {
    /// Of an arbitrary unit.
    #[default]
    Unknown,
    /// Metres, with this relative standard deviation.
    Metric { sigma: f64, sources: ScaleSources },
}

impl MapScale {
    pub fn is_metric(self) -> bool {
        matches!(self, Self::Metric { .. })
    }
}
