//! The USAN of one pixel: which part of the mask round it is as bright as itself.
//!
//! Purpose: similarity tables and exact areas and moments, for the detector and for the corners' attributes.
//! Input: grey picture, pixel, brightness threshold t (grey levels), 37-pixel mask. Output: area as salient degree sd in
//! 0..1, moments in pixels.
//! Paper: Smith and Brady, "SUSAN - a new approach to low level image processing", IJCV 1997:
//! step c = 1 where |I(r) - I(r0)| < t, exponential c = exp(-((I(r) - I(r0)) / t)^6).
//! Cost: 12 ns an area, 40 ns a set of moments.
//! It deliberately does not choose corners.

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
    pub(super) fn of_nucleus(&self, nucleus: u8) -> &[u16; 256] {
        self.table[255 - usize::from(nucleus)..].first_chunk().expect("255 + 256 entries lie in the table")
    }
}

/// USAN area times [`WHOLE`] round the pixel at (`x`, 3) of seven rows; `None` where the mask leaves the rows.
#[inline]
pub(super) fn area_in_rows(rows: &[&[u8]; 7], x: usize, similarity: &Similarity) -> Option<u16> {
    let begin = x.checked_sub(MASK_RADIUS)?;
    let c = similarity.of_nucleus(*rows[MASK_RADIUS].get(x)?);
    let mut area = 0;
    for (row, half) in rows.iter().zip(MASK_HALF_WIDTHS) {
        let row: &[u8; 7] = row.get(begin..)?.first_chunk()?;
        area += row[MASK_RADIUS - half..=MASK_RADIUS + half].iter().map(|&p| c[usize::from(p)]).sum::<u16>();
    }
    Some(area)
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
}

/// Area and moments round (`x`, `y`); `None` where the mask leaves the picture.
pub fn usan(image: &GreyImage, x: usize, y: usize, similarity: &Similarity) -> Option<Usan> {
    let r = MASK_RADIUS;
    if x < r || y < r || x + r >= image.width || y + r >= image.height {
        return None;
    }
    let grey = image.at(x, y);
    let c = similarity.of_nucleus(grey);
    let [mut area, mut sx, mut sy, mut sxx, mut sxy, mut syy] = [0i32; 6];
    for (j, half) in MASK_HALF_WIDTHS.into_iter().enumerate() {
        let dy = j as i32 - r as i32;
        let row = &image.row(y + j - r)[x - half..=x + half];
        let [mut row_area, mut row_x, mut row_xx] = [0i32; 3];
        for (i, &p) in row.iter().enumerate() {
            let (dx, c) = (i as i32 - half as i32, i32::from(c[usize::from(p)]));
            row_area += c;
            row_x += c * dx;
            row_xx += c * dx * dx;
        }
        area += row_area;
        sx += row_x;
        sxx += row_xx;
        sy += dy * row_area;
        sxy += dy * row_x;
        syy += dy * dy * row_area;
    }
    // The nucleus itself is similar: the area is at least WHOLE.
    let scale = 1.0 / area as f32;
    Some(Usan {
        grey,
        salient_degree: area as f32 / (MASK_AREA as f32 * f32::from(WHOLE)),
        centroid: [sx as f32 * scale, sy as f32 * scale],
        moments: [sxx as f32 * scale, sxy as f32 * scale, syy as f32 * scale],
    })
}

/// Whether all pixels from the nucleus towards `direction` (any length but 0), to the mask's edge, belong to the USAN.
pub(super) fn is_contiguous(
    image: &GreyImage,
    x: usize,
    y: usize,
    direction: [f32; 2],
    similarity: &Similarity,
) -> bool {
    let [dx, dy] = direction;
    let longest = dx.abs().max(dy.abs());
    let c = similarity.of_nucleus(image.at(x, y));
    (1..=MASK_RADIUS as i32).all(|step| {
        let [px, py] = [dx, dy].map(|d| (step as f32 * d / longest).round() as i32);
        let half = MASK_HALF_WIDTHS[(py + MASK_RADIUS as i32) as usize] as i32;
        let (px, py) = ((x as i32 + px) as usize, (y as i32 + py) as usize);
        // Beyond the round mask's edge there is nothing to ask.
        (px as i32 - x as i32).abs() > half || 2 * c[usize::from(image.at(px, py))] >= WHOLE
    })
}
