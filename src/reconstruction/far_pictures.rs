//! Which condensed pictures are in memory: those of the keyframes around the robot, and where a frame that was lost may be. The others wait in a spool
//! on the disk ([`places::spool`](crate::places::spool)).
//!
//! A keyframe's picture is wanted while the keyframe shares landmarks with where the robot is, or with what does (a view of a landmark is kept by one
//! keyframe of those that see it alike), or while the index over places takes it for a place of a frame that was not found; and shortly before the
//! rounds of a lost frame over all keyframes come to it. As many condensed pictures stay as [`HERE`] times `detailed_keyframes`; beyond that those go
//! that were wanted longest ago. So in a map that is not much larger than that nothing is ever away, and nothing of this does anything.
//!
//! What is away is not aligned to, and a landmark that nothing shows here is not counted as missed. Reading and writing come after the pose was
//! published, [`AT_ONCE`] pictures a frame at the most, and by the number of frames, not by the clock: replays are the same. Cost: 2 ms in such a frame
//! while the system has the file in memory, and 20 to 50 us in the others of a map of which something is away. From a slow disk (an SD card) [`AT_ONCE`]
//! reads of some 20 kB may take longer than a frame, and the next one waits for them.
//!
//! Of a disk that takes nothing, or gives nothing, it is said, and all stays where it is for half a minute ([`PAUSE`]): a picture that was not read is
//! away still, and its landmarks stay. Only one whose copy makes no sense is lost, with the landmarks that it alone showed.

use std::collections::BTreeMap;
use std::path::Path;

use super::relocalise::other_maps::OtherMaps;
use super::types::Counters;
use crate::map::away::CopyFault;
use crate::map::{KeyframeId, Map};
use crate::places::spool::PictureSpool;

/// Condensed pictures in memory for each detailed keyframe.
const HERE: usize = 2;
/// Pictures that are read, or tried to, and that are written, after one frame.
const AT_ONCE: usize = 16;
/// Of a place that a lost frame may be at: so many keyframes that share most with it.
const AROUND_PLACE: usize = 12;
/// Neighbours of the robot's keyframe whose own neighbours are wanted, and how many of each.
const NEIGHBOURS: usize = 10;
const THEIRS: usize = 30;
/// Frames until a disk that took or gave nothing is tried again: half a minute.
const PAUSE: u64 = 900;

/// See the module.
#[derive(Default)]
pub struct FarPictures {
    spool: Option<PictureSpool>,
    /// Frame at which a picture was wanted last.
    wanted_at: BTreeMap<KeyframeId, u64>,
    /// Places of frames that were not found.
    asked: Vec<KeyframeId>,
    /// What the rounds over all keyframes come to next.
    ahead: Vec<KeyframeId>,
    /// Of this frame, the most urgent first.
    wanted: Vec<KeyframeId>,
    around: Vec<(KeyframeId, u32)>,
    paused_until: u64,
    /// The same of reading: of pictures that were not read, and of all once a second one follows without one that was.
    unread_until: BTreeMap<KeyframeId, u64>,
    all_unread_until: u64,
    is_failing: bool,
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

    /// The rounds of a frame that was not found come to these keyframes next.
    pub fn ask_ahead(&mut self, keyframes: impl Iterator<Item = KeyframeId>) {
        self.ahead.extend(keyframes);
    }

