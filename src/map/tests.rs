use nalgebra::Matrix2;

use super::*;
use crate::geometry::random::Random;

fn keyframe(landmarks: &[u32]) -> Keyframe {
    let observations = landmarks.iter().map(|&l| observation(l)).collect();
    Keyframe { observations, ..examples::keyframe(Default::default(), Se3::identity()) }
}

fn observation(landmark: u32) -> Observation {
    Observation {
        landmark: LandmarkId(landmark),
        pixel: Vector2::zeros(),
        normalised: Vector2::zeros(),
        displacement: Vector2::zeros(),
        inv_sigma_px: 1.0,
        normalised_from_pixel: Matrix2::identity(),
    }
}

fn landmark() -> Landmark {
    Landmark::new(Vector3::zeros(), Matrix3::zeros(), KeyframeId(0))
}

#[test]
fn a_corrected_map_looks_the_same_from_each_camera_in_its_new_unit() {
    let mut map = Map::default();
    let shift = |x: f64| Se3::new(nalgebra::UnitQuaternion::from_scaled_axis(Vector3::y() * x), Vector3::x() * x);
    let views =
        [0.0, 0.1, 0.7, 0.8].map(|x| map.add_keyframe(Keyframe { camera_from_world: shift(x), ..keyframe(&[]) }));
    let made = |made_at: usize, z: f64| Landmark {
        position: Vector3::new(0.1, 0.2, z),
        covariance: Matrix3::identity(),
        created_by: views[made_at],
        ..landmark()
    };
    let old = map.add_landmark(made(0, 2.0), &[(views[0], observation(0)), (views[2], observation(0))]);
    // Made at a keyframe that does not see it any more: it moves with the last that does.
    let new = map.add_landmark(made(0, 3.0), &[(views[1], observation(0)), (views[2], observation(0))]);
    let from = |map: &Map, k: usize, l: LandmarkId| {
        map.keyframe(views[k]).unwrap().camera_from_world.transform(&map.landmark(l).unwrap().position)
    };
    let before = [from(&map, 0, old), from(&map, 2, new), from(&map, 3, new)];
    let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.2, 0.5));
    let moved = Sim3::new(2.0, turn, Vector3::new(5.0, -1.0, 0.5));
    let keyframes = vec![(views[0], Sim3::identity()), (views[2], moved)];
    map.correct(&Correction { keyframes, younger: Some(moved) });
    assert!((from(&map, 0, old) - before[0]).norm() < 1e-12, "the first stays");
    assert!((from(&map, 2, new) - before[1] * 2.0).norm() < 1e-12);
    assert!((from(&map, 3, new) - before[2] * 2.0).norm() < 1e-12, "younger ones move as the last");
    assert_eq!(map.landmark(new).unwrap().covariance[(1, 1)].round(), 4.0);
    map.check_consistency().unwrap();
}

#[test]
fn a_map_that_is_carried_over_looks_the_same_from_its_cameras() {
    let mut random = Random::new(11);
    let pose = |random: &mut Random| {
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| random.normal()));
        Se3::new(turn, Vector3::from_fn(|_, _| random.normal()))
    };
    let mut old = Map::default();
    let views = [0, 1].map(|_| Keyframe { camera_from_world: pose(&mut random), ..keyframe(&[]) });
    let seen = views.map(|view| (old.add_keyframe(view), observation(0)));
    let place = Landmark { position: Vector3::new(1.0, 2.0, 3.0), covariance: Matrix3::identity(), ..landmark() };
    let id = old.add_landmark(place, &seen);
    let from_camera = |map: &Map, k: KeyframeId| {
        map.keyframe(k).unwrap().camera_from_world.transform(&map.landmark(id).unwrap().position)
    };
    let before = seen.map(|(k, _)| from_camera(&old, k));
    let rigid = pose(&mut random).relabel::<World, World>();
    let mut young = old.successor();
    old.transform(&Sim3::new(2.5, rigid.rotation, rigid.translation));
    for ((k, _), before) in seen.iter().zip(before) {
        assert!((from_camera(&old, *k) - before * 2.5).norm() < 1e-12);
    }
    assert!((old.landmark(id).unwrap().covariance - Matrix3::identity() * 6.25).norm() < 1e-12);

    let own = young.add_keyframe(keyframe(&[]));
    assert!(seen.iter().all(|(k, _)| *k != own), "ids go on");
    let another = young.add_keyframe(keyframe(&[]));
    let twin = young.add_landmark(landmark(), &[(own, observation(0)), (another, observation(0))]);
    young.absorb(old);
    assert_eq!((young.keyframes.len(), young.landmarks.len()), (4, 2));
    young.fuse(twin, id);
    assert_eq!((young.landmark(id).is_none(), young.landmark(twin).unwrap().observers.len()), (true, 4));
    young.check_consistency().unwrap();
    assert_eq!(young.add_keyframe(keyframe(&[])).0, another.0 + 1);
}

