//! Exposure, gain and focus as commands and their answers say them.

use core::fmt;
use core::str::FromStr;

/// Whether the camera decides on a control by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Automatic {
    On,
    Off,
    /// It has no automatic for it.
    None,
}

impl Automatic {
    const WORDS: [(Self, &'static str); 3] = [(Self::On, "auto"), (Self::Off, "manual"), (Self::None, "manual-only")];

    /// `auto`, `manual`, `manual-only`.
    pub fn name(self) -> &'static str {
        Self::WORDS.iter().find(|(this, _)| *this == self).map_or("", |(_, word)| word)
    }
}

/// A control of the camera: a line of the answer to [`super::command_kind::CAMERA_CONTROLS`], which is its text.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraControl {
    /// `exposure`, `gain`, `focus`, or one of a newer daemon.
    pub name: String,
    /// `ms`, or `steps` of the camera's own.
    pub unit: String,
    pub low: f64,
    pub high: f64,
    pub step: f64,
    /// What the camera begins with when it is plugged in.
    pub default: f64,
    /// As it is now; NaN: the camera does not tell.
    pub value: f64,
    pub automatic: Automatic,
}

impl fmt::Display for CameraControl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, unit, low, high, step, default, value, automatic } = self;
        write!(f, "{name} {unit} {low} {high} {step} {default} {value} {}", automatic.name())
    }
}

/// It is no line of such an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoControl;

impl FromStr for CameraControl {
    type Err = NoControl;

    fn from_str(line: &str) -> Result<Self, NoControl> {
        let mut words = line.split(' ');
        let mut word = || words.next().ok_or(NoControl);
        let (name, unit) = (word()?.to_owned(), word()?.to_owned());
        let mut number = || word()?.parse::<f64>().map_err(|_| NoControl);
        let [low, high, step, default, value] = [number()?, number()?, number()?, number()?, number()?];
        let last = word()?;
        let automatic = Automatic::WORDS.iter().find(|(_, word)| *word == last).ok_or(NoControl)?.0;
        Ok(Self { name, unit, low, high, step, default, value, automatic })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_all_of_a_control() {
        let line = "exposure ms 0.3 204.7 0.1 25 8 manual";
        let control: CameraControl = line.parse().unwrap();
        assert_eq!((control.low, control.high, control.value, control.automatic), (0.3, 204.7, 8.0, Automatic::Off));
        assert_eq!(control.to_string(), line);
        let untold: CameraControl = "focus steps 0 250 5 0 NaN manual-only".parse().unwrap();
        assert!(untold.value.is_nan() && untold.automatic == Automatic::None);
        for line in ["", "exposure ms 0.3", "exposure ms a b c d e auto", "exposure ms 1 2 3 4 5 sometimes"] {
            assert_eq!(line.parse::<CameraControl>(), Err(NoControl), "{line}");
        }
    }
}
