use nalgebra::{Matrix2, Matrix3, UnitQuaternion, Vector2, Vector3};

use super::*;
use crate::map::{Landmark, LandmarkId, MapId, Observation, examples};

const KEYFRAMES: usize = 60;
/// What the scale loses over the whole way.
const LOST: f64 = 0.3;
/// Standard deviation of a landmark: 2 % of its distance.
const SIGMA: f64 = 0.06;

fn observation() -> Observation {
    Observation {
        landmark: LandmarkId(0),
        pixel: Vector2::zeros(),
        normalised: Vector2::zeros(),
        displacement: Vector2::zeros(),
        inv_sigma_px: 1.0,
        normalised_from_pixel: Matrix2::identity(),
    }
}

/// The true way round: a circle of 2 units' radius, looking outward.
fn truth(i: usize) -> Se3<Camera, World> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * (std::f64::consts::TAU * i as f64 / KEYFRAMES as f64));
    Se3::<World, Camera>::new(turn, turn * Vector3::z() * 2.0).inverse()
}

/// Unit of lengths at a keyframe of the map against the true one.
fn unit(i: usize) -> f64 {
    (-LOST * i as f64 / KEYFRAMES as f64).exp()
}

/// A map of that way whose unit shrinks as it goes; each keyframe shares 20 landmarks with the next two.
fn drifted() -> (Map, Vec<KeyframeId>) {
    let mut map = Map::default();
    let mut pose = truth(0);
    let mut ids = Vec::new();
    for i in 0..KEYFRAMES {
        if i > 0 {
            let mut step: Se3<Camera, Camera> = (truth(i) * truth(i - 1).inverse()).relabel();
            step.translation *= unit(i);
            pose = step * pose;
        }
        ids.push(map.add_keyframe(examples::keyframe(Default::default(), pose)));
    }
    for i in 2..KEYFRAMES {
        for n in 0..20 {
            let seen = [ids[i - 2], ids[i - 1], ids[i]].map(|k| (k, observation()));
            let x = Vector3::new(0.1 * f64::from(n) - 1.0, 0.3, 3.0) * unit(i);
            let position = map.keyframe(ids[i]).expect("made").camera_from_world.inverse().transform(&x);
            let covariance = Matrix3::identity() * (SIGMA * unit(i)).powi(2);
            map.add_landmark(Landmark::new(position, covariance, ids[i]), &seen);
        }
    }
    (map, ids)
}

/// The last keyframe was recognised from the first, and this is how they truly lie to each other.
fn told(ids: &[KeyframeId]) -> LoopEdge {
    let last = KEYFRAMES - 1;
    let motion = truth(last) * truth(0).inverse();
    let scale = unit(last);
    let recognised_from_old = Sim3::new(scale, motion.rotation, motion.translation * scale);
    LoopEdge { old: ids[0], recognised: ids[last], recognised_from_old, log_scale_sigma: 0.0025, landmarks: 60 }
}

/// How far the last keyframe is from where it truly is to the first, and the logarithm of the unit of what it sees.
fn error(map: &Map, ids: &[KeyframeId]) -> (f64, f64) {
    let last = map.keyframe(ids[KEYFRAMES - 1]).expect("there");
    let own = last.observations.landmarks().last().and_then(|id| map.landmark(id)).expect("seen");
    let depth = last.camera_from_world.transform(&own.position).z;
    ((last.centre() - truth(KEYFRAMES - 1).inverse().translation).norm(), (depth / 3.0).ln())
}

#[test]
fn a_loop_gives_back_place_and_scale_and_the_first_keyframe_stays() {
    let (mut map, ids) = drifted();
    let (before, log_unit) = error(&map, &ids);
    assert!(before > 0.3 && log_unit < -0.25, "{before} {log_unit}");
    let job = LoopClosure::new(&map, ids[KEYFRAMES - 1], &[told(&ids)], &[], false).expect("a loop");
    let closed = job.run().expect("a solution");
    assert_eq!(closed.keyframes.len(), KEYFRAMES);
    map.correct(&closed);
    let (after, log_unit) = error(&map, &ids);
    assert!(after < before / 20.0, "{before} {after}");
    // The one edge gives way, too, as much as the few links of a step in 59 do.
    assert!(log_unit.abs() < LOST / 10.0, "{log_unit}");
    let first = map.keyframe(ids[0]).expect("there").camera_from_world;
    assert!((first.translation - truth(0).translation).norm() < 1e-9);
    map.check_consistency().expect("links as before");
    // Closed once, it holds: nothing moves any more.
    let again = LoopEdge { recognised_from_old: Sim3::from_se3(&relative(&map, &ids)), ..told(&ids) };
    let job =
        LoopClosure::new(&map, ids[KEYFRAMES - 1], &[again], &[(ids[0], ids[KEYFRAMES - 1])], false).expect("a loop");
    let moved = job.run().map_or(0.0, |c| {
        c.keyframes.iter().map(|(_, s)| (s.scale.ln()).abs() + s.translation.norm()).fold(0.0, f64::max)
    });
    assert!(moved < 1e-6, "{moved}");
}

