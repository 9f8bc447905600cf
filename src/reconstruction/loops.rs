//! Loops: a place of the map that is seen again after a long way, and what follows from it.
//!
//! Every keyframe is entered into the index of [`places`](crate::places::index), also where no loops are looked for: frames that were lost in a large map
//! ask it, too. Those of another run's map are entered when it is loaded, of a large one the rest with the frames after that. What a keyframe shows is first asked for there; of the keyframes that are
//! neither covisible with it nor covisible with one that is, and not recent, the likeliest place (a keyframe and what it shares landmarks with) is tried
//! as for a lost frame ([`relocalise`](super::relocalise)): thumbnails, descriptors and P3P, then the search by projection, which must speak for
//! itself; in a thread of its own ([`recognition`]). Keyframes recognised one soon after the other must tell the same similarity, by the depths that are known on both sides, as
//! when maps are joined ([`other_maps`](super::relocalise::other_maps)); and it must be one that the way between both places, along what holds
//! the map together, can have drifted by: that alone tells rooms apart that look the same. A wrong loop costs a robot more than ten missed ones.
//!
//! Then the pose graph is solved in the mapping worker ([`LoopClosure`](crate::places::loops::LoopClosure)), and merged like an adjustment: the map moves, the smooth pose does
//! not, and the revision tells planners. What the two keyframes were found to see of the old place is fused with what they see, and the next
//! adjustments do the rest. A loop that has drifted by next to nothing is only fused.
//!
//! Cost, after the pose was published: describing and asking at each keyframe, and a copy of the map around the place that is to be tried: 2 to 5 ms
//! together. In a thread of its own: one attempt of relocalisation for every few frames where the index knows a place, rarer while nothing comes of it.

mod closing;
pub mod recognition;

use std::collections::VecDeque;

use recognition::Recogniser;

use super::relocalise::other_maps::{ATTEMPT_GAP, LONGEST_GAP, OtherMaps, REMEMBERED, Sighting, Similarity};
use crate::features::descriptor::Descriptor;
use crate::image::Pyramid;
use crate::map::{KeyframeId, Map};
use crate::places::describe::PlaceDescriber;
use crate::places::index::{Candidate, PlaceIndex};

/// Keyframes just before one are no place of old.
const RECENT: u32 = 20;
/// Of what a keyframe shares landmarks with, so many are looked at: its neighbours, whose own are no place of old either.
const NEIGHBOURS: usize = 10;
/// Of the index's answer: so many are weighed with their neighbours.
const WEIGHED: usize = 10;
/// Descriptors that a place must have, and its score against that of the neighbour that is most like the keyframe.
const MIN_VOTES: u32 = 8;
const MIN_LIKENESS: f32 = 0.1;
/// Keyframes that the index names for one frame.
const LIKELY: usize = 3;
/// Keyframes of a place that are tried: the likeliest, and those that share most with it.
const TRIED: usize = 3;

/// Keyframes of another run's map that are entered into the index after one frame, and as how many of these one counts that has to be described
/// (1 ms; a condensed one takes 0.04 ms), or read (0.1 ms): 4 to 5 ms.
const ENTERED_WITH_FRAME: usize = 128;
/// The same before the first frame: a map of 1000 of which 200 are not condensed, in a quarter of a second. A robot that does not know where it is waits for
/// the keyframe that shows it.
const ENTERED_AT_START: usize = 9600;
const DESCRIBED_AS: usize = 32;
const READ_AS: usize = 4;

/// A loop that two keyframes have told.
struct FoundLoop {
    /// The newest last.
    sightings: [Sighting; 2],
    /// Of the old place in the present one's frame and unit.
    told: Similarity,
}

