//! Rough motion between two pictures from blurred thumbnails: where to start looking for each track.
//!
//! In: two pyramids of one size. Out: the plane rotation and shift that takes the first picture to the second
//! ([`ImageMotion`]), in level-0 pixels, with its correlation.
//!
//! Method: thumbnails of 32 to 63 pixels across, more where a picture is much wider than high (as PTAM's small blurry image: Klein & Murray,
//! Improving the Agility of Keyframe-Based SLAM, ECCV 2008). First every shift of up to 0.45 of the picture is tried on a thumbnail of half that
//! size, by normalised cross-correlation over the overlap; where that finds nothing similar, again with the picture
//! turned either way. Then inverse-compositional Gauss-Newton over (angle, shift) with gain and bias projected out
//! (the equations of [`alignment`](super::alignment)) on the full thumbnail.
//!
//! Reach: shifts of 0.45 of the width (a turn of 25 degrees a frame for a webcam of 60 degrees), rolls of about 20 degrees.
//!
//! Does not: know the camera's model or see parallax; it is the start of a search, not a measurement.

use nalgebra::{Matrix3, Rotation2, Vector2, Vector3};

use crate::image::{GreyImage, Pyramid};

/// Plane motion of a whole picture: `x_current = R(angle) (x_previous - center) + center + shift`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageMotion {
    /// Turn of what is seen, from x (right) towards y (down), radians.
    pub angle_rad: f32,
    /// Level-0 pixels.
    pub shift_px: Vector2<f32>,
    /// Point that the turn is about: the picture's centre, level-0 pixels.
    pub center_px: Vector2<f32>,
    /// Normalised cross-correlation of the overlapping parts of the thumbnails, -1 to 1.
    pub ncc: f32,
}

impl ImageMotion {
    /// Where a level-0 position of the previous picture lies in the current one.
    #[inline]
    pub fn apply(&self, previous: Vector2<f32>) -> Vector2<f32> {
        Rotation2::new(self.angle_rad) * (previous - self.center_px) + self.center_px + self.shift_px
    }
}

/// Thumbnails are at least this wide, and less than twice as wide unless their height were too small, pixels.
const MIN_WIDTH: usize = 32;
/// At least this high, pixels.
const MIN_HEIGHT: usize = 12;
/// Largest shift tried, share of the thumbnail's side.
const REACH: f32 = 0.45;
/// Turns tried when no plain shift makes the pictures similar, radians.
const TURNS: [f32; 2] = [0.2, -0.2];
/// Correlation that ends the search.
const SIMILAR_NCC: f32 = 0.8;
const MAX_ITERATIONS: usize = 12;
/// Variance below which a picture (or its overlap) counts as blank, grey².
const BLANK_VARIANCE: f32 = 1.0;

/// A picture's thumbnail. Buffers are kept from one picture to the next.
#[derive(Debug, Clone, Default)]
pub struct Thumbnail {
    width: usize,
    height: usize,
    /// Level-0 pixels a side of one thumbnail pixel: a power of two.
    scale: usize,
    /// Blurred grey values less 128.
    pixels: Vec<f32>,
    half: Half,
    sharp: Vec<f32>,
}

/// A picture's thumbnail; empty (like no other) for a picture too small for one.
pub fn thumbnail_of(pyramid: &Pyramid) -> Thumbnail {
    let mut thumbnail = Thumbnail::default();
    thumbnail.build(pyramid);
    // It is kept for long, and this was needed to build it only.
    thumbnail.sharp = Vec::new();
    thumbnail
}

impl Thumbnail {
    /// Becomes the thumbnail of `pyramid`; false when the picture is too small for one.
    pub fn build(&mut self, pyramid: &Pyramid) -> bool {
        self.width = 0;
        // The coarsest that is large enough; finer ones may have been given up.
        let large_enough = |image: &GreyImage| image.width >= MIN_WIDTH && image.height >= MIN_HEIGHT;
        let Some((level, image)) = pyramid.levels.iter().enumerate().rev().find(|(_, image)| large_enough(image))
        else {
            return false;
        };
        // The largest power of two that leaves both sides their minimum.
        let factor = 1usize << (image.width / MIN_WIDTH).min(image.height / MIN_HEIGHT).ilog2();
        let (width, height) = (image.width / factor, image.height / factor);
        self.scale = factor << level;
        self.sharp.clear();
        for rows in image.data.chunks_exact(image.width * factor).take(height) {
            for x in 0..width {
                let sum: u32 = rows
                    .chunks_exact(image.width)
                    .map(|row| row[x * factor..][..factor].iter().map(|v| u32::from(*v)).sum::<u32>())
                    .sum();
                self.sharp.push(sum as f32 / (factor * factor) as f32 - 128.0);
            }
        }
        blur(&self.sharp, width, height, &mut self.pixels);
        self.half.build(&self.pixels, width, height);
        (self.width, self.height) = (width, height);
        true
    }
}

