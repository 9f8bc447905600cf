//! How little is known of the scale behind a turn on the spot.
//!
//! Where a turn has left everything behind whose distance was known, the first step after it is as long as the assumed distances
//! make it (`keyframe::after_rotation`), and so is all that follows: within what lies behind the turn everything fits, but beside what lies before it
//! it is too large or too small by one factor. Each such turn is remembered with its place, and each keyframe with the last one that its
//! scale came through; a turn knows the one before it. A pose rests on the scale of its anchor, so its position is uncertain along
//! the way since each of these turns, by [`SCALE_SIGMA`] of that way:
//!
//! ```text
//! P += sum over turns  s^2 d d'        d = R (c - c_turn), in the camera's axes
//! ```
//!
//! (`v` of the left perturbation moves the centre by `-R' v` and turns nothing, so rotation has no part in it.) Once the anchor is a
//! keyframe from before the turn, or one made while the robot was located by such, the sum is empty again.
//!
//! So the map consists of parts, each with a unit of its own, that hang together at turns. Where the scale of one is told, or the ratio of two, parts grow or
//! shrink about their turns ([`ScaleUncertainty::in_one_unit`]); those that have one unit then have one name, and the scale of any other came through the turn
//! between it and them, whichever was first.
//!
//! Cost: nothing until there is a turn, then a few ns a frame. Deliberately not here: that an adjustment, which ties both sides together
//! when the robot sees both, makes the factor itself better known.

use nalgebra::{Matrix3, UnitQuaternion};

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;
use crate::map::saved::SavedTurn;
use crate::map::{KeyframeId, Map, TurnId};
use crate::motion::scale::{SURER_SHARE, ScaleMeasurement};
use crate::motion::wheel_scale::{MOMENT_SIGMA, TOLD_SIGMA};

/// Standard deviation of the length of a step that assumed distances tell, as a share of it. Behind ten simulated turns of 90 and 180
/// degrees the logarithm of what became of the scale had an RMS of 0.42, one of them left out at which tracking itself went astray.
const SCALE_SIGMA: f64 = 0.5;
/// So many turns are kept apart; the doubt of more goes to the ones before them.
const MAX_TURNS: usize = 128;

/// What was told of the scale of the part of the map behind a turn.
#[derive(Debug, Clone, Copy)]
pub struct ToldBehind {
    pub turn: TurnId,
    pub word: ScaleMeasurement,
    /// Standard deviation of an error that all words of the source share.
    pub common_sigma: f64,
}

impl ToldBehind {
    pub fn sigma(&self) -> f64 {
        self.word.sigma.hypot(self.common_sigma)
    }
}

/// A part of the map: how it moves, what it is named from now on, and the standard deviation of the ratio of its unit to the one that all take.
#[derive(Debug, Clone, Copy)]
pub struct Part {
    pub motion: Sim3<World, World>,
    pub name: Option<TurnId>,
    sigma: f64,
    /// The part that it hangs on.
    on: Option<usize>,
    /// Another part that has the unit hangs on it.
    is_enclosed: bool,
}

impl Part {
    /// One that nothing is known of.
    fn resting(name: Option<TurnId>) -> Self {
        Self { motion: Sim3::identity(), name, sigma: f64::INFINITY, on: None, is_enclosed: false }
    }
}

/// What becomes of all parts of the map: of its beginning, and behind each turn.
#[derive(Debug)]
pub struct Parts(Vec<Part>);

impl Parts {
    pub fn of(&self, part: Option<TurnId>) -> Part {
        // Of a turn that is none of the map's nobody knows anything.
        self.0.get(index(part)).copied().unwrap_or(Part::resting(part))
    }
}

fn index(part: Option<TurnId>) -> usize {
    part.map_or(0, |turn| 1 + usize::from(turn.0))
}

/// Of all parts that a map may have, in their order.
fn names() -> impl Iterator<Item = Option<TurnId>> {
    std::iter::once(None).chain((0..=u16::MAX).map(|id| Some(TurnId(id))))
}

/// All turns of the present map whose next step had its length from assumed distances.
#[derive(Debug)]
pub struct ScaleUncertainty {
    turns: Vec<SavedTurn>,
    /// Parts between others that are as long as they should be: to make them longer would tear the map.
    enclosed: Vec<TurnId>,
}

impl Default for ScaleUncertainty {
    fn default() -> Self {
        Self { turns: Vec::with_capacity(MAX_TURNS), enclosed: Vec::new() }
    }
}

