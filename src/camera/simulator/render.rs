//! The picture of a scene: one ray per pixel, more where faces meet.
//!
//! Input: scene, rays, exposure times, a function that gives the pose at any time. Output: rows of grey values as `f32`,
//! 0..255, before vignetting, gain and noise.
//!
//! The picture is cut into tiles of 16x16 px. Per tile [`cull`](super::cull) names the faces that can show, mostly one.
//! A face is a homography from rays to texture coordinates and inverse depth, so a pixel costs nine multiplications, a
//! division and the filtered texture look-up. Where a tile shows several faces, the nearest is found at every pixel's
//! corners; pixels whose corners disagree are split into up to eight parts, each seen by its own ray: outlines are
//! anti-aliased and do not crawl.
//!
//! Rolling shutter: every row has its own pose; inside a tile (16 rows, about 1 ms) the homographies are interpolated,
//! which is exact to 0.01 px. Motion blur: moments of the exposure are averaged, as many as the tile's streak asks for.
//!
//! Cost at 640x480: see the table in the module `simulator`. Deliberately not here: lens blur, transparency, mirrors but for
//! lamps in polished faces.

use nalgebra::Vector3;

use super::actors::Actors;
use super::cull::{self, Candidate, Corners, Movement, View};
use super::gloss::Gloss;
use super::rays::{CullRect, Rays, TILE};
use super::scene::{Quad, Scene};
use super::tile::{Face, PARTS, Place, Tile};

/// Seconds between two moments of a streak are chosen so that it moves by this much, px.
const STREAK_STEP_PX: f64 = 1.5;

/// How one frame is exposed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shot {
    /// Middle of the exposure of the middle row, s.
    pub(super) time_s: f64,
    /// Exposure time, s; 0 = sharp.
    pub(super) exposure_s: f64,
    /// Time from the first row to the last, s; 0 = all at once.
    pub(super) readout_s: f64,
    /// Most moments averaged.
    pub(super) max_samples: u32,
}

/// Renders frames; keeps its buffers.
#[derive(Debug)]
pub(super) struct Renderer {
    rays: Rays,
    /// How polished faces show the lamps; `None`: everything is matt.
    gloss: Option<Gloss>,
    band: Vec<f32>,
    candidates: Vec<Candidate>,
    scratch: Vec<Corners>,
    visible: Vec<usize>,
}

impl Renderer {
    pub(super) fn new(rays: Rays, gloss: Option<Gloss>) -> Self {
        let band = vec![0.0; rays.tiles[0] * TILE * TILE];
        Self { rays, gloss, band, candidates: Vec::new(), scratch: Vec::new(), visible: Vec::new() }
    }

    /// Renders one frame and hands out its rows from top to bottom: `sink(y, row)`, `row` as long as the picture is wide.
    pub(super) fn render(
        &mut self,
        scene: &Scene,
        actors: Option<&Actors>,
        shot: &Shot,
        view_at: &dyn Fn(f64) -> View,
        sink: &mut dyn FnMut(usize, &[f32]),
    ) {
        let [columns, rows] = self.rays.tiles;
        let stride = columns * TILE;
        for ty in 0..rows {
            let mut band = std::mem::take(&mut self.band);
            self.render_band(scene, actors, shot, view_at, ty, &mut band);
            for r in 0..TILE.min(self.rays.height - ty * TILE) {
                sink(ty * TILE + r, &band[r * stride..][..self.rays.width]);
            }
            self.band = band;
        }
    }

