//! Which condensed pictures are in memory: those of the keyframes around the robot, and where a frame that was lost may be. The others wait in a spool
//! on the disk ([`places::spool`](crate::places::spool)).
//!
//! A keyframe's picture is wanted while the keyframe shares landmarks with where the robot is, or with what does (a view of a landmark is kept by one
//! keyframe of those that see it alike), or while the index over places takes it for a place of a frame that was not found. As many condensed pictures
//! stay as [`HERE`] times `detailed_keyframes`; beyond that those go that were wanted longest ago. So in a map that is not much larger than that nothing is
//! ever away, and nothing of this does anything.
//!
//! What is away is not aligned to, and a landmark that nothing shows here is not counted as missed. Reading and writing come after the pose was
//! published, [`AT_ONCE`] pictures a frame at the most, and by the number of frames, not by the clock: replays are the same. Cost: 2 ms in such a frame, and
//! 20 to 50 us in the others of a map of which something is away.
//!
//! A disk that takes nothing is said, and pictures stay in memory, for some seconds; a picture that cannot be read any more is said and gone, with
//! the landmarks that it alone showed.

use std::collections::BTreeMap;
use std::path::Path;

use super::relocalise::other_maps::OtherMaps;
use super::types::Counters;
use crate::map::{KeyframeId, Map};
use crate::places::spool::PictureSpool;

/// Condensed pictures in memory for each detailed keyframe.
const HERE: usize = 2;
/// Pictures that are read, and that are written, after one frame.
const AT_ONCE: usize = 16;
/// Of a place that a lost frame may be at: so many keyframes that share most with it.
const AROUND_PLACE: usize = 12;
/// Neighbours of the robot's keyframe whose own neighbours are wanted, and how many of each.
const NEIGHBOURS: usize = 10;
const THEIRS: usize = 30;
/// Frames until a disk that took nothing is tried again: half a minute.
const PAUSE: u64 = 900;

/// See the module.
#[derive(Default)]
pub struct FarPictures {
    spool: Option<PictureSpool>,
    /// Frame at which a picture was wanted last.
    wanted_at: BTreeMap<KeyframeId, u64>,
    /// Places of frames that were not found.
    asked: Vec<KeyframeId>,
    /// Of this frame, the most urgent first.
    wanted: Vec<KeyframeId>,
    around: Vec<(KeyframeId, u32)>,
    paused_until: u64,
    /// Why the last one was not written or read.
    pub reason: String,
}

impl FarPictures {
    pub fn spool_in(&mut self, folder: &Path) {
        self.spool = Some(PictureSpool::new(folder));
    }

    /// A frame may be at these places: their pictures are wanted.
    pub fn ask(&mut self, places: &[KeyframeId]) {
        self.asked.extend_from_slice(places);
    }

    /// What is wanted around `reference`, into `wanted`: half of what there is room for, at the most.
    fn want(&mut self, map: &Map, others: &OtherMaps, reference: KeyframeId, most: usize, frame: u64) {
        let Self { wanted, wanted_at, around, asked, .. } = self;
        wanted.clear();
        let mut want = |id: KeyframeId| {
            if wanted.len() < most && wanted_at.insert(id, frame) != Some(frame) {
                wanted.push(id);
            }
        };
        for &place in asked.iter() {
            want(place);
            for map in std::iter::once(map).chain(others.maps()).filter(|map| map.keyframes.contains(place.0)) {
                map.covisible(place, 1, AROUND_PLACE, around);
                around.iter().for_each(|a| want(a.0));
            }
        }
        asked.clear();
        want(reference);
        map.covisible(reference, 1, most / 2, around);
        let near: Vec<KeyframeId> = around.iter().map(|a| a.0).collect();
        near.iter().for_each(|id| want(*id));
        for id in near.into_iter().take(NEIGHBOURS) {
            map.covisible(id, 1, THEIRS, around);
            around.iter().for_each(|a| want(a.0));
        }
    }
}

impl FarPictures {
    /// After a frame: brings back what is wanted around `reference` and puts away what was not for longest, some of each; nothing is put away
    /// while keyframes `are_entered` into the index, by what their pictures keep.
    pub fn exchange(
        &mut self,
        (map, others): (&mut Map, &mut OtherMaps),
        reference: KeyframeId,
        detailed: usize,
        are_entered: bool,
        counters: &mut Counters,
    ) {
        let (frame, most) = (counters.frames, HERE * detailed);
        let maps = || std::iter::once(&*map).chain(others.maps());
        let here: usize = maps().map(|map| map.condensed_here().len()).sum();
        // Pictures of a map that was loaded may be away without a spool of our own.
        if maps().all(|map| map.away() == 0) && (here <= most || self.spool.is_none()) {
            self.asked.clear();
            return;
        }
        self.want(map, others, reference, most / 2, frame);
        let mut brought = 0;
        for &id in &self.wanted {
            for map in std::iter::once(&mut *map).chain(others.kept.iter_mut().map(|other| &mut other.map)) {
                match map.bring_picture_back(id) {
                    Ok(is_back) => brought += usize::from(is_back),
                    Err(reason) => {
                        counters.pictures_lost += 1;
                        self.reason = reason;
                    }
                }
            }
            if brought == AT_ONCE {
                break;
            }
        }
        if !are_entered && frame >= self.paused_until {
            self.put_away(map, others, most, frame, &mut counters.spool_faults);
        }
    }

    fn put_away(&mut self, map: &mut Map, others: &mut OtherMaps, most: usize, frame: u64, faults: &mut u64) {
        let Self { spool: Some(spool), wanted_at, reason, paused_until, .. } = self else { return };
        let mut here: Vec<(u64, KeyframeId)> = Vec::new();
        for map in std::iter::once(&*map).chain(others.maps()) {
            here.extend(map.condensed_here().map(|id| (wanted_at.get(&id).copied().unwrap_or(0), id)));
        }
        let mut over = here.len().saturating_sub(most).min(AT_ONCE);
        if over == 0 {
            return;
        }
        here.sort_unstable();
        wanted_at.retain(|id, at| *at == frame || here.binary_search(&(*at, *id)).is_ok());
        for &(_, id) in here.iter().filter(|h| h.0 < frame) {
            if over == 0 {
                break;
            }
            for map in std::iter::once(&mut *map).chain(others.kept.iter_mut().map(|other| &mut other.map)) {
                let mut failed = None;
                let is_away = map.put_picture_away(id, |picture| {
                    spool.put(picture).unwrap_or_else(|error| {
                        failed = Some(error);
                        None
                    })
                });
                over -= usize::from(is_away);
                if let Some(error) = failed {
                    *faults += 1;
                    (*reason, *paused_until) = (error.to_string(), frame + PAUSE);
                    return;
                }
            }
        }
    }
}