impl ScaleUncertainty {
    /// For another run.
    pub fn saved(&self) -> Vec<SavedTurn> {
        self.turns.clone()
    }

    /// What another run knew of this map.
    pub fn restored(saved: &[SavedTurn], map: &Map) -> Self {
        let (mut own, mut enclosed) = (Self::default(), Vec::new());
        own.turns.extend(saved.iter().take(MAX_TURNS));
        // A turn that tells no part's scale any more joins two parts a second time: what lies between them is enclosed.
        for (turn, id) in own.turns.iter().zip(names().skip(1)) {
            let Some(keyframe) = map.keyframe(turn.keyframe).filter(|_| !own.is_named(map, id)) else { continue };
            let ends =
                [keyframe.scale_from, turn.before].map(|end| own.from(end).map(|(id, _)| id).collect::<Vec<_>>());
            let on_one_way = ends[0].iter().chain(&ends[1]).filter(|id| !ends.iter().all(|way| way.contains(id)));
            enclosed.extend(on_one_way.copied());
        }
        own.enclosed = enclosed;
        own
    }

    /// The length of the step behind a turn was assumed, and not that of wheels.
    pub fn is_assumed(&self, id: TurnId) -> bool {
        self.turns.get(usize::from(id.0)).is_some_and(|turn| turn.variance > MOMENT_SIGMA * MOMENT_SIGMA)
    }

    /// A part, or one that it hangs on, lies between others that are as long as they should be, and cannot be made any longer.
    pub fn is_enclosed(&self, part: Option<TurnId>) -> bool {
        self.from(part).any(|(id, _)| self.enclosed.contains(&id))
    }

    /// Wheels tell the ratio of a part to the one that it hangs on, which has the unit of all, better than it was known: `sigma`.
    pub fn is_surer(&self, part: Option<TurnId>, sigma: f64) -> bool {
        let turn = part.and_then(|id| self.turns.get(usize::from(id.0))).filter(|turn| turn.before.is_none());
        turn.is_some_and(|turn| sigma < SURER_SHARE * turn.variance.sqrt()) && !self.is_enclosed(part)
    }

    /// There is a part of this name.
    fn is_named(&self, map: &Map, name: Option<TurnId>) -> bool {
        self.turns.iter().any(|turn| turn.before == name) || map.keyframes.iter().any(|(_, k)| k.scale_from == name)
    }

    /// The turn of a part, that of the part which it hangs on, and so on.
    fn from(&self, part: Option<TurnId>) -> impl Iterator<Item = (TurnId, &SavedTurn)> {
        let turn = |id: TurnId| Some((id, self.turns.get(usize::from(id.0))?));
        // There are no circles, so this ends; the bound only says so.
        std::iter::successors(part.and_then(turn), move |(_, last)| last.before.and_then(turn)).take(MAX_TURNS)
    }

    /// A turn at `keyframe`, whose own scale came through `before`: what its next keyframes are to be marked with. `assumed`: so was the length of the
    /// step; else wheels told it.
    pub fn add(&mut self, map: &Map, keyframe: KeyframeId, before: Option<TurnId>, assumed: bool) -> Option<TurnId> {
        let centre = map.keyframe(keyframe)?.centre();
        let is_the_same = |id: &TurnId| self.turns.get(usize::from(id.0)).is_some_and(|t| t.keyframe == keyframe);
        if before.as_ref().is_some_and(is_the_same) {
            return before;
        }
        let variance = if assumed { SCALE_SIGMA } else { MOMENT_SIGMA }.powi(2);
        let turn = SavedTurn { keyframe, centre, variance, before };
        if self.turns.len() < MAX_TURNS {
            self.turns.push(turn);
            return u16::try_from(self.turns.len() - 1).ok().map(TurnId);
        }
        // One that tells no part's scale any more makes room.
        if let Some(Some(free)) = names().skip(1).take(MAX_TURNS).find(|id| !self.is_named(map, *id)) {
            self.turns[usize::from(free.0)] = turn;
            self.enclosed.retain(|id| *id != free);
            return Some(free);
        }
        let id = before.or(u16::try_from(MAX_TURNS - 1).ok().map(TurnId))?;
        self.turns.get_mut(usize::from(id.0))?.variance += variance;
        Some(id)
    }

