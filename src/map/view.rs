//! How a landmark looks from an old keyframe: what is left of the picture there once the keyframe is condensed.
//!
//! Two patches of [`SMALL_PX`] x [`SMALL_PX`] pixels, of level 0 and of level 1, from which templates are cut; and a descriptor by gradients on each of
//! three levels, by which relocalisation knows the landmark again. Both are kept with four bits a number: the error of a grey value is then
//! 2 % of the patch's contrast (a camera's noise is as much), that of a descriptor 7 % of its length (noise alone makes 15 %).
//!
//! Memory: [`View`] says it, half a kilobyte.

use nalgebra::Vector2;

use crate::features::descriptor::Descriptor;
use crate::features::gradients::{GradientDescriptor, NUMBERS};
use crate::image::Crop;

/// Side of a patch, px of its level: an 8 x 8 template with its border and the pixels that interpolation needs, turned by 45 degrees or
/// magnified by half a level, reaches 7 to 8 px from its middle.
pub const SMALL_PX: usize = 16;
/// Levels of patches, from 0 on.
pub const PATCH_LEVELS: usize = 2;
/// Levels of descriptors, from 0 on.
pub const DESCRIBED_LEVELS: usize = 3;
const PIXELS: usize = SMALL_PX * SMALL_PX;
/// Step of a descriptor's numbers: the largest that four bits tell is 165, which few numbers of a real one exceed.
const DESCRIPTOR_STEP: u8 = 11;

/// How finely a picture shows a landmark.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Detail {
    /// No template can be cut, but from the coarsest levels.
    None,
    /// From level 1 on.
    Half,
    /// From level 0 on.
    Full,
}

/// Room for the pixels of a small patch.
pub type Room = [u8; PIXELS];
pub const ROOM: Room = [0; PIXELS];

/// Two numbers a byte, the lower four bits first.
fn pack<const N: usize>(number: impl Fn(usize) -> u8) -> [u8; N] {
    std::array::from_fn(|i| number(2 * i) & 15 | (number(2 * i + 1) & 15) << 4)
}

fn unpacked(packed: &[u8], i: usize) -> u8 {
    packed[i / 2] >> (4 * (i % 2)) & 15
}

/// A patch of one level.
#[derive(Debug, Clone, PartialEq)]
pub struct SmallPatch {
    /// Column and row of its first pixel in the level.
    pub left: u16,
    pub top: u16,
    /// Grey values that the numbers 0 and 15 stand for.
    pub darkest: u8,
    pub brightest: u8,
    pub packed: [u8; PIXELS / 2],
}

impl SmallPatch {
    /// As much around `pixel` (of that level) as there is; `None` where that is smaller than a patch.
    pub fn cut(image: &Crop<'_>, pixel: Vector2<f32>) -> Option<Self> {
        let begin = |at: f32, first: usize, size: usize| {
            let last = size.checked_sub(SMALL_PX)? + first;
            // The pixels of the middle are those to either side of `at`.
            Some(((at.floor() + 1.0 - SMALL_PX as f32 / 2.0).max(first as f32) as usize).min(last))
        };
        let (left, top) = (begin(pixel.x, image.left, image.width)?, begin(pixel.y, image.top, image.height)?);
        let mut pixels = [0; PIXELS];
        for (row, to) in pixels.chunks_exact_mut(SMALL_PX).enumerate() {
            let from = (top - image.top + row) * image.width + left - image.left;
            to.copy_from_slice(image.data.get(from..from + SMALL_PX)?);
        }
        let (darkest, brightest) = pixels.iter().fold((255, 0), |(low, high), &v| (v.min(low), v.max(high)));
        let range = u32::from(brightest - darkest).max(1);
        let number = |i: usize| ((u32::from(pixels[i] - darkest) * 15 + range / 2) / range) as u8;
        let (left, top) = (left.try_into().ok()?, top.try_into().ok()?);
        Some(Self { left, top, darkest, brightest, packed: pack(number) })
    }

