//! Robots whose maps have keyframes in common, in one frame. Pure.
//!
//! Each map is a chart, each keyframe that two of them have a joint between these. A map that has none in common with another one may still have them
//! with a third, so charts are laid on each other one by one, from the first robot on. What two robots make of a keyframe's place after they parted
//! differs by what each has corrected since: of several joints the first is taken, which makes this a picture and no measurement.

use std::collections::{BTreeMap, VecDeque};

use crate::messages::Transform;

/// Of each map, by its anchors' names and places in it: the frame that it is laid in (named after the first anchor of the first map there), and where its
/// own is in that. `None`: it has no anchors.
pub fn common_frames(maps: &[Vec<(u64, Transform)>]) -> Vec<Option<(u64, Transform)>> {
    let mut by_anchor: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for (map, anchors) in maps.iter().enumerate() {
        anchors.iter().for_each(|(name, _)| by_anchor.entry(*name).or_default().push(map));
    }
    let mut laid = vec![None; maps.len()];
    for first in 0..maps.len() {
        let Some((frame, _)) = maps[first].first().filter(|_| laid[first].is_none()) else { continue };
        laid[first] = Some((*frame, Transform::IDENTITY));
        let mut next = VecDeque::from([(first, Transform::IDENTITY)]);
        while let Some((map, frame_from_map)) = next.pop_front() {
            for (name, in_map) in &maps[map] {
                // Whoever has it is laid now, so it is asked for once.
                for other in by_anchor.remove(name).into_iter().flatten().filter(|other| *other != map) {
                    let in_other = || maps[other].iter().find(|anchor| anchor.0 == *name).map(|anchor| anchor.1);
                    let Some(in_other) = laid[other].is_none().then(in_other).flatten() else { continue };
                    let frame_from_other = frame_from_map * *in_map * in_other.inverse();
                    laid[other] = Some((*frame, frame_from_other));
                    next.push_back((other, frame_from_other));
                }
            }
        }
    }
    laid
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_laid_on_each_other_by_what_they_have_in_common_over_others_as_well() {
        let at = Transform::level;
        // The second is turned by a right angle and lies 5 m off the first; the third shares with the second alone; the fourth with nobody.
        let turned = at(5.0, 0.0, std::f64::consts::FRAC_PI_2);
        let first = [(1, at(0.0, 0.0, 0.0)), (2, at(1.0, 2.0, 0.3))];
        let second = [(2, turned.inverse() * first[1].1), (3, at(7.0, 1.0, 0.0))];
        let third = [(3, at(0.0, 0.0, 0.0))];
        let fourth = [(9, at(0.0, 0.0, 0.0))];
        let laid = common_frames(&[first.to_vec(), Vec::new(), fourth.to_vec(), third.to_vec(), second.to_vec()]);
        assert_eq!((laid[0], laid[1], laid[2]), (Some((1, Transform::IDENTITY)), None, Some((9, Transform::IDENTITY))));
        let near = |laid: Option<(u64, Transform)>, place: Transform| {
            let (frame, there) = laid.expect("a frame");
            let off = there.inverse() * place;
            frame == 1 && off.position.iter().all(|v| v.abs() < 1e-9) && off.yaw_rad().abs() < 1e-9
        };
        assert!(near(laid[4], turned) && near(laid[3], turned * at(7.0, 1.0, 0.0)), "{laid:?}");
    }
}