    /// Takes over the turns of another map, which lies in this one's frame by `present_from_other` and is about to be a part of it, and marks
    /// its keyframes with their new numbers. `through`: the turn that the ratio of both units came through; what had the scale of the other's
    /// start has that one's. Of more turns than there is room for the scale is believed.
    pub fn absorb(
        &mut self,
        other: &Self,
        map: &mut Map,
        present_from_other: &Sim3<World, World>,
        through: Option<TurnId>,
    ) {
        let first = self.turns.len();
        let renumbered = |id: Option<TurnId>| match id.map(|id| first + usize::from(id.0)) {
            Some(id) if id < MAX_TURNS => u16::try_from(id).ok().map(TurnId),
            Some(_) => None,
            None => through,
        };
        let renewed = |turn: &SavedTurn| SavedTurn {
            centre: present_from_other.transform(&turn.centre),
            before: renumbered(turn.before),
            ..*turn
        };
        self.turns.extend(other.turns.iter().map(renewed).take(MAX_TURNS - first));
        self.enclosed.extend(other.enclosed.iter().filter_map(|part| renumbered(Some(*part))));
        let keyframes: Vec<_> = map.keyframes.iter().map(|(id, k)| (KeyframeId(id), k.scale_from)).collect();
        for (id, turn) in keyframes {
            map.set_scale_origin(id, renumbered(turn));
        }
    }

    /// Takes over where the turns are now, as long as their keyframes are there.
    pub fn follow(&mut self, map: &Map) {
        for turn in &mut self.turns {
            turn.centre = map.keyframe(turn.keyframe).map_or(turn.centre, |k| k.centre());
        }
    }

    /// What becomes of the parts of the map when they grow or shrink, about the turns that they hang at, to the unit of one of them: `ratio` is ln of how
    /// many of its units another's is long, and its standard deviation. A part of which that is known no better than from the one that it hangs on moves
    /// with that one. The map's origin stays. Parts whose ratio is known to [`TOLD_SIGMA`] have that unit from then on, and no turn's name; any other is
    /// named by the turn between it and the one that it takes the unit of. Those between parts of one unit are enclosed.
    pub fn in_one_unit(
        &self,
        map: &Map,
        part: Option<TurnId>,
        ratio: impl Fn(Option<TurnId>) -> Option<(f64, f64)>,
    ) -> Parts {
        // A file may name turns that there are none of.
        let named = self.turns.iter().map(|turn| index(turn.before)).chain([index(part), self.turns.len()]);
        let mut parts: Vec<Option<Part>> = vec![None; 1 + named.max().unwrap_or(0)];
        parts[index(part)] = Some(Part { sigma: 0.0, ..Part::resting(None) });
        // Each turn joins two parts and there are no circles: what hangs on a part that is told is told in the next round.
        let mut told = true;
        while std::mem::take(&mut told) {
            for (turn, turn_id) in self.turns.iter().zip(names().skip(1)) {
                let ends = [index(turn_id), index(turn.before)];
                let (there, at, on) = match ends.map(|end| parts[end]) {
                    [Some(at), None] => (turn.before, at, ends[0]),
                    [None, Some(at)] => (turn_id, at, ends[1]),
                    _ => continue,
                };
                let rigid = (at.motion.scale, at.sigma.hypot(turn.variance.sqrt()));
                let is_enclosed = there.is_some_and(|id| self.enclosed.contains(&id));
                let told_surer = ratio(there).filter(|(_, sigma)| *sigma < rigid.1 && !is_enclosed);
                let (scale, sigma) = told_surer.map_or(rigid, |(log, sigma)| (log.exp(), sigma));
                let centre = map.keyframe(turn.keyframe).map_or(turn.centre, |k| k.centre());
                let motion =
                    Sim3::new(scale, UnitQuaternion::identity(), at.motion.transform(&centre) - scale * centre);
                let name = turn_id.filter(|_| sigma > TOLD_SIGMA);
                parts[index(there)] = Some(Part { motion, name, sigma, on: Some(on), is_enclosed });
                let mut between = name.is_none().then_some(on);
                while let Some(part) = between.and_then(|on| parts[on].as_mut()).filter(|part| part.name.is_some()) {
                    part.is_enclosed = true;
                    between = part.on;
                }
                told = true;
            }
        }
        let mut parts: Vec<Part> =
            parts.into_iter().zip(names()).map(|(part, name)| part.unwrap_or(Part::resting(name))).collect();
        let moved = parts[0].motion.translation;
        parts.iter_mut().for_each(|part| part.motion.translation -= moved);
        Parts(parts)
    }