#[test]
fn random_edits_keep_every_link_mutual_and_counted() {
    for seed in 0..20u64 {
        let mut generator = Random::new(seed);
        let mut random = |n: u32| generator.below(n as usize) as u32;
        let mut map = Map::default();
        for step in 0..300 {
            match random(6) {
                0 | 1 => {
                    let next = map.landmarks.next_id();
                    let seen: Vec<u32> = (0..next).filter(|_| random(3) == 0).collect();
                    map.add_keyframe(keyframe(&seen));
                }
                2 | 3 => {
                    let keyframes: Vec<_> = map.keyframes.iter().map(|(id, _)| KeyframeId(id)).collect();
                    if keyframes.len() >= 2 {
                        let a = keyframes[random(keyframes.len() as u32) as usize];
                        let b = keyframes[random(keyframes.len() as u32) as usize];
                        map.add_landmark(landmark(), &[(a, observation(0)), (b, observation(0))]);
                    }
                }
                4 => map.remove_landmark(LandmarkId(random(map.landmarks.next_id().max(1)))),
                _ => {
                    let k = KeyframeId(random(map.keyframes.next_id().max(1)));
                    if random(4) == 0 {
                        map.remove_keyframe(k);
                    } else {
                        map.remove_observation(k, LandmarkId(random(map.landmarks.next_id().max(1))));
                    }
                }
            }
            if let Err(why) = map.check_consistency() {
                panic!("seed {seed}, step {step}: {why}");
            }
        }
    }
}

#[test]
fn an_adjustment_of_a_part_changes_nothing_elsewhere() {
    let mut map = Map::default();
    let views: Vec<_> = (0..100).map(|_| map.add_keyframe(keyframe(&[]))).collect();
    let pairs = |n: usize| [(views[n], observation(0)), (views[n + 1], observation(0))];
    let ids: Vec<_> = (0..99).flat_map(|n| [n; 3]).map(|n| map.add_landmark(landmark(), &pairs(n))).collect();
    // A page that is empty for good.
    ids[64..128].iter().for_each(|id| map.remove_landmark(*id));
    map.take_changed();
    let (next_keyframe, next_landmark) = (map.keyframes.next_id(), map.landmarks.next_id());
    let young = map.add_keyframe(keyframe(&[]));
    let seen = [(views[99], observation(0)), (young, observation(0))];
    let new = map.add_landmark(landmark(), &seen);
    let moved = Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::x());
    map.place_keyframe(views[98], moved.relabel());
    map.measure_landmark(ids[296], Vector3::x(), Matrix3::identity());
    map.carry_newer(next_keyframe, next_landmark, &moved);
    map.remove_observation(views[97], ids[293]);
    assert_eq!(
        (map.keyframe(young).unwrap().centre(), map.landmark(new).unwrap().position),
        (-Vector3::x(), -Vector3::x())
    );
    let (keyframes, landmarks) = map.take_changed();
    assert_eq!(keyframes, [97, 98, 99, young.0]);
    assert_eq!(landmarks, [ids[293].0, ids[296].0, new.0]);
    map.check_consistency().unwrap();
}

/// A picture in which no two patches are the same.
fn picture() -> KeyframePicture {
    let mut image = crate::image::GreyImage::new(160, 120);
    for (i, v) in image.data.iter_mut().enumerate() {
        *v = ((i as u32).wrapping_mul(0x9E37_79B9) >> 24) as u8;
    }
    let mut pyramid = crate::image::Pyramid::new(3);
    pyramid.build(&image);
    KeyframePicture::new(std::sync::Arc::new(pyramid))
}

#[test]
fn reduced_keyframes_keep_the_views_of_a_landmark_that_differ_and_lose_them_with_it() {
    let mut map = Map::default();
    // The second sees the landmark, ahead at distance 2, as the first does; the third from 20 degrees beside.
    let ids = [0.0, 0.05, 0.73].map(|x| {
        let moved = Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::new(-x, 0.0, 0.0));
        let view = Keyframe { camera_from_world: moved, picture: picture(), ..keyframe(&[]) };
        map.add_keyframe(view)
    });
    let ahead = Landmark { position: Vector3::new(0.0, 0.0, 2.0), ..landmark() };
    let seen = ids.map(|k| (k, Observation { pixel: Vector2::new(80.0, 60.0), ..observation(0) }));
    let id = map.add_landmark(ahead, &seen);
    ids.iter().for_each(|k| map.reduce_picture(*k));
    let shows = |map: &Map| ids.map(|k| map.keyframe(k).unwrap().picture.shows(id.0));
    assert!(ids.iter().all(|k| map.keyframe(*k).unwrap().picture.whole().is_none()));
    assert_eq!(shows(&map), [true, false, true]);
    map.remove_observation(ids[2], id);
    assert_eq!(shows(&map), [true, false, false]);
    map.remove_landmark(id);
    assert_eq!(shows(&map), [false; 3]);
    map.check_consistency().unwrap();
}

