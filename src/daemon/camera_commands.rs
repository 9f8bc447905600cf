//! What commands ask of the camera: which it is, exposure, gain and focus, and that a calibration of it is kept.
//!
//! The supervisor hands a command to the capture stage and answers it when that has ([`CameraDesk`]); the stage carries it out between two frames
//! ([`CameraOrder::carry_out`]). A control transfer takes a millisecond. A camera that hangs over it delays its own frames by the driver's 5 s, which
//! is half of what the watchdog allows, and no pose of a frame that has come.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, TryRecvError, TrySendError, bounded};
use tracing::{info, warn};

use super::calibration::Calibration;
use super::request::Request;
use crate::calibration::store;
use crate::camera::controls::{Control, ControlError, ControlState, Decides, Setting};
use crate::camera::{Device, FrameSource};
use crate::messages::{Automatic, CameraControl, Command, CommandReply, command_kind, reply_code};
use crate::publish;

/// Orders on their way to the capture stage.
pub const CAMERA_QUEUE: usize = 4;
/// A driver gives a control transfer up after 5 s, and with it its order: time for this one and one before it.
const PATIENCE: Duration = Duration::from_secs(12);

#[derive(Debug, Clone, PartialEq)]
enum Wish {
    Tell,
    Set(Control, Setting),
    Identify,
    /// The calibration in a file.
    Keep(PathBuf),
}

/// What the capture stage is asked for.
#[derive(Debug)]
pub struct CameraOrder {
    wish: Wish,
    reply: Sender<CommandReply>,
    /// Who takes up a calibration that was kept; `None`: the configuration says which one this run has.
    taker: Option<Sender<Request>>,
}

impl CameraOrder {
    /// Between two frames; `source`: `None` while there is no camera.
    pub fn carry_out(self, source: Option<&mut (dyn FrameSource + 'static)>) {
        let answer = match (source, self.wish) {
            (None, _) => CommandReply::new(reply_code::FAILED, "there is no camera at the moment"),
            (Some(source), Wish::Keep(path)) => match source.device() {
                Some(camera) => return keep(camera, source.description().size, path, self.taker, self.reply),
                None => no_camera(source),
            },
            (Some(source), Wish::Identify) => match source.device() {
                Some(camera) => {
                    let text = format!("{} {}", camera.identity, camera.path.display());
                    CommandReply::new(reply_code::OK, &text)
                }
                None => no_camera(source),
            },
            (Some(source), Wish::Tell) => answer(source, None),
            (Some(source), Wish::Set(control, to)) => answer(source, Some((control, to))),
        };
        // Whoever asked may have gone.
        let _ = self.reply.try_send(answer);
    }
}

fn no_camera(source: &dyn FrameSource) -> CommandReply {
    let text = format!("{} is no camera, so nothing is kept of one", source.description().name);
    CommandReply::new(reply_code::UNSUPPORTED, &text)
}

/// To whoever begins the next map; when the camera has it, to be said behind its name.
fn hand_on(kept: Calibration, taker: Option<&Sender<Request>>) -> &'static str {
    match taker.map(|taker| taker.try_send(Request::Calibrated(Box::new(kept)))) {
        Some(Ok(())) => ", which has it from the next map on",
        // Other requests are before it.
        Some(Err(_)) => ", which has it from the next start on",
        None => "; which one this daemon has is in its configuration",
    }
}

/// In a thread of its own: frames do not wait for a disk. Of the files that it writes none is ever half there, however it ends.
fn keep(
    camera: Device,
    size: Option<(u32, u32)>,
    path: PathBuf,
    taker: Option<Sender<Request>>,
    reply: Sender<CommandReply>,
) {
    let work = move || {
        let answer = match store::adopt(&store::state_folders(), &camera.identity, size, &path) {
            Ok((kept, model)) => {
                let kept = kept.display().to_string();
                info!(camera = %camera.identity, path = kept, "calibration kept");
                let when = hand_on(Calibration::known(model, kept.clone()), taker.as_ref());
                CommandReply::new(reply_code::OK, &format!("kept as {kept} for camera {}{when}", camera.identity))
            }
            Err(error) => {
                let reason = error.to_string();
                warn!(reason, "command not carried out");
                CommandReply::new(reply_code::FAILED, &reason)
            }
        };
        let _ = reply.try_send(answer);
    };
    // Without a thread nobody answers, which the sender is told.
    if let Err(error) = std::thread::Builder::new().name("cairn-calibration".into()).spawn(work) {
        warn!(%error, "command not carried out");
    }
}

