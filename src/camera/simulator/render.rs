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
//! Cost at 640x480: see the table in the module `simulator`. Deliberately not here: lens blur, transparency, mirrors.

use super::cull::{self, Candidate, Corners, EDGE_M, Movement, View, homography};
use super::rays::{Rays, TILE};
use super::scene::{Quad, Scene};
use super::texture::{Footprint, Texture};

/// Seconds between two moments of a streak are chosen so that it moves by this much, px.
const STREAK_STEP_PX: f64 = 1.5;
/// Grey of a ray that leaves the scene (it cannot, rooms are closed).
const NOTHING: f32 = 128.0;
/// Id of [`NOTHING`].
const NO_FACE: u32 = u32::MAX;

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

/// Things that move with a time of their own: faces in camera coordinates, drawn over everything that is farther.
pub(super) trait Actors {
    /// Faces at `time_s`; always the same number of them. Their `texture` indexes [`textures`](Self::textures).
    fn quads(&self, time_s: f64) -> [Quad; 2];
    fn textures(&self) -> &[Texture];
}

/// A face as one tile sees it at one moment: single precision, at the tile's first row and the change to its last.
#[derive(Debug, Clone, Copy)]
struct Face<'a> {
    first: [[f32; 3]; 3],
    change: [[f32; 3]; 3],
    extent: [f32; 2],
    /// [`EDGE_M`] in texels.
    slack: f32,
    texture: &'a Texture,
}

impl Face<'_> {
    /// Homography at `row` tile rows below the tile's first.
    #[inline(always)]
    fn at(&self, row: f32) -> [[f32; 3]; 3] {
        let t = row / TILE as f32;
        let mut h = self.first;
        for (h, c) in h.iter_mut().flatten().zip(self.change.iter().flatten()) {
            *h += t * c;
        }
        h
    }
}

/// Renders frames; keeps its buffers.
#[derive(Debug)]
pub(super) struct Renderer {
    rays: Rays,
    band: Vec<f32>,
    candidates: Vec<Candidate>,
    scratch: Vec<Corners>,
    visible: Vec<usize>,
    /// Corner grid of one tile: nearest inverse depth and face.
    depth: Vec<f32>,
    ids: Vec<u32>,
}

const GRID: usize = TILE + 1;

impl Renderer {
    pub(super) fn new(rays: Rays) -> Self {
        let band = vec![0.0; rays.tiles[0] * TILE * TILE];
        let (depth, ids) = (vec![0.0; GRID * GRID], vec![0; GRID * GRID]);
        Self { rays, band, candidates: Vec::new(), scratch: Vec::new(), visible: Vec::new(), depth, ids }
    }