    /// What is wanted around `reference`, into `wanted`: half of what there is room for, at the most.
    fn want(&mut self, map: &Map, others: &OtherMaps, reference: KeyframeId, most: usize, frame: u64) {
        let Self { wanted, wanted_at, around, asked, ahead, .. } = self;
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
        ahead.drain(..).for_each(&mut want);
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
            self.ahead.clear();
            return;
        }
        self.want(map, others, reference, most / 2, frame);
        self.bound(map, others, here + most, frame);
        let is_well = self.bring_back(map, others, counters);
        if is_well && !are_entered && frame >= self.paused_until {
            self.put_away(map, others, most, frame, &mut counters.spool_faults);
        }
    }

    /// Forgets when pictures were wanted that are not here, once that is known of many.
    fn bound(&mut self, map: &Map, others: &OtherMaps, few: usize, frame: u64) {
        if self.wanted_at.len() <= 2 * few {
            return;
        }
        let is_here = |id: KeyframeId| {
            let mut maps = std::iter::once(map).chain(others.maps());
            maps.any(|map| map.keyframe(id).is_some_and(|k| !k.picture.is_away()))
        };
        self.wanted_at.retain(|id, at| *at == frame || is_here(*id));
    }

    /// Brings back some of what is wanted, up to the first that cannot be had. Whether there was none.
    fn bring_back(&mut self, map: &mut Map, others: &mut OtherMaps, counters: &mut Counters) -> bool {
        let frame = counters.frames;
        if frame < self.all_unread_until {
            return true;
        }
        self.unread_until.retain(|_, until| frame < *until);
        let mut brought = 0;
        for &id in self.wanted.iter().filter(|id| !self.unread_until.contains_key(id)) {
            for map in std::iter::once(&mut *map).chain(others.kept.iter_mut().map(|other| &mut other.own.map)) {
                match map.bring_picture_back(id) {
                    Ok(false) => {}
                    Ok(true) => {
                        brought += 1;
                        self.is_failing = false;
                    }
                    Err(CopyFault::Senseless(reason)) => {
                        counters.pictures_lost += 1;
                        self.reason = reason;
                        return false;
                    }
                    Err(CopyFault::NotRead(reason)) => {
                        counters.pictures_unread += 1;
                        self.reason = reason;
                        self.unread_until.insert(id, frame + PAUSE);
                        if std::mem::replace(&mut self.is_failing, true) {
                            self.all_unread_until = frame + PAUSE;
                        }
                        return false;
                    }
                }
            }
            if brought == AT_ONCE {
                break;
            }
        }
        true
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
            for map in std::iter::once(&mut *map).chain(others.kept.iter_mut().map(|other| &mut other.own.map)) {
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Vector2, Vector3};

    use super::*;
    use crate::geometry::Se3;
    use crate::image::{GreyImage, Pyramid};
    use crate::map::view::{DESCRIBED_LEVELS, Description};
    use crate::map::{LandmarkId, examples};
    use crate::reconstruction::track::template::observe;

    /// Five keyframes at one place, whose pictures are away but for the last one's; as many failures of each copy, then it is read.
    fn map(failures: [u32; 4]) -> (Map, [KeyframeId; 5]) {
        let mut pyramid = Pyramid::new(5);
        pyramid.build(&GreyImage::new(640, 480));
        let (mut map, pyramid) = (Map::default(), Arc::new(pyramid));
        let ids = [(); 5].map(|()| map.add_keyframe(examples::keyframe(pyramid.clone(), Se3::identity())));
        for x in [100.0, 200.0, 300.0] {
            let seen = observe(&examples::lens(), LandmarkId(0), Vector2::new(x, 240.0), 1.0).expect("in the picture");
            map.add_landmark(examples::landmark(Vector3::z(), ids[0]), &ids.map(|id| (id, seen)));
        }
        for (id, failures) in ids.into_iter().zip(failures) {
            map.condense_picture(id, &examples::lens(), |_, l| Description {
                landmarks: vec![[None; DESCRIBED_LEVELS]; l.len()],
                place: vec![],
            });
            assert!(map.put_picture_away(id, |picture| examples::copied(picture, failures)));
        }
        (map, ids)
    }

    fn exchange(far: &mut FarPictures, map: &mut Map, reference: KeyframeId, counters: &mut Counters) {
        far.exchange((map, &mut OtherMaps::default()), reference, 20, false, counters);
        counters.frames += 1;
    }

    #[test]
    fn one_that_is_not_read_waits_and_the_others_do_not() {
        let (mut map, ids) = map([1, 0, 0, 0]);
        let (mut far, mut counters) = (FarPictures::default(), Counters::default());
        (0..2).for_each(|_| exchange(&mut far, &mut map, ids[4], &mut counters));
        assert_eq!((map.away(), counters.pictures_unread, far.reason.as_str()), (1, 1, "a bad block"));
        assert!(map.keyframe(ids[0]).is_some_and(|k| k.picture.is_away()));
        (2..PAUSE).for_each(|_| exchange(&mut far, &mut map, ids[4], &mut counters));
        assert_eq!((map.away(), counters.pictures_unread), (1, 1), "it is not tried meanwhile");
        (0..2).for_each(|_| exchange(&mut far, &mut map, ids[4], &mut counters));
        assert_eq!((map.away(), counters.pictures_unread, counters.pictures_lost, map.landmarks.len()), (0, 1, 0, 3));
    }

    #[test]
    fn a_disk_that_gives_nothing_is_asked_twice_in_half_a_minute() {
        let (mut map, ids) = map([1; 4]);
        let (mut far, mut counters) = (FarPictures::default(), Counters::default());
        (0..PAUSE).for_each(|_| exchange(&mut far, &mut map, ids[4], &mut counters));
        assert_eq!((map.away(), counters.pictures_unread), (4, 2));
        (0..4 * PAUSE).for_each(|_| exchange(&mut far, &mut map, ids[4], &mut counters));
        assert_eq!((map.away(), counters.pictures_lost, map.landmarks.len()), (0, 0, 3));
    }

    #[test]
    fn what_the_rounds_of_a_lost_frame_come_to_is_brought_back_wherever_the_robot_was() {
        let (mut map, ids) = map([0; 4]);
        // It shares nothing with the others.
        let elsewhere = map.add_keyframe(examples::keyframe(Arc::default(), Se3::identity()));
        let (mut far, mut counters) = (FarPictures::default(), Counters::default());
        exchange(&mut far, &mut map, elsewhere, &mut counters);
        assert_eq!(map.away(), 4);
        far.ask_ahead([ids[1], ids[2]].into_iter());
        exchange(&mut far, &mut map, elsewhere, &mut counters);
        assert_eq!(map.condensed_here().collect::<Vec<_>>(), [ids[1], ids[2]]);
    }

    #[test]
    fn what_is_remembered_of_pictures_that_are_away_is_bounded() {
        let (map, ids) = map([9; 4]);
        let mut far =
            FarPictures { wanted_at: (0..1000).map(|id| (KeyframeId(id), 3)).collect(), ..FarPictures::default() };
        far.bound(&map, &OtherMaps::default(), 500, 9);
        assert_eq!(far.wanted_at.len(), 1000, "few are not worth it");
        far.bound(&map, &OtherMaps::default(), 20, 9);
        assert_eq!(far.wanted_at.keys().copied().collect::<Vec<_>>(), [ids[4]], "the one that is here");
    }
}
