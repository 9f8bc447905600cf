use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::super::asked::ASK_GAP;
use super::*;
use crate::features::Feedback;
use crate::features::thumbnail::thumbnail_of;
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;
use crate::geometry::{CameraModel, Se3};
use crate::image::{GreyImage, Pyramid};
use crate::map::saved::{Ids, MapHead};
use crate::map::scale::{MapScale, ScaleSource, ScaleSources};
use crate::map::{AssumedDistance, Landmark, LandmarkId, TurnId, examples};
use crate::motion::scale::{ScaleFusion, ScaleMeasurement};
use crate::reconstruction::odometry::Odometry;
use crate::reconstruction::track::search::Match;
use crate::reconstruction::track::template::observe;
use crate::reconstruction::{InlineWorker, PoseEstimate, ReconstructionConfig};

const FOCAL_PX: f64 = 300.0;
const FRAME_NS: i64 = 33_000_000;
/// Units of the other run to one of this.
const OTHER_UNIT: f64 = 3.0;

fn camera() -> CameraModel {
    CameraModel::new(320, 240, FOCAL_PX, FOCAL_PX, 159.5, 119.5, [0.0; 5]).expect("a camera")
}

/// A wall of speckles at distance 1, seen by a camera that has moved to the right by `shift` px at its distance; others at another place.
fn wall(shift: usize, place: u32) -> Arc<Pyramid> {
    let mut picture = GreyImage::new(320, 240);
    let speckle = |x: usize, y: usize| {
        let mixed = ((x as u32).wrapping_mul(0x9E37_79B9) ^ (y as u32 + 31 * place).wrapping_mul(0x85EB_CA6B))
            .wrapping_mul(0xC2B2_AE35);
        ((mixed >> 15).wrapping_mul(0x27D4_EB2F) >> 24) as u8 / 4
    };
    for (i, pixel) in picture.data.iter_mut().enumerate() {
        let (x, y) = (i % 320 + shift, i / 320);
        *pixel = 40 + speckle(x / 6, y / 6) + speckle(x / 30 + 977, y / 30);
    }
    let mut pyramid = Pyramid::new(4);
    pyramid.build(&picture);
    Arc::new(pyramid)
}

fn moved(shift: usize, unit: f64) -> Se3<Camera, World> {
    Se3::new(UnitQuaternion::identity(), Vector3::x() * (-unit * shift as f64 / FOCAL_PX))
}

/// Keyframes that have moved so far along a wall, and landmarks all over it. `first_ns`: time of the first one.
fn map_of(shifts: &[usize], place: u32, (unit, first_ns): (f64, i64)) -> Map {
    let camera = camera();
    let mut map = Map::default();
    let ids: Vec<KeyframeId> = (0..)
        .zip(shifts)
        .map(|(i, &shift)| {
            let keyframe = examples::keyframe(wall(shift, place), moved(shift, unit));
            let thumbnail = thumbnail_of(keyframe.picture.pyramid());
            map.add_keyframe(Keyframe { timestamp_ns: first_ns + FRAME_NS * i, thumbnail, ..keyframe })
        })
        .collect();
    for n in 0..40 * 11 {
        let (x, y) = (24.0 + 18.0 * (n % 40) as f32, 24.0 + 18.0 * (n / 40) as f32);
        let pixel = |shift: usize| Some(Vector2::new(x - shift as f32, y)).filter(|p| (16.0..304.0).contains(&p.x));
        let seen: Vec<_> = ids
            .iter()
            .zip(shifts)
            .filter_map(|(id, shift)| Some((*id, observe(&camera, LandmarkId(0), pixel(*shift)?, 1.0)?)))
            .collect();
        if seen.len() >= 2 {
            let ray = Vector3::new((f64::from(x) - 159.5) / FOCAL_PX, (f64::from(y) - 119.5) / FOCAL_PX, 1.0);
            let landmark = examples::landmark(ray * unit, seen[0].0);
            let covariance = landmark.covariance * 1e-6;
            map.add_landmark(Landmark { covariance, sought: 9, found: 9, ..landmark }, &seen);
        }
    }
    map
}