    /// Renders one frame and hands out its rows from top to bottom: `sink(y, row)`, `row` as long as the picture is wide.
    pub(super) fn render(
        &mut self,
        scene: &Scene,
        actors: Option<&dyn Actors>,
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
        actors: Option<&dyn Actors>,
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
        let movement = movement(&view, view_at, first - 0.5 * shot.exposure_s, last + 0.5 * shot.exposure_s);
        let columns = self.rays.tiles[0];
        let tiles = &self.rays.bounds[ty * columns..][..columns];
        let mut rect = tiles[0];
        for t in tiles {
            for k in 0..2 {
                rect.low[k] = rect.low[k].min(t.low[k]);
                rect.high[k] = rect.high[k].max(t.high[k]);
            }
        }
        let statics = scene.quads.len();
        let still = scene.quads.iter().enumerate().map(|(i, q)| (i as u32, false, q.clone(), view));
        let acting = actors.map(|a| a.quads(middle)).into_iter().flatten().enumerate();
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
                        Moment { times: [first + offset, last + offset], views: [start, end] }
                    })
                    .collect()
            });
            let mut out = [[0.0f32; TILE]; TILE];
            let share = 1.0 / samples as f32;
            for moment in moments.iter() {
                let acting = actors.map(|a| (a, moment.times.map(|t| a.quads(t))));
                let faces = visible.iter().filter_map(|&v| {
                    let face = self.candidates[v].face as usize;
                    match (&acting, face.checked_sub(statics)) {
                        (Some((a, quads)), Some(k)) => {
                            let [start, end] = [&quads[0][k], &quads[1][k]];
                            let views = [View::identity(); 2];
                            Face::new([start, end], &views, &a.textures()[start.texture])
                        }
                        _ => {
                            let quad = &scene.quads[face];
                            Face::new([quad, quad], &moment.views, &scene.textures[quad.texture])
                        }
                    }
                });
                let faces: Vec<Face> = faces.collect();
                let place = Place { rays: &self.rays, tx, ty, jacobian: self.rays.jacobians[tile] };
                match faces.as_slice() {
                    [face] if alone => place.one_face(face, share, &mut out),
                    faces => {
                        let parts = (PARTS / samples).max(2);
                        place.many_faces(faces, share, parts, &mut self.depth, &mut self.ids, &mut out);
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
        let ray = nalgebra::Vector3::new(centre[0], centre[1], 1.0);
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

/// Poses at one moment of the exposure of the band's first and last row.
#[derive(Debug, Clone)]
struct Moment {
    times: [f64; 2],
    views: [View; 2],
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

impl<'a> Face<'a> {
    fn new(quads: [&Quad; 2], views: &[View; 2], texture: &'a Texture) -> Option<Self> {
        let (start, end) = (homography(quads[0], &views[0])?, homography(quads[1], &views[1])?);
        let mut face = Self {
            first: start.map(|r| r.map(|v| v as f32)),
            change: [[0.0; 3]; 3],
            extent: quads[0].size.map(|s| (s * quads[0].density) as f32),
            slack: (EDGE_M * quads[0].density) as f32,
            texture,
        };
        for i in 0..3 {
            for j in 0..3 {
                face.change[i][j] = (end[i][j] - start[i][j]) as f32;
            }
        }
        Some(face)
    }
}

/// One tile.
struct Place<'a> {
    rays: &'a Rays,
    tx: usize,
    ty: usize,
    /// d normalised / d pixel.
    jacobian: [f32; 4],
}

type Tile = [[f32; TILE]; TILE];

impl Place<'_> {
    /// A tile filled by one face.
    fn one_face(&self, face: &Face, share: f32, out: &mut Tile) {
        /// Rows that share a footprint.
        const STEP: usize = 4;
        let mut print = Footprint::default();
        for (r, out) in out.iter_mut().enumerate() {
            if r % STEP == 0 {
                let middle = r + STEP / 2;
                let (x, y) = self.centres::<1>(middle, TILE / 2);
                print = footprint(face.texture, &face.at(middle as f32), x[0], y[0], &self.jacobian);
            }
            self.whole_row(face, r, &print, share, out);
        }
    }

    /// A row filled by one face.
    #[inline(always)]
    fn whole_row(&self, face: &Face, r: usize, print: &Footprint, share: f32, out: &mut [f32; TILE]) {
        let (x, y) = self.centres::<TILE>(r, 0);
        let values = shade(face.texture, &face.at(r as f32), &x, &y, print);
        for (o, v) in out.iter_mut().zip(values) {
            *o += share * v;
        }
    }

    #[inline(always)]
    fn centres<const N: usize>(&self, r: usize, from: usize) -> ([f32; N], [f32; N]) {
        let grid = &self.rays.centres;
        let at = (self.ty * TILE + r) * grid.stride + self.tx * TILE + from;
        let mut xy = ([0.0; N], [0.0; N]);
        xy.0.copy_from_slice(&grid.x[at..at + N]);
        xy.1.copy_from_slice(&grid.y[at..at + N]);
        xy
    }

    /// A tile with outlines: each pixel is split into `parts` where its corners see different faces.
    fn many_faces(&self, faces: &[Face], share: f32, parts: usize, depth: &mut [f32], ids: &mut [u32], out: &mut Tile) {
        let grid = &self.rays.corners;
        for r in 0..GRID {
            let at = (self.ty * TILE + r) * grid.stride + self.tx * TILE;
            let (x, y) = (&grid.x[at..at + GRID], &grid.y[at..at + GRID]);
            let (depth, ids) = (&mut depth[r * GRID..][..GRID], &mut ids[r * GRID..][..GRID]);
            depth.fill(0.0);
            ids.fill(NO_FACE);
            for (k, face) in faces.iter().enumerate() {
                nearest(face, r as f32 - 0.5, k as u32, x, y, depth, ids);
            }
        }
        for (r, out) in out.iter_mut().enumerate() {
            let (top, bottom) = (&ids[r * GRID..][..GRID], &ids[(r + 1) * GRID..][..GRID]);
            if let Some(face) = faces.get(top[0] as usize)
                && top.iter().chain(bottom).all(|id| *id == top[0])
            {
                let (x, y) = self.centres::<1>(r, TILE / 2);
                let print = footprint(face.texture, &face.at(r as f32), x[0], y[0], &self.jacobian);
                self.whole_row(face, r, &print, share, out);
                continue;
            }
            for from in [0, HALF] {
                let mut shares = Shares::default();
                for i in 0..HALF {
                    let c = from + i;
                    let seen = [top[c], top[c + 1], bottom[c], bottom[c + 1]];
                    if seen.iter().all(|id| *id == seen[0]) {
                        shares.add(seen[0], i, 1.0);
                    } else {
                        self.split(faces, r, c, &seen, parts, i, &mut shares);
                    }
                }
                let (x, y) = self.centres::<HALF>(r, from);
                for (id, weights) in shares.seen() {
                    let Some(face) = faces.get(*id as usize) else {
                        (0..HALF).for_each(|i| out[from + i] += share * weights[i] * NOTHING);
                        continue;
                    };
                    let m = weights.iter().position(|w| *w > 0.0).unwrap_or(0);
                    let h = face.at(r as f32);
                    let values =
                        shade(face.texture, &h, &x, &y, &footprint(face.texture, &h, x[m], y[m], &self.jacobian));
                    for i in 0..HALF {
                        out[from + i] += share * weights[i] * values[i];
                    }
                }
            }
        }
    }

    /// Shares of one pixel whose corners see different faces: `parts` rays, tested against these faces only.
    fn split(
        &self,
        faces: &[Face],
        r: usize,
        c: usize,
        seen: &[u32; 4],
        parts: usize,
        lane: usize,
        shares: &mut Shares,
    ) {
        let grid = &self.rays.corners;
        let at = (self.ty * TILE + r) * grid.stride + self.tx * TILE + c;
        let places = |g: &[f32]| {
            let (a, b) = (g[at], g[at + 1]);
            let (c, d) = (g[at + grid.stride], g[at + grid.stride + 1]);
            PLACES.map(|p| {
                let (top, bottom) = (a + (b - a) * p[0], c + (d - c) * p[0]);
                top + (bottom - top) * p[1]
            })
        };
        let (x, y) = (places(&grid.x), places(&grid.y));
        let (mut depth, mut ids) = ([0.0; PARTS], [seen[0]; PARTS]);
        for (k, id) in seen.iter().enumerate() {
            if seen[..k].contains(id) {
                continue;
            }
            if let Some(face) = faces.get(*id as usize) {
                nearest(face, r as f32, *id, &x, &y, &mut depth, &mut ids);
            }
        }
        let parts = parts.min(PARTS);
        for id in &ids[..parts] {
            shares.add(*id, lane, 1.0 / parts as f32);
        }
    }
}

/// Pixels shaded together in a tile with outlines.
const HALF: usize = TILE / 2;
/// Most rays of a divided pixel.
const PARTS: usize = 8;
/// Where they go: no two in one row or column of an 8x8 grid; the first 2 and 4 are spread evenly too.
const PLACES: [[f32; 2]; PARTS] = [
    [0.4375, 0.1875],
    [0.5625, 0.8125],
    [0.9375, 0.4375],
    [0.0625, 0.5625],
    [0.1875, 0.0625],
    [0.8125, 0.9375],
    [0.6875, 0.3125],
    [0.3125, 0.6875],
];

/// How much each face has of each of [`HALF`] pixels.
#[derive(Default)]
struct Shares {
    faces: [(u32, [f32; HALF]); 8],
    used: usize,
}

impl Shares {
    fn add(&mut self, id: u32, lane: usize, share: f32) {
        let found = self.faces[..self.used].iter().position(|f| f.0 == id);
        let slot = found.unwrap_or_else(|| {
            // More faces than that in eight pixels: the last ones share a place.
            let slot = self.used.min(self.faces.len() - 1);
            self.faces[slot].0 = id;
            self.used = slot + 1;
            slot
        });
        self.faces[slot].1[lane] += share;
    }

    fn seen(&self) -> &[(u32, [f32; HALF])] {
        &self.faces[..self.used]
    }
}

/// Updates nearest inverse depth and face along a row of rays.
#[inline(always)]
fn nearest(face: &Face, row: f32, id: u32, x: &[f32], y: &[f32], depth: &mut [f32], ids: &mut [u32]) {
    let h = face.at(row);
    let high = [face.extent[0] + face.slack, face.extent[1] + face.slack];
    for (((x, y), depth), ids) in x.iter().zip(y).zip(depth).zip(ids) {
        let w = h[2][0] * x + h[2][1] * y + h[2][2];
        let u = h[0][0] * x + h[0][1] * y + h[0][2];
        let v = h[1][0] * x + h[1][1] * y + h[1][2];
        let low = -face.slack * w;
        let inside = (u >= low) & (v >= low) & (u <= high[0] * w) & (v <= high[1] * w) & (w > *depth);
        *depth = if inside { w } else { *depth };
        *ids = if inside { id } else { *ids };
    }
}

/// Inverse depth to depth. Beyond the horizon of the plane it is not used, but must stay finite.
#[inline(always)]
fn depth(w: f32) -> f32 {
    1.0 / if w > 1e-4 { w } else { 1e-4 }
}

/// Filtered texture values of a group of neighbouring pixels.
#[inline(always)]
fn shade<const N: usize>(
    texture: &Texture,
    h: &[[f32; 3]; 3],
    x: &[f32; N],
    y: &[f32; N],
    print: &Footprint,
) -> [f32; N] {
    let (mut u, mut v) = ([0.0; N], [0.0; N]);
    for i in 0..N {
        let z = depth(h[2][0] * x[i] + h[2][1] * y[i] + h[2][2]);
        u[i] = (h[0][0] * x[i] + h[0][1] * y[i] + h[0][2]) * z;
        v[i] = (h[1][0] * x[i] + h[1][1] * y[i] + h[1][2]) * z;
    }
    texture.sample(&u, &v, print)
}

/// What the pixel of ray (x, y) covers: the chain rule, d (u, v) / d pixel.
fn footprint(texture: &Texture, h: &[[f32; 3]; 3], x: f32, y: f32, j: &[f32; 4]) -> Footprint {
    let z = depth(h[2][0] * x + h[2][1] * y + h[2][2]);
    let u = (h[0][0] * x + h[0][1] * y + h[0][2]) * z;
    let v = (h[1][0] * x + h[1][1] * y + h[1][2]) * z;
    let (ux, uy) = ((h[0][0] - u * h[2][0]) * z, (h[0][1] - u * h[2][1]) * z);
    let (vx, vy) = ((h[1][0] - v * h[2][0]) * z, (h[1][1] - v * h[2][1]) * z);
    texture.footprint(ux * j[0] + uy * j[2], ux * j[1] + uy * j[3], vx * j[0] + vy * j[2], vx * j[1] + vy * j[3])
}
