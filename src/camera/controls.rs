//! What of exposure, gain and focus can be set on a source while it runs. Not here: how (`v4l2`), when (the capture stage), by whom.

use std::fmt;

/// What can be set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    Exposure,
    Gain,
    Focus,
}

impl Control {
    pub const ALL: [Self; 3] = [Self::Exposure, Self::Gain, Self::Focus];

    /// `exposure`, `gain`, `focus`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Exposure => "exposure",
            Self::Gain => "gain",
            Self::Focus => "focus",
        }
    }

    /// Exposure is a time; what a step of gain or focus is only the camera's maker knows.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Exposure => "ms",
            Self::Gain | Self::Focus => "steps",
        }
    }
}

impl fmt::Display for Control {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Who decides on a control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Decides {
    /// The camera.
    Camera,
    /// It is as it was set; the camera could decide.
    Us,
    /// The camera has no automatic for it.
    OnlyUs,
}

/// A control that a source has, in the control's unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlState {
    pub control: Control,
    pub low: f64,
    pub high: f64,
    pub step: f64,
    /// What the camera begins with when it is plugged in.
    pub default: f64,
    /// NaN: the camera does not tell.
    pub value: f64,
    pub decides: Decides,
}

impl ControlState {
    /// Whether a value lies in the range; NaN does not.
    pub fn allows(&self, value: f64) -> bool {
        // Decimal fractions are no binary ones: both ends are in it.
        let slack = 1e-6 * self.step;
        (self.low - slack..=self.high + slack).contains(&value)
    }
}

/// What a control is to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Setting {
    /// The camera decides.
    Automatic,
    /// In the control's unit.
    Value(f64),
}

/// Why a control is not set.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ControlError {
    #[error("{0} has no exposure, gain or focus that could be set")]
    NoControls(String),
    #[error("this camera has no {0} that could be set")]
    Missing(Control),
    #[error("{control} {value} {unit}: this camera takes {low} to {high} {unit}, every {step}", control = state.control,
        unit = state.control.unit(), low = state.low, high = state.high, step = state.step)]
    Range { value: f64, state: ControlState },
    #[error("{0}: this camera has no automatic for it")]
    NoAutomatic(Control),
    #[error("{control}: the camera refused it: {reason}")]
    Refused { control: Control, reason: String },
}