/// Tells of the controls, or sets one.
fn answer(source: &mut dyn FrameSource, set: Option<(Control, Setting)>) -> CommandReply {
    let done = match set {
        None => source.controls().map(|controls| {
            let lines: Vec<String> = controls.iter().map(|c| wire(c).to_string()).collect();
            lines.join("\n")
        }),
        Some((control, to)) => source.set_control(control, to).map(|state| {
            let automatic = state.decides == Decides::Camera;
            info!(control = control.name(), value = state.value, automatic, "camera control set");
            sentence(&state)
        }),
    };
    match done {
        Ok(text) => CommandReply::new(reply_code::OK, &text),
        Err(error) => {
            let code = match error {
                ControlError::NoControls(_) | ControlError::Missing(_) | ControlError::NoAutomatic(_) => {
                    reply_code::UNSUPPORTED
                }
                ControlError::Range { .. } => reply_code::INVALID,
                ControlError::Refused { .. } => reply_code::FAILED,
            };
            let reason = error.to_string();
            if set.is_some() {
                warn!(reason, "command not carried out");
            }
            CommandReply::new(code, &reason)
        }
    }
}

/// As in the answer that lists them.
fn wire(state: &ControlState) -> CameraControl {
    let &ControlState { control, low, high, step, default, value, decides } = state;
    let automatic = match decides {
        Decides::Camera => Automatic::On,
        Decides::Us => Automatic::Off,
        Decides::OnlyUs => Automatic::None,
    };
    CameraControl {
        name: control.name().into(),
        unit: control.unit().into(),
        low,
        high,
        step,
        default,
        value,
        automatic,
    }
}

fn sentence(state: &ControlState) -> String {
    let (name, value, unit) = (state.control.name(), state.value, state.control.unit());
    match state.decides {
        Decides::Camera => format!("the camera decides on {name}, {value} {unit} now"),
        Decides::Us | Decides::OnlyUs => format!("{name} is {value} {unit}"),
    }
}

/// What a command asks for; the error says how it should be.
fn wish(command: &Command) -> Result<Wish, &'static str> {
    const FORM: &str = "exposure, gain or focus, a space, and a number or auto";
    match command.kind {
        command_kind::CAMERA_CONTROLS => return Ok(Wish::Tell),
        command_kind::CAMERA_IDENTITY => return Ok(Wish::Identify),
        command_kind::KEEP_CALIBRATION => {
            let path = command.path().map(PathBuf::from).filter(|path| path.is_absolute());
            return path.map(Wish::Keep).ok_or("the path must be absolute and UTF-8");
        }
        _ => {}
    }
    let (name, to) = command.path().and_then(|text| text.split_once(' ')).ok_or(FORM)?;
    let control = Control::ALL.into_iter().find(|control| control.name() == name).ok_or(FORM)?;
    let setting = match to {
        "auto" => Setting::Automatic,
        number => Setting::Value(number.parse().map_err(|_| FORM)?),
    };
    Ok(Wish::Set(control, setting))
}

/// A command under way, and who waits for it.
struct Asked {
    request: publish::Request,
    outcome: Receiver<CommandReply>,
    began: Instant,
}

/// The supervisor's end.
pub struct CameraDesk {
    orders: Sender<CameraOrder>,
    taker: Option<Sender<Request>>,
    asked: Vec<Asked>,
}

impl CameraDesk {
    /// `taker`: as in an order.
    pub fn new(orders: Sender<CameraOrder>, taker: Option<Sender<Request>>) -> Self {
        Self { orders, taker, asked: Vec::new() }
    }

    /// Hands a command on.
    pub fn take(&mut self, request: publish::Request) {
        // A sender that has gone needs no answer.
        let refuse = |request: publish::Request, code, why| {
            let _ = request.reply(CommandReply::new(code, why));
        };
        let wish = match wish(request.command()) {
            Ok(wish) => wish,
            Err(why) => return refuse(request, reply_code::INVALID, why),
        };
        let (reply, outcome) = bounded(1);
        match self.orders.try_send(CameraOrder { wish, reply, taker: self.taker.clone() }) {
            Ok(()) => self.asked.push(Asked { request, outcome, began: Instant::now() }),
            Err(TrySendError::Full(_)) => refuse(request, reply_code::BUSY, "other requests are under way"),
            Err(TrySendError::Disconnected(_)) => refuse(request, reply_code::FAILED, "the source has ended"),
        }
    }

