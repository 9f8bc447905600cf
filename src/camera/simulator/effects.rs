//! From light to grey values: vignetting, exposure, noise, a covered lens.
//!
//! Input: a row of grey values as a perfect camera would see them, frame number, gain. Output: bytes.
//!
//! ```text
//! v = scene * vignetting(x, y) * gain          vignetting = 1 - loss (r / r_corner)²
//! out = v + n sqrt(read² + shot² v / 255)      n standard normal
//! ```
//!
//! Grey values are perceptual, as a webcam delivers them: with a response curve of power 1/2.2 an exposure of `ev`
//! values multiplies them by 2^(ev / 2.2), so a gain is still a gain. Everything is a pure function of seed,
//! configuration and frame: frames can be rendered in any order.
//!
//! Cost: about 1 ns a pixel; the noise comes from a table that each row enters at a place of its own.

use std::f64::consts::TAU;

use super::random::{Random, mix};
use super::render::Shot;
use super::scene::Scene;
use super::trajectory::Trajectory;
use crate::camera::simulator_config::{BlackoutConfig, ExposureConfig, SimulatorConfig};
use crate::geometry::CameraModel;

/// Entries of the noise table that a row may start at.
const NOISE_STARTS: usize = 1 << 14;
/// Grey value that the automatic exposure steers the picture's mean to.
const TARGET_GREY: f64 = 118.0;
/// Exponent of the response curve.
const RESPONSE: f64 = 1.0 / 2.2;
/// Time between two measurements of the automatic exposure, s.
const METER_STEP_S: f64 = 0.25;
/// Weights of past measurements, newest first: reacts within about a second, twice differentiable in between.
const METER_WEIGHTS: [f64; 6] = [0.10, 0.22, 0.26, 0.21, 0.13, 0.08];

/// Sensor noise and vignetting of one configuration.
#[derive(Debug)]
pub(super) struct Sensor {
    seed: u64,
    /// Standard normal numbers; empty = no noise.
    table: Vec<f32>,
    read_variance: f32,
    /// Variance per grey level.
    shot_variance: f32,
    /// Light lost per squared pixel of distance from the principal point.
    vignetting: f32,
    centre: [f32; 2],
}

impl Sensor {
    pub(super) fn new(config: &SimulatorConfig, camera: &CameraModel) -> Self {
        let mut random = Random::new(config.seed, 0x4015e);
        let table = if config.noise.enabled {
            (0..NOISE_STARTS + config.width as usize).map(|_| random.normal() as f32).collect()
        } else {
            Vec::new()
        };
        let (w, h) = (f64::from(config.width), f64::from(config.height));
        let corner = camera.cx.max(w - camera.cx).powi(2) + camera.cy.max(h - camera.cy).powi(2);
        let loss = if config.vignetting.enabled { config.vignetting.corner_loss } else { 0.0 };
        Self {
            seed: mix(config.seed ^ 0x4015e),
            table,
            read_variance: config.noise.read_sigma.powi(2) as f32,
            shot_variance: (config.noise.shot_sigma.powi(2) / 255.0) as f32,
            vignetting: (loss / corner) as f32,
            centre: [camera.cx as f32, camera.cy as f32],
        }
    }

    /// One row of frame `sequence`; `light` and `out` are as long as the picture is wide.
    pub(super) fn expose(&self, sequence: u64, y: usize, gain: f32, light: &[f32], out: &mut [u8]) {
        let dy = y as f32 - self.centre[1];
        let top = gain * (1.0 - self.vignetting * dy * dy);
        let slope = gain * self.vignetting;
        let start = mix(self.seed ^ mix(sequence) ^ y as u64) as usize % NOISE_STARTS;
        match self.table.get(start..start + light.len()) {
            Some(noise) => {
                for (x, ((out, light), n)) in out.iter_mut().zip(light).zip(noise).enumerate() {
                    let dx = x as f32 - self.centre[0];
                    let v = light * (top - slope * dx * dx);
                    *out = to_byte(v + n * (self.read_variance + self.shot_variance * v).sqrt());
                }
            }
            None => {
                for (x, (out, light)) in out.iter_mut().zip(light).enumerate() {
                    let dx = x as f32 - self.centre[0];
                    *out = to_byte(light * (top - slope * dx * dx));
                }
            }
        }
    }
}

/// Rounds to 0..255; vectorises on every machine.
#[inline(always)]
fn to_byte(v: f32) -> u8 {
    let v = if v > 0.0 { v } else { 0.0 };
    let v = if v < 255.0 { v } else { 255.0 };
    ((v + 8_388_608.0).to_bits() & 0xff) as u8
}

/// The exposure control: exposure values against frame time.
#[derive(Debug)]
pub(super) struct Exposure {
    config: ExposureConfig,
    seed: u64,
    /// Measurements already made: (step, exposure values wanted). Bounded ring.
    meter: Vec<(i64, f64)>,
}

impl Exposure {
    pub(super) fn new(config: &SimulatorConfig) -> Self {
        let slots = 2 * METER_WEIGHTS.len();
        Self { config: config.exposure.clone(), seed: mix(config.seed ^ 0xe4), meter: vec![(i64::MIN, 0.0); slots] }
    }

    /// Exposure values at `time_s` beside the fixed exposure.
    pub(super) fn ev(&mut self, time_s: f64, scene: &Scene, trajectory: &Trajectory, camera: &CameraModel) -> f64 {
        let mut ev = 0.0;
        if self.config.automatic {
            ev += self.automatic_ev(time_s, scene, trajectory, camera);
        }
        if self.config.jumps {
            ev += self.jump_ev(time_s);
        }
        if self.config.hunts {
            ev += self.hunt_ev(time_s);
        }
        ev
    }