/// Tracking in a map of three keyframes along the wall, at the last of them.
fn tracking() -> Reconstruction {
    let config = ReconstructionConfig::default();
    let mut r = Reconstruction::new(&config, &camera(), Box::new(InlineWorker::default()), true);
    r.active.map = map_of(&[0, 60, 120], 0, (1.0, FRAME_NS));
    r.active.reference = KeyframeId(2);
    r.active.odometry = Odometry::begin(0, moved(120, 1.0));
    r.state = TrackingState::Tracking;
    r
}

fn saved(maps: Vec<Map>) -> SavedMaps {
    let optics = tracking().take_changes(true).optics;
    let one = |(number, map): (u32, Map)| {
        let reference = KeyframeId(map.keyframes.ids().next().unwrap_or_default());
        let head = MapHead { id: MapId(0), reference, frames: 9, scale: MapScale::Unknown, turns: vec![] };
        let alone = SavedMaps { frame_ns: 0, optics: optics.clone(), maps: vec![SavedMap { head, map }] };
        let from = Ids { maps: 10 * number, keyframes: 100 * number, landmarks: 1000 * number };
        alone.renumbered(from).expect("room for them").maps
    };
    let maps = (0..).zip(maps).flat_map(one).collect();
    SavedMaps { frame_ns: 0, optics: optics.clone(), maps }
}

/// With ids that a run gets them with.
fn for_run(r: &Reconstruction, maps: Vec<Map>) -> SavedMaps {
    let given = r.given_ids();
    let from = Ids { maps: given.maps + 16, keyframes: given.keyframes + 1000, landmarks: given.landmarks + 1000 };
    saved(maps).renumbered(from).expect("room for them")
}

/// Four keyframes along the same wall, of another day.
fn another_day() -> Map {
    map_of(&[20, 80, 140, 200], 0, (OTHER_UNIT, 86_400_000_000_000))
}

fn stand(r: &mut Reconstruction, frames: std::ops::Range<i64>) -> PoseEstimate {
    let mut last = None;
    for i in frames {
        let features = FrameFeatures {
            sequence: i as u64,
            timestamp_ns: FRAME_NS * (9 + i),
            pyramid: wall(124, 0),
            ..FrameFeatures::default()
        };
        last = Some(r.track(&features));
        r.map(&features, &mut Feedback::default());
    }
    last.expect("a frame")
}

#[test]
fn a_merged_map_is_joined_while_the_robot_stands_and_frame_number_and_reset_counter_stay() {
    let mut r = tracking();
    let before = stand(&mut r, 0..2);
    let loaded = for_run(&r, vec![another_day()]);
    assert_eq!(r.merge(loaded), Ok(Waiting { maps: 1, keyframes: 4 }));
    assert_eq!((r.maps(), r.counters().maps_joined), (2, 0));
    let (mut after, mut frames) = (before.clone(), 0);
    while r.counters().maps_joined == 0 && frames < 400 {
        after = stand(&mut r, 2 + frames..3 + frames);
        frames += 1;
    }
    println!("joined after {frames} frames");
    assert_eq!((r.maps(), r.counters().maps_joined), (1, 1));
    assert_eq!((after.map, after.reset_counter), (before.map, before.reset_counter));
    let x = |e: &PoseEstimate| e.world_from_camera.expect("a pose").translation;
    assert!((x(&after) - x(&before)).norm() < 0.01, "{} {}", x(&before), x(&after));
    assert!((x(&after).x - 124.0 / FOCAL_PX).abs() < 0.01);
    // All keyframes of the other day are where they were, in this map's unit.
    let map = &r.active.map;
    let others: Vec<(KeyframeId, &Keyframe)> =
        map.keyframes.iter().map(|(id, k)| (KeyframeId(id), k)).filter(|(id, _)| map.numbers.is_merged(*id)).collect();
    assert_eq!(others.len(), 4);
    for ((_, k), shift) in others.iter().zip([20.0, 80.0, 140.0, 200.0]) {
        assert!((k.centre() - Vector3::x() * (shift / FOCAL_PX)).norm() < 0.02, "{shift}: {}", k.centre());
    }
    map.check_consistency().expect("whole");
    // The robot's newest keyframe is its own, and so is the next number.
    let newest = map.newest().expect("there");
    assert!(!map.numbers.is_merged(newest) && map.keyframes.next_id() > others[3].0.0);
}

