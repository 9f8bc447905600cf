//! One tile of the picture: 16x16 pixels, each seen by one ray, more where faces meet.
//!
//! Input: the faces that the tile can show, as homographies at its first and last row. Output: their filtered textures,
//! added to the tile's grey values with a share (a moment of the exposure).
//!
//! Where a tile shows several faces the nearest is found at every pixel's corners; a pixel whose corners disagree is
//! divided into up to eight parts, each seen by its own ray. A face thinner than a pixel may be missed.

use super::cull::{EDGE_M, View, homography};
use super::gloss::Highlights;
use super::rays::{Rays, TILE};
use super::scene::Quad;
use super::texture::{Footprint, Texture};

/// Grey of a ray that leaves the scene (it cannot, rooms are closed).
const NOTHING: f32 = 128.0;
/// Id of [`NOTHING`].
const NO_FACE: u32 = u32::MAX;
/// Corners of pixels along a tile's side.
const GRID: usize = TILE + 1;

/// Grey values of one tile.
pub(super) type Tile = [[f32; TILE]; TILE];

/// A face as one tile sees it at one moment: single precision, at the tile's first row and the change to its last.
#[derive(Debug, Clone, Copy)]
pub(super) struct Face<'a> {
    first: [[f32; 3]; 3],
    change: [[f32; 3]; 3],
    extent: [f32; 2],
    /// [`EDGE_M`] in texels.
    slack: f32,
    texture: &'a Texture,
    /// Lamps that it shows in this tile.
    pub(super) highlights: Highlights,
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

impl<'a> Face<'a> {
    /// `quads` and `views`: the face and the camera at the tile's first and last row.
    pub(super) fn new(quads: [&Quad; 2], views: &[View; 2], texture: &'a Texture) -> Option<Self> {
        let (start, end) = (homography(quads[0], &views[0])?, homography(quads[1], &views[1])?);
        let mut face = Self {
            first: start.map(|r| r.map(|v| v as f32)),
            change: [[0.0; 3]; 3],
            extent: quads[0].size.map(|s| (s * quads[0].density) as f32),
            slack: (EDGE_M * quads[0].density) as f32,
            texture,
            highlights: Highlights::default(),
        };
        for i in 0..3 {
            for j in 0..3 {
                face.change[i][j] = (end[i][j] - start[i][j]) as f32;
            }
        }
        Some(face)
    }
}

/// Where a tile is.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place<'a> {
    pub(super) rays: &'a Rays,
    /// Column and row among the tiles.
    pub(super) tx: usize,
    pub(super) ty: usize,
    /// d normalised / d pixel, see [`Rays::jacobians`].
    pub(super) jacobian: [f32; 4],
}

impl Place<'_> {
    /// A tile filled by one face.
    pub(super) fn one_face(&self, face: &Face, share: f32, out: &mut Tile) {
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
        let mut values = shade(face.texture, &face.at(r as f32), &x, &y, print);
        face.highlights.add(&x, &y, r as f32, TILE as f32, &mut values);
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

    /// A tile with outlines: a pixel is divided into `parts` where its corners see different faces.
    pub(super) fn many_faces(&self, faces: &[Face], share: f32, parts: usize, out: &mut Tile) {
        let grid = &self.rays.corners;
        let mut ids = [[NO_FACE; GRID]; GRID];
        for (r, ids) in ids.iter_mut().enumerate() {
            let at = (self.ty * TILE + r) * grid.stride + self.tx * TILE;
            let (x, y) = (&grid.x[at..at + GRID], &grid.y[at..at + GRID]);
            let mut depth = [0.0; GRID];
            for (k, face) in faces.iter().enumerate() {
                nearest(face, r as f32 - 0.5, k as u32, x, y, &mut depth, ids);
            }
        }
        for (r, out) in out.iter_mut().enumerate() {
            let (top, bottom) = (&ids[r], &ids[r + 1]);
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
                        self.split(faces, r, c, &seen, parts, &mut shares);
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
                    let print = footprint(face.texture, &h, x[m], y[m], &self.jacobian);
                    let mut values = shade(face.texture, &h, &x, &y, &print);
                    face.highlights.add(&x, &y, r as f32, TILE as f32, &mut values);
                    for i in 0..HALF {
                        out[from + i] += share * weights[i] * values[i];
                    }
                }
            }
        }
    }

    /// Shares of one pixel whose corners see different faces: `parts` rays, tested against these faces only.
    fn split(&self, faces: &[Face], r: usize, c: usize, seen: &[u32; 4], parts: usize, shares: &mut Shares) {
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
            shares.add(*id, c % HALF, 1.0 / parts as f32);
        }
    }
}

/// Pixels shaded together in a tile with outlines.
const HALF: usize = TILE / 2;
/// Most rays of a divided pixel.
pub(super) const PARTS: usize = 8;
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
