//! What a picture would look like from elsewhere: at several scales, a fifth apart, and tilted; corners are found and described in each,
//! so that a pair may see the same thing from different distances and slants.
//!
//! Input: a grey picture and the number of scales. Output: [`Scale`]s, each a picture with the affine map that leads from its pixels back
//! to the original's. [`scales`]: the picture itself and smaller ones, each 1 / 1.2 of the one before (Rublee et al., ORB, ICCV 2011).
//! [`tilted`]: the picture as it were seen at a slant (Morel & Yu, ASIFT, SIAM J. Imaging Sciences 2(2), 2009): squeezed by `t` along a direction `phi`
//! after a Gaussian of `0.8 sqrt(t² - 1)` along it (their section 4), at the scales from the half on. Directions are 72 / t degrees apart.
//! A pixel's centre is its integer coordinate, so a plain scale's map is `x_0 = (x_k + 1/2) f - 1/2`. Smaller ones are resampled linearly
//! from the one before: the steps are small enough not to alias; a half is the mean of four.
//! Cost: about 1 ns a pixel of each scale, 40 ns a pixel of a tilted one.
//!
//! Deliberately not here: the frame path's pyramid of halves (`image::pyramid`), which is faster and coarser.

use nalgebra::{Matrix2, Vector2};

use crate::image::GreyImage;

/// Ratio of a scale to the next.
pub const STEP: f64 = 1.2;
/// Most scales that are made: the last is a fifteenth of the picture.
pub const MAX_SCALES: usize = 16;
/// No picture is made smaller than this, pixels.
const MIN_SIDE: usize = 60;
/// Tilts that are simulated: the cosine of the slant is 1 / t, so up to 60 degrees, with as much on the other picture's side.
const TILTS: [f64; 2] = [std::f64::consts::SQRT_2, 2.0];
/// Degrees from one direction to the next, times the tilt (Morel & Yu, section 3.3).
const DIRECTION_STEP_DEG: f64 = 72.0;
/// The squeezed direction is smoothed by so many pixels for each of `sqrt(t² - 1)` (Morel & Yu, section 4).
const SMOOTHING_PX: f64 = 0.8;

/// One scale or view.
#[derive(Debug, Clone, PartialEq)]
pub struct Scale {
    pub image: GreyImage,
    /// How much it is squeezed: 1 for what the camera took.
    pub tilt: f64,
    /// `x_0 = linear x_k + offset`, pixels of the picture by pixels of this one, and back.
    linear: Matrix2<f64>,
    offset: Vector2<f64>,
    back: Matrix2<f64>,
}

impl Scale {
    /// The picture itself.
    fn of(picture: &GreyImage) -> Self {
        let (linear, offset) = (Matrix2::identity(), Vector2::zeros());
        Self { image: picture.clone(), tilt: 1.0, linear, offset, back: linear }
    }

    /// Position in the picture of a position in this scale, pixels.
    pub fn base(&self, at: &Vector2<f64>) -> Vector2<f64> {
        self.linear * at + self.offset
    }

    /// Position in this scale of a position in the picture, pixels.
    pub fn local(&self, base: &Vector2<f64>) -> Vector2<f64> {
        self.back * (base - self.offset)
    }

    /// Pixels of the picture by pixels of this scale.
    pub fn linear(&self) -> &Matrix2<f64> {
        &self.linear
    }

    /// Pixels of this scale by pixels of the picture.
    pub fn back(&self) -> &Matrix2<f64> {
        &self.back
    }

    /// Is it what the camera took, not tilted?
    pub fn is_plain(&self) -> bool {
        self.tilt == 1.0
    }

    /// The size of a pixel of this scale in pixels of the picture: root of the area.
    pub fn size_px(&self) -> f64 {
        self.linear.determinant().abs().sqrt()
    }

    /// The same made smaller, whole pixels to a side.
    fn resampled(&self, width: usize, height: usize) -> Self {
        let factor = Vector2::new(self.image.width as f64 / width as f64, self.image.height as f64 / height as f64);
        let linear = self.linear * Matrix2::from_diagonal(&factor);
        let offset = self.base(&(0.5 * factor).add_scalar(-0.5));
        let image = resample(&self.image, width, height);
        Self { image, linear, offset, back: inverse(&linear), tilt: self.tilt }
    }