    /// Answers what has been carried out meanwhile.
    pub fn answer(&mut self) {
        for asked in std::mem::take(&mut self.asked) {
            let reply = match asked.outcome.try_recv() {
                Ok(reply) => reply,
                Err(TryRecvError::Empty) if asked.began.elapsed() < PATIENCE => {
                    self.asked.push(asked);
                    continue;
                }
                Err(TryRecvError::Empty) => {
                    CommandReply::new(reply_code::FAILED, "the camera does not answer; it may still be carried out")
                }
                Err(TryRecvError::Disconnected) => CommandReply::new(reply_code::FAILED, "the source has ended"),
            };
            // A sender that has gone needs no answer.
            let _ = asked.request.reply(reply);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Grab, SourceDescription, SourceError};
    use crate::frame::{Clock, RawFrame};

    /// A camera with a gain of 0 to 255 alone, or a source without controls.
    struct Source {
        description: SourceDescription,
        gain: Option<f64>,
    }

    impl Source {
        fn new(gain: Option<f64>) -> Self {
            let description = SourceDescription {
                name: "simulator hall seed 1".into(),
                size: None,
                rate_hz: None,
                clock: Clock::Monotonic,
                camera: None,
                frames: None,
            };
            Self { description, gain }
        }
    }

    /// What every source is, unless it says otherwise.
    struct Plain(Source);

    impl FrameSource for Plain {
        fn description(&self) -> &SourceDescription {
            &self.0.description
        }
        fn grab(&mut self, _: &mut RawFrame, _: Duration) -> Result<Grab, SourceError> {
            Ok(Grab::End)
        }
    }

    impl FrameSource for Source {
        fn description(&self) -> &SourceDescription {
            &self.description
        }
        fn grab(&mut self, _: &mut RawFrame, _: Duration) -> Result<Grab, SourceError> {
            Ok(Grab::End)
        }
        fn device(&self) -> Option<Device> {
            let identity = store::CameraIdentity::parse("046d:0825")?;
            Some(Device { identity, path: "/dev/video3".into() })
        }
        fn controls(&mut self) -> Result<Vec<ControlState>, ControlError> {
            let value = self.gain.ok_or(ControlError::Missing(Control::Gain))?;
            let (low, high, step, default, decides) = (0.0, 255.0, 1.0, 64.0, Decides::OnlyUs);
            Ok(vec![ControlState { control: Control::Gain, low, high, step, default, value, decides }])
        }
        fn set_control(&mut self, control: Control, to: Setting) -> Result<ControlState, ControlError> {
            let state = self.controls()?[0];
            match (control, to) {
                (Control::Gain, Setting::Automatic) => Err(ControlError::NoAutomatic(control)),
                (Control::Gain, Setting::Value(value)) if state.allows(value) => {
                    self.gain = Some(value);
                    Ok(ControlState { value, ..state })
                }
                (Control::Gain, Setting::Value(value)) => Err(ControlError::Range { value, state }),
                _ => Err(ControlError::Missing(control)),
            }
        }
    }

    fn ask(source: Option<&mut (dyn FrameSource + 'static)>, text: Option<&str>) -> (u32, String) {
        let command = match text {
            Some(text) => Command::with_path(command_kind::SET_CAMERA, text).expect("short"),
            None => Command::new(command_kind::CAMERA_CONTROLS),
        };
        let wish = match wish(&command) {
            Ok(wish) => wish,
            Err(why) => return (reply_code::INVALID, why.into()),
        };
        let (reply, outcome) = bounded(1);
        CameraOrder { wish, reply, taker: None }.carry_out(source);
        let answer = outcome.try_recv().expect("answered");
        (answer.code, answer.message().into())
    }

    #[test]
    fn a_calibration_is_kept_of_a_camera_only_and_what_is_wrong_with_it_is_said() {
        let order = |source: Option<&mut (dyn FrameSource + 'static)>, command: &Command| {
            let wish = match wish(command) {
                Ok(wish) => wish,
                Err(why) => return (reply_code::INVALID, why.to_owned()),
            };
            let (reply, outcome) = bounded(1);
            CameraOrder { wish, reply, taker: None }.carry_out(source);
            let answer = outcome.recv_timeout(Duration::from_secs(10)).expect("answered");
            (answer.code, answer.message().to_owned())
        };
        let keep = |path| Command::with_path(command_kind::KEEP_CALIBRATION, path).expect("short");
        let identify = Command::new(command_kind::CAMERA_IDENTITY);
        let mut camera = Source::new(Some(64.0));
        assert_eq!(order(Some(&mut camera), &identify), (reply_code::OK, "046d:0825 /dev/video3".into()));
        assert_eq!(order(Some(&mut camera), &keep("camera.toml")).0, reply_code::INVALID, "whose folder?");
        let (code, text) = order(Some(&mut camera), &keep("/not/there.toml"));
        assert!(code == reply_code::FAILED && text.starts_with("/not/there.toml: "), "{code} {text}");
        assert_eq!(order(None, &keep("/not/there.toml")).0, reply_code::FAILED);
        for command in [identify, keep("/not/there.toml")] {
            let (code, text) = order(Some(&mut Plain(Source::new(None))), &command);
            assert!(code == reply_code::UNSUPPORTED && text.contains("simulator hall seed 1"), "{code} {text}");
        }
    }

    #[test]
    fn a_calibration_that_is_kept_is_handed_to_the_next_map_and_what_comes_of_it_is_said() {
        let model = crate::geometry::CameraModel::new(320, 240, 300.0, 300.0, 160.0, 120.0, [0.0; 5]).expect("camera");
        let kept = || Calibration::known(model.clone(), "kept.toml".into());
        let (taker, taken) = bounded(1);
        assert!(hand_on(kept(), Some(&taker)).contains("the next map"));
        assert!(hand_on(kept(), Some(&taker)).contains("next start"), "there is no room");
        assert!(hand_on(kept(), None).contains("configuration"));
        let Ok(Request::Calibrated(calibration)) = taken.try_recv() else { panic!("handed on") };
        assert_eq!((*calibration, taken.len()), (kept(), 0));
    }

    #[test]
    fn a_camera_tells_what_it_offers_and_takes_what_lies_in_its_range() {
        let mut camera = Source::new(Some(64.0));
        let (code, text) = ask(Some(&mut camera), None);
        let listed: Vec<CameraControl> = text.lines().filter_map(|line| line.parse().ok()).collect();
        assert_eq!((code, listed.len()), (reply_code::OK, 1));
        assert_eq!((listed[0].name.as_str(), listed[0].high, listed[0].automatic), ("gain", 255.0, Automatic::None));
        assert_eq!(ask(Some(&mut camera), Some("gain 80")), (reply_code::OK, "gain is 80 steps".into()));
        assert_eq!(camera.gain, Some(80.0));
        let (code, text) = ask(Some(&mut camera), Some("gain 300"));
        assert_eq!(code, reply_code::INVALID);
        assert_eq!(text, "gain 300 steps: this camera takes 0 to 255 steps, every 1");
        assert_eq!(ask(Some(&mut camera), Some("gain auto")).0, reply_code::UNSUPPORTED);
        assert_eq!(ask(Some(&mut camera), Some("focus 3")).0, reply_code::UNSUPPORTED);
        for text in ["", "gain", "gain much", "zoom 3", "gain  3", "gain 3 4"] {
            assert_eq!(ask(Some(&mut camera), Some(text)).0, reply_code::INVALID, "{text:?}");
        }
        assert_eq!(camera.gain, Some(80.0));
    }

    #[test]
    fn a_source_without_controls_says_so_and_so_does_none() {
        let mut plain = Plain(Source::new(None));
        for text in [None, Some("exposure 5"), Some("gain auto")] {
            let (code, said) = ask(Some(&mut plain), text);
            assert_eq!(code, reply_code::UNSUPPORTED);
            assert_eq!(said, "simulator hall seed 1 has no exposure, gain or focus that could be set");
            assert_eq!(ask(None, text), (reply_code::FAILED, "there is no camera at the moment".into()));
        }
    }
}
