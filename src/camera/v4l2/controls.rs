//! Focus, exposure, gain, white balance and power-line frequency of a camera that has such controls.
//!
//! Input: an open device and `[camera]`. Output: the controls set; what a camera lacks is mentioned in the log at level debug,
//! what it refuses although the configuration names a value for it as a warning. Nothing here fails.
//!
//! - At every opening ([`prepare`]): autofocus and the rate that sinks in the dark off or on, a fixed lens position, a fixed exposure,
//!   what lamps flicker with. Without a fixed exposure the camera's automatic is switched on: an earlier lock outlives a process.
//! - Once settled ([`Lock`]): exposure, gain and white balance stay what the camera's automatics made of them, exposure no longer than a
//!   limit. UVC knows no limit for its automatic, so this is what a bound on motion blur comes to; what is cut from exposure is put on gain.
//!
//! Cost: a dozen control transfers at opening and at the lock, a millisecond each on USB; nothing a frame. Not here: an
//! automatic exposure of our own.

use super::config::{PowerLine, V4l2Config};
use super::device::{ControlRange, Device};

const AUTO_WHITE_BALANCE: u32 = 0x0098_090c;
pub const AUTO_GAIN: u32 = 0x0098_0912;
pub const GAIN: u32 = 0x0098_0913;
const POWER_LINE: u32 = 0x0098_0918;
pub const EXPOSURE_MODE: u32 = 0x009a_0901;
/// Units of 0.1 ms.
pub const EXPOSURE: u32 = 0x009a_0902;
const DYNAMIC_RATE: u32 = 0x009a_0903;
pub const FOCUS: u32 = 0x009a_090a;
pub const AUTOFOCUS: u32 = 0x009a_090c;

pub const MODE_AUTO: i32 = 0;
pub const MODE_MANUAL: i32 = 1;
pub const MODE_APERTURE_PRIORITY: i32 = 3;
pub const UNITS_PER_MS: f64 = 10.0;

impl PowerLine {
    /// V4L2's number for it.
    fn value(self) -> Option<i32> {
        match self {
            Self::Keep => None,
            Self::Off => Some(0),
            Self::Hz50 => Some(1),
            Self::Hz60 => Some(2),
            Self::Auto => Some(3),
        }
    }
}

/// The seam to the kernel, so that tests need no camera.
pub trait Controls {
    fn get(&self, id: u32) -> std::io::Result<i32>;
    fn set(&self, id: u32, value: i32) -> std::io::Result<()>;
    fn range(&self, id: u32) -> std::io::Result<ControlRange>;
}

impl Controls for Device {
    fn get(&self, id: u32) -> std::io::Result<i32> {
        self.control(id)
    }
    fn set(&self, id: u32, value: i32) -> std::io::Result<()> {
        self.set_control(id, value)
    }
    fn range(&self, id: u32) -> std::io::Result<ControlRange> {
        self.control_range(id)
    }
}

/// Sets what holds from the first frame on.
pub fn prepare(device: &impl Controls, config: &V4l2Config) {
    prefer(device, AUTOFOCUS, i32::from(config.autofocus), "autofocus");
    prefer(device, DYNAMIC_RATE, i32::from(config.dynamic_rate), "dynamic_rate");
    if config.focus >= 0 {
        demand(device, FOCUS, config.focus, "focus");
    }
    if let Some(value) = config.power_line.value() {
        demand(device, POWER_LINE, value, "power_line");
    }
    if config.exposure_ms > 0.0 {
        demand(device, EXPOSURE_MODE, MODE_MANUAL, "exposure_ms");
        demand(device, EXPOSURE, units(config.exposure_ms), "exposure_ms");
        return;
    }
    if device.range(EXPOSURE_MODE).is_ok()
        && let Err(error) = automatic_exposure(device)
    {
        tracing::debug!(%error, "camera has no automatic exposure");
    }
    prefer(device, AUTO_GAIN, 1, "automatic gain");
    prefer(device, AUTO_WHITE_BALANCE, 1, "automatic white balance");
}

/// The camera decides on exposure. Webcams have one of the two automatics, the first nearly always.
pub fn automatic_exposure(device: &impl Controls) -> std::io::Result<()> {
    device.set(EXPOSURE_MODE, MODE_APERTURE_PRIORITY).or_else(|_| device.set(EXPOSURE_MODE, MODE_AUTO))
}

/// Locks the automatics once they have settled.
#[derive(Debug)]
pub struct Lock {
    after_ns: i64,
    /// 0: none.
    limit_units: i32,
    first_ns: Option<i64>,
    done: bool,
}