#[test]
fn a_larger_map_that_was_lost_stays_where_it_was_and_the_present_one_goes_there() {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.2, -0.5, 0.1));
    let elsewhere = Sim3::<World, World>::new(1.0, turn, Vector3::new(2.0, 0.3, -1.0));
    for is_told in [false, true] {
        let mut r = tracking();
        let before = stand(&mut r, 0..2);
        if is_told {
            let word = ScaleMeasurement { source: ScaleSource::Wheels, log_metres_per_unit: 0.4, sigma: 0.2 };
            assert!(r.add_scale(&word));
        }
        let mut lost = ActiveMap::of_another_run(for_run(&r, vec![another_day()]).maps.remove(0));
        lost.map.transform(&elsewhere);
        assert!(lost.map.keyframes.len() > r.active.map.keyframes.len());
        let there: Vec<(KeyframeId, Vector3<f64>)> =
            lost.map.keyframes.iter().map(|(id, k)| (KeyframeId(id), k.centre())).collect();
        let told = Sim3::new(1.0 / OTHER_UNIT, UnitQuaternion::identity(), Vector3::zeros()) * elsewhere.inverse();
        let revision = r.corrections.revision;
        r.join(OtherMap::new(lost), &told, 0.01);
        // A unit that something has told stays; about its origin the other map lies as it did.
        let unit = if is_told { OTHER_UNIT.recip() } else { 1.0 };
        for (id, centre) in &there {
            let now = r.active.map.keyframe(*id).expect("a part").centre();
            assert!((now - centre * unit).norm() < 1e-9, "{is_told}: {now} for {centre}");
        }
        let here = elsewhere.transform(&(Vector3::x() * (OTHER_UNIT * 124.0 / FOCAL_PX))) * unit;
        let after = stand(&mut r, 2..3);
        let x = after.world_from_camera.expect("a pose").translation;
        assert!((x - here).norm() < 0.01, "{is_told}: {x} for {here}");
        assert_eq!((after.map, after.reset_counter), (before.map, before.reset_counter));
        assert_eq!(r.corrections.revision, revision + 1);
        let was = before.world_from_camera.expect("a pose").translation;
        assert!((r.corrections.distance - (here - was).norm()).abs() < 0.02, "{}", r.corrections.distance);
        let odom = |e: &PoseEstimate| e.odom_from_camera.expect("a smooth pose").translation;
        assert!((odom(&after) - odom(&before)).norm() < 0.01, "the smooth pose does not jump");
        r.active.map.check_consistency().expect("whole");
    }
}

#[test]
fn a_larger_map_that_was_lost_is_metric_still_and_comes_over_where_this_one_was_placed() {
    for is_placed in [false, true] {
        let mut r = tracking();
        let before = stand(&mut r, 0..2);
        if is_placed {
            r.hold_frame();
        }
        let mut saved = for_run(&r, vec![another_day()]).maps.remove(0);
        saved.head.scale = MapScale::Metric { sigma: 0.01, sources: ScaleSources::default().with(ScaleSource::Wheels) };
        let lost = ActiveMap::of_another_run(saved);
        let last = lost.map.newest().expect("four");
        let there = lost.map.keyframe(last).expect("there").centre();
        let told = Sim3::new(1.0 / OTHER_UNIT, UnitQuaternion::identity(), Vector3::zeros());
        r.join(OtherMap::new(lost), &told, 0.05);
        let now = r.active.map.keyframe(last).expect("a part").centre();
        if is_placed {
            assert!((now - there / OTHER_UNIT).norm() < 1e-9, "{now}");
            continue;
        }
        assert!((now - there).norm() < 1e-9, "{now} for {there}");
        let after = stand(&mut r, 2..4);
        assert!(
            matches!(after.scale, MapScale::Metric { sigma, .. } if (sigma - 0.01).abs() < 1e-6),
            "{:?}",
            after.scale
        );
        let x = after.world_from_camera.expect("a pose").translation.x;
        assert!((x - OTHER_UNIT * 124.0 / FOCAL_PX).abs() < 0.01, "{x}");
        assert_eq!(after.reset_counter, before.reset_counter + 1, "its lengths are metres now");
    }
}