/// [1 2 1] / 4 each way; the border repeats.
fn blur(from: &[f32], width: usize, height: usize, to: &mut Vec<f32>) {
    to.clear();
    for y in 0..height {
        let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)].map(|y| &from[y * width..][..width]);
        let column = |x: usize| rows[0][x] + 2.0 * rows[1][x] + rows[2][x];
        for x in 0..width {
            to.push((column(x.saturating_sub(1)) + 2.0 * column(x) + column((x + 1).min(width - 1))) / 16.0);
        }
    }
}

/// Half-size thumbnail, for the exhaustive search.
#[derive(Debug, Clone, Default)]
struct Half {
    width: usize,
    height: usize,
    /// Grey values less 128, in sixteenths.
    pixels: Vec<i16>,
    /// Sums of values and of their squares over all pixels above and left: (width + 1) x (height + 1).
    sums: Vec<[i64; 2]>,
}

impl Half {
    fn build(&mut self, full: &[f32], full_width: usize, full_height: usize) {
        (self.width, self.height) = (full_width / 2, full_height / 2);
        self.pixels.clear();
        for rows in full.chunks_exact(2 * full_width).take(self.height) {
            for x in 0..self.width {
                let four = rows[2 * x] + rows[2 * x + 1] + rows[full_width + 2 * x] + rows[full_width + 2 * x + 1];
                self.pixels.push((four * 4.0) as i16);
            }
        }
        self.sum();
    }

    fn sum(&mut self) {
        let stride = self.width + 1;
        self.sums.clear();
        self.sums.resize(stride * (self.height + 1), [0; 2]);
        for y in 0..self.height {
            let mut row = [0; 2];
            for x in 0..self.width {
                let v = i64::from(self.pixels[y * self.width + x]);
                row = [row[0] + v, row[1] + v * v];
                let above = self.sums[y * stride + x + 1];
                self.sums[(y + 1) * stride + x + 1] = [above[0] + row[0], above[1] + row[1]];
            }
        }
    }

    /// Sum and sum of squares over `width` x `height` pixels from (x, y) on.
    fn rectangle(&self, x: usize, y: usize, width: usize, height: usize) -> [i64; 2] {
        let at = |x: usize, y: usize| self.sums[y * (self.width + 1) + x];
        let [a, b, c, d] = [at(x, y), at(x + width, y), at(x, y + height), at(x + width, y + height)];
        [d[0] - b[0] - c[0] + a[0], d[1] - b[1] - c[1] + a[1]]
    }

    /// The same picture turned by `angle` about its centre; what comes from outside repeats the border.
    fn turned(&self, angle: f32, out: &mut Half) {
        (out.width, out.height) = (self.width, self.height);
        out.pixels.clear();
        let center = Vector2::new(self.width as f32 - 1.0, self.height as f32 - 1.0) * 0.5;
        let turn = Rotation2::new(-angle);
        for y in 0..self.height {
            for x in 0..self.width {
                let p = turn * (Vector2::new(x as f32, y as f32) - center) + center;
                let x = (p.x.round().max(0.0) as usize).min(self.width - 1);
                let y = (p.y.round().max(0.0) as usize).min(self.height - 1);
                out.pixels.push(self.pixels[y * self.width + x]);
            }
        }
        out.sum();
    }

