//! The USAN of one pixel: which part of the mask round it is as bright as itself.
//!
//! Purpose: similarity tables and exact areas and moments, for the detector and for the corners' attributes.
//! Input: grey picture, pixel, brightness threshold t (grey levels), 37-pixel mask. Output: area as salient degree sd in
//! 0..1, moments in pixels.
//! Paper: Smith and Brady, "SUSAN - a new approach to low level image processing", IJCV 1997:
//! step c = 1 where |I(r) - I(r0)| < t, exponential c = exp(-((I(r) - I(r0)) / t)^6).
//! Cost: 37 table look-ups an area; moments add three sums over 56 cells.
//! It deliberately does not choose corners.

use crate::features::dispatch::simd_kernel;
use crate::image::GreyImage;

/// Radius of the 37-pixel mask, pixels.
pub const MASK_RADIUS: usize = 3;

/// Half the width of the mask's rows, top to bottom: 3, 5, 7, 7, 7, 5, 3 pixels.
pub const MASK_HALF_WIDTHS: [usize; 7] = [1, 2, 3, 3, 3, 2, 1];

/// Pixels of the mask, the nucleus with them.
pub const MASK_AREA: u32 = 37;

/// How similar two grey levels are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SusanResponse {
    /// All or nothing: c = 1 where the difference is below t.
    Step,
    /// c = exp(-(difference / t)^6).
    #[default]
    Exponential,
}

/// What a whole similarity (c = 1) counts in a [`Similarity`] table and in areas; 37 of them fit 16 bits.
pub const WHOLE: u16 = 1024;

/// Similarity c of two grey levels by their difference, for one threshold.
#[derive(Debug, Clone)]
pub struct Similarity {
    /// c * [`WHOLE`] at difference - 255, so that the index I(r) - I(r0) + 255 needs no absolute value. One more entry
    /// makes the length a power of two.
    table: [u16; 512],
}

impl Similarity {
    /// `t` in grey levels, at least 1 (0 counts as 1: a nucleus is always similar to itself).
    pub fn new(response: SusanResponse, t: u8) -> Self {
        let t = f64::from(t.max(1));
        let mut table = [0; 512];
        for (i, c) in table.iter_mut().enumerate() {
            let x = (i as f64 - 255.0).abs() / t;
            *c = match response {
                SusanResponse::Step => u16::from(x < 1.0) * WHOLE,
                SusanResponse::Exponential => ((-x.powi(6)).exp() * f64::from(WHOLE)).round() as u16,
            };
        }
        Self { table }
    }

    /// c * [`WHOLE`] of two grey levels that differ by `difference`.
    #[inline]
    pub fn at_difference(&self, difference: u8) -> u16 {
        self.table[255 + usize::from(difference)]
    }

    /// c * [`WHOLE`] of all grey levels compared with the nucleus.
    #[inline(always)]
    pub(in crate::features) fn of_nucleus(&self, nucleus: u8) -> &[u16; 256] {
        self.table[255 - usize::from(nucleus)..].first_chunk().expect("255 + 256 entries lie in the table")
    }
}

/// USAN area times [`WHOLE`] round the pixel at (`x`, 3) of seven rows; `None` where the mask leaves the rows.
#[inline(always)]
pub(super) fn area_in_rows(rows: &[&[u8]; 7], x: usize, similarity: &Similarity) -> Option<u16> {
    let begin = x.checked_sub(MASK_RADIUS)?;
    let c = similarity.of_nucleus(*rows[MASK_RADIUS].get(x)?);
    let mut area = 0;
    for (row, half) in rows.iter().zip(MASK_HALF_WIDTHS) {
        let row: &[u8; 7] = row.get(begin..)?.first_chunk()?;
        for &p in &row[MASK_RADIUS - half..=MASK_RADIUS + half] {
            area += c[usize::from(p)];
        }
    }
    Some(area)
}

/// The mask's bounding rows, padded to eight so that a row is a vector: 7 rows of 8.
const CELLS: usize = 56;

/// What each cell weighs in a sum over the mask; outside the mask nothing.
struct Weights {
    one: [i16; CELLS],
    x: [i16; CELLS],
    y: [i16; CELLS],
}