fn relative(map: &Map, ids: &[KeyframeId]) -> Se3<Camera, Camera> {
    let pose = |id: KeyframeId| map.keyframe(id).expect("there").camera_from_world;
    (pose(ids[KEYFRAMES - 1]) * pose(ids[0]).inverse()).relabel()
}

#[test]
fn most_of_the_map_stays_where_the_oldest_keyframe_hangs_on_it_by_little() {
    let (map, ids) = drifted();
    let job = LoopClosure::new(&map, ids[KEYFRAMES - 1], &[told(&ids)], &[], false).expect("a loop");
    let swung = Sim3::new(0.95, UnitQuaternion::from_scaled_axis(Vector3::y() * 0.02), Vector3::new(0.4, 0.0, 0.1));
    let moved =
        |first: usize| -> Vec<_> { (0..KEYFRAMES).map(|i| if i < first { Sim3::identity() } else { swung }).collect() };
    let held = job.held_instead(&moved(3)).expect("another one");
    assert!(held >= 3);
    assert_eq!(job.held_instead(&moved(40)), None, "the oldest with most of the map");
    // Drift along the way is no reason.
    let along: Vec<_> =
        (0..KEYFRAMES).map(|i| Sim3::new(1.0, UnitQuaternion::identity(), Vector3::x() * (0.01 * i as f64))).collect();
    assert_eq!(job.held_instead(&along), None);
}

#[test]
fn a_turn_that_told_no_scale_takes_most_of_the_error() {
    let (mut map, ids) = drifted();
    // From the middle on the scale came through a turn.
    ids[30..].iter().for_each(|id| map.set_scale_origin(*id, Some(crate::map::TurnId(0))));
    let job = LoopClosure::new(&map, ids[KEYFRAMES - 1], &[told(&ids)], &[], false).expect("a loop");
    let closed = job.run().expect("a solution");
    // Three steps of 59; evenly spread it were a twentieth.
    assert!(share(&closed, 28, 31) > 2.0 / 3.0);
}

/// Of the whole change of scale, what comes between two keyframes.
fn share(closed: &Correction, from: usize, to: usize) -> f64 {
    let scale = |i: usize| closed.keyframes[i].1.scale.ln();
    (scale(to) - scale(from)) / (scale(KEYFRAMES - 1) - scale(0))
}

#[test]
fn where_landmarks_tell_the_scale_badly_most_of_the_error_is_taken_out() {
    let taken = |worse: f64| {
        let (mut map, ids) = drifted();
        let there = |l: &Landmark| (28..=31).any(|i| l.observers.contains(&ids[i]));
        let bad: Vec<_> = map.landmarks.iter().filter(|(_, l)| there(l)).map(|(id, l)| (id, l.position)).collect();
        for (id, position) in bad {
            map.measure_landmark(LandmarkId(id), position, Matrix3::identity() * (worse * SIGMA).powi(2));
        }
        let job = LoopClosure::new(&map, ids[KEYFRAMES - 1], &[told(&ids)], &[], false).expect("a loop");
        share(&job.run().expect("a solution"), 28, 31)
    };
    // Three steps of 59.
    let even = taken(1.0);
    assert!((0.02..0.1).contains(&even), "{even}");
    let weak = taken(20.0);
    assert!(weak > 0.4, "{weak}");
}

#[test]
fn a_loop_whose_end_is_gone_is_none() {
    let (mut map, ids) = drifted();
    map.remove_keyframe(ids[0]);
    assert!(LoopClosure::new(&map, ids[KEYFRAMES - 1], &[told(&ids)], &[], false).is_none());
    assert!(LoopClosure::new(&map, ids[KEYFRAMES - 1], &[], &[], false).is_none());
    assert!(LoopClosure::new(&map, ids[0], &[told(&ids)], &[], false).is_none());
}

#[test]
fn neighbours_by_number_of_different_maps_are_not_tied_unless_nothing_else_holds_them() {
    let mut map = Map::default();
    let made_in = [0, 0, 0, 1, 1, 0];
    let at = |i: usize| Se3::new(UnitQuaternion::identity(), Vector3::x() * i as f64);
    let ids: Vec<KeyframeId> = (0..)
        .zip(made_in)
        .map(|(i, map)| (at(i), MapId(map)))
        .map(|(pose, id)| map.add_keyframe(Keyframe { map: id, ..examples::keyframe(Default::default(), pose) }))
        .collect();
    let told = LoopEdge {
        old: ids[0],
        recognised: ids[5],
        recognised_from_old: Sim3::identity(),
        log_scale_sigma: 0.01,
        landmarks: 60,
    };
    let tied = |closed: &[(KeyframeId, KeyframeId)]| -> Vec<(usize, usize)> {
        let job = LoopClosure::new(&map, ids[5], &[told], closed, false).expect("a loop");
        let mut ends: Vec<_> = job.edges.iter().map(|e| (e.from, e.to)).collect();
        assert_eq!(ends.pop(), Some((0, 5)), "what was told comes last");
        ends
    };
    // The robot went on in its own map behind the other one.
    assert_eq!(tied(&[(ids[1], ids[4])]), [(0, 1), (1, 2), (3, 4), (2, 5), (1, 4)]);
    assert_eq!(tied(&[]), [(0, 1), (1, 2), (3, 4), (2, 5), (2, 3)], "somewhere it has to hang");
}