    /// Shift that takes `self` to `current` with the best normalised cross-correlation over the overlap, and that.
    fn best_shift(&self, current: &Half) -> (Vector2<f32>, f32) {
        let (width, height) = (self.width, self.height);
        let (reach_x, reach_y) = ((width as f32 * REACH) as isize, (height as f32 * REACH) as isize);
        let mut best = (Vector2::zeros(), f32::NEG_INFINITY);
        for dy in -reach_y..=reach_y {
            for dx in -reach_x..=reach_x {
                // Overlap: from (ax, ay) in self and (bx, by) in current.
                let (ax, bx) = ((-dx).max(0) as usize, dx.max(0) as usize);
                let (ay, by) = ((-dy).max(0) as usize, dy.max(0) as usize);
                let (w, h) = (width - ax - bx, height - ay - by);
                let mut product = 0i64;
                for y in 0..h {
                    let a = &self.pixels[(ay + y) * width + ax..][..w];
                    let b = &current.pixels[(by + y) * width + bx..][..w];
                    // Values are within 2^11, rows below 64 pixels (512 were a picture 40 times as wide as high): below 2^28.
                    product += i64::from(a.iter().zip(b).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum::<i32>());
                }
                let ([a, aa], [b, bb]) = (self.rectangle(ax, ay, w, h), current.rectangle(bx, by, w, h));
                let n = (w * h) as i64;
                let (va, vb) = ((n * aa - a * a) as f32, (n * bb - b * b) as f32);
                // In sixteenths of grey, squared.
                let blank = BLANK_VARIANCE * 256.0 * (n * n) as f32;
                if va < blank || vb < blank {
                    continue;
                }
                let ncc = (n * product - a * b) as f32 / (va * vb).sqrt();
                if ncc > best.1 {
                    best = (Vector2::new(dx as f32, dy as f32), ncc);
                }
            }
        }
        best
    }
}

/// Scratch of the alignment of thumbnails, kept from one to the next.
#[derive(Debug, Clone, Default)]
pub struct ThumbnailAligner {
    turned: Half,
    terms: Vec<Term>,
}

/// What one pixel of the previous thumbnail contributes.
#[derive(Debug, Clone, Copy)]
struct Term {
    /// From the centre.
    at: Vector2<f32>,
    value: f32,
    /// Gradient over (angle, shift x, shift y), made orthogonal to 1 and to the values.
    gradient: Vector3<f32>,
}

impl ThumbnailAligner {
    /// Motion from `previous` to `current`; `None` when they differ in size, one is blank, or nothing similar is found.
    pub fn align(&mut self, previous: &Thumbnail, current: &Thumbnail) -> Option<ImageMotion> {
        if previous.width == 0 || (previous.width, previous.height) != (current.width, current.height) {
            return None;
        }
        let (shift, mut score) = previous.half.best_shift(&current.half);
        let mut best = self.refine(previous, current, 0.0, 2.0 * shift);
        if best.is_none_or(|m| m.ncc < SIMILAR_NCC) {
            for turn in TURNS {
                previous.half.turned(turn, &mut self.turned);
                let (shift, turned_score) = self.turned.best_shift(&current.half);
                if turned_score <= score {
                    continue;
                }
                if let Some(motion) = self.refine(previous, current, turn, 2.0 * shift)
                    && best.is_none_or(|m| motion.ncc > m.ncc)
                {
                    (best, score) = (Some(motion), turned_score);
                }
            }
        }
        best
    }

