//! Maps of other runs that a command has kept beside the present one, to become a part of it.
//!
//! Such a map is one that was lost ([`joining`](super::joining)): keyframes of the present map are looked for in it, and two that tell the same similarity join
//! them. But the robot was never followed from one to the other, and need not come to a place of both for months. So older keyframes of the present map are
//! looked for as well, by the pictures that they keep: one at a time, after a pose was published and while the robot may stand still. First those that
//! the index over places knows, then all; one round after the other, rarer each time that nothing came of it.
//!
//! Another building may look alike, so most of what should be in view must be found (as of any map that this run is not in), and where both maps are metric
//! their units must agree. And more is doubted than of a map that was lost: what the other map knows of metres is handed down with the error of the ratio that was measured
//! and of all turns on the spot between that place and where either map begins.
//!
//! Until it is joined such a map is held, however many others are lost, and stands in no file of this run: the next one is asked for it again.
//!
//! Cost: nothing while there is none; else one attempt of relocalisation for some frames.

use std::collections::BTreeMap;

use super::asked::Asked;
use super::other_maps::{MAX_SCALE_SIGMA, OtherMap, Sighting, Similarity, WORTH_KEEPING, seen_most_by};
use crate::features::FrameFeatures;
use crate::map::remade::remade;
use crate::map::saved::{SavedMap, SavedMaps, SavedOptics};
use crate::map::{Keyframe, KeyframeId, Map, MapId};
use crate::reconstruction::Reconstruction;
use crate::reconstruction::active_map::ActiveMap;
use crate::reconstruction::keyframe::distance_prior::is_blind;
use crate::reconstruction::types::TrackingState;

/// Maps that wait to be joined, at the most.
const MOST_WAITING: usize = 8;
/// Keyframes of which the index is asked until one is known to it, after one frame: 2 ms each.
const LOOKED_AT: usize = 4;
/// Focal lengths that differ by less in their logarithm are one, whatever their sigmas say.
const SAME_FOCAL_LOG: f64 = 0.02;
/// Keyframes of the same moment whose pictures are compared, which may have to be read from the disk.
const MOST_COMPARED: usize = 64;
/// No map's scale is the same throughout: how surely one ratio at one place tells that of the maps, at the best.
pub const LEAST_SCALE_SIGMA: f64 = 0.02;
/// Both maps are metric: so much of the logarithm of the ratio of their units is nobody's sigma.
const MOST_UNIT_LOG: f64 = 0.1;

/// What waits to be joined to the present map now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Waiting {
    pub maps: usize,
    pub keyframes: usize,
}

impl Reconstruction {
    /// Whether maps could be merged now.
    pub fn can_merge(&self) -> Result<(), String> {
        if self.localise_only {
            return Err(
                "frames are only located in the present map, which stays as it is; switch that off first".into()
            );
        }
        let is_there = self.state != TrackingState::Initializing && !self.active.map.keyframes.is_empty();
        if is_there { Ok(()) } else { Err("there is no map yet to merge another one with".into()) }
    }

    /// Keeps the maps of another run, none of whose ids this run has given ([`given_ids`](Self::given_ids)), beside the present one, to be joined to
    /// it. In the error's case everything is as it was.
    pub fn merge(&mut self, saved: SavedMaps) -> Result<Waiting, String> {
        self.can_merge()?;
        self.is_same_lens(&saved.optics)?;
        let new: Vec<SavedMap> = saved.maps.into_iter().filter(|m| m.map.keyframes.len() >= WORTH_KEEPING).collect();
        let keyframes: usize = new.iter().map(|m| m.map.keyframes.len()).sum();
        if new.is_empty() {
            return Err(format!("there is no map of {WORTH_KEEPING} keyframes in it"));
        }
        let there = self.others.merged().count();
        if there + new.len() > MOST_WAITING {
            return Err(format!("{there} maps wait to be joined, and with it there were more than {MOST_WAITING}"));
        }
        let (own, most) = (self.total_keyframes(), self.config.max_keyframes);
        if own + keyframes > most {
            return Err(format!(
                "it has {keyframes} keyframes; with the {own} that there are these are more than reconstruction.max_keyframes, {most}"
            ));
        }
        if self.knows(&new) {
            return Err(
                "keyframes of it are in the present maps already: it was merged before, or is one of these".into()
            );
        }
        self.leave_ids_to(&new);
        let waiting = Waiting { maps: new.len(), keyframes };
        for saved in new {
            let own = ActiveMap::of_another_run(saved);
            self.loops.expect_more(&own.map);
            self.others.add(OtherMap { is_merged: true, ..OtherMap::new(own) });
        }
        self.others.asked = Asked::default();
        Ok(waiting)
    }

    /// Two cameras that nobody calibrated are compared by what was found of their lenses: the present map's is the one that stays.
    fn is_same_lens(&self, theirs: &SavedOptics) -> Result<(), String> {
        let own = self.optics.saved();
        let [here, there] = [own.camera.fx, theirs.camera.fx];
        let sigma = own.refined_sigma[0].hypot(theirs.refined_sigma[0]);
        if theirs.is_guessed && (there / here).ln().abs() > SAME_FOCAL_LOG + 3.0 * sigma {
            return Err(format!(
                "its focal length was found to be {there:.0} px, that of the present map {here:.0} px"
            ));
        }
        Ok(())
    }