/// What there is of loops.
#[derive(Default)]
pub struct Loops {
    index: PlaceIndex,
    /// Of starts, other runs and second looks, not yet in it.
    to_enter: VecDeque<KeyframeId>,
    describer: PlaceDescriber,
    seen: Vec<Descriptor>,
    ranked: Vec<Candidate>,
    near: Vec<KeyframeId>,
    around: Vec<(KeyframeId, u32)>,
    /// Keyframes that were recognised in the same map, the newest last.
    sightings: Vec<Sighting>,
    waiting: Option<FoundLoop>,
    under_way: Option<FoundLoop>,
    /// Ends of the loops that were closed, the newest last.
    closed: Vec<(KeyframeId, KeyframeId)>,
    /// Frame before which nothing is tried again, and how many frames that was from the last time.
    next_attempt: u64,
    gap: u64,
    warm: usize,
    recogniser: Recogniser,
}

impl Loops {
    /// What was found and not closed yet is not to be: its map has ended or is another one now.
    pub fn forget_found(&mut self) {
        self.recogniser.discard();
        self.sightings.clear();
        (self.waiting, self.under_way) = (None, None);
    }

    /// Keyframes of the map that a picture may show the place of, the likeliest first.
    pub fn likely(&mut self, map: &Map, pyramid: &Pyramid) -> Vec<KeyframeId> {
        let Self { index, describer, seen, ranked, .. } = self;
        describer.describe(pyramid, seen);
        index.query(seen, LIKELY, |k| map.keyframes.contains(k.0), ranked);
        ranked.iter().filter(|c| c.votes >= MIN_VOTES).map(|c| c.keyframe).collect()
    }

    /// The maps are those of another run: their keyframes are entered, the newest first, as the robot is likely to begin where it ended; of a large map
    /// what is left comes with the next frames.
    pub fn expect(&mut self, map: &Map, others: &OtherMaps) {
        self.follow(map, others);
        self.to_enter.clear();
        std::iter::once(map).chain(others.maps()).for_each(|map| self.expect_more(map));
        self.enter(map, others, ENTERED_AT_START);
    }

    /// One more map, entered with the next frames.
    pub fn expect_more(&mut self, map: &Map) {
        let before = self.to_enter.len();
        self.to_enter.extend(map.keyframes.ids().map(KeyframeId));
        self.to_enter.make_contiguous()[before..].reverse();
    }

    /// Keyframes in the index.
    #[cfg(test)]
    pub fn entered(&self) -> usize {
        self.index.len()
    }

    /// Condensed keyframes are known by what their pictures keep, as they are to a run that loads them.
    pub fn shorten(&mut self, map: &Map, condensed: &[KeyframeId]) {
        for (id, keyframe) in condensed.iter().filter_map(|id| Some((*id, map.keyframe(*id)?))) {
            if keyframe.picture.is_condensed() {
                self.index.replace(id, keyframe.picture.place_descriptors());
            }
        }
    }

    /// Keyframes at the ends of loops that were closed: what holds both ends together rests on them.
    pub fn ends(&self) -> impl Iterator<Item = KeyframeId> {
        self.closed.iter().flat_map(|(old, recognised)| [*old, *recognised])
    }

    /// Whether some wait.
    pub fn is_entering(&self) -> bool {
        !self.to_enter.is_empty()
    }

    /// Enters some of those that wait and are in a map still.
    fn enter(&mut self, map: &Map, others: &OtherMaps, most: usize) {
        let Self { index, describer, seen, to_enter, .. } = self;
        let mut work = 0;
        while work < most
            && let Some(id) = to_enter.pop_front()
        {
            let keyframe = map.keyframe(id).or_else(|| others.maps().find_map(|map| map.keyframe(id)));
            let Some(keyframe) = keyframe else { continue };
            match keyframe.picture.is_condensed() {
                true if keyframe.picture.is_away() => {
                    let mut picture = keyframe.picture.clone();
                    // One that cannot be read is known by nothing; it is said once the robot is there.
                    let _ = picture.bring_back();
                    index.add(id, picture.place_descriptors());
                    work += READ_AS;
                }
                true => {
                    index.add(id, keyframe.picture.place_descriptors());
                    work += 1;
                }
                false => {
                    // Reduced pictures have the levels that this takes.
                    describer.describe(keyframe.picture.pyramid(), seen);
                    index.add(id, seen);
                    work += DESCRIBED_AS;
                }
            }
        }
    }