#[test]
fn a_smaller_map_that_was_lost_gives_its_frame_back_where_a_planner_had_placed_it_alone() {
    for [here, there] in [[false, false], [false, true], [true, false], [true, true]] {
        let mut r = tracking();
        stand(&mut r, 0..2);
        if here {
            r.hold_frame();
        }
        let saved = for_run(&r, vec![another_day()]).maps.remove(0);
        let mut lost = ActiveMap { is_placed: there, ..ActiveMap::of_another_run(saved) };
        let last = lost.map.newest().expect("four");
        let others: Vec<u32> = lost.map.keyframes.ids().filter(|id| *id != last.0).collect();
        others.into_iter().for_each(|id| _ = lost.map.remove_keyframe(KeyframeId(id)));
        assert!(lost.map.keyframes.len() < r.active.map.keyframes.len());
        let was = lost.map.keyframe(last).expect("there").centre();
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * 0.3);
        let told = Sim3::new(1.0 / OTHER_UNIT, turn, Vector3::x());
        let joined = told.transform(&was);
        r.join(OtherMap::new(lost), &told, 0.05);
        let now = r.active.map.keyframe(last).expect("a part").centre();
        let gives_back = there && !here;
        let expected = if gives_back { was } else { joined };
        assert!((now - expected).norm() < 1e-9, "{here} {there}: {now}");
        assert_eq!(r.is_placed(), here || there, "a planner's word holds in what is left");
    }
}

#[test]
fn a_planners_word_holds_of_the_last_map_that_it_was_said_of_and_in_that_ones_unit() {
    let mut r = tracking();
    stand(&mut r, 0..2);
    let another = || {
        let saved = for_run(&r, vec![another_day()]).maps.remove(0);
        OtherMap::new(ActiveMap { is_placed: true, ..ActiveMap::of_another_run(saved) })
    };
    let (lost, kept) = (another(), another());
    r.others.add(kept);
    // Lengths were of no known unit when it was said, and are metres now.
    let metric = MapScale::Metric { sigma: 0.01, sources: ScaleSources::default().with(ScaleSource::Wheels) };
    r.active.fusion = ScaleFusion::of_stored(metric);
    r.join(lost, &Sim3::new(1.0 / OTHER_UNIT, UnitQuaternion::identity(), Vector3::x()), 0.05);
    assert!(!r.is_placed());
    assert!(r.others.kept[0].own.is_placed);
    r.hold_frame();
    assert!(r.is_placed() && !r.others.kept[0].own.is_placed);
}

#[test]
fn what_waits_to_be_joined_is_in_no_file_and_what_was_joined_is() {
    let mut r = tracking();
    stand(&mut r, 0..2);
    r.take_changes(true);
    let loaded = for_run(&r, vec![another_day()]);
    r.merge(loaded).expect("kept");
    assert!(!r.has_changes(), "nothing of the present map");
    let everything = r.take_changes(true);
    assert_eq!((everything.maps.len(), everything.keyframes.len()), (1, r.active.map.keyframes.len()));
    stand(&mut r, 2..402);
    let joined = r.take_changes(false);
    assert_eq!((r.counters().maps_joined, joined.maps.len()), (1, 1));
    let (_, ids) = &joined.maps[0];
    let new = |id: &&u32| r.active.map.numbers.is_merged(KeyframeId(**id));
    assert_eq!(ids.iter().filter(new).count(), 4);
    assert_eq!(joined.keyframes.iter().filter(|(id, _)| new(&id)).count(), 4);
}

