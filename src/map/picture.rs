//! What a keyframe keeps of its picture: all of it while it is among the newest or their neighbours, later what templates are cut from.
//!
//! Level 0 is three quarters of a pyramid, and of an old keyframe little of it is read again: the surroundings of its landmarks. So
//! `reduce` replaces level 0 by patches of [`PATCH_PX`] x [`PATCH_PX`] pixels around some of its
//! observations ([`Map::reduce_picture`](super::Map::reduce_picture) says which) and keeps the coarser levels whole: relocalisation
//! describes landmarks there, and coarse searches start there.
//!
//! Memory, 640 x 480: 410 kB whole; reduced 102 kB and 0.6 kB a patch. Readers sample either through a [`Crop`] and need not know which
//! it is.

use std::sync::Arc;

use nalgebra::Vector2;

use crate::image::pyramid::double;
use crate::image::{Crop, GreyImage, Pyramid};

/// Side of a patch, level-0 px: an 8 x 8 template with its border and the pixels that interpolation needs, turned by 45 degrees and
/// magnified or minified by half a level, reaches 11 px from its middle.
pub const PATCH_PX: usize = 24;

/// The pixels of level 0 around one observation.
#[derive(Debug, Clone)]
struct Patch {
    /// Its number.
    landmark: u32,
    left: u16,
    top: u16,
    pixels: Box<[u8; PATCH_PX * PATCH_PX]>,
}

/// See the module.
#[derive(Debug, Clone, Default)]
pub struct KeyframePicture {
    /// Its level 0 is empty once reduced.
    pyramid: Arc<Pyramid>,
    /// What is left of level 0, ascending landmark.
    patches: Arc<Vec<Patch>>,
    /// Grows with what a copy elsewhere must be told; patches of landmarks that are no longer observed go untold.
    revision: u32,
}

/// What a file keeps of a picture: everything else follows from it.
pub struct Kept<'a> {
    /// Level 0, or of a reduced picture level 1.
    pub finest: &'a GreyImage,
    pub is_whole: bool,
    /// Levels of the pyramid, the one that was given up among them.
    pub levels: usize,
}

/// A patch as a file keeps it.
#[derive(Debug, Clone)]
pub struct KeptPatch {
    /// Its number.
    pub landmark: u32,
    /// Column and row of its first pixel in level 0.
    pub left: u16,
    pub top: u16,
    pub pixels: Box<[u8; PATCH_PX * PATCH_PX]>,
}

impl KeyframePicture {
    pub fn new(pyramid: Arc<Pyramid>) -> Self {
        Self { pyramid, ..Self::default() }
    }

    /// What a file is to keep of it; `None` where there is no picture.
    pub fn kept(&self) -> Option<Kept<'_>> {
        let is_whole = self.whole().is_some();
        let finest = self.pyramid.levels.get(usize::from(!is_whole))?;
        Some(Kept { finest, is_whole, levels: self.pyramid.levels.len() })
    }

    /// The patches of a reduced picture, ascending landmark.
    pub fn patches(&self) -> impl Iterator<Item = (u32, [u16; 2], &[u8; PATCH_PX * PATCH_PX])> {
        self.patches.iter().map(|p| (p.landmark, [p.left, p.top], &*p.pixels))
    }

    /// A picture from what a file kept of it; `patches` in any order.
    pub fn restored(finest: GreyImage, is_whole: bool, levels: usize, patches: Vec<KeptPatch>) -> Self {
        let pyramid = match is_whole {
            true => {
                let mut pyramid = Pyramid::new(levels);
                *pyramid.base_mut() = finest;
                pyramid.rebuild();
                pyramid
            }
            false => Pyramid::from_half(finest, levels),
        };
        let own = |p: KeptPatch| Patch { landmark: p.landmark, left: p.left, top: p.top, pixels: p.pixels };
        let mut patches: Vec<Patch> = patches.into_iter().map(own).collect();
        patches.sort_by_key(|p| p.landmark);
        Self { pyramid: Arc::new(pyramid), patches: Arc::new(patches), revision: 0 }
    }

    /// See [`KeyframePicture`]: as long as this stays, a copy elsewhere needs no more than the landmarks that are observed.
    pub fn revision(&self) -> u32 {
        self.revision
    }

    /// All levels there are, the finest one first; of a reduced picture that is empty.
    pub fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    /// The whole picture, unless it was reduced.
    pub fn whole(&self) -> Option<&Pyramid> {
        self.pyramid.levels.first().filter(|base| !base.data.is_empty()).map(|_| &*self.pyramid)
    }

    /// The whole picture to be held elsewhere, unless it was reduced.
    pub fn shared(&self) -> Option<Arc<Pyramid>> {
        self.whole().map(|_| self.pyramid.clone())
    }

    pub fn levels(&self) -> usize {
        self.pyramid.levels.len()
    }

    /// What there is of a level around the observation of `landmark`.
    #[inline]
    pub fn around(&self, level: usize, landmark: u32) -> Option<Crop<'_>> {
        let image = self.pyramid.levels.get(level)?;
        if level > 0 || !image.data.is_empty() {
            return Some(image.whole());
        }
        let patch = &self.patches[self.place(landmark).ok()?];
        Some(Crop {
            left: usize::from(patch.left),
            top: usize::from(patch.top),
            width: PATCH_PX,
            height: PATCH_PX,
            data: &patch.pixels[..],
        })
    }

    /// Whether a template of `landmark` can be cut from level 0.
    #[inline]
    pub fn shows(&self, landmark: u32) -> bool {
        self.whole().is_some() || self.place(landmark).is_ok()
    }

    /// All of a level; of a reduced picture level 0 is level 1 doubled, which under the smoothing of a descriptor looks the same.
    pub fn level(&self, level: usize) -> Option<std::borrow::Cow<'_, GreyImage>> {
        use std::borrow::Cow;
        match level {
            0 if self.whole().is_none() => self.pyramid.levels.get(1).map(|half| Cow::Owned(double(half))),
            _ => self.pyramid.levels.get(level).map(Cow::Borrowed),
        }
    }

    /// Gives up level 0 but for patches around these observations (level-0 px); does nothing where there is no coarser level.
    pub(super) fn reduce(&mut self, kept: impl Iterator<Item = (u32, Vector2<f32>)>) {
        let Some(whole) = self.whole().filter(|p| p.levels.len() > 1) else { return };
        let mut patches: Vec<Patch> =
            kept.filter_map(|(landmark, pixel)| Patch::cut(&whole.levels[0], landmark, pixel)).collect();
        patches.sort_by_key(|p| p.landmark);
        let coarser = whole.without_base();
        (self.patches, self.pyramid) = (Arc::new(patches), Arc::new(coarser));
        self.revision += 1;
    }

    /// One landmark turned out to be another.
    pub(super) fn rename(&mut self, landmark: u32, to: u32) {
        if let (Ok(from), Err(_)) = (self.place(landmark), self.place(to)) {
            let patches = Arc::make_mut(&mut self.patches);
            patches[from].landmark = to;
            patches.sort_by_key(|p| p.landmark);
            self.revision += 1;
        }
    }

    /// All landmarks have other ids now, in the same order, and so has the keyframe: whoever has kept a picture under its new one has another.
    pub(super) fn rename_all(&mut self, new: impl Fn(u32) -> u32) {
        Arc::make_mut(&mut self.patches).iter_mut().for_each(|p| p.landmark = new(p.landmark));
        self.revision += 1;
    }

    /// The landmark is not observed any more.
    pub(super) fn forget(&mut self, landmark: u32) {
        if let Ok(i) = self.place(landmark) {
            Arc::make_mut(&mut self.patches).remove(i);
        }
    }

    /// Forgets the patches of all landmarks but these (ascending).
    pub(super) fn keep_only(&mut self, landmarks: &[u32]) {
        Arc::make_mut(&mut self.patches).retain(|p| landmarks.binary_search(&p.landmark).is_ok());
    }

    fn place(&self, landmark: u32) -> Result<usize, usize> {
        self.patches.binary_search_by_key(&landmark, |p| p.landmark)
    }
}