    /// The same seen at a slant: squeezed by `tilt` along the direction `phi_rad`, which becomes its rows.
    fn squeezed(&self, tilt: f64, phi_rad: f64) -> Self {
        let (sin, cos) = phi_rad.sin_cos();
        // Along the rows and down the columns of the view, pixels of this scale.
        let (along, down) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let far = Vector2::new(self.image.width as f64 - 1.0, self.image.height as f64 - 1.0);
        let corners = [Vector2::zeros(), Vector2::new(far.x, 0.0), Vector2::new(0.0, far.y), far];
        let reach = |d: &Vector2<f64>| {
            let at = corners.map(|c| c.dot(d));
            (at.into_iter().fold(f64::INFINITY, f64::min), at.into_iter().fold(f64::NEG_INFINITY, f64::max))
        };
        let ((left, right), (top, bottom)) = (reach(&along), reach(&down));
        let (width, height) = (((right - left) / tilt) as usize + 1, (bottom - top) as usize + 1);
        let turned = Matrix2::from_columns(&[along * tilt, down]);
        let start = along * left + down * top;
        let sigma = SMOOTHING_PX * (tilt * tilt - 1.0).sqrt();
        let radius = (3.0 * sigma).ceil() as i32;
        let mut taps: Vec<(f64, f64)> =
            (-radius..=radius).map(f64::from).map(|k| (k, (-k * k / (2.0 * sigma * sigma)).exp())).collect();
        let total: f64 = taps.iter().map(|(_, w)| w).sum();
        taps.iter_mut().for_each(|(_, w)| *w /= total);
        let mut image = GreyImage::new(width, height);
        for (v, row) in image.data.chunks_exact_mut(width).enumerate() {
            for (u, pixel) in row.iter_mut().enumerate() {
                let at = start + turned * Vector2::new(u as f64, v as f64);
                let sum: f64 = taps.iter().map(|(k, w)| w * linear_grey(&self.image, &(at + along * *k))).sum();
                *pixel = sum.round().clamp(0.0, 255.0) as u8;
            }
        }
        let linear = self.linear * turned;
        Self { image, offset: self.base(&start), back: inverse(&linear), linear, tilt: self.tilt * tilt }
    }

    /// This and smaller ones, at most `count`, none smaller than a corner's surroundings.
    fn and_smaller(self, count: usize) -> Vec<Self> {
        let (width, height) = (self.image.width as f64, self.image.height as f64);
        let mut all = vec![self];
        for k in 1..count.min(MAX_SCALES) {
            let shrink = STEP.powi(k as i32);
            let side = |of: f64| (of / shrink).round() as usize;
            let Some(last) = all.last() else { break };
            if side(width).min(side(height)) < MIN_SIDE {
                break;
            }
            all.push(last.resampled(side(width), side(height)));
        }
        all
    }
}

/// Of a map that is made of turns and positive factors.
fn inverse(linear: &Matrix2<f64>) -> Matrix2<f64> {
    linear.try_inverse().unwrap_or_else(Matrix2::identity)
}

/// The picture at up to `count` scales (at least one), the largest first.
pub fn scales(picture: &GreyImage, count: usize) -> Vec<Scale> {
    Scale::of(picture).and_smaller(count)
}

/// The picture as it were seen at slants, each view at up to `count` scales from the half on: a view's scales follow each other, the largest first.
/// Nothing of a picture whose half is too small for a tilted view.
pub fn tilted(picture: &GreyImage, count: usize) -> Vec<Vec<Scale>> {
    let (width, height) = (picture.width / 2, picture.height / 2);
    if width.min(height) < 2 * MIN_SIDE {
        return Vec::new();
    }
    let half = Scale::of(picture).resampled(width, height);
    let mut all = Vec::new();
    for tilt in TILTS {
        let directions = (180.0 / (DIRECTION_STEP_DEG / tilt)).round().max(1.0);
        for k in 0..directions as usize {
            let phi = std::f64::consts::PI * k as f64 / directions;
            all.push(half.squeezed(tilt, phi).and_smaller(count));
        }
    }
    all
}

