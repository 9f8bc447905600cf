//! A condensed picture that is kept elsewhere: where, and what has to be known of it here.
//!
//! The map asks of every keyframe which landmarks it shows, wherever its picture is; only who wants to see them needs the picture itself. So
//! eight bytes a view stay: the landmark, its place in the copy, and which patches there are. A landmark may be forgotten, renamed or fused while
//! the picture is away; the copy is not touched, and what does not hold any more is left out when it comes back.
//!
//! Nothing here reads or writes a file: whoever keeps copies brings a [`PictureCopy`].

use std::sync::Arc;

use super::view::{Detail, PATCH_LEVELS, View};
use crate::features::descriptor::Descriptor;
use crate::image::Pyramid;

/// All that there is of a condensed picture ([`KeyframePicture`](super::picture::KeyframePicture)).
#[derive(Debug, Clone)]
pub struct Condensed {
    pub pyramid: Arc<Pyramid>,
    /// Ascending landmark.
    pub views: Arc<Vec<View>>,
    pub place: Arc<Vec<Descriptor>>,
}

/// A copy of a condensed picture, as it was.
pub trait PictureCopy: Send + Sync + std::fmt::Debug {
    fn read(&self) -> Result<Condensed, CopyFault>;
}

/// Why a copy cannot be had.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CopyFault {
    /// Not now: the disk says why, and may give it later.
    #[error("{0}")]
    NotRead(String),
    /// What is there is no such copy, and never will be.
    #[error("{0}")]
    Senseless(String),
}

/// Views that a condensed picture has at the most, as they are numbered in a byte.
pub const MOST_NUMBERED: usize = 1 << u8::BITS;

/// What is known of a copy.
#[derive(Debug, Clone)]
pub(super) struct Away {
    copy: Arc<dyn PictureCopy>,
    /// Of the picture when it was made.
    revision: u32,
    /// Ascending landmark.
    shown: Vec<Shown>,
}

#[derive(Debug, Clone, Copy)]
struct Shown {
    landmark: u32,
    /// Its number among the views of the copy.
    number: u8,
    /// There is a patch of this level.
    patches: [bool; PATCH_LEVELS],
}

impl Away {
    /// `None` where a copy has more views than it can have.
    pub fn new(copy: Arc<dyn PictureCopy>, revision: u32, views: &[View]) -> Option<Self> {
        let one = |(number, view): (usize, &View)| {
            let (landmark, number) = (view.landmark, u8::try_from(number).ok()?);
            Some(Shown { landmark, number, patches: view.patches.each_ref().map(Option::is_some) })
        };
        let shown = views.iter().enumerate().map(one).collect::<Option<_>>()?;
        Some(Self { copy, revision, shown })
    }

    pub fn revision(&self) -> u32 {
        self.revision
    }

    /// All of it, with the views that are still asked for under the names that they have now.
    pub fn read(&self) -> Result<Condensed, CopyFault> {
        let copy = self.copy.read()?;
        let view = |s: &Shown| Some(View { landmark: s.landmark, ..copy.views.get(usize::from(s.number))?.clone() });
        let views: Vec<View> = self.shown.iter().filter_map(view).collect();
        match views.len() == self.shown.len() {
            true => Ok(Condensed { views: Arc::new(views), ..copy }),
            false => Err(CopyFault::Senseless("the copy of a picture is another".into())),
        }
    }

    pub fn detail(&self, landmark: u32) -> Detail {
        match self.place_of(landmark).map(|i| self.shown[i].patches) {
            Ok([true, _]) => Detail::Full,
            Ok([false, true]) => Detail::Half,
            Ok([false, false]) | Err(_) => Detail::None,
        }
    }

    pub fn has(&self, landmark: u32) -> bool {
        self.place_of(landmark).is_ok()
    }

    fn place_of(&self, landmark: u32) -> Result<usize, usize> {
        self.shown.binary_search_by_key(&landmark, |s| s.landmark)
    }

    pub fn retain(&mut self, stays: impl Fn(u32) -> bool) {
        self.shown.retain(|s| stays(s.landmark));
    }

    pub fn rename(&mut self, new: impl Fn(u32) -> u32) {
        self.shown.iter_mut().for_each(|s| s.landmark = new(s.landmark));
        self.shown.sort_by_key(|s| s.landmark);
    }

    pub fn bytes(&self) -> usize {
        size_of::<Self>() + self.shown.capacity() * size_of::<Shown>()
    }
}