impl Lock {
    pub fn new(config: &V4l2Config) -> Self {
        let limit_units = if config.exposure_limit_ms > 0.0 { units(config.exposure_limit_ms) } else { 0 };
        let after_ns = (config.lock_after_s * 1e9) as i64;
        Self { after_ns, limit_units, first_ns: None, done: after_ns == 0 }
    }

    /// Somebody has set something by hand: what is locked later would undo it.
    pub fn give_up(&mut self) {
        self.done = true;
    }

    /// To be called for every frame.
    pub fn frame(&mut self, device: &impl Controls, arrival_ns: i64) {
        if self.done {
            return;
        }
        let first_ns = *self.first_ns.get_or_insert(arrival_ns);
        if arrival_ns.saturating_sub(first_ns) >= self.after_ns {
            self.done = true;
            self.lock(device);
        }
    }

    fn lock(&self, device: &impl Controls) {
        // A camera that hangs takes seconds for each of a dozen requests, and no frame is taken meanwhile.
        let exposure = match device.get(EXPOSURE) {
            Err(error) if is_hung(&error) => {
                return tracing::warn!(%error, "camera does not answer, its exposure stays automatic");
            }
            exposure => exposure.ok(),
        };
        let gain = device.get(GAIN).ok();
        prefer(device, AUTO_GAIN, 0, "automatic gain");
        prefer(device, AUTO_WHITE_BALANCE, 0, "automatic white balance");
        let Some(exposure) = exposure else {
            return tracing::warn!("camera does not tell its exposure, which stays automatic");
        };
        let locked = if self.limit_units > 0 { exposure.min(self.limit_units) } else { exposure };
        demand(device, EXPOSURE_MODE, MODE_MANUAL, "lock_after_s");
        demand(device, EXPOSURE, locked, "lock_after_s");
        let mut gain_locked = gain;
        if let Some(gain) = gain {
            // Gain's unit is the maker's own; as a factor it is at least the right direction.
            let wanted = f64::from(gain.max(1)) * f64::from(exposure.max(1)) / f64::from(locked.max(1));
            let value = if locked < exposure { wanted.min(f64::from(i32::MAX)) as i32 } else { gain };
            gain_locked = Some(demand(device, GAIN, value, "lock_after_s"));
        }
        tracing::info!(exposure_ms = f64::from(locked) / UNITS_PER_MS, gain = gain_locked, "exposure locked");
    }
}

/// The driver has given up waiting for the camera's answer.
pub fn is_hung(error: &std::io::Error) -> bool {
    error.kind() == std::io::ErrorKind::TimedOut
}

fn units(ms: f64) -> i32 {
    (ms * UNITS_PER_MS).round().clamp(1.0, 1e6) as i32
}

/// A switch that many cameras lack.
fn prefer(device: &impl Controls, id: u32, value: i32, name: &str) {
    if let Err(error) = device.set(id, value) {
        tracing::debug!(control = name, value, %error, "camera has no such switch");
    }
}

/// A value that somebody asked for, within the camera's range; what was set.
fn demand(device: &impl Controls, id: u32, value: i32, name: &str) -> i32 {
    let inside = device.range(id).map_or(value, |range| value.clamp(range.low, range.high.max(range.low)));
    if inside != value {
        tracing::warn!(control = name, value, set = inside, "beyond the camera's range");
    }
    if let Err(error) = device.set(id, inside) {
        tracing::warn!(control = name, value, %error, "camera does not take this");
    }
    inside
}

/// A camera of numbers.
#[cfg(test)]
pub mod fake {
    use super::{ControlRange, Controls};
    use std::cell::{Cell, RefCell};
    use std::collections::BTreeMap;
    use std::io::{Error, ErrorKind, Result};

    /// Controls with their ranges and values.
    pub struct Fake {
        controls: RefCell<BTreeMap<u32, (i32, i32, i32)>>,
        steps: BTreeMap<u32, i32>,
        refused: Option<u32>,
        hangs: bool,
        timeouts: Cell<usize>,
    }

    impl Fake {
        /// Number, and lowest, highest and present value of each.
        pub fn new(controls: &[(u32, (i32, i32, i32))]) -> Self {
            let controls = RefCell::new(controls.iter().copied().collect());
            Self { controls, steps: BTreeMap::new(), refused: None, hangs: false, timeouts: Cell::new(0) }
        }

