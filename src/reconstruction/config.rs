//! `[reconstruction]` of the configuration.

/// Tracking and mapping. Every default is what measured best over all development sequences together.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReconstructionConfig {
    /// Landmarks looked for in each frame, at the most. 50..=1000.
    pub landmarks_per_frame: usize,
    /// A pose rests on at least this many landmarks seen in its frame, else the frame is lost. 10..=200.
    pub min_landmarks: usize,
    /// Radius of the search around a landmark's predicted place, px. 1.0..=32.0.
    pub search_radius_px: f64,
    /// Standard deviation of an aligned point at full resolution, px. 0.1..=4.0.
    pub sigma_px: f64,
    /// A keyframe is made when fewer than this share of its reference keyframe's landmarks is still seen. 0.3..=0.95.
    pub keyframe_share: f64,
    /// A keyframe is made when the median parallax to the reference keyframe exceeds this, degrees. 0.5..=20.0.
    pub keyframe_parallax_deg: f64,
    /// Smallest parallax at which a landmark is made, degrees. 0.2..=10.0.
    pub min_parallax_deg: f64,
    /// Time from the first row's exposure to the last one's (rolling shutter), ms; negative: last row first. -40.0..=40.0.
    pub readout_ms: f64,
    /// Learn the readout time from the pictures, starting at `readout_ms`.
    pub estimate_readout: bool,
    /// Refine focal length, principal point and distortion from the motion, around the calibration and as far as that is uncertain.
    pub refine_intrinsics: bool,
    /// Keyframes that a local adjustment moves, at the most. 2..=40.
    pub adjusted_keyframes: usize,
    /// Keyframes that hold a local adjustment in place, at the most. 0..=80.
    pub fixed_keyframes: usize,
    /// Levenberg-Marquardt steps of each of a local adjustment's two passes, at the most. 1..=50.
    pub adjustment_steps: usize,
    /// Lock-step replay merges a mapping result this many frames after its keyframe, waiting for it, or before a frame that comes 0.11 s or
    /// more after the one before. 1..=30.
    pub merge_after_frames: u64,
    /// Keyframes a map holds at the most; beyond it those go that others make up for. 20..=10000.
    pub max_keyframes: usize,
    /// Keyframes that keep pictures of half the resolution or more, at the most: the newest, their neighbours, and those before; older ones are
    /// condensed to patches of their landmarks. 20..=2000.
    pub detailed_keyframes: usize,
    /// A keyframe goes when more than this share of its landmarks is seen by three others, or made up for by what newer keyframes of the same place see.
    /// 0.5..=1.0 (1 = never).
    pub redundant_share: f64,
    /// Rotation-compensated median flow from the reference frame at which a start is tried, px. 3.0..=100.0.
    pub start_flow_px: f64,
    /// Landmarks that a start needs. 20..=500.
    pub start_landmarks: usize,
    /// How long tracking may be lost before a new map may begin beside this one, s. 0.0..=60.0.
    pub lost_s: f64,
    /// Close loops: recognise places of the map after a long way and correct the drift since.
    pub loops: bool,
}

impl Default for ReconstructionConfig {
    fn default() -> Self {
        Self {
            landmarks_per_frame: 220,
            min_landmarks: 15,
            search_radius_px: 6.0,
            sigma_px: 0.8,
            keyframe_share: 0.75,
            keyframe_parallax_deg: 3.0,
            min_parallax_deg: 1.0,
            readout_ms: 0.0,
            estimate_readout: true,
            refine_intrinsics: true,
            adjusted_keyframes: 10,
            fixed_keyframes: 20,
            adjustment_steps: 5,
            merge_after_frames: 3,
            max_keyframes: 1000,
            detailed_keyframes: 200,
            redundant_share: 0.9,
            start_flow_px: 4.0,
            start_landmarks: 50,
            lost_s: 0.5,
            loops: true,
        }
    }
}

impl ReconstructionConfig {
    /// First value out of its range: key, value with unit, and what is allowed.
    pub fn validate(&self) -> Result<(), (&'static str, String, String)> {
        fn within<T: PartialOrd + std::fmt::Display>(
            key: &'static str,
            value: T,
            low: T,
            high: T,
            unit: &str,
        ) -> Result<(), (&'static str, String, String)> {
            if value >= low && value <= high {
                return Ok(());
            }
            let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
            Err((key, format!("{value}{unit}"), format!("must lie in {low}..={high}{unit}")))
        }
        within("landmarks_per_frame", self.landmarks_per_frame, 50, 1000, "")?;
        within("min_landmarks", self.min_landmarks, 10, 200, "")?;
        within("search_radius_px", self.search_radius_px, 1.0, 32.0, "px")?;
        within("sigma_px", self.sigma_px, 0.1, 4.0, "px")?;
        within("keyframe_share", self.keyframe_share, 0.3, 0.95, "")?;
        within("keyframe_parallax_deg", self.keyframe_parallax_deg, 0.5, 20.0, "degrees")?;
        within("min_parallax_deg", self.min_parallax_deg, 0.2, 10.0, "degrees")?;
        within("readout_ms", self.readout_ms, -40.0, 40.0, "ms")?;
        within("adjusted_keyframes", self.adjusted_keyframes, 2, 40, "")?;
        within("fixed_keyframes", self.fixed_keyframes, 0, 80, "")?;
        within("adjustment_steps", self.adjustment_steps, 1, 50, "")?;
        within("merge_after_frames", self.merge_after_frames, 1, 30, "frames")?;
        within("max_keyframes", self.max_keyframes, 20, 10_000, "")?;
        within("detailed_keyframes", self.detailed_keyframes, 20, 2000, "")?;
        within("redundant_share", self.redundant_share, 0.5, 1.0, "")?;
        within("start_flow_px", self.start_flow_px, 3.0, 100.0, "px")?;
        within("start_landmarks", self.start_landmarks, 20, 500, "")?;
        within("lost_s", self.lost_s, 0.0, 60.0, "s")
    }
}