    /// Gauss-Newton from (angle, shift in thumbnail pixels) on.
    fn refine(
        &mut self,
        previous: &Thumbnail,
        current: &Thumbnail,
        mut angle: f32,
        mut shift: Vector2<f32>,
    ) -> Option<ImageMotion> {
        let (width, height) = (previous.width, previous.height);
        let center = Vector2::new(width as f32 - 1.0, height as f32 - 1.0) * 0.5;
        let hessian = self.terms_of_overlap(previous, angle, shift)?;
        let inverse = hessian.try_inverse()?;
        let n = self.terms.len() as f32;
        let mean_t = self.terms.iter().map(|t| t.value).sum::<f32>() / n;
        let energy_t = self.terms.iter().map(|t| (t.value - mean_t) * (t.value - mean_t)).sum::<f32>();
        let limit = Vector2::new(width as f32 - 1.001, height as f32 - 1.001);
        let mut ncc = f32::NEG_INFINITY;
        for _ in 0..MAX_ITERATIONS {
            let (sin, cos) = angle.sin_cos();
            let mut gradient = Vector3::zeros();
            let (mut sum, mut squares, mut product) = (0.0f32, 0.0f32, 0.0f32);
            for term in &self.terms {
                let x = cos * term.at.x - sin * term.at.y + center.x + shift.x;
                let y = sin * term.at.x + cos * term.at.y + center.y + shift.y;
                // Those that leave on the way see the border.
                let (x, y) = (x.max(0.0).min(limit.x), y.max(0.0).min(limit.y));
                let (i, j) = (x as i32, y as i32);
                let (fx, fy) = (x - i as f32, y - j as f32);
                let at = j as usize * width + i as usize;
                let (upper, lower) = (&current.pixels[at..at + 2], &current.pixels[at + width..at + width + 2]);
                let top = upper[0] + fx * (upper[1] - upper[0]);
                let bottom = lower[0] + fx * (lower[1] - lower[0]);
                let v = top + fy * (bottom - top);
                gradient += term.gradient * v;
                sum += v;
                squares += v * v;
                product += v * (term.value - mean_t);
            }
            let energy = squares - sum * sum / n;
            if !(energy > BLANK_VARIANCE * n) {
                return None;
            }
            ncc = product / (energy * energy_t).sqrt();
            let gain = (product / energy_t).clamp(0.5, 2.0);
            let step = inverse * gradient / gain;
            // The template's frame moves by the inverse of the step.
            angle -= step.x;
            let (sin, cos) = angle.sin_cos();
            shift -= Vector2::new(cos * step.y - sin * step.z, sin * step.y + cos * step.z);
            if step.x.abs() * center.x < 0.01 && step.yz().norm_squared() < 1e-4 {
                break;
            }
        }
        let inside = |v: Vector2<f32>| v.x.abs() <= width as f32 * 0.6 && v.y.abs() <= height as f32 * 0.6;
        if !(ncc > 0.0 && inside(shift) && angle.abs() < 0.6) {
            return None;
        }
        let scale = previous.scale as f32;
        // Centre of the part of level 0 that the thumbnail covers, where its own centre lies.
        let center_px = center.map(|v| (v + 0.5) * scale - 0.5);
        Some(ImageMotion { angle_rad: angle, shift_px: shift * scale, center_px, ncc })
    }