#[test]
fn what_cannot_be_merged_is_refused_and_changes_nothing() {
    let mut r = tracking();
    stand(&mut r, 0..2);
    let refused = |r: &mut Reconstruction, maps: Vec<Map>, why: &str| {
        let before = (r.given_ids(), r.maps(), r.total_keyframes());
        let loaded = for_run(r, maps);
        let told = r.merge(loaded).expect_err(why);
        assert!(told.contains(why), "{told}");
        assert_eq!((r.given_ids(), r.maps(), r.total_keyframes()), before);
    };
    refused(&mut r, vec![map_of(&[0, 60], 0, (1.0, 0))], "no map of 4 keyframes");
    refused(&mut r, vec![map_of(&[0, 60, 120, 180], 0, (1.0, FRAME_NS))], "already");
    r.config.max_keyframes = r.total_keyframes() + 3;
    refused(&mut r, vec![another_day()], "max_keyframes");
    r.config.max_keyframes += 100;
    r.localise_only = true;
    refused(&mut r, vec![another_day()], "only located in");
    r.localise_only = false;
    // While it waits, and once it was joined; then the whole map, as a copy would have it.
    let loaded = for_run(&r, vec![another_day()]);
    r.merge(loaded).expect("kept");
    refused(&mut r, vec![another_day()], "already");
    stand(&mut r, 2..402);
    assert_eq!(r.counters().maps_joined, 1);
    refused(&mut r, vec![another_day()], "already");
    // Elsewhere at the same moments, as two recordings may be: not the same.
    let loaded = for_run(&r, vec![map_of(&[20, 80, 140, 200], 9, (OTHER_UNIT, 86_400_000_000_000))]);
    r.merge(loaded).expect("another wall");
    for place in 10..17 {
        let loaded = for_run(&r, vec![map_of(&[20, 80, 140, 200], place, (1.0, i64::from(place)))]);
        r.merge(loaded).expect("there is room");
    }
    refused(&mut r, vec![map_of(&[20, 80, 140, 200], 17, (1.0, 17))], "wait to be joined");
    r.reset();
    refused(&mut r, vec![another_day()], "no map yet");
}

#[test]
fn all_maps_of_a_file_are_taken_but_those_that_are_worth_nothing() {
    let mut r = tracking();
    stand(&mut r, 0..2);
    let small = map_of(&[0, 60, 120], 8, (1.0, 70));
    let far = map_of(&[0, 60, 120, 180, 240], 9, (1.0, 90));
    let loaded = for_run(&r, vec![another_day(), small, far]);
    let next = [&loaded.maps[0], &loaded.maps[2]].map(|m| m.map.keyframes.next_id());
    assert_eq!(r.merge(loaded), Ok(Waiting { maps: 2, keyframes: 9 }));
    let kept: Vec<usize> = r.others.merged().map(|other| other.own.map.keyframes.len()).collect();
    assert_eq!(kept, [4, 5]);
    assert!(next.iter().all(|next| *next <= r.active.map.keyframes.next_id()));
    assert!(r.others.merged().all(|other| other.own.id < r.active.next_id));
}

#[test]
fn another_place_is_never_joined() {
    let mut r = tracking();
    stand(&mut r, 0..2);
    let loaded = for_run(&r, vec![map_of(&[20, 80, 140, 200], 5, (1.0, 7))]);
    r.merge(loaded).expect("kept");
    stand(&mut r, 2..300);
    assert_eq!((r.maps(), r.counters().maps_joined), (2, 0));
    assert!(r.others.asked.rounds >= 4 && r.others.asked.gap > ASK_GAP, "{:?}", r.others.asked);
}

#[test]
fn a_keyframe_that_is_asked_again_is_no_second_witness() {
    let mut r = tracking();
    let loaded = for_run(&r, vec![another_day()]);
    r.merge(loaded).expect("kept");
    let see = |r: &mut Reconstruction, id: u32| {
        let features = seen_from(&r.active.map, KeyframeId(id)).expect("a picture");
        let sighting = r.find_in(0, &features, KeyframeId(id), &[]).expect("known");
        r.hear_sighting(0, sighting);
    };
    (0..3).for_each(|_| see(&mut r, 1));
    assert_eq!((r.maps(), r.others.kept[0].sightings.len()), (2, 1));
    see(&mut r, 2);
    assert_eq!((r.maps(), r.counters().maps_joined), (1, 1));
}

