//! A simulated webcam: textured rooms rendered in software, seeded, with ground truth.
//!
//! Input: [`SimulatorConfig`]. Output: frames through [`FrameSource`], 8-bit grey, as a cheap webcam would deliver them,
//! and the exact pose of each ([`Trajectory::pose_at`] with the frame's own timestamp).
//!
//! # What is promised
//! - Frame `k` is a pure function of the configuration (seed included) and `k`: same bytes in every run, in any order,
//!   at any pace.
//! - Timestamps: frame `k` is taken at `start + k / rate`; that is the middle of the exposure of the picture's middle
//!   row. With [`Pacing::LockStep`] start is [`RECORDING_START_NS`] and the clock the recording's own; with
//!   [`Pacing::RealTime`] start is CLOCK_MONOTONIC at the first frame.
//! - World: REP-103 axes, z up, metres, origin on the floor in the middle of the room.
//! - In real time a frame is handed over at its timestamp, as if reading and transfer took no time. A frame that is
//!   late keeps its timestamp; when rendering falls behind by more than a period, the frames in between are skipped and
//!   their sequence numbers are missing.
//!
//! # Rooms
//! `random` numbers; `paint`, `styles`, `furnishings`: textures; `scene`, `room`: geometry and light;
//! `another_day`: what of them has changed; `desk`: the place of `desk_sweep`; `building`: three rooms in a row; [`trajectory`], `jerks`: the movement; [`wheels`]: what a driven base tells of it; `rays`, `cull`, `render`, `tile`, `texture`, `gloss`: the
//! picture; `effects`, `actors`, `occluder`, `people`: what spoils it; `export`: a recording on disk.
//!
//! # Cost
//! Median CPU time of one thread for a frame of 640x480, release build, on one busy core of a 2-core AMD EPYC virtual
//! machine; effects on `room_tour`, one at a time on top of the flawless camera (7.3 ms):
//!
//! | | ms |
//! |---|---|
//! | distortion, vignetting, exposure, noise, rolling shutter, occluder | below 0.5 each |
//! | all of them | 7.7 (90 % of frames below 8.9) |
//! | motion blur of 8 ms too | 8.9 (90 % below 15: a frame costs more the farther it streaks) |
//! | `fast_rotation` with blur | 22 (90 % below 88) |
//! | most faces in view: `desk_orbit`, default | 12.2 |
//! | 1280x720, all | 27 |
//!
//! Start: 0.5 to 1 s and about 45 MB, mostly textures.
//!
//! Deliberately not here: physics, colour, transparency, reflections but of lamps, cast shadows of moving things.

mod actors;
mod another_day;
mod building;
mod cull;
mod desk;
mod effects;
mod export;
mod furnishings;
mod gloss;
mod jerks;
mod occluder;
mod paint;
mod people;
mod random;
mod rays;
mod render;
mod room;
mod scene;
mod styles;
mod texture;
mod tile;
pub mod trajectory;
pub mod wheels;

#[cfg(test)]
mod tests;

use std::time::Duration;

use nalgebra::Vector3;

pub use super::simulator_config::{Scenario, SimulatorConfig, SimulatorConfigError};
pub use export::{ExportError, Recorded};
pub use scene::{Chessboard, WallTag};
pub use trajectory::Trajectory;
pub use wheels::Odometer;

use super::{FrameSource, Grab, Pacing, SourceDescription, SourceError};
use crate::frame::{Clock, PixelFormat, RawFrame, monotonic_ns};
use crate::geometry::CameraModel;
use crate::image::GreyImage;
use crate::motion::wheel::{WheelFault, WheelMessage};
use actors::Actors;
use cull::View;
use effects::{Exposure, Sensor};
use gloss::Gloss;
use render::Renderer;
use scene::Scene;

