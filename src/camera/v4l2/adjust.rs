//! Exposure, gain and focus by hand while the camera streams: what it offers, and setting one.
//!
//! Input: an open device. Output: controls in the units of [`camera::controls`](super::super::controls); exposure, which V4L2 counts in 0.1 ms, in ms.
//! A value beyond the range is refused and named with it; within the range it is taken to the nearest step. The automatic that would undo it is
//! switched off first, and on again if the camera then refuses the value. A camera that hangs is asked nothing more: the driver waits 5 s for each
//! answer, and no frame comes meanwhile.
//!
//! Cost: three control transfers to ask for a control, up to six to set one, a millisecond each on USB, between two frames. Not here: white balance.

use super::controls::{
    AUTO_GAIN, AUTOFOCUS, Controls, EXPOSURE, EXPOSURE_MODE, FOCUS, GAIN, MODE_APERTURE_PRIORITY, MODE_AUTO,
    MODE_MANUAL, UNITS_PER_MS, automatic_exposure, is_hung,
};
use crate::camera::controls::{Control, ControlError, ControlState, Decides, Setting};
use std::io;

/// What the camera has of it.
pub fn offered(device: &impl Controls) -> Result<Vec<ControlState>, ControlError> {
    let told = |control| state(device, control).map_err(|e| refused(control, &e)).transpose();
    Control::ALL.into_iter().filter_map(told).collect()
}

/// Sets one; what it is then.
pub fn set(device: &impl Controls, control: Control, to: Setting) -> Result<ControlState, ControlError> {
    let refused = |e: io::Error| refused(control, &e);
    let before = state(device, control).map_err(refused)?.ok_or(ControlError::Missing(control))?;
    match to {
        Setting::Automatic if before.decides == Decides::OnlyUs => return Err(ControlError::NoAutomatic(control)),
        Setting::Automatic => give_back(device, control).map_err(refused)?,
        Setting::Value(value) if !before.allows(value) => {
            return Err(ControlError::Range { value, state: before });
        }
        Setting::Value(value) => {
            if before.decides != Decides::OnlyUs {
                take(device, control).map_err(refused)?;
            }
            let steps = ((value - before.low) / before.step).round();
            let (id, per_unit) = value_of(control);
            // The range need not end with a step.
            let raw = ((before.low + steps * before.step).min(before.high) * per_unit).round() as i32;
            if let Err(error) = device.set(id, raw) {
                if before.decides == Decides::Camera && !is_hung(&error) {
                    // As it was; if that fails, too, the next answer tells.
                    let _ = give_back(device, control);
                }
                return Err(refused(error));
            }
        }
    }
    Ok(state(device, control).map_err(refused)?.unwrap_or(before))
}

fn refused(control: Control, error: &io::Error) -> ControlError {
    ControlError::Refused { control, reason: error.to_string() }
}

/// What the camera answers, `None` if it does not have it; an error if it hangs.
fn answered<T>(answer: io::Result<T>) -> io::Result<Option<T>> {
    match answer {
        Err(error) if is_hung(&error) => Err(error),
        answer => Ok(answer.ok()),
    }
}

/// V4L2's number of the value, and its units in one of ours.
fn value_of(control: Control) -> (u32, f64) {
    match control {
        Control::Exposure => (EXPOSURE, UNITS_PER_MS),
        Control::Gain => (GAIN, 1.0),
        Control::Focus => (FOCUS, 1.0),
    }
}

/// `None`: the camera has none.
fn state(device: &impl Controls, control: Control) -> io::Result<Option<ControlState>> {
    let (id, per_unit) = value_of(control);
    let Some(range) = answered(device.range(id))?.filter(|range| range.low < range.high) else { return Ok(None) };
    let [low, high, step, default] =
        [range.low, range.high, range.step.max(1), range.default].map(|v| f64::from(v) / per_unit);
    let decides = match is_automatic(device, control)? {
        Some(true) => Decides::Camera,
        Some(false) => Decides::Us,
        None => Decides::OnlyUs,
    };
    let value = answered(device.get(id))?.map_or(f64::NAN, |v| f64::from(v) / per_unit);
    Ok(Some(ControlState { control, low, high, step, default, value, decides }))
}

/// `None`: there is no such switch.
fn is_automatic(device: &impl Controls, control: Control) -> io::Result<Option<bool>> {
    let (switch, is_on): (u32, fn(i32) -> bool) = match control {
        Control::Exposure => (EXPOSURE_MODE, |mode| matches!(mode, MODE_AUTO | MODE_APERTURE_PRIORITY)),
        Control::Gain => (AUTO_GAIN, |on| on != 0),
        Control::Focus => (AUTOFOCUS, |on| on != 0),
    };
    Ok(answered(device.get(switch))?.map(is_on))
}

/// The camera does not decide any more.
fn take(device: &impl Controls, control: Control) -> io::Result<()> {
    match control {
        Control::Exposure => device.set(EXPOSURE_MODE, MODE_MANUAL),
        Control::Gain => device.set(AUTO_GAIN, 0),
        Control::Focus => device.set(AUTOFOCUS, 0),
    }
}

