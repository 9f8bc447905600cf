//! Saddle points of a blurred picture.
//!
//! Input: a grey picture. Output: the picture blurred by a binomial of five taps, and at every pixel `S = Ixy² - Ixx Iyy` with
//! differences over two pixels: positive at saddles, about zero along straight edges, negative in blobs. Where four
//! squares meet with contrast C, S is about 0.2 C². Local maxima of S are the candidates.
//!
//! Cost: 0.8 ms for 640x480. Not here: what is a corner of a board (`profile`).

use nalgebra::Vector2;

use crate::image::GreyImage;

/// Pixels at the rim without S: half of the stencil.
pub const RIM: usize = 3;
/// Least S of a candidate: a contrast of some 7 grey levels.
const MIN_SADDLE: f32 = 10.0;
/// Candidates of a picture; beyond it the strongest stay.
const MAX_CANDIDATES: usize = 3000;

/// Blurred picture and saddle measure, row by row.
#[derive(Debug, Default)]
pub struct SaddleMap {
    pub width: usize,
    pub height: usize,
    blurred: Vec<f32>,
    saddle: Vec<f32>,
    row: Vec<f32>,
    /// (S, x, y), strongest first.
    pub candidates: Vec<(f32, u32, u32)>,
}

impl SaddleMap {
    /// Computes everything for a picture.
    pub fn build(&mut self, image: &GreyImage) {
        (self.width, self.height) = (image.width, image.height);
        self.candidates.clear();
        self.blurred.clear();
        self.blurred.resize(image.width * image.height, 0.0);
        self.saddle.clear();
        self.saddle.resize(image.width * image.height, 0.0);
        if image.width < 4 * RIM || image.height < 4 * RIM {
            return;
        }
        self.blur(image);
        self.measure();
        self.collect();
    }

    fn blur(&mut self, image: &GreyImage) {
        let (w, h) = (image.width, image.height);
        // Down the columns first, from bytes to one row of floats; then along it.
        self.row.clear();
        self.row.resize(w + 4, 0.0);
        for y in 0..h {
            let at = |d: isize| image.row(y.saturating_add_signed(d).min(h - 1));
            let (a, b, c, d, e) = (at(-2), at(-1), at(0), at(1), at(2));
            let (a, b, c, d, e) = (&a[..w], &b[..w], &c[..w], &d[..w], &e[..w]);
            let row = &mut self.row[2..w + 2];
            for x in 0..w {
                let sum =
                    u16::from(a[x]) + u16::from(e[x]) + 4 * (u16::from(b[x]) + u16::from(d[x])) + 6 * u16::from(c[x]);
                row[x] = f32::from(sum) * (1.0 / 16.0);
            }
            let (first, last) = (self.row[2], self.row[w + 1]);
            self.row[..2].fill(first);
            self.row[w + 2..].fill(last);
            let row = &self.row[..w + 4];
            let out = &mut self.blurred[y * w..(y + 1) * w];
            let (a, b, c, d, e) = (&row[..w], &row[1..w + 1], &row[2..w + 2], &row[3..w + 3], &row[4..w + 4]);
            for x in 0..w {
                out[x] = (a[x] + e[x] + 4.0 * (b[x] + d[x]) + 6.0 * c[x]) * (1.0 / 16.0);
            }
        }
    }

    fn measure(&mut self) {
        let (w, h) = (self.width, self.height);
        for y in RIM..h - RIM {
            let (up, mid, down) = (
                &self.blurred[(y - 2) * w..(y - 1) * w],
                &self.blurred[y * w..(y + 1) * w],
                &self.blurred[(y + 2) * w..(y + 3) * w],
            );
            let n = w - 4;
            let out = &mut self.saddle[y * w + 2..y * w + 2 + n];
            let (ul, uc, ur) = (&up[..n], &up[2..n + 2], &up[4..n + 4]);
            let (ml, mc, mr) = (&mid[..n], &mid[2..n + 2], &mid[4..n + 4]);
            let (dl, dc, dr) = (&down[..n], &down[2..n + 2], &down[4..n + 4]);
            for x in 0..n {
                let centre = 2.0 * mc[x];
                let xx = ml[x] + mr[x] - centre;
                let yy = uc[x] + dc[x] - centre;
                let xy = 0.25 * (ul[x] + dr[x] - ur[x] - dl[x]);
                out[x] = xy * xy - xx * yy * (1.0 / 16.0);
            }
        }
    }