#[test]
fn nothing_is_asked_in_a_turn_on_the_spot_or_while_the_robot_is_lost() {
    let mut r = tracking();
    stand(&mut r, 0..2);
    let loaded = for_run(&r, vec![another_day()]);
    r.merge(loaded).expect("kept");
    while r.loops.is_entering() {
        r.enter_loaded();
    }
    let asked = |r: &mut Reconstruction| {
        r.counters.frames += 1000;
        r.others.asked = Asked::default();
        r.ask_older();
        r.others.asked.before.is_some()
    };
    r.pending.turned = Some(0.0);
    assert!(!asked(&mut r));
    r.pending.turned = None;
    r.state = TrackingState::Lost;
    assert!(!asked(&mut r));
    r.state = TrackingState::Tracking;
    assert!(asked(&mut r));
    // A keyframe whose own place rests on assumptions tells nothing either.
    let map = &r.active.map;
    assert!(map.detailed().all(|id| seen_from(map, id).is_some()));
    let assumed = Some(AssumedDistance { inverse: 1.0, sigma: 0.5 });
    let landmarks = map.landmarks.iter().map(|(id, l)| (id, Landmark { assumed, ..l.clone() })).collect();
    let keyframes = map.keyframes.iter().map(|(id, k)| (id, k.clone())).collect();
    let blind = Map::restored(keyframes, landmarks).expect("it fits");
    assert!(blind.detailed().all(|id| seen_from(&blind, id).is_none()));
}

#[test]
fn what_is_inherited_is_as_unsure_as_the_join_and_the_turns_on_both_sides() {
    let mut r = tracking();
    let metric = |sigma| {
        ScaleFusion::of_stored(MapScale::Metric { sigma, sources: ScaleSources::default().with(ScaleSource::Tag) })
    };
    let other = |is_merged| {
        let SavedMap { head, map } = saved(vec![another_day()]).maps.remove(0);
        let own = ActiveMap { fusion: metric(0.01), ..ActiveMap::of_another_run(SavedMap { head, map }) };
        OtherMap { is_merged, ..OtherMap::new(own) }
    };
    let sighting = |keyframe: u32, other: &OtherMap| {
        let found = other.own.map.keyframe(other.own.reference).into_iter().flat_map(|k| k.observations.iter());
        let found = found.map(|o| Match {
            landmark: o.landmark,
            template: other.own.reference,
            point: Vector3::z(),
            pixel: o.pixel,
            normalised: o.normalised,
            displacement: Vector2::zeros(),
            inv_sigma_px: 1.0,
            inlier: true,
            is_alike: true,
        });
        Sighting { keyframe: KeyframeId(keyframe), there: Se3::identity(), found: found.collect() }
    };
    let told = |scale: f64| {
        let rotation = UnitQuaternion::identity();
        Similarity { present_from_other: Sim3::new(scale, rotation, Vector3::zeros()), log_scale_sigma: 0.02 }
    };
    let sigma = |r: &Reconstruction, other: &OtherMap, scale: f64| {
        let by = [sighting(0, other), sighting(1, other)];
        r.join_sigma(other, [&by[0], &by[1]], &told(scale))
    };
    let near = |a: Option<f64>, b: f64| assert!(a.is_some_and(|a| (a - b).abs() < 1e-9), "{a:?} {b}");
    let (mut merged, lost) = (other(true), other(false));
    near(sigma(&r, &merged, 1.7), 0.02);
    assert_eq!(sigma(&r, &lost, 1.7), Some(MAX_SCALE_SIGMA), "a map of the same run: as always");
    // Behind a turn on the spot in the present map, and in the other one.
    let turn = r.active.scale.add(&r.active.map, KeyframeId(0), None, true);
    r.active.map.set_scale_origin(KeyframeId(1), turn);
    let behind = r.active.scale.sigma_behind(turn, false);
    assert!(behind > 0.4);
    near(sigma(&r, &merged, 1.7), 0.02_f64.hypot(behind));
    let theirs = merged.own.scale.add(&merged.own.map, merged.own.reference, None, false);
    let ids: Vec<u32> = merged.own.map.keyframes.ids().collect();
    ids.iter().for_each(|id| merged.own.map.set_scale_origin(KeyframeId(*id), theirs));
    let there = merged.own.scale.sigma_behind(theirs, false);
    near(sigma(&r, &merged, 1.7), 0.02_f64.hypot(behind).hypot(there));
    assert_eq!(sigma(&r, &lost, 1.7), Some(MAX_SCALE_SIGMA));
    // Both metric, and no turn: metres are metres.
    let mut r = tracking();
    r.active.fusion = metric(0.01);
    let merged = other(true);
    near(sigma(&r, &merged, 1.05), 0.02);
    assert!(sigma(&r, &merged, 1.7).is_none() && sigma(&r, &other(false), 1.7).is_some());
    assert_eq!(TurnId(0), turn.expect("a turn"));
}