/// Grey value between pixels; beyond the edge that of the edge.
fn linear_grey(image: &GreyImage, at: &Vector2<f64>) -> f64 {
    let x = at.x.clamp(0.0, image.width as f64 - 1.0);
    let y = at.y.clamp(0.0, image.height as f64 - 1.0);
    let (left, top) =
        ((x as usize).min(image.width.saturating_sub(2)), (y as usize).min(image.height.saturating_sub(2)));
    let (right, bottom) = ((left + 1).min(image.width - 1), (top + 1).min(image.height - 1));
    let (across, down) = (x - left as f64, y - top as f64);
    let grey = |x: usize, y: usize| f64::from(image.at(x, y));
    let row = |y: usize| grey(left, y) * (1.0 - across) + grey(right, y) * across;
    row(top) * (1.0 - down) + row(bottom) * down
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
                assert!((seen - (base.x / 2.0 + base.y / 3.0)).abs() < 2.5, "{} {base}", scale.size_px());
            }
        }
    }

    #[test]
    fn a_tilted_view_shows_what_its_map_says_and_no_more_detail_than_it_has_pixels_for() {
        let picture = |grey: &dyn Fn(f64, f64) -> f64| {
            let mut picture = GreyImage::new(320, 280);
            for (i, p) in picture.data.iter_mut().enumerate() {
                *p = grey((i % 320) as f64, (i / 320) as f64).round() as u8;
            }
            picture
        };
        let smooth = |x: f64, y: f64| 128.0 + 50.0 * (x / 30.0).sin() + 50.0 * (y / 23.0).cos();
        let views = tilted(&picture(&smooth), 3);
        // 72 / t degrees apart: 180 t / 72.
        assert_eq!(views.iter().filter(|v| v[0].tilt == 2.0).count(), 5);
        assert_eq!(views.len(), 9);
        for scale in views.iter().flatten() {
            let middle = Vector2::new(159.5, 139.5);
            let local = scale.local(&middle);
            assert!((scale.base(&local) - middle).norm() < 1e-9);
            let stretch = scale.linear().singular_values();
            assert!((stretch.max() / stretch.min() - scale.tilt).abs() < 0.05, "{stretch}");
            let whole = local.map(f64::round);
            let base = scale.base(&whole);
            let seen = f64::from(scale.image.at(whole.x as usize, whole.y as usize));
            assert!((seen - smooth(base.x, base.y)).abs() < 8.0, "{seen} {}", smooth(base.x, base.y));
        }
        // Stripes five pixels wide: what is squeezed across them is grey, what is squeezed along them is not.
        let striped = tilted(&picture(&|x, _| if ((x / 2.5) as usize).is_multiple_of(2) { 30.0 } else { 220.0 }), 1);
        let contrast = |scale: &Scale| {
            let at = scale.local(&Vector2::new(159.5, 139.5)).map(|v| v as usize);
            let row: Vec<u8> =
                (at.x - 8..at.x + 8).flat_map(|x| (at.y - 8..at.y + 8).map(move |y| scale.image.at(x, y))).collect();
            f64::from(row.iter().max().unwrap() - row.iter().min().unwrap())
        };
        let of = |tilt: f64, along: f64| {
            let view = striped
                .iter()
                .map(|v| &v[0])
                .find(|v| v.tilt == tilt && (v.linear()[(0, 0)] / v.linear().column(0).norm() - along).abs() < 0.4);
            contrast(view.expect("a view"))
        };
        assert!(of(2.0, 1.0) < 40.0 && of(2.0, 0.0) > 60.0, "{} {}", of(2.0, 1.0), of(2.0, 0.0));
    }

    #[test]
    fn pictures_too_small_for_it_have_no_tilted_views() {
        assert!(tilted(&GreyImage::new(200, 600), 8).is_empty());
        assert!(tilted(&GreyImage::new(1, 1), 8).is_empty());
    }

    #[test]
    fn small_pictures_have_one_scale() {
        assert_eq!(scales(&GreyImage::new(64, 64), 8).len(), 1);
        assert_eq!(scales(&GreyImage::new(1, 1), 8).len(), 1);
        assert_eq!(scales(&GreyImage::new(640, 480), 100).len(), 12);
    }
}