    fn render_band(
        &mut self,
        scene: &Scene,
        actors: Option<&Actors>,
        shot: &Shot,
        view_at: &dyn Fn(f64) -> View,
        ty: usize,
        band: &mut [f32],
    ) {
        let height = self.rays.height as f64;
        let row_time = |row: f64| shot.time_s + shot.readout_s * ((row - 0.5 * (height - 1.0)) / height);
        let (first, last) = (row_time((ty * TILE) as f64), row_time(((ty + 1) * TILE) as f64));
        let middle = 0.5 * (first + last);
        let view = view_at(middle);
        let span = [first - 0.5 * shot.exposure_s, last + 0.5 * shot.exposure_s];
        let mut movement = movement(&view, view_at, span[0], span[1]);
        movement.metres += actors.map_or(0.0, |a| a.fastest_m_s() * 0.5 * (span[1] - span[0]));
        let columns = self.rays.tiles[0];
        let tiles = &self.rays.bounds[ty * columns..][..columns];
        let mut rect = CullRect::empty();
        for t in tiles {
            rect.include(t.low);
            rect.include(t.high);
        }
        let statics = scene.quads.len();
        let still = scene.quads.iter().enumerate().map(|(i, q)| (i as u32, false, q.clone(), view));
        let acting = actors.map(|a| a.quads(middle, &view)).into_iter().flatten().enumerate();
        let acting = acting.map(|(i, q)| ((statics + i) as u32, true, q, View::identity()));
        cull::candidates(still.chain(acting), &rect, &movement, &mut self.candidates);

        // Poses of the moments at the band's first and last row, for each number of them that some tile asks for.
        let most = shot.max_samples.max(1) as usize;
        let mut moments: Vec<Option<Vec<Moment>>> = vec![None; most + 1];
        let blurred = shot.exposure_s > 0.0 && most > 1;
        let edges = blurred.then(|| (view_at(middle - 0.5 * shot.exposure_s), view_at(middle + 0.5 * shot.exposure_s)));
        for tx in 0..columns {
            let tile = ty * columns + tx;
            let mut visible = std::mem::take(&mut self.visible);
            let alone =
                cull::refine(&self.candidates, &self.rays.bounds[tile], &movement, &mut self.scratch, &mut visible);
            let samples = match &edges {
                Some((a, b)) => self.streak_samples(tile, &visible, &view, [a, b]).min(most),
                None => 1,
            };
            let moments = moments[samples].get_or_insert_with(|| {
                (0..samples)
                    .map(|i| {
                        let offset = shot.exposure_s * ((i as f64 + 0.5) / samples as f64 - 0.5);
                        let start = view_at(first + offset);
                        let end = if shot.readout_s > 0.0 { view_at(last + offset) } else { start };
                        let acting = actors.map(|a| [a.quads(first + offset, &start), a.quads(last + offset, &end)]);
                        Moment { views: [start, end], acting }
                    })
                    .collect()
            });
            let bounds = &self.rays.bounds[tile];
            let towards =
                Vector3::new(0.5 * (bounds.low[0] + bounds.high[0]), 0.5 * (bounds.low[1] + bounds.high[1]), 1.0);
            let mut out: Tile = [[0.0; TILE]; TILE];
            let share = 1.0 / samples as f32;
            for moment in moments.iter() {
                let faces = visible.iter().filter_map(|&v| {
                    let face = self.candidates[v].face as usize;
                    match (actors, &moment.acting, face.checked_sub(statics)) {
                        (Some(actors), Some([start, end]), Some(k)) => {
                            let (start, end) = (start.get(k)?, end.get(k)?);
                            Face::new([start, end], &[View::identity(); 2], actors.texture(start.texture)?)
                        }
                        _ => {
                            let quad = &scene.quads[face];
                            let mut face = Face::new([quad, quad], &moment.views, &scene.textures[quad.texture])?;
                            if let Some(gloss) = self.gloss.as_ref().filter(|_| quad.polished) {
                                face.highlights = gloss.seen_in(quad, &moment.views, &towards);
                            }
                            Some(face)
                        }
                    }
                });
                let faces: Vec<Face> = faces.collect();
                let place = Place { rays: &self.rays, tx, ty, jacobian: self.rays.jacobians[tile] };
                match faces.as_slice() {
                    [face] if alone => place.one_face(face, share, &mut out),
                    faces => {
                        let parts = (PARTS / samples).max(2);
                        place.many_faces(faces, share, parts, &mut out);
                    }
                }
            }
            for (r, row) in out.iter().enumerate() {
                band[r * columns * TILE + tx * TILE..][..TILE].copy_from_slice(row);
            }
            self.visible = visible;
        }
    }

    /// Number of moments that a tile's streak asks for, 1..=64. `edges`: views at the start and end of the exposure.
    fn streak_samples(&self, tile: usize, visible: &[usize], middle: &View, edges: [&View; 2]) -> usize {
        let rect = &self.rays.bounds[tile];
        let centre = [0.5 * (rect.low[0] + rect.high[0]), 0.5 * (rect.low[1] + rect.high[1])];
        let mut inverse_depth = 0.02;
        for &v in visible {
            let candidate = &self.candidates[v];
            if candidate.moving {
                continue;
            }
            let h = candidate.homography[2];
            let w = h[0] * centre[0] + h[1] * centre[1] + h[2];
            inverse_depth = f64::max(inverse_depth, w.min(5.0));
        }
        let ray = Vector3::new(centre[0], centre[1], 1.0);
        let point = middle.rotation * (ray / inverse_depth) + middle.position;
        let seen = |view: &View| {
            let p = view.rotation.tr_mul(&(point - view.position));
            [p.x / p.z.max(1e-3), p.y / p.z.max(1e-3)]
        };
        let [a, b] = edges.map(seen);
        let per_px = f64::from(self.rays.jacobians[tile][0]).abs().max(1e-6);
        let streak_px = (a[0] - b[0]).hypot(a[1] - b[1]) / per_px;
        let wanted = (streak_px / STREAK_STEP_PX).ceil().clamp(1.0, 64.0) as usize;
        // Few different numbers, so that few poses have to be worked out.
        match wanted {
            0..=4 => wanted,
            5..=8 => wanted.next_multiple_of(2),
            _ => wanted.next_multiple_of(4),
        }
    }
}

/// Poses at one moment of the exposure of the band's first and last row, and where the actors are then.
#[derive(Debug, Clone)]
struct Moment {
    views: [View; 2],
    /// Faces of the actors at both, camera coordinates.
    acting: Option<[Vec<Quad>; 2]>,
}

/// How far the camera gets from `middle` between two times.
fn movement(middle: &View, view_at: &dyn Fn(f64) -> View, from: f64, to: f64) -> Movement {
    let mut worst = Movement { angle: 0.0, metres: 0.0 };
    if to - from < 1e-9 {
        return worst;
    }
    for t in [from, to] {
        let view = view_at(t);
        let turned = (view.rotation - middle.rotation).norm();
        // A third more than the ends show: speeds are not constant. (Frobenius norm = sqrt 2 times the angle.)
        worst.angle = f64::max(worst.angle, 1.3 * turned);
        worst.metres = f64::max(worst.metres, 1.3 * (view.position - middle.position).norm());
    }
    worst
}