    /// Lagging mean of what past measurements asked for; between two measurements the weights slide linearly.
    fn automatic_ev(&mut self, time_s: f64, scene: &Scene, trajectory: &Trajectory, camera: &CameraModel) -> f64 {
        let position = time_s / METER_STEP_S;
        let (step, part) = (position.floor() as i64, position - position.floor());
        let mut sum = 0.0;
        for k in 0..=METER_WEIGHTS.len() {
            let now = METER_WEIGHTS.get(k).copied().unwrap_or(0.0);
            let before = k.checked_sub(1).and_then(|k| METER_WEIGHTS.get(k)).copied().unwrap_or(0.0);
            // At the next step every measurement has moved on by one place.
            let weight = before + (now - before) * part;
            sum += weight * self.measure(step + 1 - k as i64, scene, trajectory, camera);
        }
        sum
    }

    /// Exposure values that the mean of a coarse picture at measurement `step` asks for, -2..2.
    fn measure(&mut self, step: i64, scene: &Scene, trajectory: &Trajectory, camera: &CameraModel) -> f64 {
        let slot = step.rem_euclid(self.meter.len() as i64) as usize;
        if self.meter[slot].0 == step {
            return self.meter[slot].1;
        }
        let pose = trajectory.pose_at_seconds(step as f64 * METER_STEP_S);
        let (mut sum, mut n) = (0.0, 0.0);
        for j in 0..9 {
            for i in 0..12 {
                let u = (f64::from(i) + 0.5) / 12.0 * f64::from(camera.width);
                let v = (f64::from(j) + 0.5) / 9.0 * f64::from(camera.height);
                let mut ray = nalgebra::Vector2::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy);
                if camera.lens.is_wide_angle() {
                    ray = camera.undistort(&nalgebra::Vector2::new(u, v)).unwrap_or(ray);
                }
                let direction = pose.rotation * ray.push(1.0);
                if let Some(hit) = scene.trace(&pose.translation, &direction) {
                    sum += hit.value;
                    n += 1.0;
                }
            }
        }
        let mean = if n > 0.0 { f64::max(sum / n, 1.0) } else { TARGET_GREY };
        let ev = ((TARGET_GREY / mean).log2() / RESPONSE).clamp(-2.0, 2.0);
        self.meter[slot] = (step, ev);
        ev
    }

    /// Sudden jumps: one at a random time in every period, fading with a time constant of 0.5 s.
    fn jump_ev(&self, time_s: f64) -> f64 {
        let period = self.config.jump_period_s;
        let current = (time_s / period).floor() as i64;
        let mut ev = 0.0;
        for k in current - 1..=current {
            if k < 0 {
                continue;
            }
            let mut random = Random::new(self.seed, k as u64);
            let start = (k as f64 + random.range(0.25, 0.75)) * period;
            let size = self.config.jump_ev * random.range(0.5, 1.0) * if random.chance(0.5) { 1.0 } else { -1.0 };
            if time_s >= start {
                ev += size * (-(time_s - start) / 0.5).exp();
            }
        }
        ev
    }

    /// The limit cycle of a control that is too eager for its delay (to first order a sine: the describing function of its limiter),
    /// which dies down and starts again as the picture changes.
    fn hunt_ev(&self, time_s: f64) -> f64 {
        /// Time from one dying down to the next, periods.
        const ENVELOPE_PERIODS: f64 = 7.0;
        let mut random = Random::new(self.seed, u64::MAX);
        let phase = random.range(0.0, TAU);
        let envelope_phase = random.range(0.0, TAU);
        let turns = time_s / self.config.hunt_period_s;
        let envelope = 0.65 + 0.35 * (TAU * turns / ENVELOPE_PERIODS + envelope_phase).sin();
        self.config.hunt_ev * envelope * (TAU * turns + phase).sin()
    }
}

/// Whether the lens is covered in a frame.
pub(super) fn covered(config: &BlackoutConfig, sequence: u64, rate_hz: f64) -> bool {
    if !config.enabled {
        return false;
    }
    let start = (config.start_s * rate_hz).ceil() as u64;
    let Some(since) = sequence.checked_sub(start) else { return false };
    let period = (config.period_s * rate_hz).round() as u64;
    let since = if period > 0 { since % period } else { since };
    since < u64::from(config.frames)
}

/// Factor on grey values of an exposure.
pub(super) fn gain(ev: f64) -> f64 {
    (ev * RESPONSE).exp2()
}

/// Exposure times of the frame at `time_s`, exposed by `ev` exposure values more than the configured time.
pub(super) fn shot(config: &SimulatorConfig, time_s: f64, ev: f64) -> Shot {
    let longer = if config.exposure.sets_time { ev.exp2() } else { 1.0 };
    let exposure_ms = (config.motion_blur.exposure_ms * longer).min(1000.0 / config.rate_hz);
    let on = |enabled: bool, ms: f64| if enabled { ms * 1e-3 } else { 0.0 };
    Shot {
        time_s,
        exposure_s: on(config.motion_blur.enabled, exposure_ms),
        readout_s: on(config.rolling_shutter.enabled, config.rolling_shutter.readout_ms),
        max_samples: config.motion_blur.max_samples,
    }
}