        pub fn with_steps(mut self, id: u32, control: (i32, i32, i32), step: i32) -> Self {
            self.controls.get_mut().insert(id, control);
            self.steps.insert(id, step);
            self
        }

        /// Takes no value of this one.
        pub fn refusing(self, id: u32) -> Self {
            Self { refused: Some(id), ..self }
        }

        /// Answers nothing.
        pub fn hanging(self) -> Self {
            Self { hangs: true, ..self }
        }

        /// How often somebody has waited for it in vain.
        pub fn timeouts(&self) -> usize {
            self.timeouts.get()
        }

        fn wait(&self) -> Result<()> {
            if !self.hangs {
                return Ok(());
            }
            self.timeouts.set(self.timeouts.get() + 1);
            Err(ErrorKind::TimedOut.into())
        }
    }

    impl Controls for Fake {
        fn get(&self, id: u32) -> Result<i32> {
            self.wait()?;
            self.controls.borrow().get(&id).map(|c| c.2).ok_or_else(|| Error::from(ErrorKind::InvalidInput))
        }
        fn set(&self, id: u32, value: i32) -> Result<()> {
            self.wait()?;
            match self.controls.borrow_mut().get_mut(&id) {
                Some(c) if (c.0..=c.1).contains(&value) && self.refused != Some(id) => {
                    c.2 = value;
                    Ok(())
                }
                _ => Err(ErrorKind::InvalidInput.into()),
            }
        }
        fn range(&self, id: u32) -> Result<ControlRange> {
            self.wait()?;
            let controls = self.controls.borrow();
            let (low, high, default) = *controls.get(&id).ok_or_else(|| Error::from(ErrorKind::InvalidInput))?;
            Ok(ControlRange { low, high, step: self.steps.get(&id).copied().unwrap_or(1), default })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::fake::Fake;
    use super::*;

    #[test]
    fn the_lock_cuts_exposure_to_its_limit_and_makes_up_with_gain() {
        let config = V4l2Config { lock_after_s: 2.0, exposure_limit_ms: 5.0, ..V4l2Config::default() };
        let camera = Fake::new(&[
            (EXPOSURE_MODE, (0, 3, 0)),
            (EXPOSURE, (3, 2047, 100)),
            (GAIN, (0, 255, 40)),
            (AUTO_WHITE_BALANCE, (0, 1, 0)),
        ]);
        prepare(&camera, &config);
        assert_eq!(camera.get(EXPOSURE_MODE).ok(), Some(MODE_APERTURE_PRIORITY));
        assert_eq!(camera.get(AUTO_WHITE_BALANCE).ok(), Some(1));
        let mut lock = Lock::new(&config);
        lock.frame(&camera, 10_000_000_000);
        lock.frame(&camera, 11_900_000_000);
        assert_eq!(camera.get(EXPOSURE).ok(), Some(100), "not yet");
        lock.frame(&camera, 12_000_000_000);
        let now = |id| camera.get(id).ok();
        assert_eq!((now(EXPOSURE_MODE), now(EXPOSURE), now(GAIN)), (Some(MODE_MANUAL), Some(50), Some(80)));
        assert_eq!(now(AUTO_WHITE_BALANCE), Some(0));
    }

    #[test]
    fn a_camera_that_hangs_is_asked_once_and_keeps_its_automatic() {
        let config = V4l2Config { lock_after_s: 2.0, ..V4l2Config::default() };
        let camera = Fake::new(&[(EXPOSURE_MODE, (0, 3, 3)), (EXPOSURE, (3, 2047, 100))]).hanging();
        let mut lock = Lock::new(&config);
        for s in [10, 12, 14] {
            lock.frame(&camera, s * 1_000_000_000);
        }
        assert_eq!(camera.timeouts(), 1);
    }

    #[test]
    fn fixed_values_are_set_within_the_cameras_range_and_missing_controls_do_no_harm() {
        let config = V4l2Config { focus: 999, exposure_ms: 4.0, power_line: PowerLine::Hz50, ..V4l2Config::default() };
        let camera = Fake::new(&[(FOCUS, (0, 250, 0)), (EXPOSURE_MODE, (0, 3, 3)), (EXPOSURE, (3, 2047, 250))]);
        prepare(&camera, &config);
        let now = |id| camera.get(id).ok();
        assert_eq!((now(FOCUS), now(EXPOSURE_MODE), now(EXPOSURE)), (Some(250), Some(MODE_MANUAL), Some(40)));
        prepare(&Fake::new(&[]), &V4l2Config { lock_after_s: 1.0, ..V4l2Config::default() });
    }
}