impl Patch {
    /// As much around `pixel` as lies in the picture; `None` where that is smaller than a patch.
    fn cut(image: &GreyImage, landmark: u32, pixel: Vector2<f32>) -> Option<Self> {
        let begin = |at: f32, size: usize| {
            let last = size.checked_sub(PATCH_PX)?;
            // The pixels of the middle are those to either side of `at`.
            Some(((at.floor() + 1.0 - PATCH_PX as f32 / 2.0).max(0.0) as usize).min(last))
        };
        let (left, top) = (begin(pixel.x, image.width)?, begin(pixel.y, image.height)?);
        let mut pixels = Box::new([0; PATCH_PX * PATCH_PX]);
        for (row, to) in pixels.chunks_exact_mut(PATCH_PX).enumerate() {
            to.copy_from_slice(&image.row(top + row)[left..left + PATCH_PX]);
        }
        Some(Self { landmark, left: left.try_into().ok()?, top: top.try_into().ok()?, pixels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::patch_sampling::warp_patch;
    use nalgebra::Matrix2;

    fn noise(width: usize, height: usize) -> Arc<Pyramid> {
        let mut image = GreyImage::new(width, height);
        let mut seed = 5u32;
        for v in &mut image.data {
            seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
            *v = (seed >> 24) as u8;
        }
        let mut pyramid = Pyramid::new(3);
        pyramid.build(&image);
        Arc::new(pyramid)
    }

    #[test]
    fn templates_of_a_reduced_picture_are_those_of_the_whole_one() {
        let whole = KeyframePicture::new(noise(120, 90));
        let seen = [(7, 60.3, 44.8), (2, 6.1, 80.9), (4, 112.9, 7.2)];
        let seen = seen.map(|(id, x, y)| (id, Vector2::new(x, y)));
        let mut reduced = whole.clone();
        reduced.reduce(seen.into_iter());
        assert!(whole.whole().is_some() && reduced.whole().is_none());
        // Turned by 45 degrees and half a level coarser: the farthest that a patch must reach.
        for map in [Matrix2::identity(), Matrix2::new(0.99, -0.99, 0.99, 0.99), Matrix2::new(-1.3, 0.2, 0.1, 1.2)] {
            for (landmark, pixel) in seen {
                let warped = |picture: &KeyframePicture, level| {
                    let mut out = [0.0; 100];
                    let at = crate::image::pyramid::level_from_base(level, pixel);
                    warp_patch(&picture.around(level, landmark)?, at, &map, &mut out).then_some(out)
                };
                assert_eq!(warped(&whole, 0), warped(&reduced, 0), "{landmark:?} {map}");
                assert_eq!(warped(&whole, 1), warped(&reduced, 1));
            }
        }
        assert!(reduced.shows(7) && !reduced.shows(8));
        reduced.forget(7);
        assert!(!reduced.shows(7) && reduced.around(0, 7).is_none());
        assert!(reduced.around(1, 7).is_some());
    }

    #[test]
    fn a_picture_too_small_to_be_reduced_stays_whole() {
        let mut tiny = KeyframePicture::new(noise(20, 16));
        tiny.reduce(std::iter::empty());
        assert!(tiny.whole().is_some() && tiny.levels() == 1);
    }
}