/// Where a scenario takes place.
fn place(scenario: Scenario, plan: &room::Plan) -> Scene {
    match scenario {
        Scenario::Corridor => room::corridor(plan),
        Scenario::DeskSweep => desk::office(plan),
        Scenario::ThreeRooms => building::building(plan, false),
        Scenario::LookAlike => building::building(plan, true),
        _ => room::furnished_room(plan),
    }
}

/// Timestamp of frame 0 in lock-step, ns.
pub const RECORDING_START_NS: i64 = 1_000_000_000_000;

/// The simulated webcam.
#[derive(Debug)]
pub struct Simulator {
    config: SimulatorConfig,
    pacing: Pacing,
    camera: CameraModel,
    description: SourceDescription,
    scene: Scene,
    trajectory: Trajectory,
    /// `None`: nothing is told of wheels.
    odometer: Option<Odometer>,
    renderer: Renderer,
    sensor: Sensor,
    exposure: Exposure,
    actors: Option<Actors>,
    /// Number of frames; `None` = endless.
    frames: Option<u64>,
    /// Sequence number of the next frame.
    next: u64,
}

impl Simulator {
    /// Checks the configuration and paints the room: some tenths of a second.
    pub fn new(config: &SimulatorConfig, pacing: Pacing) -> Result<Self, SourceError> {
        let refuse =
            |e: SimulatorConfigError| SourceError::Open { path: "simulator".to_owned(), reason: e.to_string() };
        config.validate().map_err(refuse)?;
        let camera = config.camera_model().map_err(refuse)?;
        let plan = room::Plan {
            seed: config.seed,
            texel_m: config.texel_mm * 1e-3,
            rich: !config.low_texture,
            chessboard: &config.chessboard,
            tags: &config.tags,
            desk: &config.desk,
            another_day: &config.another_day,
        };
        let scene = place(config.scenario, &plan);
        let gloss = Gloss::new(&config.gloss, &scene.lamps);
        let (clock, start_ns) = match pacing {
            Pacing::LockStep => (Clock::Recording, Some(RECORDING_START_NS)),
            Pacing::RealTime => (Clock::Monotonic, None),
        };
        let frames = (config.duration_s > 0.0).then(|| (config.duration_s * config.rate_hz).ceil() as u64);
        let description = SourceDescription {
            name: format!("simulator {} seed {}", config.scenario.name(), config.seed),
            size: Some((config.width, config.height)),
            rate_hz: Some(config.rate_hz),
            clock,
            camera: Some(camera.clone()),
            frames,
        };
        tracing::info!(
            source = %description.name,
            faces = scene.quads.len(),
            texture_bytes = scene.texture_bytes(),
            "simulated room painted"
        );
        let trajectory = Trajectory::new(config, start_ns);
        Ok(Self {
            odometer: Odometer::new(config, &trajectory),
            trajectory,
            renderer: Renderer::new(rays::Rays::new(&camera), gloss),
            sensor: Sensor::new(config, &camera),
            exposure: Exposure::new(config),
            actors: Actors::new(config, &camera),
            config: config.clone(),
            pacing,
            camera,
            description,
            scene,
            frames,
            next: 0,
        })
    }

    /// The ground truth. Clones stay valid when the simulator has been handed over to a capture thread.
    pub fn trajectory(&self) -> &Trajectory {
        &self.trajectory
    }

    /// The base's driver, at its first message; `None`: nothing is told of wheels.
    pub fn odometer(&self) -> Option<Odometer> {
        Odometer::new(&self.config, &self.trajectory)
    }

    /// The simulated lens.
    pub fn camera_model(&self) -> &CameraModel {
        &self.camera
    }

    /// Geometry of the chessboard, if the scene has one.
    pub fn chessboard(&self) -> Option<&Chessboard> {
        self.scene.chessboard.as_ref()
    }

    /// Where the tags hang, if the scene has any.
    pub fn tags(&self) -> &[WallTag] {
        &self.scene.tags
    }

    /// What a ray from a place of the world meets first, in lengths of its direction: the truth of what stands where.
    pub fn reach(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        self.scene.trace(origin, direction).map(|hit| hit.distance)
    }

