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
use super::device::Device;

const AUTO_WHITE_BALANCE: u32 = 0x0098_090c;
const AUTO_GAIN: u32 = 0x0098_0912;
const GAIN: u32 = 0x0098_0913;
const POWER_LINE: u32 = 0x0098_0918;
const EXPOSURE_MODE: u32 = 0x009a_0901;
/// Units of 0.1 ms.
const EXPOSURE: u32 = 0x009a_0902;
const DYNAMIC_RATE: u32 = 0x009a_0903;
const FOCUS: u32 = 0x009a_090a;
const AUTOFOCUS: u32 = 0x009a_090c;

const MODE_AUTO: i32 = 0;
const MODE_MANUAL: i32 = 1;
const MODE_APERTURE_PRIORITY: i32 = 3;
const UNITS_PER_MS: f64 = 10.0;

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
    fn range(&self, id: u32) -> std::io::Result<(i32, i32)>;
}

impl Controls for Device {
    fn get(&self, id: u32) -> std::io::Result<i32> {
        self.control(id)
    }
    fn set(&self, id: u32, value: i32) -> std::io::Result<()> {
        self.set_control(id, value)
    }
    fn range(&self, id: u32) -> std::io::Result<(i32, i32)> {
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
    // Webcams have one of the two automatics, the second nearly always.
    if device.range(EXPOSURE_MODE).is_ok()
        && device.set(EXPOSURE_MODE, MODE_APERTURE_PRIORITY).is_err()
        && let Err(error) = device.set(EXPOSURE_MODE, MODE_AUTO)
    {
        tracing::debug!(%error, "camera has no automatic exposure");
    }
    prefer(device, AUTO_GAIN, 1, "automatic gain");
    prefer(device, AUTO_WHITE_BALANCE, 1, "automatic white balance");
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
        let (exposure, gain) = (device.get(EXPOSURE).ok(), device.get(GAIN).ok());
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
    let inside = device.range(id).map_or(value, |(low, high)| value.clamp(low, high.max(low)));
    if inside != value {
        tracing::warn!(control = name, value, set = inside, "beyond the camera's range");
    }
    if let Err(error) = device.set(id, inside) {
        tracing::warn!(control = name, value, %error, "camera does not take this");
    }
    inside
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;
    use std::collections::BTreeMap;
    use std::io::{Error, ErrorKind, Result};

    /// Controls with their ranges and values.
    struct Fake(RefCell<BTreeMap<u32, (i32, i32, i32)>>);

    impl Fake {
        fn new(controls: &[(u32, (i32, i32, i32))]) -> Self {
            Self(RefCell::new(controls.iter().copied().collect()))
        }
    }

    impl Controls for Fake {
        fn get(&self, id: u32) -> Result<i32> {
            self.0.borrow().get(&id).map(|c| c.2).ok_or_else(|| Error::from(ErrorKind::InvalidInput))
        }
        fn set(&self, id: u32, value: i32) -> Result<()> {
            match self.0.borrow_mut().get_mut(&id) {
                Some(c) if (c.0..=c.1).contains(&value) => {
                    c.2 = value;
                    Ok(())
                }
                _ => Err(ErrorKind::InvalidInput.into()),
            }
        }
        fn range(&self, id: u32) -> Result<(i32, i32)> {
            self.0.borrow().get(&id).map(|c| (c.0, c.1)).ok_or_else(|| Error::from(ErrorKind::InvalidInput))
        }
    }

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
    fn fixed_values_are_set_within_the_cameras_range_and_missing_controls_do_no_harm() {
        let config = V4l2Config { focus: 999, exposure_ms: 4.0, power_line: PowerLine::Hz50, ..V4l2Config::default() };
        let camera = Fake::new(&[(FOCUS, (0, 250, 0)), (EXPOSURE_MODE, (0, 3, 3)), (EXPOSURE, (3, 2047, 250))]);
        prepare(&camera, &config);
        let now = |id| camera.get(id).ok();
        assert_eq!((now(FOCUS), now(EXPOSURE_MODE), now(EXPOSURE)), (Some(250), Some(MODE_MANUAL), Some(40)));
        prepare(&Fake::new(&[]), &V4l2Config { lock_after_s: 1.0, ..V4l2Config::default() });
    }
}