    /// Some keyframe is the same picture of the same moment as one that is there.
    fn knows(&self, new: &[SavedMap]) -> bool {
        let key = |k: &Keyframe| (k.timestamp_ns, k.sequence);
        let mut there: BTreeMap<(i64, u64), Vec<&Keyframe>> = BTreeMap::new();
        for map in std::iter::once(&self.active.map).chain(self.others.maps()) {
            map.keyframes.iter().for_each(|(_, k)| there.entry(key(k)).or_default().push(k));
        }
        let keyframes = new.iter().flat_map(|m| m.map.keyframes.iter()).map(|(_, k)| k);
        keyframes
            .filter_map(|k| Some((k, there.get(&key(k))?)))
            .take(MOST_COMPARED)
            .any(|(k, same)| same.iter().any(|s| shows_the_same(k, s)))
    }

    /// Ids of this run go on above those of these maps.
    fn leave_ids_to(&mut self, new: &[SavedMap]) {
        let active = &mut self.active;
        for SavedMap { head, map } in new {
            active.map.leave_numbers(map.keyframes.next_id(), map.landmarks.next_id());
            let made_in = map.keyframes.iter().map(|(_, k)| k.map.0).max();
            let newest = made_in.map_or(head.id.0, |made_in| made_in.max(head.id.0));
            active.next_id = active.next_id.max(MapId(newest.saturating_add(1)));
        }
    }

    /// Looks for an older keyframe of the present map in one that waits to be joined.
    pub(in crate::reconstruction) fn ask_older(&mut self) {
        let of_maps = self.others.merged().count();
        let is_due = of_maps > 0 && self.counters.frames >= self.others.asked.next_attempt;
        // What the index does not have yet it does not know; and a frame that is in no known place tells nothing of others.
        let is_placed = self.state == TrackingState::Tracking && self.pending.turned.is_none();
        if !is_due || !is_placed || self.loops.is_entering() {
            return;
        }
        let turn = self.others.asked.rounds % of_maps;
        let waiting = self.others.kept.iter().enumerate().filter(|(_, other)| other.is_merged);
        let Some(index) = waiting.map(|(index, _)| index).nth(turn) else { return };
        self.others.asked.next_attempt = self.counters.frames + self.others.asked.gap;
        let by_index = (self.others.asked.rounds / of_maps).is_multiple_of(2);
        let Some((id, features, likely)) = self.next_to_ask(index, by_index, of_maps) else { return };
        if let Some(sighting) = self.find_in(index, &features, id, &likely) {
            self.hear_sighting(index, sighting);
        }
    }

    /// The next keyframe of the round with its picture, and where it may be; `by_index`: one of which that is known.
    fn next_to_ask(
        &mut self,
        index: usize,
        by_index: bool,
        of_maps: usize,
    ) -> Option<(KeyframeId, FrameFeatures, Vec<KeyframeId>)> {
        for _ in 0..LOOKED_AT {
            let map = &self.active.map;
            let Some(id) = map.detailed_before(self.others.asked.before) else {
                self.others.asked.end_round(of_maps);
                return None;
            };
            self.others.asked.before = Some(id);
            let Some(features) = seen_from(map, id) else { continue };
            let likely = self.likely_in(index, &features);
            if !by_index || !likely.is_empty() {
                return Some((id, features, likely));
            }
        }
        None
    }

    /// Standard deviation of the logarithm of the ratio of both maps' units, where they begin; `None`: they cannot be one.
    pub(super) fn join_sigma(&self, other: &OtherMap, by: [&Sighting; 2], told: &Similarity) -> Option<f64> {
        if !other.is_merged {
            return Some(MAX_SCALE_SIGMA);
        }
        let (active, other) = (&self.active, &other.own);
        let here =
            |s: &Sighting| active.scale.sigma_behind(active.map.keyframe(s.keyframe).and_then(|k| k.scale_from), false);
        let there = |s: &Sighting| {
            let seen = seen_most_by(&other.map, s).and_then(|id| other.map.keyframe(id)?.scale_from);
            other.scale.sigma_behind(seen, false)
        };
        let worst = |of: &dyn Fn(&Sighting) -> f64| of(by[0]).max(of(by[1]));
        let sigma = told.log_scale_sigma.max(LEAST_SCALE_SIGMA).hypot(worst(&here)).hypot(worst(&there));
        let are_metric = active.fusion.is_metric() && other.fusion.is_metric();
        let Some(((own, own_sigma, _), (others, others_sigma, _))) = active.fusion.fused().zip(other.fusion.fused())
        else {
            return Some(sigma);
        };
        let off = (told.present_from_other.scale.ln() - (others - own)).abs();
        let most = MOST_UNIT_LOG + 3.0 * sigma.hypot(own_sigma).hypot(others_sigma);
        (!are_metric || off <= most).then_some(sigma)
    }
}

/// What was seen at a keyframe, if its place is measured and enough of its picture is kept.
fn seen_from(map: &Map, id: KeyframeId) -> Option<FrameFeatures> {
    let keyframe = map.keyframe(id).filter(|_| !is_blind(map, id))?;
    let (sequence, timestamp_ns) = (keyframe.sequence, keyframe.timestamp_ns);
    Some(FrameFeatures { sequence, timestamp_ns, pyramid: remade(&keyframe.picture)?, ..FrameFeatures::default() })
}

/// Of two keyframes: their coarsest levels, which all pictures keep, are the same to the byte.
fn shows_the_same(a: &Keyframe, b: &Keyframe) -> bool {
    let coarsest = |k: &Keyframe| {
        let mut picture = k.picture.clone();
        // One that cannot be read is taken for another.
        let _ = picture.bring_back();
        picture.pyramid().levels.last().map(|level| level.data.clone())
    };
    coarsest(a).zip(coarsest(b)).is_some_and(|(a, b)| !a.is_empty() && a == b)
}

#[cfg(test)]
#[path = "merging_tests.rs"]
mod tests;