    /// Collects the pixels of `previous` that are seen after the motion; returns the Gauss-Newton matrix.
    fn terms_of_overlap(&mut self, previous: &Thumbnail, angle: f32, shift: Vector2<f32>) -> Option<Matrix3<f32>> {
        let (width, height) = (previous.width, previous.height);
        let center = Vector2::new(width as f32 - 1.0, height as f32 - 1.0) * 0.5;
        let turn = Rotation2::new(angle);
        self.terms.clear();
        for y in 1..height - 1 {
            for x in 1..width - 1 {
                let at = Vector2::new(x as f32, y as f32) - center;
                let seen = turn * at + center + shift;
                if !(seen.x >= 0.0 && seen.y >= 0.0 && seen.x < width as f32 - 1.0 && seen.y < height as f32 - 1.0) {
                    continue;
                }
                let p = &previous.pixels;
                let k = y * width + x;
                let (gx, gy) = (0.5 * (p[k + 1] - p[k - 1]), 0.5 * (p[k + width] - p[k - width]));
                let gradient = Vector3::new(at.x * gy - at.y * gx, gx, gy);
                self.terms.push(Term { at, value: p[k], gradient });
            }
        }
        let n = self.terms.len() as f32;
        if self.terms.len() < width * height / 5 {
            return None;
        }
        let (mut sum, mut sum_t) = (Vector3::zeros(), 0.0);
        for term in &self.terms {
            sum += term.gradient;
            sum_t += term.value;
        }
        let (mean, mean_t) = (sum / n, sum_t / n);
        let (mut along, mut energy) = (Vector3::zeros(), 0.0);
        for term in &self.terms {
            let t = term.value - mean_t;
            along += (term.gradient - mean) * t;
            energy += t * t;
        }
        if !(energy > BLANK_VARIANCE * n) {
            return None;
        }
        along /= energy;
        let mut hessian = Matrix3::zeros();
        for term in &mut self.terms {
            term.gradient -= mean + along * (term.value - mean_t);
            hessian += term.gradient * term.gradient.transpose();
        }
        Some(hessian)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;

    /// A picture of soft spots, moved by `motion` (whose centre is that of the picture).
    fn picture([width, height]: [usize; 2], spots: &[[f32; 4]], motion: &ImageMotion) -> Pyramid {
        let mut image = GreyImage::new(width, height);
        let turn = Rotation2::new(-motion.angle_rad);
        for y in 0..height {
            for x in 0..width {
                let moved = Vector2::new(x as f32, y as f32) - motion.center_px - motion.shift_px;
                let p = turn * moved + motion.center_px;
                let value = spots.iter().map(|[u, v, size, grey]| {
                    grey * (-((p.x - u).powi(2) + (p.y - v).powi(2)) / (2.0 * size * size)).exp()
                });
                image.data[y * width + x] = (120.0 + value.sum::<f32>()).clamp(0.0, 255.0) as u8;
            }
        }
        let mut pyramid = Pyramid::new(5);
        pyramid.build(&image);
        pyramid
    }

    fn motion([width, height]: [usize; 2], angle_rad: f32, shift: [f32; 2]) -> ImageMotion {
        let center_px = Vector2::new(width as f32 - 1.0, height as f32 - 1.0) * 0.5;
        ImageMotion { angle_rad, shift_px: Vector2::from(shift), center_px, ncc: 1.0 }
    }

    /// Within a thumbnail's pixel.
    #[test]
    fn a_motion_is_found_in_pictures_of_any_shape() {
        for size in [[640, 480], [1242, 375], [621, 187], [416, 128], [240, 320]] {
            for seed in 1..3 {
                let mut random = Random::new(seed);
                let mut within = |from: f64, to: f64| random.uniform(from, to) as f32;
                let [w, h] = size.map(|v| v as f64);
                let spots: Vec<[f32; 4]> = (0..20)
                    .map(|_| {
                        [
                            within(-0.2 * w, 1.2 * w),
                            within(-0.2 * h, 1.2 * h),
                            within(0.03 * h, 0.15 * h),
                            within(-80.0, 80.0),
                        ]
                    })
                    .collect();
                let still = motion(size, 0.0, [0.0; 2]);
                let before = thumbnail_of(&picture(size, &spots, &still));
                for (angle, x, y) in [(0.0, 0.25, 0.0), (0.08, -0.1, 0.1), (-0.05, 0.15, -0.05)] {
                    let truth = motion(size, angle, [x * size[0] as f32, y * size[1] as f32]);
                    let after = thumbnail_of(&picture(size, &spots, &truth));
                    let found = ThumbnailAligner::default().align(&before, &after).expect("a motion");
                    for place in [[0.3, 0.3], [0.6, 0.4], [0.5, 0.7]] {
                        let place = Vector2::new(place[0] * size[0] as f32, place[1] * size[1] as f32);
                        let off = (found.apply(place) - truth.apply(place)).norm();
                        assert!(
                            off < before.scale as f32,
                            "{size:?}, seed {seed}, {truth:?}: {found:?}, off by {off} px"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn thumbnails_are_large_enough_both_ways_and_not_much_larger() {
        for size in [[640, 480], [1280, 720], [1242, 375], [621, 187], [416, 128], [320, 240], [33, 13]] {
            let thumbnail = thumbnail_of(&picture(size, &[], &motion(size, 0.0, [0.0; 2])));
            let (width, height) = (thumbnail.width, thumbnail.height);
            assert!(width >= MIN_WIDTH && height >= MIN_HEIGHT, "{size:?}: {width} x {height}");
            assert!(width < 2 * MIN_WIDTH || height < 2 * MIN_HEIGHT, "{size:?}: {width} x {height}");
        }
        assert!(!Thumbnail::default().build(&picture([31, 40], &[], &motion([31, 40], 0.0, [0.0; 2]))));
    }

    #[test]
    fn blank_pictures_and_those_of_another_size_have_no_motion() {
        let blank = |size| thumbnail_of(&picture(size, &[], &motion(size, 0.0, [0.0; 2])));
        let mut aligner = ThumbnailAligner::default();
        assert_eq!(aligner.align(&blank([640, 480]), &blank([640, 480])), None);
        assert_eq!(aligner.align(&blank([640, 480]), &blank([1242, 375])), None);
        assert_eq!(aligner.align(&Thumbnail::default(), &Thumbnail::default()), None);
    }
}
