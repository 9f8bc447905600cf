//! What a keyframe keeps of its picture: all of it while it is among the newest or their neighbours, later what templates are cut from, in the end
//! how some landmarks looked.
//!
//! Level 0 is three quarters of a pyramid, and of an old keyframe little of it is read again: the surroundings of its landmarks. So
//! `reduce` replaces level 0 by patches of [`PATCH_PX`] x [`PATCH_PX`] pixels around some of its
//! observations ([`Map::reduce_picture`](super::Map::reduce_picture) says which) and keeps the coarser levels whole: relocalisation
//! describes landmarks there, and coarse searches start there.
//!
//! `condense` gives up the two levels after it as well, for [`View`]s of the landmarks that
//! [`Map::condense_picture`](super::Map::condense_picture) chooses. Thumbnails, and coarse searches, have the levels that are left.
//!
//! Of keyframes far from the robot the condensed picture is elsewhere ([`away`](super::away)) until it is brought back: there is nothing to be cut from it
//! meanwhile, but which landmarks it shows is known.
//!
//! Memory, 640 x 480: 410 kB whole; reduced 102 kB and 0.6 kB a patch; condensed 8 kB and 0.5 kB a view; away 0.3 kB. Readers sample any through a
//! [`Crop`] and need not know which it is.

use std::sync::Arc;

use nalgebra::Vector2;

use super::away::{Away, Condensed, CopyFault, PictureCopy};
pub use super::view::Detail;
use super::view::{PATCH_LEVELS, PLACE_DESCRIPTORS, ROOM, Room, SmallPatch, View};
use crate::features::descriptor::Descriptor;
use crate::image::pyramid::{double, level_from_base};
use crate::image::{Crop, GreyImage, Pyramid};

/// Side of a patch, level-0 px: an 8 x 8 template with its border and the pixels that interpolation needs, turned by 45 degrees and
/// magnified or minified by half a level, reaches 11 px from its middle.
pub const PATCH_PX: usize = 24;
/// Finest level that is whole in a condensed picture: 80 x 60 pixels of 640 x 480.
pub const CONDENSED_LEVEL: usize = 3;
/// Where it is narrower than this a thumbnail needs a finer one, and the picture is small anyway, px.
const CONDENSED_WIDTH: usize = 32;

/// The pixels of level 0 around one observation.
#[derive(Debug, Clone)]
pub struct Patch {
    /// Its number.
    pub landmark: u32,
    /// Column and row of its first pixel in level 0.
    pub left: u16,
    pub top: u16,
    pub pixels: Box<[u8; PATCH_PX * PATCH_PX]>,
}

/// See the module.
#[derive(Debug, Clone, Default)]
pub struct KeyframePicture {
    /// Its level 0 is empty once reduced.
    pyramid: Arc<Pyramid>,
    /// What is left of level 0, ascending landmark.
    patches: Arc<Vec<Patch>>,
    /// What is left of a condensed one, ascending landmark.
    views: Arc<Vec<View>>,
    /// What the index over places is told of a condensed one when another run goes on in the map.
    place: Arc<Vec<Descriptor>>,
    /// There is a copy elsewhere of a condensed one.
    copy: Option<Arc<Away>>,
    /// And nothing but the copy.
    is_away: bool,
    /// Grows with what a copy elsewhere must be told; patches of landmarks that are no longer observed go untold.
    revision: u32,
}

/// What a file keeps of a picture: everything else follows from it.
pub struct Kept<'a> {
    /// The finest level there is whole, and its number: 0; 1 of a reduced picture; [`CONDENSED_LEVEL`] of a condensed one.
    pub finest: &'a GreyImage,
    pub level: usize,
    /// Levels of the pyramid, the one that was given up among them.
    pub levels: usize,
}

impl KeyframePicture {
    pub fn new(pyramid: Arc<Pyramid>) -> Self {
        Self { pyramid, ..Self::default() }
    }