/// The camera decides again.
fn give_back(device: &impl Controls, control: Control) -> io::Result<()> {
    match control {
        Control::Exposure => automatic_exposure(device),
        Control::Gain => device.set(AUTO_GAIN, 1),
        Control::Focus => device.set(AUTOFOCUS, 1),
    }
}

#[cfg(test)]
mod tests {
    use super::super::controls::fake::Fake;
    use super::*;

    /// As a webcam: an automatic exposure, gain without a switch, focus in steps of 5.
    fn webcam() -> Fake {
        Fake::new(&[
            (EXPOSURE_MODE, (0, 3, 3)),
            (EXPOSURE, (3, 2047, 250)),
            (GAIN, (0, 255, 64)),
            (AUTOFOCUS, (0, 1, 0)),
        ])
        .with_steps(FOCUS, (0, 250, 30), 5)
    }

    #[test]
    fn what_a_camera_offers_is_told_in_our_units() {
        let told = offered(&webcam()).expect("told");
        let exposure = told[0];
        assert_eq!(
            (exposure.control, exposure.low, exposure.high, exposure.step),
            (Control::Exposure, 0.3, 204.7, 0.1)
        );
        assert_eq!((exposure.value, exposure.decides), (25.0, Decides::Camera));
        assert_eq!((told[1].control, told[1].value, told[1].decides), (Control::Gain, 64.0, Decides::OnlyUs));
        assert_eq!((told[2].control, told[2].step, told[2].decides), (Control::Focus, 5.0, Decides::Us));
        assert_eq!(offered(&Fake::new(&[])), Ok(Vec::new()));
    }

    #[test]
    fn a_value_switches_its_automatic_off_and_is_taken_to_the_nearest_step() {
        let camera = webcam();
        let done = set(&camera, Control::Exposure, Setting::Value(8.03)).expect("set");
        assert_eq!((done.value, done.decides), (8.0, Decides::Us));
        assert_eq!(camera.get(EXPOSURE_MODE).ok(), Some(MODE_MANUAL));
        assert_eq!(set(&camera, Control::Focus, Setting::Value(33.0)).expect("set").value, 35.0);
        // Both ends of the range, although 0.3 and 204.7 are no binary fractions.
        for end in [0.3, 204.7] {
            assert_eq!(set(&camera, Control::Exposure, Setting::Value(end)).expect("set").value, end);
        }
        let back = set(&camera, Control::Exposure, Setting::Automatic).expect("set");
        assert_eq!(back.decides, Decides::Camera);
        assert_eq!(camera.get(EXPOSURE_MODE).ok(), Some(MODE_APERTURE_PRIORITY));
        assert_eq!(set(&camera, Control::Focus, Setting::Automatic).expect("set").decides, Decides::Camera);
    }

    #[test]
    fn what_cannot_be_is_refused_with_range_and_unit_and_changes_nothing() {
        let camera = webcam();
        let refused = |control, to| set(&camera, control, to).expect_err("refused").to_string();
        assert_eq!(
            refused(Control::Exposure, Setting::Value(9000.0)),
            "exposure 9000 ms: this camera takes 0.3 to 204.7 ms, every 0.1"
        );
        assert!(refused(Control::Gain, Setting::Value(f64::NAN)).starts_with("gain NaN steps: "));
        assert_eq!(refused(Control::Gain, Setting::Automatic), "gain: this camera has no automatic for it");
        assert_eq!(offered(&camera).expect("told")[0].decides, Decides::Camera);
        let bare = Fake::new(&[]);
        let missing = set(&bare, Control::Focus, Setting::Value(1.0)).expect_err("missing").to_string();
        assert_eq!(missing, "this camera has no focus that could be set");
    }

    #[test]
    fn a_value_beyond_the_last_step_of_the_range_is_its_end() {
        let camera = Fake::new(&[]).with_steps(FOCUS, (0, 253, 30), 5);
        assert_eq!(set(&camera, Control::Focus, Setting::Value(253.0)).expect("set").value, 253.0);
    }

    #[test]
    fn a_camera_that_hangs_is_asked_once_and_no_more() {
        type Order = fn(&Fake) -> Result<(), ControlError>;
        let orders: [Order; 2] = [
            |camera: &Fake| offered(camera).map(|_| ()),
            |camera: &Fake| set(camera, Control::Exposure, Setting::Value(8.0)).map(|_| ()),
        ];
        for order in orders {
            let camera = webcam().hanging();
            let said = order(&camera).expect_err("it hangs").to_string();
            assert!(said.starts_with("exposure: the camera refused it: "), "{said}");
            assert_eq!(camera.timeouts(), 1);
        }
    }

    #[test]
    fn a_camera_that_refuses_a_value_decides_again() {
        let camera = webcam().refusing(EXPOSURE);
        let refused = set(&camera, Control::Exposure, Setting::Value(8.0)).expect_err("refused").to_string();
        assert!(refused.starts_with("exposure: the camera refused it: "), "{refused}");
        assert_eq!(camera.get(EXPOSURE_MODE).ok(), Some(MODE_APERTURE_PRIORITY));
    }
}