    /// Its pixels.
    pub fn show<'a>(&self, room: &'a mut Room) -> Crop<'a> {
        let range = u32::from(self.brightest.saturating_sub(self.darkest));
        let grey: [u8; 16] = std::array::from_fn(|n| self.darkest + ((range * n as u32 + 7) / 15) as u8);
        for (two, packed) in room.chunks_exact_mut(2).zip(&self.packed) {
            two.copy_from_slice(&[grey[usize::from(packed & 15)], grey[usize::from(packed >> 4)]]);
        }
        Crop {
            left: usize::from(self.left),
            top: usize::from(self.top),
            width: SMALL_PX,
            height: SMALL_PX,
            data: &room[..],
        }
    }
}

/// A descriptor with four bits a number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoarseDescriptor(pub [u8; NUMBERS / 2]);

impl CoarseDescriptor {
    pub fn of(descriptor: &GradientDescriptor) -> Self {
        Self(pack(|i| ((descriptor.0[i].saturating_add(DESCRIPTOR_STEP / 2)) / DESCRIPTOR_STEP).min(15)))
    }

    pub fn restored(&self) -> GradientDescriptor {
        GradientDescriptor(std::array::from_fn(|i| unpacked(&self.0, i) * DESCRIPTOR_STEP))
    }
}

/// By level.
pub type Described = [Option<CoarseDescriptor>; DESCRIBED_LEVELS];

/// Descriptors of a condensed keyframe's picture that are kept for the index over places: half of what the index has of it, the strongest.
pub const PLACE_DESCRIPTORS: usize = 64;

/// What a keyframe is to be known by once its picture is gone.
#[derive(Debug, Clone, Default)]
pub struct Description {
    /// Of the landmarks that were asked for, in their order.
    pub landmarks: Vec<Described>,
    /// Of the picture; at most [`PLACE_DESCRIPTORS`].
    pub place: Vec<Descriptor>,
}

/// See the module.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Its number.
    pub landmark: u32,
    pub patches: [Option<SmallPatch>; PATCH_LEVELS],
    pub described: Described,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use crate::image::GreyImage;

    #[test]
    fn a_small_patch_differs_from_its_picture_by_half_a_step_at_most() {
        let mut random = Random::new(3);
        let mut image = GreyImage::new(60, 50);
        image.data.iter_mut().for_each(|v| *v = 40 + random.below(150) as u8);
        for pixel in [Vector2::new(30.4, 20.7), Vector2::new(1.0, 48.0), Vector2::new(59.0, 0.0)] {
            let patch = SmallPatch::cut(&image.whole(), pixel).expect("it fits");
            let mut room = ROOM;
            let crop = patch.show(&mut room);
            let half_step = (u32::from(patch.brightest - patch.darkest) / 30 + 1) as u8;
            for (i, v) in crop.data.iter().enumerate() {
                let (x, y) = (crop.left + i % SMALL_PX, crop.top + i / SMALL_PX);
                assert!(v.abs_diff(image.row(y)[x]) <= half_step, "{x} {y}");
            }
        }
        let flat = GreyImage { width: 16, height: 16, data: vec![77; 256] };
        let mut room = ROOM;
        let patch = SmallPatch::cut(&flat.whole(), Vector2::new(8.0, 8.0)).expect("it just fits");
        assert!(patch.show(&mut room).data.iter().all(|v| *v == 77));
        assert!(SmallPatch::cut(&GreyImage::new(15, 40).whole(), Vector2::new(8.0, 8.0)).is_none());
    }

    #[test]
    fn a_coarse_descriptor_is_nearer_to_its_own_than_noise() {
        let mut random = Random::new(4);
        for _ in 0..50 {
            let raw: Vec<f64> = (0..NUMBERS).map(|_| random.normal().powi(2)).collect();
            let total: f64 = raw.iter().sum();
            let own = GradientDescriptor(std::array::from_fn(|i| (512.0 * (raw[i] / total).sqrt()).round() as u8));
            let apart = f64::from(own.distance_squared(&CoarseDescriptor::of(&own).restored())).sqrt();
            assert!(apart < 0.1 * 512.0, "{apart}");
        }
    }
}