const WEIGHTS: Weights = {
    let mut w = Weights { one: [0; CELLS], x: [0; CELLS], y: [0; CELLS] };
    let mut k = 0;
    while k < MASK_AREA as usize {
        let cell = MASK_CELLS[k];
        w.one[cell] = 1;
        w.x[cell] = (cell % 8) as i16 - MASK_RADIUS as i16;
        w.y[cell] = (cell / 8) as i16 - MASK_RADIUS as i16;
        k += 1;
    }
    w
};

/// The mask's cells among the padded ones.
const MASK_CELLS: [usize; MASK_AREA as usize] = {
    let mut cells = [0; MASK_AREA as usize];
    let (mut n, mut row) = (0, 0);
    while row < 7 {
        let half = MASK_HALF_WIDTHS[row];
        let mut x = MASK_RADIUS - half;
        while x <= MASK_RADIUS + half {
            cells[n] = 8 * row + x;
            n += 1;
            x += 1;
        }
        row += 1;
    }
    cells
};

/// The mask's pixels and their similarities to the nucleus, laid out for sums by vectors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mask {
    nucleus: u8,
    grey: [u8; CELLS],
    /// c * [`WHOLE`]; 0 outside the mask.
    c: [i16; CELLS],
}

impl Mask {
    /// Takes the mask round the pixel at (`x`, 3) of seven rows; false where it leaves the rows. Not inlined, nor are the
    /// sums: the cells must lie in memory, or they would be added up one by one.
    #[inline(never)]
    pub(super) fn gather(&mut self, rows: &[&[u8]; 7], x: usize, similarity: &Similarity) -> bool {
        let Some(begin) = x.checked_sub(MASK_RADIUS).filter(|begin| rows.iter().all(|row| row.len() >= begin + 7))
        else {
            return false;
        };
        self.nucleus = rows[MASK_RADIUS][x];
        let table = similarity.of_nucleus(self.nucleus);
        for (row, to) in rows.iter().zip(self.grey.chunks_exact_mut(8)) {
            to[..7].copy_from_slice(&row[begin..begin + 7]);
        }
        for (r, half) in MASK_HALF_WIDTHS.into_iter().enumerate() {
            for k in 8 * r + MASK_RADIUS - half..=8 * r + MASK_RADIUS + half {
                self.c[k] = table[usize::from(self.grey[k])] as i16;
            }
        }
        true
    }

    /// USAN area times [`WHOLE`].
    pub(super) fn area(&self) -> u16 {
        self.c.iter().fold(0, |sum, &c| sum + c as u16)
    }

    /// Sum of c times the cell's weight.
    fn sum(&self, weight: impl Fn(usize) -> i16) -> i32 {
        (0..CELLS).map(|k| i32::from(self.c[k]) * i32::from(weight(k))).sum()
    }

    /// Centre of gravity relative to the nucleus, pixels, and contrast: the sum of (1 - c) |I(r) - I(r0)| over the mask,
    /// grey levels. `area`: see [`Self::area`]; the nucleus itself is similar, so it is not 0.
    #[inline]
    pub(super) fn first_moments(&self, area: u16) -> ([f32; 2], f32) {
        let sums = first_sums(self);
        let scale = 1.0 / f32::from(area);
        ([sums[0] as f32 * scale, sums[1] as f32 * scale], sums[2] as f32 / f32::from(WHOLE))
    }

    /// Whether all pixels from the nucleus towards `direction` (any length but 0), to the mask's edge, belong to the USAN.
    #[inline]
    pub(super) fn is_contiguous(&self, direction: [f32; 2]) -> bool {
        steps_towards(direction).into_iter().fold(true, |all, step| all & self.belongs(step))
    }

    /// Whether the USAN goes on both ways across `direction` (towards its centre of gravity): then an edge or a ramp
    /// passes through the nucleus, however small the area is.
    #[inline]
    pub(super) fn is_edge(&self, [dx, dy]: [f32; 2]) -> bool {
        // No early end: which pixel fails first cannot be foreseen, and a wrong guess costs more than the rest.
        steps_towards([-dy, dx]).into_iter().fold(true, |all, step| all & self.belongs(step) & self.belongs(-step))
    }

