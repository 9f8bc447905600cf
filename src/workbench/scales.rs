//! A picture at several scales, a fifth apart: corners are found and described at each, so that a pair may see the same
//! thing from different distances.
//!
//! Input: a grey picture and the number of scales. Output: the picture itself and smaller ones, each 1 / 1.2 of the one
//! before (Rublee et al., ORB, ICCV 2011), with the factor of each axis. A pixel's centre is its integer coordinate, so
//! `x_0 = (x_k + 1/2) f - 1/2`. Resampled linearly from the one before: the steps are small enough not to alias.
//! Cost: about 1 ns a pixel of each scale.
//!
//! Deliberately not here: the frame path's pyramid of halves (`image::pyramid`), which is faster and coarser.

use nalgebra::Vector2;

use crate::image::GreyImage;

/// Ratio of a scale to the next.
pub const STEP: f64 = 1.2;
/// Most scales that are made: the last is a fifteenth of the picture.
pub const MAX_SCALES: usize = 16;
/// No picture is made smaller than this, pixels.
const MIN_SIDE: usize = 60;

/// One scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Scale {
    pub image: GreyImage,
    /// Pixels of the picture a pixel of this scale, across and down.
    pub factor: Vector2<f64>,
}

impl Scale {
    /// Position in the picture of a position in this scale, pixels.
    pub fn base(&self, at: &Vector2<f64>) -> Vector2<f64> {
        (at.add_scalar(0.5)).component_mul(&self.factor).add_scalar(-0.5)
    }

    /// Position in this scale of a position in the picture, pixels.
    pub fn local(&self, base: &Vector2<f64>) -> Vector2<f64> {
        base.add_scalar(0.5).component_div(&self.factor).add_scalar(-0.5)
    }

    /// Mean factor: the size of a pixel of this scale in pixels of the picture.
    pub fn size_px(&self) -> f64 {
        0.5 * (self.factor.x + self.factor.y)
    }
}

/// The picture at up to `count` scales (at least one), the largest first.
pub fn scales(picture: &GreyImage, count: usize) -> Vec<Scale> {
    let mut all = vec![Scale { image: picture.clone(), factor: Vector2::new(1.0, 1.0) }];
    for k in 1..count.min(MAX_SCALES) {
        let shrink = STEP.powi(k as i32);
        let (width, height) =
            ((picture.width as f64 / shrink).round() as usize, (picture.height as f64 / shrink).round() as usize);
        let Some(last) = all.last() else { break };
        if width.min(height) < MIN_SIDE {
            break;
        }
        let image = resample(&last.image, width, height);
        let factor = Vector2::new(picture.width as f64 / width as f64, picture.height as f64 / height as f64);
        all.push(Scale { image, factor });
    }
    all
}

/// Linear interpolation at the pixel centres of the new size.
fn resample(from: &GreyImage, width: usize, height: usize) -> GreyImage {
    let mut to = GreyImage::new(width, height);
    // Left neighbour and share of the right one, in 1 / 256.
    let taps = |size: usize, old: usize| -> Vec<(usize, u32)> {
        let factor = old as f64 / size as f64;
        (0..size)
            .map(|i| {
                let at = ((i as f64 + 0.5) * factor - 0.5).clamp(0.0, old as f64 - 1.0);
                let left = (at as usize).min(old.saturating_sub(2));
                (left, ((at - left as f64) * 256.0).round() as u32)
            })
            .collect()
    };
    let (columns, rows) = (taps(width, from.width), taps(height, from.height));
    for ((top, down), out) in rows.iter().zip(to.data.chunks_exact_mut(width)) {
        let (a, b) = (from.row(*top), from.row((top + 1).min(from.height - 1)));
        for ((left, share), pixel) in columns.iter().zip(out) {
            let right = (left + 1).min(from.width - 1);
            let mix = |row: &[u8]| u32::from(row[*left]) * (256 - share) + u32::from(row[right]) * share;
            *pixel = ((mix(a) * (256 - down) + mix(b) * down + (1 << 15)) >> 16) as u8;
        }
    }
    to
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_stays_the_same_ramp_at_every_scale() {
        let mut picture = GreyImage::new(320, 240);
        for y in 0..240 {
            for x in 0..320 {
                picture.data[y * 320 + x] = (x / 2 + y / 3) as u8;
            }
        }
        let all = scales(&picture, 8);
        assert_eq!(all.len(), 8);
        for scale in &all {
            for (x, y) in [(10.0, 10.0), (30.0, 20.0), (70.0, 50.0)] {
                let local = Vector2::new(x, y);
                let base = scale.base(&local);
                assert!((scale.local(&base) - local).norm() < 1e-12);
                let seen = f64::from(scale.image.at(x as usize, y as usize));
                assert!((seen - (base.x / 2.0 + base.y / 3.0)).abs() < 2.5, "{} {base}", scale.factor);
            }
        }
    }

    #[test]
    fn small_pictures_have_one_scale() {
        assert_eq!(scales(&GreyImage::new(64, 64), 8).len(), 1);
        assert_eq!(scales(&GreyImage::new(1, 1), 8).len(), 1);
        assert_eq!(scales(&GreyImage::new(640, 480), 100).len(), 12);
    }
}