    fn collect(&mut self) {
        let (w, h) = (self.width, self.height);
        for y in RIM..h - RIM {
            let row = &self.saddle[y * w..(y + 1) * w];
            for x in RIM..w - RIM {
                let s = row[x];
                // The nearest neighbours first: they rule out nearly all.
                if s > MIN_SADDLE && s > row[x - 1] && s >= row[x + 1] && self.is_peak(x, y, s) {
                    self.candidates.push((s, x as u32, y as u32));
                }
            }
        }
        let order = |a: &(f32, u32, u32), b: &(f32, u32, u32)| b.0.total_cmp(&a.0).then((a.2, a.1).cmp(&(b.2, b.1)));
        if self.candidates.len() > MAX_CANDIDATES {
            self.candidates.select_nth_unstable_by(MAX_CANDIDATES, order);
            self.candidates.truncate(MAX_CANDIDATES);
        }
        self.candidates.sort_unstable_by(order);
    }

    /// Is `s` at (x, y) the largest of the 5 x 5 around it? Of equal ones the first in reading order is.
    fn is_peak(&self, x: usize, y: usize, s: f32) -> bool {
        let w = self.width;
        (y - 2..=y + 2).all(|v| {
            let row = &self.saddle[v * w + x - 2..=v * w + x + 2];
            if v < y { row.iter().all(|n| s > *n) } else { row.iter().all(|n| s >= *n) }
        })
    }

    /// Saddle measure at a pixel; 0 outside.
    pub fn saddle(&self, x: usize, y: usize) -> f32 {
        if x < self.width && y < self.height { self.saddle[y * self.width + x] } else { 0.0 }
    }

    /// Blurred grey value between pixels; `None` outside the picture.
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> Option<f32> {
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (ix, iy) = (x as usize, y as usize);
        if ix + 1 >= self.width || iy + 1 >= self.height {
            return None;
        }
        let (fx, fy) = (x - ix as f32, y - iy as f32);
        let at = iy * self.width + ix;
        let (upper, lower) = (self.blurred.get(at..at + 2)?, self.blurred.get(at + self.width..at + self.width + 2)?);
        let (a, b) = (upper[0] + fx * (upper[1] - upper[0]), lower[0] + fx * (lower[1] - lower[0]));
        Some(a + fy * (b - a))
    }

    /// The saddle point of the quadratic through the pixels around a peak, at most a pixel away.
    pub fn peak(&self, x: usize, y: usize) -> Vector2<f64> {
        let start = Vector2::new(x as f64, y as f64);
        if x < RIM || y < RIM || x + RIM >= self.width || y + RIM >= self.height {
            return start;
        }
        let at = |dx: isize, dy: isize| {
            f64::from(self.blurred[y.saturating_add_signed(dy) * self.width + x.saturating_add_signed(dx)])
        };
        let c = 2.0 * at(0, 0);
        let (gx, gy) = (0.25 * (at(2, 0) - at(-2, 0)), 0.25 * (at(0, 2) - at(0, -2)));
        let (xx, yy) = (0.25 * (at(2, 0) + at(-2, 0) - c), 0.25 * (at(0, 2) + at(0, -2) - c));
        let xy = (at(2, 2) + at(-2, -2) - at(2, -2) - at(-2, 2)) / 16.0;
        let det = xx * yy - xy * xy;
        let step = Vector2::new(-(yy * gx - xy * gy), -(xx * gy - xy * gx)) / det;
        if step.norm() <= 1.5 { start + step } else { start }
    }
}