    /// Parts have moved, have these names from now on, and are known so.
    pub fn rename(&mut self, parts: &Parts) {
        for (turn, id) in self.turns.iter_mut().zip(names().skip(1)) {
            let (behind, before) = (parts.of(id), parts.of(turn.before));
            // What is named by this turn came through it.
            let (from, to) = if before.name == id { (behind, before) } else { (before, behind) };
            // Where nothing is named by it, it tells that it leads to what has the unit.
            turn.before = from.name.filter(|_| behind.name.is_some());
            turn.variance = turn.variance.min(from.sigma.powi(2) + to.sigma.powi(2));
            // Where its keyframe is gone, too.
            turn.centre = behind.motion.transform(&turn.centre);
        }
        let enclosed = parts.0.iter().filter(|part| part.is_enclosed);
        self.enclosed = enclosed.filter_map(|part| part.name).collect();
    }

    /// The whole map has moved so, also where a turn's keyframe is gone.
    pub fn carry(&mut self, motion: &Sim3<World, World>) {
        self.turns.iter_mut().for_each(|turn| turn.centre = motion.transform(&turn.centre));
    }

    /// Standard deviation of the scale that came through `last`, as a share, beside that of the map's unit; `assuming`: of a step whose length is
    /// being assumed now.
    pub fn sigma_behind(&self, last: Option<TurnId>, assuming: bool) -> f64 {
        let step = if assuming { SCALE_SIGMA.powi(2) } else { 0.0 };
        (step + self.from(last).map(|(_, turn)| turn.variance).sum::<f64>()).sqrt()
    }