#[test]
fn the_graph_is_what_ties_the_map_then_the_strongest_of_what_is_covisible() {
    use graph::{EdgeView, MapGraph, Tie};
    let mut random = Random::new(9);
    let mut map = Map::default();
    let keyframes: Vec<KeyframeId> = (0..30).map(|_| map.add_keyframe(keyframe(&[]))).collect();
    for _ in 0..400 {
        let first = random.below(25);
        let seen: Vec<_> = keyframes[first..first + 5].iter().map(|k| (*k, observation(0))).collect();
        map.add_landmark(landmark(), &seen[..2 + random.below(4)]);
    }
    let ties = [(keyframes[1], keyframes[28], Tie::Loop), (keyframes[0], keyframes[1], Tie::Join(MapId(7)))];
    let gone = (KeyframeId(99), keyframes[3], Tie::Loop);
    let filled_from = |oldest: KeyframeId, limit: usize| {
        let mut graph = MapGraph::default();
        graph.fill(&map, ties.into_iter().chain([gone]), oldest, limit);
        graph
    };
    let filled = |limit: usize| filled_from(KeyframeId(0), limit);
    let whole = filled(usize::MAX);
    assert_eq!(whole.total, whole.edges.len());
    let shared = |a: KeyframeId, b: KeyframeId| {
        let own = |k| map.keyframe(k).unwrap().observations.landmarks().collect::<Vec<_>>();
        let others = own(b);
        own(a).iter().filter(|l| others.contains(l)).count() as u32
    };
    let found: Vec<(KeyframeId, KeyframeId, Tie)> = whole.edges[..2].iter().map(|e| (e.from, e.to, e.tie)).collect();
    assert_eq!(found, ties, "an edge without its keyframe is none");
    assert!(whole.edges.iter().all(|e| e.shared == shared(e.from, e.to)), "{whole:?}");
    let pairs = keyframes.iter().flat_map(|&a| keyframes.iter().map(move |&b| (a, b)));
    let covisible = pairs.filter(|&(a, b)| a < b && shared(a, b) > 0).count();
    assert_eq!(whole.edges.len(), 2 + covisible);
    assert!(whole.edges[2..].windows(2).all(|w| w[0].shared >= w[1].shared));
    for limit in [0, 1, 2, 3, 40, covisible + 1, covisible + 2] {
        let part = filled(limit);
        assert_eq!((part.edges.as_slice(), part.total), (&whole.edges[..limit], whole.total), "{limit}");
    }
    // Of a map whose older keyframes are not told no edge leads to one of these.
    for oldest in [1, 2, 17, 29, 30].map(KeyframeId) {
        let newer = filled_from(oldest, usize::MAX);
        let both: Vec<_> = whole.edges.iter().filter(|e| e.from >= oldest && e.to >= oldest).copied().collect();
        assert_eq!((newer.edges, newer.total), (both, whole.total), "{oldest:?}");
    }
    let first: &EdgeView = &whole.edges[2];
    assert!(first.from < first.to && first.tie == Tie::Covisible);
}

#[test]
fn of_more_sightings_than_are_counted_the_share_stays() {
    let mut map = Map::default();
    let seen_from = map.add_keyframe(keyframe(&[]));
    let before = Landmark { sought: Landmark::MOST_SOUGHT, found: Landmark::MOST_SOUGHT / 4, ..landmark() };
    let id = map.add_landmark(before, &[(seen_from, observation(0))]);
    map.count_sighting(id, true);
    let after = map.landmark(id).expect("there");
    assert_eq!((after.sought, after.found), (Landmark::MOST_SOUGHT / 2 + 1, Landmark::MOST_SOUGHT / 8 + 1));
}

#[test]
fn an_assumed_distance_is_told_from_the_first_observer_that_is_left() {
    let mut map = Map::default();
    let views = [0.0, 3.0, 4.0].map(|x| {
        let pose = Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::x() * -x);
        map.add_keyframe(Keyframe { camera_from_world: pose, picture: picture(), ..keyframe(&[]) })
    });
    // Assumed four in front of the first one; it was looked for nearer since.
    let assumed = AssumedDistance { inverse: 0.25, sigma: 0.05 };
    let made = Landmark { position: Vector3::z() * 2.0, assumed: Some(assumed), created_by: views[0], ..landmark() };
    let seen = views.map(|view| (view, Observation { pixel: Vector2::new(80.0, 60.0), ..observation(0) }));
    let [first, second] = [(); 2].map(|()| map.add_landmark(made.clone(), &seen));
    map.remove_observation(views[2], first);
    assert_eq!(map.landmark(first).unwrap().assumed, Some(assumed), "the last one told nothing");
    map.remove_keyframe(views[0]);
    // Three to the side and four ahead: five away, as surely as before by its share.
    let AssumedDistance { inverse, sigma } = map.landmark(second).unwrap().assumed.unwrap();
    assert!((inverse - 0.2).abs() < 1e-12 && (sigma - 0.04).abs() < 1e-12, "{inverse} +- {sigma}");
    map.check_consistency().unwrap();
}
