//! What a map's lengths are, and who says so.

/// What a scale is told by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ScaleSource {
    Wheels,
    Height,
    Tag,
    /// The map was metric when it was loaded.
    StoredMap,
}

impl ScaleSource {
    pub const ALL: [Self; 4] = [Self::Wheels, Self::Height, Self::Tag, Self::StoredMap];

    /// As logged, and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Wheels => "WHEELS",
            Self::Height => "HEIGHT",
            Self::Tag => "TAG",
            Self::StoredMap => "STORED_MAP",
        }
    }
}

/// Sources; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ScaleSources(u8);

impl ScaleSources {
    pub fn with(self, source: ScaleSource) -> Self {
        Self(self.0 | 1 << source as u8)
    }

    /// Those of both.
    pub fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// One bit each, in the order of [`ScaleSource::ALL`].
    pub fn bits(self) -> u8 {
        self.0
    }

    /// The reverse; bits that are no source's are left out.
    pub fn from_bits(bits: u8) -> Self {
        Self(bits & ((1 << ScaleSource::ALL.len()) - 1))
    }

    pub fn contains(self, source: ScaleSource) -> bool {
        self.0 & 1 << source as u8 != 0
    }
}

impl std::fmt::Display for ScaleSources {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names: Vec<&str> =
            ScaleSource::ALL.into_iter().filter(|source| self.contains(*source)).map(ScaleSource::name).collect();
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