    /// What to add to the translation's covariance (left perturbation, camera's axes, map units^2) of a pose that rests on scale
    /// that came through `last`.
    pub fn covariance(&self, map: &Map, last: TurnId, pose: &Se3<Camera, World>) -> Matrix3<f64> {
        let mut sum = Matrix3::zeros();
        for (_, turn) in self.from(Some(last)) {
            let centre = map.keyframe(turn.keyframe).map_or(turn.centre, |k| k.centre());
            let way = pose.transform(&centre);
            sum += way * way.transpose() * turn.variance;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::map::{Keyframe, examples};

    fn keyframe(scale_from: Option<TurnId>) -> Keyframe {
        Keyframe { scale_from, ..examples::keyframe(Default::default(), Se3::identity()) }
    }

    #[test]
    fn parts_before_turns_take_the_newest_unit_and_stay_joined_at_the_turns() {
        let mut map = Map::default();
        let mut doubt = ScaleUncertainty::default();
        let at = |z: f64, scale_from| Keyframe {
            camera_from_world: Se3::new(UnitQuaternion::identity(), Vector3::new(0.0, 0.0, -z)),
            ..keyframe(scale_from)
        };
        let first_turn = map.add_keyframe(at(4.0, None));
        let first = doubt.add(&map, first_turn, None, true);
        let second_turn = map.add_keyframe(at(6.0, first));
        let second = doubt.add(&map, second_turn, first, false);
        // Before the first turn a unit is half as long as behind the second, between both three times.
        let logs = [(None, 0.5_f64.ln()), (first, 3.0_f64.ln())];
        let told = |part| logs.iter().find(|(p, _)| *p == part).map(|(_, log)| (*log, 0.01));
        let parts = doubt.in_one_unit(&map, second, told);
        let moved = |part, z: f64| parts.of(part).motion.transform(&Vector3::new(0.0, 0.0, z)).z;
        assert!(moved(None, 0.0).abs() < 1e-12 && (moved(None, 4.0) - 2.0).abs() < 1e-12, "4 of that unit are 2");
        assert!((moved(first, 4.0) - 2.0).abs() < 1e-12 && (moved(first, 6.0) - 8.0).abs() < 1e-12, "and 2 are 6");
        assert!((moved(second, 6.0) - 8.0).abs() < 1e-12 && (moved(second, 7.0) - 9.0).abs() < 1e-12);
        assert!([None, first, second].iter().all(|part| parts.of(*part).name.is_none()), "all are one");
        let untold = doubt.in_one_unit(&map, second, |_| Some((0.7, 2.0)));
        assert!([None, first, second].iter().all(|part| untold.of(*part).motion.scale == 1.0));
    }

    #[test]
    fn where_nothing_tells_the_beginning_it_is_in_doubt_beside_the_newest_part() {
        let mut map = Map::default();
        let mut doubt = ScaleUncertainty::default();
        let turns: Vec<KeyframeId> = (0..3).map(|_| map.add_keyframe(keyframe(None))).collect();
        let first = doubt.add(&map, turns[0], None, true);
        let second = doubt.add(&map, turns[1], first, false);
        // A way that was left at the first part.
        let aside = doubt.add(&map, turns[2], first, true);
        let doubted = doubt.saved();
        let told = |part: Option<TurnId>| part.is_none().then_some((2.0_f64.ln(), 0.1));
        let parts = doubt.in_one_unit(&map, second, told);
        let names = [second, first, None, aside].map(|part| parts.of(part).name);
        assert_eq!(names, [None, second, first, aside]);
        assert_eq!(parts.of(aside).motion.scale, parts.of(first).motion.scale, "it hangs there");
        assert_eq!(parts.of(None).motion.scale, 2.0);
        let (assumed, by_wheels) = (SCALE_SIGMA, MOMENT_SIGMA);
        doubt.rename(&parts);
        let sigma = |part| doubt.sigma_behind(part, false);
        assert_eq!((sigma(None), sigma(second)), (0.0, by_wheels));
        // What was told of the beginning, by the newest, tells the step between it and the first part no better than both.
        assert!((sigma(first).powi(2) - (2.0 * by_wheels.powi(2) + 0.1_f64.powi(2))).abs() < 1e-12);
        assert!((sigma(aside) - by_wheels.hypot(assumed)).abs() < 1e-12, "and what hangs at the first part");
        // The beginning, which is named by the first turn now, is told: what lies between is not, and can be made no longer without a gap.
        let surer = doubt.in_one_unit(&map, None, |part| (part == first).then_some((0.0, 0.02)));
        doubt.rename(&surer);
        assert_eq!([second, first, aside].map(|part| surer.of(part).name), [second, None, aside]);
        assert_eq!([second, first, aside].map(|part| doubt.is_enclosed(part)), [true, false, true]);
        // So it is for another run, which finds the turn at the other end of what lies between.
        turns.iter().zip([second, None, aside]).for_each(|(id, part)| map.set_scale_origin(*id, part));
        let restored = ScaleUncertainty::restored(&doubt.saved(), &map);
        assert_eq!([second, first, aside].map(|part| restored.is_enclosed(part)), [true, false, true]);
        let untouched = ScaleUncertainty::restored(&doubted, &map);
        assert!([first, second, aside].iter().all(|part| !untouched.is_enclosed(*part)), "nothing was told of these");
        let torn = doubt.in_one_unit(&map, None, |part| (part == second).then_some((0.3, 0.01)));
        assert_eq!((torn.of(second).motion.scale, torn.of(second).name), (1.0, second));
    }

    #[test]
    fn a_joined_maps_scale_came_through_its_own_turns_and_the_one_that_told_the_ratio() {
        let (mut present, mut other) = (Map::default(), Map::default());
        let (mut doubt, mut others) = (ScaleUncertainty::default(), ScaleUncertainty::default());
        let here = present.add_keyframe(keyframe(None));
        let through = doubt.add(&present, here, None, true);
        let start = other.add_keyframe(keyframe(None));
        let turn = others.add(&other, start, None, true);
        let behind = other.add_keyframe(keyframe(turn));
        let present_from_other = Sim3::new(2.0, UnitQuaternion::identity(), Vector3::new(0.0, 0.0, 5.0));
        doubt.absorb(&others, &mut other, &present_from_other, through);
        assert_eq!(other.keyframe(start).and_then(|k| k.scale_from), through);
        assert_eq!(other.keyframe(behind).and_then(|k| k.scale_from), Some(TurnId(1)));
        // The present map's turn lies 2 from the camera, the other's, carried over to z = 5, 3.
        let pose = Se3::new(UnitQuaternion::identity(), Vector3::new(0.0, 0.0, -2.0));
        let sigma = |last, assuming| doubt.sigma_behind(last, assuming) / SCALE_SIGMA;
        assert!((sigma(Some(TurnId(1)), false) - 2.0_f64.sqrt()).abs() < 1e-12, "of both turns");
        assert!((sigma(Some(TurnId(1)), true) - 3.0_f64.sqrt()).abs() < 1e-12, "and in a third");
        assert!(sigma(None, false) == 0.0 && sigma(None, true) == 1.0);
        let variance = |id| doubt.covariance(&Map::default(), TurnId(id), &pose)[(2, 2)];
        assert!((variance(0) - 4.0 * SCALE_SIGMA.powi(2)).abs() < 1e-12);
        assert!((variance(1) - (9.0 + 4.0) * SCALE_SIGMA.powi(2)).abs() < 1e-12);
    }
}