    /// Timestamp of a frame, ns.
    pub fn timestamp_ns(&self, sequence: u64) -> i64 {
        self.trajectory.start_ns() + (sequence as f64 * 1e9 / self.config.rate_hz).round() as i64
    }

    /// Renders frame `sequence`, whatever was rendered before.
    pub fn render(&mut self, sequence: u64, out: &mut GreyImage) {
        out.resize(self.config.width as usize, self.config.height as usize);
        self.render_into(sequence, &mut out.data);
    }

    fn render_into(&mut self, sequence: u64, out: &mut [u8]) {
        let width = self.config.width as usize;
        let time_s = sequence as f64 / self.config.rate_hz;
        if effects::covered(&self.config.blackout, sequence, self.config.rate_hz) {
            // What light leaks in below a hand.
            let dark = vec![4.0; width];
            for (y, row) in out.chunks_exact_mut(width).enumerate() {
                self.sensor.expose(sequence, y, 1.0, &dark, row);
            }
            return;
        }
        let ev = self.exposure.ev(time_s, &self.scene, &self.trajectory, &self.camera);
        let gain = effects::gain(ev) as f32;
        let trajectory = &self.trajectory;
        let view_at = |t: f64| {
            let pose = trajectory.pose_at_seconds(t);
            View { rotation: pose.rotation.to_rotation_matrix().into_inner(), position: pose.translation }
        };
        let sensor = &self.sensor;
        let shot = effects::shot(&self.config, time_s, ev);
        self.renderer.render(&self.scene, self.actors.as_ref(), &shot, &view_at, &mut |y, light| {
            if let Some(row) = out.get_mut(y * width..(y + 1) * width) {
                sensor.expose(sequence, y, gain, light, row);
            }
        });
    }
}

impl FrameSource for Simulator {
    fn description(&self) -> &SourceDescription {
        &self.description
    }

    fn grab(&mut self, slot: &mut RawFrame, timeout: Duration) -> Result<Grab, SourceError> {
        if self.pacing == Pacing::RealTime {
            // Behind by more than a period: go on with the newest frame that is due.
            let late_s = (monotonic_ns() - self.timestamp_ns(self.next)) as f64 * 1e-9;
            let late = (late_s * self.config.rate_hz).floor();
            if late >= 1.0 {
                self.next += late as u64;
            }
        }
        if self.frames.is_some_and(|n| self.next >= n) {
            return Ok(Grab::End);
        }
        let sequence = self.next;
        let timestamp_ns = self.timestamp_ns(sequence);
        if self.pacing == Pacing::RealTime {
            let wait_ns = timestamp_ns - monotonic_ns();
            if wait_ns > i64::try_from(timeout.as_nanos()).unwrap_or(i64::MAX) {
                std::thread::sleep(timeout);
                return Ok(Grab::TimedOut);
            }
        }
        slot.sequence = sequence;
        slot.timestamp_ns = timestamp_ns;
        slot.format = PixelFormat::Grey;
        slot.width = self.config.width;
        slot.height = self.config.height;
        slot.stride = self.config.width;
        slot.data.resize(self.config.width as usize * self.config.height as usize, 0);
        self.render_into(sequence, &mut slot.data);
        self.next = sequence + 1;
        if self.pacing == Pacing::RealTime {
            // Rendered ahead of its time; at most `timeout`, see above.
            let wait_ns = timestamp_ns - monotonic_ns();
            if wait_ns > 0 {
                std::thread::sleep(Duration::from_nanos(wait_ns as u64));
            }
        }
        slot.arrival_ns = monotonic_ns();
        Ok(Grab::Frame)
    }

    fn wheels(&mut self, until_ns: i64, to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {
        let Some(odometer) = &mut self.odometer else { return };
        while odometer.next_stamp_ns() <= until_ns {
            if let Some(message) = odometer.next_message() {
                to(&message, None);
            }
        }
    }
}