    /// Whether the cell `step` cells after the nucleus's is USAN. Beyond the round mask's edge there is nothing to ask.
    #[inline(always)]
    fn belongs(&self, step: i32) -> bool {
        let k = (NUCLEUS_CELL + step) as usize % CELLS;
        (WEIGHTS.one[k] == 0) | (self.c[k] >= WHOLE as i16 / 2)
    }

    /// Second moments about the nucleus (xx, xy, yy), each divided by the area, pixels squared.
    fn moments(&self) -> [f32; 3] {
        let Weights { x, y, .. } = &WEIGHTS;
        let scale = 1.0 / f32::from(self.area());
        [self.sum(|k| x[k] * x[k]), self.sum(|k| x[k] * y[k]), self.sum(|k| y[k] * y[k])].map(|s| s as f32 * scale)
    }
}

/// The nucleus among the cells.
const NUCLEUS_CELL: i32 = 8 * MASK_RADIUS as i32 + MASK_RADIUS as i32;

/// Cells one, two and three steps from the nucleus towards a direction, rounded to the nearest (half away from it).
#[inline(always)]
fn steps_towards([dx, dy]: [f32; 2]) -> [i32; 3] {
    let (ax, ay) = (dx.abs(), dy.abs());
    let (sx, sy) = (if dx < 0.0 { -1 } else { 1 }, if dy < 0.0 { -8 } else { 8 });
    let (long, short, along, aside) = if ax >= ay { (ax, ay, sx, sy) } else { (ay, ax, sy, sx) };
    // k short / long rounds to at least n where 2 k short >= (2 n - 1) long.
    let least = |k: f32, n: f32| i32::from(2.0 * k * short >= (2.0 * n - 1.0) * long);
    [
        along + aside * least(1.0, 1.0),
        2 * along + aside * (least(2.0, 1.0) + least(2.0, 2.0)),
        3 * along + aside * (least(3.0, 1.0) + least(3.0, 2.0) + least(3.0, 3.0)),
    ]
}

impl Default for Mask {
    fn default() -> Self {
        Self { nucleus: 0, grey: [0; CELLS], c: [0; CELLS] }
    }
}

simd_kernel! {
    /// Sums of c x, c y and (1 - c) |I(r) - I(r0)|, each times [`WHOLE`].
    fn first_sums(mask: &Mask) -> [i32; 3] = first_sums_body
}

#[inline(always)]
fn first_sums_body(mask: &Mask) -> [i32; 3] {
    let (mut x, mut y, mut unlike) = (0, 0, 0);
    for k in 0..CELLS {
        x += i32::from(mask.c[k]) * i32::from(WEIGHTS.x[k]);
        y += i32::from(mask.c[k]) * i32::from(WEIGHTS.y[k]);
        let rest = WHOLE as i16 * WEIGHTS.one[k] - mask.c[k];
        unlike += i32::from(rest) * i32::from(i16::from(mask.grey[k].abs_diff(mask.nucleus)));
    }
    [x, y, unlike]
}

/// Area and moments of a USAN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Usan {
    /// Grey level of the nucleus.
    pub grey: u8,
    /// Area / mask area, 0..1.
    pub salient_degree: f32,
    /// Centre of gravity relative to the nucleus, pixels.
    pub centroid: [f32; 2],
    /// Second moments about the nucleus (xx, xy, yy), each divided by the area, pixels squared.
    pub moments: [f32; 3],
    /// Sum of (1 - c) |I(r) - I(r0)|: how much, and how strongly, the rest of the mask differs; grey levels.
    pub contrast: f32,
}

/// Area and moments round (`x`, `y`); `None` where the mask leaves the picture.
pub fn usan(image: &GreyImage, x: usize, y: usize, similarity: &Similarity) -> Option<Usan> {
    let top = y.checked_sub(MASK_RADIUS)?;
    if x >= image.width || y >= image.height || y + MASK_RADIUS >= image.height {
        return None;
    }
    let mut mask = Mask::default();
    if !mask.gather(&std::array::from_fn(|i| image.row(top + i)), x, similarity) {
        return None;
    }
    let (centroid, contrast) = mask.first_moments(mask.area());
    Some(Usan {
        grey: mask.nucleus,
        salient_degree: f32::from(mask.area()) / (MASK_AREA as f32 * f32::from(WHOLE)),
        centroid,
        moments: mask.moments(),
        contrast,
    })
}
