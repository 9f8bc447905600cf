//! `cairn command camera`: exposure, gain and focus of the running daemon's camera.

use std::str::FromStr;
use std::time::Duration;

use super::{CliError, session};
use crate::client::Client;
use crate::messages::{Automatic, CameraControl, CommandReply};

#[derive(Debug, Clone, clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct CameraArgs {
    /// Print what the camera offers as one JSON array
    #[arg(long)]
    json: bool,
    /// Without one: what the camera offers
    #[command(subcommand)]
    set: Option<Set>,
}

#[derive(Debug, Clone, clap::Subcommand)]
enum Set {
    /// Set the time of exposure
    Exposure {
        /// Milliseconds, or auto: the camera decides
        #[arg(value_name = "MS", allow_negative_numbers = true)]
        to: Value,
    },
    /// Set the gain
    Gain {
        /// Steps of the camera's own, or auto: the camera decides
        #[arg(value_name = "STEPS", allow_negative_numbers = true)]
        to: Value,
    },
    /// Set the position of the lens; every change changes the calibration
    Focus {
        /// Steps of the camera's own, or auto: the camera decides
        #[arg(value_name = "STEPS", allow_negative_numbers = true)]
        to: Value,
    },
}

/// A number, or `auto`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Value(Option<f64>);

impl FromStr for Value {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self(None)),
            number => number.parse().map(|value| Self(Some(value))).map_err(|_| "must be a number or auto".into()),
        }
    }
}

/// The daemon's answer; `None`: what the camera offers is printed.
pub fn run(args: &CameraArgs, client: &Client, timeout: Duration) -> Result<Option<CommandReply>, CliError> {
    let (control, Value(value)) = match args.set {
        None => return show(client, timeout, args.json),
        Some(Set::Exposure { to }) => ("exposure", to),
        Some(Set::Gain { to }) => ("gain", to),
        Some(Set::Focus { to }) => ("focus", to),
    };
    Ok(Some(client.set_camera(control, value, timeout)?))
}

fn show(client: &Client, timeout: Duration, as_json: bool) -> Result<Option<CommandReply>, CliError> {
    let controls = match client.camera_controls(timeout)? {
        Ok(controls) => controls,
        Err(refused) => return Ok(Some(refused)),
    };
    let text = if as_json {
        session::json(&controls.iter().map(object).collect::<Vec<_>>())?
    } else {
        // An older daemon does not tell it.
        let named =
            client.camera_identity(timeout)?.map(|(identity, device)| format!("camera {identity} at {device}\n"));
        named.unwrap_or_default() + &controls.iter().map(line).collect::<String>()
    };
    session::print(&text)?;
    Ok(None)
}

fn object(c: &CameraControl) -> serde_json::Value {
    let automatic = match c.automatic {
        Automatic::On => Some(true),
        Automatic::Off => Some(false),
        Automatic::None => None,
    };
    serde_json::json!({
        "name": c.name, "unit": c.unit, "low": c.low, "high": c.high, "step": c.step, "default": c.default,
        "value": Some(c.value).filter(|v| v.is_finite()), "auto": automatic,
    })
}

fn line(c: &CameraControl) -> String {
    let CameraControl { name, unit, low, high, step, default, value, automatic } = c;
    let who = match automatic {
        Automatic::On => ", by the camera",
        Automatic::Off => ", set; auto: the camera decides",
        Automatic::None => "",
    };
    let now = if value.is_finite() { format!("{value} {unit}") } else { "not told".into() };
    format!("{name}: {now}{who} ({low} to {high} {unit}, every {step}; {default} when plugged in)\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_control_is_a_line_for_a_person_and_an_object_for_a_script() {
        let control = |text: &str| text.parse::<CameraControl>().expect("control");
        let exposure = control("exposure ms 0.3 204.7 0.1 25 8 auto");
        assert_eq!(line(&exposure), "exposure: 8 ms, by the camera (0.3 to 204.7 ms, every 0.1; 25 when plugged in)\n");
        let gain = control("gain steps 0 255 1 64 NaN manual-only");
        assert_eq!(line(&gain), "gain: not told (0 to 255 steps, every 1; 64 when plugged in)\n");
        assert_eq!((object(&gain)["value"].clone(), object(&gain)["auto"].clone()), Default::default());
        assert_eq!(object(&exposure)["auto"], true);
    }

    #[test]
    fn a_value_is_a_number_or_auto() {
        assert_eq!("8.5".parse(), Ok(Value(Some(8.5))));
        assert_eq!("auto".parse(), Ok(Value(None)));
        assert!("more".parse::<Value>().is_err());
    }
}