    /// What a file is to keep of it; `None` where there is no picture.
    pub fn kept(&self) -> Option<Kept<'_>> {
        let level = self.pyramid.levels.iter().position(|l| !l.data.is_empty())?;
        Some(Kept { finest: &self.pyramid.levels[level], level, levels: self.pyramid.levels.len() })
    }

    /// The patches of a reduced picture, ascending landmark.
    pub fn patches(&self) -> impl Iterator<Item = (u32, [u16; 2], &[u8; PATCH_PX * PATCH_PX])> {
        self.patches.iter().map(|p| (p.landmark, [p.left, p.top], &*p.pixels))
    }

    /// A picture from what a file kept of it; `patches` in any order.
    pub fn restored(finest: GreyImage, is_whole: bool, levels: usize, mut patches: Vec<Patch>) -> Self {
        let pyramid = Pyramid::from_level(finest, usize::from(!is_whole), levels);
        patches.sort_by_key(|p| p.landmark);
        Self { pyramid: Arc::new(pyramid), patches: Arc::new(patches), ..Self::default() }
    }

    /// A condensed picture from what a file kept of it; `views` in any order.
    pub fn restored_condensed(
        finest: GreyImage,
        levels: usize,
        mut views: Vec<View>,
        mut place: Vec<Descriptor>,
    ) -> Self {
        place.truncate(PLACE_DESCRIPTORS);
        views.sort_by_key(|v| v.landmark);
        let pyramid = Pyramid::from_level(finest, CONDENSED_LEVEL, levels);
        Self { pyramid: Arc::new(pyramid), views: Arc::new(views), place: Arc::new(place), ..Self::default() }
    }

    /// The views of a condensed picture, ascending landmark.
    pub fn views(&self) -> &[View] {
        &self.views
    }

    /// Descriptors of a condensed picture for the index over places.
    pub fn place_descriptors(&self) -> &[Descriptor] {
        &self.place
    }

    /// How a landmark looked, if that is what the picture keeps.
    pub fn view(&self, landmark: u32) -> Option<&View> {
        self.views.binary_search_by_key(&landmark, |v| v.landmark).ok().map(|i| &self.views[i])
    }

    pub fn is_condensed(&self) -> bool {
        self.is_away || self.pyramid.levels.get(1).is_some_and(|level| level.data.is_empty())
    }

    /// Memory on the heap, bytes, without what the allocator adds; a picture that is shared counts here.
    pub fn bytes(&self) -> usize {
        self.pyramid.levels.iter().map(|l| l.data.capacity() + size_of::<GreyImage>()).sum::<usize>()
            + self.patches.capacity() * size_of::<Patch>()
            + self.patches.len() * PATCH_PX * PATCH_PX
            + self.views.capacity() * size_of::<View>()
            + self.place.capacity() * size_of::<Descriptor>()
            + self.copy.as_ref().map_or(0, |copy| copy.bytes())
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

    /// Whether all of a level is there.
    #[inline]
    pub fn has_level(&self, level: usize) -> bool {
        self.pyramid.levels.get(level).is_some_and(|l| !l.data.is_empty())
    }

    /// What there is of a level around the observation of `landmark`; `room` is for what has to be unpacked.
    #[inline]
    pub fn around<'a>(&'a self, level: usize, landmark: u32, room: &'a mut Room) -> Option<Crop<'a>> {
        let image = self.pyramid.levels.get(level)?;
        if !image.data.is_empty() {
            return Some(image.whole());
        }
        if self.is_condensed() {
            return Some(self.view(landmark)?.patches.get(level)?.as_ref()?.show(room));
        }
        self.patch(landmark)
    }

    fn patch(&self, landmark: u32) -> Option<Crop<'_>> {
        let patch = &self.patches[self.patch_of(landmark).ok()?];
        Some(Crop {
            left: usize::from(patch.left),
            top: usize::from(patch.top),
            width: PATCH_PX,
            height: PATCH_PX,
            data: &patch.pixels[..],
        })
    }

    /// From which level on a template of `landmark` can be cut.
    #[inline]
    pub fn detail(&self, landmark: u32) -> Detail {
        if self.whole().is_some() || self.patch_of(landmark).is_ok() {
            return Detail::Full;
        }
        if !self.is_condensed() {
            // There is none of a keyframe whose picture could not be had.
            return if self.pyramid.levels.is_empty() { Detail::None } else { Detail::Half };
        }
        if let Some(away) = self.away() {
            return away.detail(landmark);
        }
        match self.view(landmark).map(|view| view.patches.each_ref().map(Option::is_some)) {
            Some([true, _]) => Detail::Full,
            Some([false, true]) => Detail::Half,
            Some([false, false]) | None => Detail::None,
        }
    }

    /// How finely a template of `landmark` is cut where this level is asked for. A condensed picture has no levels between its patches and
    /// [`CONDENSED_LEVEL`], so from there it is the next coarser one.
    #[inline]
    pub fn detail_at(&self, level: usize, landmark: u32) -> Detail {
        let patch = |view: &View| view.patches.get(level).is_some_and(Option::is_some);
        match level {
            _ if level == 0 || !self.is_condensed() => self.detail(landmark),
            _ if level >= CONDENSED_LEVEL || self.view(landmark).is_some_and(patch) => Detail::Full,
            _ if level + 1 == CONDENSED_LEVEL => Detail::Half,
            _ => Detail::None,
        }
    }

    /// Whether a template of `landmark` can be cut from level 0.
    #[inline]
    pub fn shows(&self, landmark: u32) -> bool {
        self.detail(landmark) == Detail::Full
    }

    /// All of a level; of a reduced picture level 0 is level 1 doubled, which under the smoothing of a descriptor looks the same. Of a
    /// condensed one there are coarse levels only.
    pub fn level(&self, level: usize) -> Option<std::borrow::Cow<'_, GreyImage>> {
        use std::borrow::Cow;
        let there = |level: usize| self.pyramid.levels.get(level).filter(|l| !l.data.is_empty());
        match level {
            0 if self.whole().is_none() => there(1).map(|half| Cow::Owned(double(half))),
            _ => there(level).map(Cow::Borrowed),
        }
    }

    /// Whether enough levels are there for `condense`, and it was not done yet.
    pub fn can_be_condensed(&self) -> bool {
        let wide = self.pyramid.levels.get(CONDENSED_LEVEL).is_some_and(|l| l.width >= CONDENSED_WIDTH);
        wide && !self.is_condensed()
    }

    /// Both patches of an observation (level-0 px), as far as there is something to cut them from.
    pub(super) fn small_patches(&self, landmark: u32, pixel: Vector2<f32>) -> [Option<SmallPatch>; PATCH_LEVELS] {
        std::array::from_fn(|level| {
            let mut room = ROOM;
            let crop = self.around(level, landmark, &mut room)?;
            SmallPatch::cut(&crop, level_from_base(level, pixel))
        })
    }

    /// Gives up all levels finer than [`CONDENSED_LEVEL`] for these views.
    pub(super) fn condense(&mut self, mut views: Vec<View>, mut place: Vec<Descriptor>) {
        place.truncate(PLACE_DESCRIPTORS);
        place.shrink_to_fit();
        views.sort_by_key(|v| v.landmark);
        views.shrink_to_fit();
        self.pyramid = Arc::new(self.pyramid.without_finest(CONDENSED_LEVEL));
        (self.patches, self.views, self.place) = (Arc::default(), Arc::new(views), Arc::new(place));
        self.revision += 1;
    }

    /// Gives up level 0 but for patches around these observations (level-0 px); does nothing where there is no coarser level.
    pub(super) fn reduce(&mut self, kept: impl Iterator<Item = (u32, Vector2<f32>)>) {
        let Some(whole) = self.whole().filter(|p| p.levels.len() > 1) else { return };
        let mut patches: Vec<Patch> =
            kept.filter_map(|(landmark, pixel)| Patch::cut(&whole.levels[0], landmark, pixel)).collect();
        patches.sort_by_key(|p| p.landmark);
        let coarser = whole.without_finest(1);
        (self.patches, self.pyramid) = (Arc::new(patches), Arc::new(coarser));
        self.revision += 1;
    }

    /// What is known of it while it is not here.
    fn away(&self) -> Option<&Away> {
        self.copy.as_deref().filter(|_| self.is_away)
    }

    /// Nothing of it is here: there is only a copy elsewhere.
    #[inline]
    pub fn is_away(&self) -> bool {
        self.is_away
    }

    /// Whether it could be elsewhere.
    pub fn can_be_away(&self) -> bool {
        self.is_condensed() && !self.is_away && self.has_level(CONDENSED_LEVEL)
    }

    /// Gives up what is here of a condensed picture, as there is a copy elsewhere: the one that was made before if that is still as good, else the one
    /// that `copied` makes. Whether there is one.
    pub fn put_away(&mut self, copied: impl FnOnce(&Self) -> Option<Arc<dyn PictureCopy>>) -> bool {
        if !self.can_be_away() {
            return false;
        }
        // Views that were forgotten since are in the copy still.
        match self.copy.as_mut().filter(|copy| copy.revision() == self.revision) {
            Some(copy) => {
                let views = &self.views;
                let is_here = |l: u32| views.binary_search_by_key(&l, |v| v.landmark).is_ok();
                Arc::make_mut(copy).retain(is_here);
            }
            None => {
                let copy = copied(self).and_then(|copy| Away::new(copy, self.revision, &self.views));
                let Some(copy) = copy else { return false };
                self.copy = Some(Arc::new(copy));
            }
        }
        (self.pyramid, self.views, self.place) = Default::default();
        self.is_away = true;
        true
    }

    /// Reads what is elsewhere. A copy that cannot be read now leaves the picture away; one that makes no sense leaves it
    /// [lost](Self::is_lost), with the revision that it had: what a file kept of it is better than nothing.
    pub fn bring_back(&mut self) -> Result<(), CopyFault> {
        let Some(away) = self.away() else { return Ok(()) };
        match away.read() {
            Ok(Condensed { pyramid, views, place }) => {
                (self.pyramid, self.views, self.place) = (pyramid, views, place);
                self.is_away = false;
                Ok(())
            }
            Err(fault) => {
                if let CopyFault::Senseless(_) = fault {
                    let none = Pyramid::from_level(GreyImage::default(), CONDENSED_LEVEL, CONDENSED_LEVEL + 1);
                    (self.pyramid, self.copy, self.is_away) = (Arc::new(none), None, false);
                }
                Err(fault)
            }
        }
    }

    /// A condensed one of which nothing is left, as its copy was spoiled.
    pub fn is_lost(&self) -> bool {
        self.is_condensed() && !self.is_away && !self.has_level(CONDENSED_LEVEL)
    }

    /// All that there is of a condensed one.
    pub fn condensed(&self) -> Option<Condensed> {
        let Self { pyramid, views, place, .. } = self;
        let all = || Condensed { pyramid: pyramid.clone(), views: views.clone(), place: place.clone() };
        self.can_be_away().then(all)
    }

    /// One landmark turned out to be another.
    pub(super) fn rename(&mut self, landmark: u32, to: u32) {
        if let (Ok(from), Err(_)) = (self.patch_of(landmark), self.patch_of(to)) {
            let patches = Arc::make_mut(&mut self.patches);
            patches[from].landmark = to;
            patches.sort_by_key(|p| p.landmark);
            self.revision += 1;
        }
        if let Some(copy) = self.copy.as_mut().filter(|copy| self.is_away && copy.has(landmark) && !copy.has(to)) {
            Arc::make_mut(copy).rename(|l| if l == landmark { to } else { l });
            self.revision += 1;
        }
        if let (Some(_), None) = (self.view(landmark), self.view(to)) {
            let views = Arc::make_mut(&mut self.views);
            views.iter_mut().filter(|v| v.landmark == landmark).for_each(|v| v.landmark = to);
            views.sort_by_key(|v| v.landmark);
            self.revision += 1;
        }
    }

    /// All landmarks have other ids now, in the same order, and so has the keyframe: whoever has kept a picture under its new one has another.
    pub(super) fn rename_all(&mut self, new: impl Fn(u32) -> u32) {
        Arc::make_mut(&mut self.patches).iter_mut().for_each(|p| p.landmark = new(p.landmark));
        Arc::make_mut(&mut self.views).iter_mut().for_each(|v| v.landmark = new(v.landmark));
        if let Some(copy) = &mut self.copy {
            Arc::make_mut(copy).rename(new);
        }
        self.revision += 1;
    }

    /// The landmark is not observed any more.
    pub(super) fn forget(&mut self, landmark: u32) {
        if let Ok(i) = self.patch_of(landmark) {
            Arc::make_mut(&mut self.patches).remove(i);
        }
        if self.view(landmark).is_some() {
            Arc::make_mut(&mut self.views).retain(|v| v.landmark != landmark);
        }
        if let Some(copy) = self.copy.as_mut().filter(|copy| self.is_away && copy.has(landmark)) {
            Arc::make_mut(copy).retain(|l| l != landmark);
        }
    }

    /// Forgets the patches and views of all landmarks but these (ascending).
    pub(super) fn keep_only(&mut self, landmarks: &[u32]) {
        Arc::make_mut(&mut self.views).retain(|v| landmarks.binary_search(&v.landmark).is_ok());
        Arc::make_mut(&mut self.patches).retain(|p| landmarks.binary_search(&p.landmark).is_ok());
        if let Some(copy) = &mut self.copy {
            Arc::make_mut(copy).retain(|l| landmarks.binary_search(&l).is_ok());
        }
    }

    fn patch_of(&self, landmark: u32) -> Result<usize, usize> {
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
                    let mut room = ROOM;
                    warp_patch(&picture.around(level, landmark, &mut room)?, at, &map, &mut out).then_some(out)
                };
                assert_eq!(warped(&whole, 0), warped(&reduced, 0), "{landmark:?} {map}");
                assert_eq!(warped(&whole, 1), warped(&reduced, 1));
            }
        }
        assert!(reduced.shows(7) && !reduced.shows(8));
        reduced.forget(7);
        let mut room = ROOM;
        assert!(!reduced.shows(7) && reduced.around(0, 7, &mut room).is_none());
        assert!(reduced.around(1, 7, &mut room).is_some());
    }

    #[test]
    fn a_picture_too_small_to_be_reduced_stays_whole() {
        let mut tiny = KeyframePicture::new(noise(20, 16));
        tiny.reduce(std::iter::empty());
        assert!(tiny.whole().is_some() && tiny.levels() == 1);
    }
}
