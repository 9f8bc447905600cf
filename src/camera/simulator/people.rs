//! People who walk through the picture: nearer than some things, farther than others.
//!
//! Input: a time. Output: the faces of figures in world coordinates. A figure is two upright boxes, body and head, 1.75 m tall in
//! patterned clothes, that bob and sway as they walk. Each paces a lane of its own to and fro, one in front of the desk, one in front
//! of the window (in the corridor one along it); where in its lane a figure is at the start is drawn from the seed.
//!
//! All their corners move together and against everything else, for as long as they are in the picture. Lanes keep clear of the
//! furniture and of where `hand_held`, `desk_orbit` and `sideways` hold the camera; a camera that drives may run into a figure, of which
//! it then sees nothing. Deliberately not here: limbs, shadows.

use std::f64::consts::PI;

use nalgebra::Vector3;

use super::paint::Noise;
use super::random::Random;
use super::scene::Quad;
use super::styles::{Painter, Style};
use super::texture::Texture;
use crate::camera::simulator_config::{Scenario, SimulatorConfig};

/// Boxes of a figure: across, along its way, from height, to height, m; and what they wear.
const BOXES: [([f64; 4], Style); 2] =
    [([0.44, 0.28, 0.0, 1.47], Style::Clothes), ([0.17, 0.20, 1.50, 1.75], Style::Foliage)];
/// Texels per metre.
const DENSITY: f64 = 400.0;
/// Length of a step, m.
const STEP_M: f64 = 0.65;

/// Where a figure walks to and fro: from, to, world, m.
type Lane = [[f64; 2]; 2];
const ROOM_LANES: [Lane; 2] = [[[1.94, -1.5], [1.94, 1.5]], [[-2.1, 1.62], [1.7, 1.62]]];
const CORRIDOR_LANES: [Lane; 1] = [[[-6.0, 0.46], [6.0, 0.46]]];

/// Figures set out within this time, s.
const LATEST_S: f64 = 1.5;

#[derive(Debug)]
struct Figure {
    lane: Lane,
    /// What it waits longer than the first one may, s.
    later_s: f64,
}

/// All of them.
#[derive(Debug)]
pub(super) struct People {
    figures: Vec<Figure>,
    start_s: f64,
    walk_m_s: f64,
    textures: Vec<Texture>,
}

impl People {
    pub(super) fn new(config: &SimulatorConfig) -> Self {
        let mut random = Random::new(config.seed, 0x9e09);
        let noise = Noise::new(&mut random);
        let lanes: &[Lane] = match config.scenario {
            Scenario::Corridor => &CORRIDOR_LANES,
            _ => &ROOM_LANES,
        };
        let figures: Vec<Figure> =
            lanes.iter().map(|lane| Figure { lane: *lane, later_s: random.range(0.0, LATEST_S) }).collect();
        let mut textures = Vec::new();
        for _ in &figures {
            for ([across, _, low, high], style) in BOXES {
                let random = Random::new(random.next(), 0);
                let size = [across, high - low];
                let canvas = Painter { random, noise: &noise, rich: true }.paint(style, size, DENSITY);
                textures.push(Texture::new(canvas.width, canvas.height, canvas.texels));
            }
        }
        Self { figures, start_s: config.people.start_s, walk_m_s: config.people.walk_m_s, textures }
    }

    /// One a box; see [`Quad::texture`].
    pub(super) fn textures(&self) -> &[Texture] {
        &self.textures
    }

    /// Fastest that any part of a figure moves, m/s: it walks, bobs and sways.
    pub(super) fn fastest_m_s(&self) -> f64 {
        2.0 * self.walk_m_s
    }

    /// Adds the faces at `time_s` to `out`, always as many; `Quad::texture` counts from `first_texture`.
    pub(super) fn add_quads(&self, time_s: f64, first_texture: usize, out: &mut Vec<Quad>) {
        for (k, figure) in self.figures.iter().enumerate() {
            let [from, to] = figure.lane.map(|[x, y]| Vector3::new(x, y, 0.0));
            let length = (to - from).norm();
            let walked_m = (time_s - self.start_s - figure.later_s).max(0.0) * self.walk_m_s;
            let laps = (walked_m / length).rem_euclid(2.0);
            let (share, back) = if laps < 1.0 { (laps, 1.0) } else { (2.0 - laps, -1.0) };
            let step = PI * walked_m / STEP_M;
            let (bob, sway) = (0.025 * (2.0 * step).sin(), 0.03 * step.sin());
            let forward = (to - from) / length * back;
            let left = Vector3::z().cross(&forward);
            let middle = from + (to - from) * share + Vector3::z() * bob + left * sway;
            for (b, ([across, along, low, high], _)) in BOXES.iter().enumerate() {
                for (normal, half, width) in
                    [(forward, along, across), (-forward, along, across), (left, across, along), (-left, across, along)]
                {
                    let right = Vector3::z().cross(&normal);
                    let origin = middle + normal * (0.5 * half) - right * (0.5 * width) + Vector3::z() * *high;
                    out.push(Quad {
                        origin,
                        right,
                        down: -Vector3::z(),
                        away: -normal,
                        size: [*width, high - low],
                        texture: first_texture + k * BOXES.len() + b,
                        density: DENSITY,
                        polished: false,
                    });
                }
            }
        }
    }
}
