//! Something that walks past close to the camera.
//!
//! Input: a time. Output: two upright patterned faces (body and head) in camera coordinates that come in from one side,
//! slow down in the middle, cover the configured share of the picture there and leave on the other side; next time from
//! the other side. It belongs to nothing that the camera maps: its corners move against all others.
//!
//! It is 0.4 m before the lens, nearer than anything else, so that it covers what it should in every scene.

use nalgebra::{Vector2, Vector3};

use super::paint::Noise;
use super::random::Random;
use super::scene::Quad;
use super::styles::{Painter, Style};
use super::texture::Texture;
use crate::camera::simulator_config::{OccluderConfig, SimulatorConfig};
use crate::geometry::CameraModel;

/// Distance from the lens, m.
const DEPTH: f64 = 0.4;
/// Share of the picture's height that the body takes; the head has the rest.
const BODY: f64 = 0.68;
/// Width of the head in body widths.
const HEAD: f64 = 0.6;

/// The passing thing.
#[derive(Debug)]
pub(super) struct Occluder {
    config: OccluderConfig,
    textures: [Texture; 2],
    /// Picture's edges in normalised coordinates: left, right, top, bottom.
    edges: [f64; 4],
    /// Width of the body, m.
    width: f64,
    density: f64,
}

impl Occluder {
    pub(super) fn new(config: &SimulatorConfig, camera: &CameraModel) -> Self {
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        let mut edges =
            [-camera.cx / camera.fx, (w - camera.cx) / camera.fx, -camera.cy / camera.fy, (h - camera.cy) / camera.fy];
        if camera.lens.is_wide_angle() {
            // Where the middles of the picture's sides look to.
            for (edge, (x, y)) in
                edges.iter_mut().zip([(0.0, camera.cy), (w, camera.cy), (camera.cx, 0.0), (camera.cx, h)])
            {
                *edge = camera.undistort(&Vector2::new(x, y)).map_or(*edge, |n| if y == camera.cy { n.x } else { n.y });
            }
        }
        // Area of body and head together = share of the picture.
        let width = config.occluder.share * (edges[1] - edges[0]) * DEPTH / (BODY + (1.0 - BODY) * HEAD);
        let density = 1800.0;
        let mut random = Random::new(config.seed, 0x0cc1);
        let noise = Noise::new(&mut random);
        let height = 1.6 * (edges[3] - edges[2]) * DEPTH;
        let mut paint = |style, size| {
            let random = Random::new(random.next(), 0);
            let canvas = Painter { random, noise: &noise, rich: true }.paint(style, size, density);
            Texture::new(canvas.width, canvas.height, canvas.texels)
        };
        let textures = [paint(Style::Clothes, [width, height * BODY]), paint(Style::Foliage, [width * HEAD, height])];
        Self { config: config.occluder.clone(), textures, edges, width, density }
    }

    /// Both faces at `time_s`, camera coordinates; `Quad::texture` counts from `first_texture`.
    pub(super) fn quads(&self, time_s: f64, first_texture: usize) -> [Quad; 2] {
        let since = time_s - self.config.start_s;
        let lap = (since / self.config.period_s).floor();
        let t = (since - lap * self.config.period_s) / self.config.pass_s;
        let away = since < 0.0 || t > 1.0;
        // -1..1 across the picture, slowest in the middle.
        let s = 2.0 * t - 1.0;
        let across = 0.35 * s + 0.65 * s.powi(3);
        let side = if lap.rem_euclid(2.0) < 0.5 { 1.0 } else { -1.0 };
        let [left, right, top, bottom] = self.edges.map(|e| e * DEPTH);
        // Far enough to both sides to be out of every lens's sight.
        let reach = 0.5 * (right - left) * 1.5 + self.width;
        let x = if away { 100.0 } else { 0.5 * (left + right) + side * across * reach };
        let step = 0.012 * (bottom - top) * (since * 11.0).sin();
        let (height, lean) = (bottom - top, 0.04 * (since * 5.5).sin());
        let quad = |texture: usize, width: f64, from: f64, to: f64| {
            let (right, down) = (Vector3::new(lean.cos(), lean.sin(), 0.0), Vector3::new(-lean.sin(), lean.cos(), 0.0));
            let middle = Vector3::new(x, top + from * height + step, DEPTH);
            let size = [width, (to - from) * height];
            Quad {
                origin: middle - right * (0.5 * width),
                right,
                down,
                away: Vector3::z(),
                size,
                texture: first_texture + texture,
                density: self.density,
                polished: false,
            }
        };
        // Body to below the picture, head to above it.
        [quad(0, self.width, 1.0 - BODY, 1.3), quad(1, self.width * HEAD, -0.3, 1.0 - BODY)]
    }

    pub(super) fn textures(&self) -> &[Texture] {
        &self.textures
    }
}