    /// Takes out of the index what is in no map any more.
    fn follow(&mut self, map: &Map, others: &OtherMaps) {
        let is_alive =
            |id: &KeyframeId| map.keyframes.contains(id.0) || others.maps().any(|m| m.keyframes.contains(id.0));
        let gone: Vec<KeyframeId> = self.index.keyframes().filter(|id| !is_alive(id)).collect();
        if gone.len() == self.index.len() {
            // After a reset: to take each out by itself would take long.
            self.index = PlaceIndex::default();
        }
        gone.iter().for_each(|id| self.index.remove(*id));
        self.closed.retain(|(a, b)| is_alive(a) && is_alive(b));
    }

    /// Keyframes of the likeliest old place for what keyframe `id` sees, the likeliest first; none if nothing is likely.
    fn likeliest(&mut self, map: &Map, id: KeyframeId) -> Vec<KeyframeId> {
        let Self { index, seen, ranked, near, around, .. } = self;
        note_near(map, id, near, around);
        index.query(seen, usize::MAX, |k| map.keyframes.contains(k.0), ranked);
        let is_recent = |k: KeyframeId| map.numbers.since(k, id) < RECENT;
        let is_old = |c: &Candidate| !is_recent(c.keyframe) && near.binary_search(&c.keyframe).is_err();
        let familiar = ranked.iter().find(|c| !is_old(c)).map_or(0.0, |c| c.score);
        let mut scores: Vec<(KeyframeId, f32)> = ranked.iter().map(|c| (c.keyframe, c.score)).collect();
        scores.sort_unstable_by_key(|s| s.0);
        let score_of = |k: KeyframeId| scores.binary_search_by_key(&k, |s| s.0).map_or(0.0, |i| scores[i].1);
        let likely = |c: &&Candidate| c.votes >= MIN_VOTES && c.score >= MIN_LIKENESS * familiar;
        let mut best: Option<(f32, KeyframeId)> = None;
        for c in ranked.iter().filter(|c| is_old(c)).filter(likely).take(WEIGHED) {
            map.covisible(c.keyframe, 1, NEIGHBOURS, around);
            let group = c.score + around.iter().map(|a| score_of(a.0)).sum::<f32>();
            if best.is_none_or(|b| group > b.0) {
                best = Some((group, c.keyframe));
            }
        }
        let Some((_, best)) = best else { return Vec::new() };
        map.covisible(best, 1, TRIED - 1, around);
        let others = around.iter().map(|a| a.0).filter(|k| near.binary_search(k).is_err());
        std::iter::once(best).chain(others).collect()
    }

    /// How many frames until the next attempt.
    fn note_attempt(&mut self, frame: u64, found: bool) {
        match found && self.warm < REMEMBERED {
            true => (self.warm, self.gap) = (self.warm + 1, ATTEMPT_GAP),
            false => (self.warm, self.gap) = (0, (2 * self.gap).clamp(ATTEMPT_GAP, LONGEST_GAP)),
        }
        self.next_attempt = if self.warm > 0 { frame } else { frame + self.gap };
    }
}

/// A keyframe, what it shares landmarks with, and what the nearest of these do; ascending.
fn note_near(map: &Map, id: KeyframeId, near: &mut Vec<KeyframeId>, around: &mut Vec<(KeyframeId, u32)>) {
    near.clear();
    near.push(id);
    map.covisible(id, 1, usize::MAX, around);
    near.extend(around.iter().map(|a| a.0));
    for &(neighbour, _) in around.iter().take(NEIGHBOURS) {
        near.extend(map.keyframe(neighbour).into_iter().flat_map(|k| k.covisible.iter().map(|c| c.0)));
    }
    near.sort_unstable();
    near.dedup();
}
