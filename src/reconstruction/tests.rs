//! Of a frame's journey as a whole: what no step of it shows alone.

use std::sync::Arc;

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use super::consensus::PosedViews;
use super::odometry::Odometry;
use super::relocalise::other_maps::OtherMap;
use super::track::association::Target;
use super::track::template::observe;
use super::*;
use crate::features::Track;
use crate::features::thumbnail::Thumbnail;
use crate::image::{GreyImage, Pyramid};
use crate::map::saved::{MapHead, SavedMap, SavedMaps};
use crate::map::scale::{MapScale, ScaleSource, ScaleSources};
use crate::map::{Keyframe, KeyframeId, Landmark, LandmarkId, Map, MapId, TurnId, examples};
use crate::motion::scale::{ScaleFusion, ScaleMeasurement};

pub(super) const FOCAL_PX: f64 = 300.0;
pub(super) const FRAME_NS: i64 = 33_000_000;

pub(super) fn camera() -> CameraModel {
    CameraModel::new(320, 240, FOCAL_PX, FOCAL_PX, 159.5, 119.5, [0.0; 5]).unwrap()
}

/// A wall of speckles at distance 1, seen by a camera that has moved to the right by `shift` px at its distance.
pub(super) fn wall(shift: usize) -> Pyramid {
    let mut picture = GreyImage::new(320, 240);
    let speckle = |x: usize, y: usize| {
        let mixed =
            ((x as u32).wrapping_mul(0x9E37_79B9) ^ (y as u32).wrapping_mul(0x85EB_CA6B)).wrapping_mul(0xC2B2_AE35);
        ((mixed >> 15).wrapping_mul(0x27D4_EB2F) >> 24) as u8 / 4
    };
    for (i, pixel) in picture.data.iter_mut().enumerate() {
        // Fine ones for landmarks, coarse ones for thumbnails.
        let (x, y) = (i % 320 + shift, i / 320);
        *pixel = 40 + speckle(x / 6, y / 6) + speckle(x / 30 + 977, y / 30);
    }
    let mut pyramid = Pyramid::new(4);
    pyramid.build(&picture);
    pyramid
}

fn keyframe(camera_from_world: Se3<Camera, World>, pyramid: Pyramid) -> Keyframe {
    let mut thumbnail = Thumbnail::default();
    thumbnail.build(&pyramid);
    Keyframe { thumbnail, ..examples::keyframe(Arc::new(pyramid), camera_from_world) }
}

/// Tracking in a map of one keyframe at the world's origin, which sees 165 landmarks on the wall; the frame before was at `last`.
fn before_the_wall(last: Se3<Camera, World>) -> Reconstruction {
    let camera = camera();
    let mut map = Map::default();
    let id = map.add_keyframe(keyframe(Se3::identity(), wall(0)));
    for n in 0..165 {
        let pixel = Vector2::new(24.0 + 18.0 * (n % 15) as f32, 24.0 + 18.0 * (n / 15) as f32);
        let seen = observe(&camera, LandmarkId::default(), pixel, 1.0).unwrap();
        let landmark = Landmark::new(seen.normalised.push(1.0), Matrix3::identity() * 1e-8, id);
        map.add_landmark(Landmark { sought: 9, found: 9, ..landmark }, &[(id, seen)]);
    }
    let config = ReconstructionConfig::default();
    let mut reconstruction = Reconstruction::new(&config, &camera, Box::new(InlineWorker::default()), true);
    reconstruction.active.map = map;
    reconstruction.active.reference = id;
    reconstruction.active.odometry = Odometry::begin(0, last);
    reconstruction.state = TrackingState::Tracking;
    reconstruction
}

pub(super) fn frame(timestamp_ns: i64, shift: usize) -> FrameFeatures {
    let pyramid = Arc::new(wall(shift));
    FrameFeatures { sequence: 1, timestamp_ns, arrival_ns: 0, decoded_ns: 0, pyramid, tracks: Vec::new() }
}

fn looking_aside(rad: f64) -> Se3<Camera, World> {
    Se3::new(UnitQuaternion::from_scaled_axis(Vector3::y() * rad), Vector3::zeros())
}

fn events(reconstruction: &mut Reconstruction) -> Vec<TrajectoryEvent> {
    let mut out = Vec::new();
    reconstruction.take_trajectory_events(&mut out);
    out
}

/// Poses that the record holds: time stamp, world position by the reference keyframe's own pose.
fn recorded(reconstruction: &mut Reconstruction) -> Vec<(i64, Vector3<f64>)> {
    let place = |e: &TrajectoryEvent| match e {
        TrajectoryEvent::Pose { timestamp_ns, keyframe_from_camera, .. } => {
            Some((*timestamp_ns, keyframe_from_camera.translation))
        }
        _ => None,
    };
    events(reconstruction).iter().filter_map(place).collect()
}

#[test]
fn a_pose_replaced_behind_a_turn_is_replaced_in_the_record() {
    let mut reconstruction = before_the_wall(Se3::identity());
    let at = |x: f64| Se3::new(UnitQuaternion::identity(), Vector3::new(-x, 0.0, 0.0));
    reconstruction.record_pose(100, &at(0.1));
    reconstruction.record_pose(200, &at(0.2));
    reconstruction.record_instead(200, &at(0.5));
    let expected = [(100, Vector3::x() * 0.1), (200, Vector3::x() * 0.5)];
    assert_eq!(
        recorded(&mut reconstruction),
        expected,
        "one pose a frame, the later one, and the frame before it as it was"
    );

    // A frame whose pose was drained already, or that had none: nothing is invented for it.
    reconstruction.record_instead(200, &at(0.7));
    reconstruction.record_pose(300, &at(0.3));
    reconstruction.record_instead(400, &at(0.9));
    assert_eq!(recorded(&mut reconstruction), [(300, Vector3::x() * 0.3)]);
}

#[test]
fn a_pose_by_few_tracks_that_finds_little_gives_way_to_constant_velocity() {
    let mut reconstruction = before_the_wall(Se3::identity());
    reconstruction.track(&frame(FRAME_NS, 0));
    // Twelve tracks have slipped as if the camera had rolled by six degrees: about the picture's middle alone landmarks are near there.
    let rolled = UnitQuaternion::from_scaled_axis(Vector3::z() * 0.105);
    let bound = [
        (25, 0),
        (60, 1),
        (75, 2),
        (81, 3),
        (83, 4),
        (97, 5),
        (112, 6),
        (3, 7),
        (11, 8),
        (150, 9),
        (161, 10),
        (45, 11),
    ];
    let tracks = bound.map(|(landmark, id)| {
        let landmark = LandmarkId(landmark);
        let at = reconstruction.active.map.landmark(landmark).unwrap().position;
        reconstruction.active.bindings.set(id, Target::Landmark(landmark));
        let position = camera().project(&(rolled * at)).unwrap().cast();
        Track { id, position, age: 3 }
    });
    let features = FrameFeatures { tracks: tracks.to_vec(), ..frame(2 * FRAME_NS, 2) };
    let estimate = reconstruction.track(&features);
    let (found, sought) = (estimate.landmarks, estimate.landmarks_sought);
    assert!(10 * found >= 9 * sought, "{found} of {sought}");
    let x = estimate.world_from_camera.unwrap().translation.x;
    assert!((x - 2.0 / FOCAL_PX).abs() < 1e-3, "{x}");
}

#[test]
fn a_frame_found_elsewhere_leaves_the_matches_of_its_own_search() {
    // The prediction looks 70 degrees aside, where nothing of the map is; the thumbnail knows the view.
    let mut reconstruction = before_the_wall(looking_aside(1.2));
    let features = frame(FRAME_NS, 4);
    let tracked = reconstruction.place(&features, None).expect("the view of the only keyframe");
    let moved = tracked.camera_from_world.inverse().translation - Vector3::new(4.0 / FOCAL_PX, 0.0, 0.0);
    assert!(
        moved.norm() < 0.005 && tracked.camera_from_world.rotation.angle() < 0.005,
        "{:?}",
        tracked.camera_from_world
    );
    let matches: Vec<_> = reconstruction.tracker.inliers().copied().collect();
    assert_eq!(matches.len(), tracked.landmarks, "what the map will learn from is what the pose rests on");
    for m in &matches {
        let seen = camera().project(&tracked.camera_from_world.transform(&m.point)).expect("before the camera");
        assert!((seen - m.pixel.cast::<f64>()).norm() < 1.5, "matched at {}, seen at {seen}", m.pixel);
    }
    // The usual search's own buffers are kept for the next time.
    assert_eq!(reconstruction.relocaliser.tracker.inliers().count(), 0, "the failed search found nothing");
}

#[test]
fn a_frame_found_where_it_was_expected_is_not_looked_for_elsewhere() {
    let mut reconstruction = before_the_wall(Se3::identity());
    let tracked = reconstruction.place(&frame(FRAME_NS, 4), None).expect("near the frame before");
    assert!(tracked.landmarks > 60, "{} landmarks", tracked.landmarks);
    assert_eq!(reconstruction.tracker.inliers().count(), tracked.landmarks);
    assert!(reconstruction.relocaliser.tracker.matches().is_empty());
}

#[test]
fn a_frame_that_was_found_again_is_recorded_counted_and_no_keyframe() {
    let mut reconstruction = before_the_wall(looking_aside(1.2));
    reconstruction.active.odometry.lost_frames = 3;
    reconstruction.state = TrackingState::Lost;
    let estimate = reconstruction.track(&frame(FRAME_NS, 4));
    assert_eq!(estimate.state, TrackingState::Tracking);
    assert!(estimate.landmarks >= 30 && estimate.world_from_camera.is_some());
    assert_eq!(reconstruction.counters().relocalisations, 1);
    assert!(reconstruction.pending.keyframe.is_none(), "its templates would be those of a view that was just lost");
    let recorded = recorded(&mut reconstruction);
    assert!(
        matches!(recorded.as_slice(), [(FRAME_NS, at)] if (at - Vector3::x() * (4.0 / FOCAL_PX)).norm() < 0.005),
        "{recorded:?}"
    );
}

/// The landmarks say that the camera stands, and the tracks go in three directions, by so many pixels a frame.
fn moving(n: u64, pixels: f32) -> FrameFeatures {
    let place = |i: u64| {
        let (sin, cos) = (i as f32 * std::f32::consts::TAU / 3.0).sin_cos();
        let from = Vector2::new(20.0 + 28.0 * (i % 10) as f32, 50.0 + 18.0 * (i / 10) as f32);
        from + Vector2::new(cos, sin) * (pixels * n as f32)
    };
    let tracks = (0..80).map(|id| Track { id, position: place(id), age: 1 }).collect();
    FrameFeatures { sequence: n, tracks, ..frame(n as i64 * FRAME_NS, 0) }
}

#[test]
fn a_map_that_the_picture_contradicts_for_a_second_is_lost_without_what_it_grew_by() {
    let mut reconstruction = before_the_wall(Se3::identity());
    let map = &mut reconstruction.active.map;
    (0..3).for_each(|_| _ = map.add_keyframe(keyframe(Se3::identity(), wall(0))));
    let old: Vec<u32> = map.keyframes.iter().map(|k| k.0).collect();
    let mut told = Vec::new();
    for n in 1..60 {
        told.push(reconstruction.track(&moving(n, 0.9)));
        if n == 25 {
            // As one is made of a wrong pose.
            let map = &mut reconstruction.active.map;
            reconstruction.active.reference = map.add_keyframe(keyframe(Se3::identity(), wall(0)));
        }
        if reconstruction.counters().contradictions > 0 {
            break;
        }
    }
    let count = told.len();
    assert!((30..50).contains(&count), "after {count} frames");
    let tracked = told.iter().filter(|estimate| estimate.state == TrackingState::Tracking).count();
    assert_eq!((tracked, reconstruction.state), (count - 1, TrackingState::Lost));
    assert_eq!(
        told[count - 1].reset_counter,
        told[0].reset_counter + 1,
        "where it goes on has nothing to do with those poses"
    );
    let left: Vec<u32> = reconstruction.active.map.keyframes.iter().map(|k| k.0).collect();
    assert_eq!(left, old);
    assert!(left.contains(&reconstruction.active.reference.0));
    // Nothing speaks against the map: the next frame is found in it.
    let next = FrameFeatures { sequence: 61, ..frame(61 * FRAME_NS, 0) };
    assert_eq!(reconstruction.track(&next).state, TrackingState::Tracking);
}

#[test]
fn a_new_map_that_the_picture_contradicts_is_given_up_and_its_frames_have_no_pose_again() {
    let mut reconstruction = before_the_wall(Se3::identity());
    let Reconstruction { optics, initialiser, active, .. } = &mut reconstruction;
    initialiser.watch(&moving(0, 6.0), &optics.camera, optics.intrinsics.supposed(&optics.camera));
    let start: Vec<_> = initialiser.pending.drain(..).collect();
    let mut posed = PosedViews::default();
    start.iter().for_each(|frame| posed.push(frame.clone(), &Se3::identity()));
    active.probation.begin(posed, &optics.shutter);
    active.probation.keep(start);
    let map = active.id;
    let told: Vec<_> = (1..=6).map(|n| reconstruction.track(&moving(n, 6.0))).collect();
    let states: Vec<bool> = told.iter().map(|estimate| estimate.state == TrackingState::Tracking).collect();
    assert_eq!(states, [true, true, true, true, false, false], "the fifth frame that disagrees");
    assert_eq!((reconstruction.active.id.0, reconstruction.counters.resets), (map.0 + 1, 1));
    assert_eq!(told[5].reset_counter, told[0].reset_counter + 1);
    let waiting: Vec<u64> = reconstruction.initialiser.pending.iter().map(|frame| frame.sequence).collect();
    assert_eq!(waiting, [0, 1, 2, 3, 4, 5, 6]);
    let retired = |e: &TrajectoryEvent| matches!(e, TrajectoryEvent::KeyframeRetired { .. });
    assert_eq!(
        events(&mut reconstruction).iter().filter(|e| retired(e)).count(),
        1,
        "its poses are written as another map's"
    );
}

fn word(source: ScaleSource, metres_per_unit: f64, sigma: f64) -> ScaleMeasurement {
    ScaleMeasurement { source, log_metres_per_unit: metres_per_unit.ln(), sigma }
}

#[test]
fn a_map_becomes_metric_at_once_and_later_refinements_leave_the_smooth_pose() {
    let mut r = before_the_wall(Se3::identity());
    let mut feedback = Feedback::default();
    let mut step = |r: &mut Reconstruction, i: i64| {
        let features = frame(i * FRAME_NS, 4 * i as usize);
        let estimate = r.track(&features);
        r.map(&features, &mut feedback);
        estimate
    };
    let pixel = 4.0 / FOCAL_PX;
    let x = |pose: Option<Vector3<f64>>| pose.expect("a pose").x;
    let before = step(&mut r, 1);
    assert!(before.scale == MapScale::Unknown && r.base().is_none());
    assert!(r.add_scale(&word(ScaleSource::Wheels, 3.0, 0.012)));
    let last = step(&mut r, 2);
    assert_eq!((last.reset_counter, last.map), (before.reset_counter, before.map), "it is scaled after this frame");
    // Three metres to a unit: the next pose is in metres, in another map, by one reset.
    let metric = step(&mut r, 3);
    assert!(metric.scale.is_metric() && metric.state == TrackingState::Tracking && metric.landmarks > 60);
    assert_eq!((metric.reset_counter, metric.map.0), (before.reset_counter + 1, before.map.0 + 1));
    let world = |e: &PoseEstimate| x(e.world_from_camera.map(|p| p.translation));
    let odom = |e: &PoseEstimate| x(e.odom_from_camera.map(|p| p.translation));
    assert!((world(&metric) - 9.0 * pixel).abs() < 0.01 && (odom(&metric) - 9.0 * pixel).abs() < 0.01, "{metric:?}");
    assert!((metric.linear_velocity.x - 3.0 * pixel / 0.033).abs() < 0.3, "{}", metric.linear_velocity);
    // Ten per cent more: map coordinates move, with their revision; the smooth pose goes on.
    r.add_scale(&word(ScaleSource::Wheels, 1.1, 0.012));
    let (wait, refined) = (step(&mut r, 4), step(&mut r, 5));
    assert_eq!((refined.reset_counter, refined.map), (metric.reset_counter, metric.map));
    assert_eq!(refined.map_revision, wait.map_revision + 1);
    assert!((world(&refined) - 3.3 * 5.0 * pixel).abs() < 0.015);
    assert!((odom(&refined) - odom(&wait) - 3.3 * pixel).abs() < 0.01, "one step of the new length");
    let events = events(&mut r);
    let joined =
        events.iter().any(|e| matches!(e, TrajectoryEvent::MapJoined { scale, .. } if (scale - 3.0).abs() < 1e-9));
    let scaled =
        events.iter().any(|e| matches!(e, TrajectoryEvent::KeyframeScaled { scale, .. } if (scale - 1.1).abs() < 1e-9));
    assert!(joined && scaled, "a trajectory is written in the unit of its end");
    assert!(r.active.map.check_consistency().is_ok());
    // The next map is unscaled again, and has a number of its own.
    r.reset();
    assert_eq!(r.scale(), MapScale::Unknown);
    let numbers = [before.map, metric.map, r.map_id(), r.active.next_id];
    assert!(numbers.is_sorted_by(|a, b| a < b), "{numbers:?}");
}

/// Keyframes before the wall, half a unit apart behind a turn at the one at 1 and another at the one at 2; the newest is tracked.
fn behind_two_turns() -> (Reconstruction, [KeyframeId; 6]) {
    let mut r = before_the_wall(Se3::identity());
    let at = |x: f64| Se3::new(UnitQuaternion::identity(), Vector3::x() * -x);
    let ActiveMap { map, scale, .. } = &mut r.active;
    let [one, two, three, four, five] =
        [1.0, 1.5, 2.0, 2.5, 3.0].map(|x| map.add_keyframe(examples::keyframe(Default::default(), at(x))));
    let first = scale.add(map, one, None, true);
    [two, three].into_iter().for_each(|id| map.set_scale_origin(id, first));
    let second = scale.add(map, three, first, true);
    [four, five].into_iter().for_each(|id| map.set_scale_origin(id, second));
    (r.active.reference, r.active.odometry) = (five, Odometry::begin(0, at(3.0)));
    (r, [KeyframeId(0), one, two, three, four, five])
}

/// Where they are, and the turns that their scale came through.
fn places(r: &Reconstruction, ids: &[KeyframeId; 6]) -> ([f64; 6], [Option<u16>; 6]) {
    let keyframe = |id: KeyframeId| r.active.map.keyframe(id).expect("it is there");
    (ids.map(|id| keyframe(id).centre().x), ids.map(|id| keyframe(id).scale_from.map(|turn| turn.0)))
}

fn near(found: &[f64; 6], expected: &[f64; 6]) -> bool {
    found.iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-9)
}

#[test]
fn metres_behind_turns_in_a_row_leave_what_was_metric_as_long_as_it_is_and_what_lies_between_doubted() {
    let (mut r, ids) = behind_two_turns();
    let sources = ScaleSources::default().with(ScaleSource::Height);
    r.active.fusion = ScaleFusion::of_stored(MapScale::Metric { sigma: 0.01, sources });
    let sigma = |r: &Reconstruction| match r.scale() {
        MapScale::Metric { sigma, .. } => sigma,
        MapScale::Unknown => f64::NAN,
    };
    assert!(sigma(&r) > 0.5);
    // The surest word of a frame is heard, whoever told it, and wherever a driver of wheels has spoken.
    r.hear_at(ids[5], &word(ScaleSource::Height, 2.0, 0.01), 0.02);
    r.hear_at(ids[5], &word(ScaleSource::Tag, 3.0, 0.03), 0.0);
    r.follow_scale(&frame(0, 0));
    let (found, turns) = places(&r, &ids);
    assert!(near(&found, &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]), "{found:?}");
    assert_eq!(turns, [None, None, Some(1), Some(1), None, None]);
    assert!((sigma(&r) - 0.01_f64.hypot(0.02)).abs() < 1e-9, "what all heights share is in it: {}", sigma(&r));
    assert!(r.active.scale.sigma_behind(Some(TurnId(1)), false) > 0.4);
    assert!((r.active.odometry.pose().unwrap().inverse().translation.x - 5.0).abs() < 1e-9);
}

#[test]
fn the_first_metres_of_a_map_may_be_told_behind_turns_and_then_its_beginning_is_in_doubt() {
    let (mut r, ids) = behind_two_turns();
    // What was said of the beginning says nothing of the newest part.
    r.hear_at(ids[0], &word(ScaleSource::Tag, 9.0, 0.08), 0.0);
    r.hear_at(ids[5], &word(ScaleSource::Height, 2.0, 0.01), 0.0);
    let resets = r.reset_counter();
    r.follow_scale(&frame(0, 0));
    assert_eq!(r.reset_counter(), resets + 1);
    let (found, turns) = places(&r, &ids);
    assert!(near(&found, &[0.0, 2.0, 3.0, 4.0, 5.0, 6.0]), "all are twice as long: {found:?}");
    assert_eq!(turns, [Some(0), Some(0), Some(1), Some(1), None, None]);
    let MapScale::Metric { sigma, sources } = r.scale() else { panic!("it is metric") };
    assert!(sigma < 0.02 && sources == ScaleSources::default().with(ScaleSource::Height), "{sigma} {sources}");
    // Back at the beginning it is not known.
    r.active.reference = ids[0];
    assert!(matches!(r.scale(), MapScale::Metric { sigma, .. } if sigma > 0.5));
}

#[test]
fn a_map_that_begins_beside_a_loaded_one_has_a_number_that_no_keyframe_has() {
    let mut map = Map::default();
    // Made in a map of a greater number, which was joined to the one that is tracked in.
    map.add_keyframe(Keyframe { map: MapId(8), ..keyframe(Se3::identity(), wall(0)) });
    let mut fresh = before_the_wall(Se3::identity());
    let optics = fresh.take_changes(true).optics;
    let scale = MapScale::Unknown;
    let head = MapHead { id: MapId(3), reference: KeyframeId(0), frames: 9, scale, turns: Vec::new() };
    fresh.resume(SavedMaps { frame_ns: 0, optics, maps: vec![SavedMap { head, map }] }, false);
    assert_eq!((fresh.map_id(), fresh.active.next_id), (MapId(3), MapId(9)));
}

#[test]
fn maps_that_are_only_located_in_outlive_a_reset() {
    let mut mapped = before_the_wall(Se3::identity());
    let optics = mapped.take_changes(true).optics;
    let map = std::mem::take(&mut mapped.active.map);
    let scale = MapScale::Unknown;
    let head = MapHead { id: MapId(3), reference: KeyframeId(0), frames: 9, scale, turns: Vec::new() };
    let mut r =
        Reconstruction::new(&ReconstructionConfig::default(), &camera(), Box::new(InlineWorker::default()), true);
    r.resume(SavedMaps { frame_ns: 0, optics, maps: vec![SavedMap { head, map }] }, true);
    // The second frame's time is before the first one's.
    let mut resets = Vec::new();
    for time_ns in [9 * FRAME_NS, FRAME_NS] {
        let found = r.track(&frame(time_ns, 4));
        assert_eq!((found.state, found.map), (TrackingState::Tracking, MapId(3)));
        resets.push(found.reset_counter);
        r.reset();
        assert_eq!((r.state(), r.map_id(), r.active.map.keyframes.len()), (TrackingState::Lost, MapId(3), 1));
    }
    assert_eq!(resets[1], resets[0] + 1);
    // Nothing of the map in it: no other map begins.
    let features = FrameFeatures { pyramid: Arc::new(Pyramid::new(4)), ..frame(2 * FRAME_NS, 0) };
    for _ in 0..3 {
        assert_eq!((r.track(&features).state, r.maps()), (TrackingState::Lost, 1));
    }
    assert!(!events(&mut r).iter().any(|e| matches!(e, TrajectoryEvent::KeyframeRetired { .. })));
}

#[test]
fn of_maps_that_were_only_located_in_none_is_left_when_others_are_loaded() {
    let mut mapped = before_the_wall(Se3::identity());
    let optics = mapped.take_changes(true).optics;
    // Two maps, with ids from these on.
    let saved = |first: u32| {
        let map = |number: u32| {
            let mut map = Map::default();
            map.skip_ids_to(first + 10 * number, 0);
            map.add_keyframe(Keyframe { map: MapId(first + number), ..keyframe(Se3::identity(), wall(0)) });
            let (id, reference) = (MapId(first + number), KeyframeId(first + 10 * number));
            let head = MapHead { id, reference, frames: 9, scale: MapScale::Unknown, turns: Vec::new() };
            SavedMap { head, map }
        };
        SavedMaps { frame_ns: 0, optics: optics.clone(), maps: vec![map(0), map(1)] }
    };
    let mut r =
        Reconstruction::new(&ReconstructionConfig::default(), &camera(), Box::new(InlineWorker::default()), true);
    r.resume(saved(3), true);
    let resets = r.reset_counter();
    r.exchange(saved(100), true);
    let ids: Vec<u32> = r.others.kept.iter().map(|other| other.own.id.0).collect();
    assert_eq!((r.map_id(), ids, r.state()), (MapId(100), vec![101], TrackingState::Lost));
    assert!(r.localise_only && r.reset_counter() > resets);
    let retired = |e: &TrajectoryEvent| match e {
        TrajectoryEvent::KeyframeRetired { keyframe, .. } => Some(keyframe.0),
        _ => None,
    };
    let mut retired: Vec<u32> = events(&mut r).iter().filter_map(retired).collect();
    retired.sort_unstable();
    assert_eq!(retired, [3, 13]);
}

#[test]
fn keyframes_of_another_run_come_into_the_index_at_once_and_of_a_large_map_the_rest_with_the_next_frames() {
    let mut mapped = before_the_wall(Se3::identity());
    let optics = mapped.take_changes(true).optics;
    let saved = || {
        let mut map = Map::default();
        let pictures: Vec<_> = (0..20).map(|shift| wall(20 * shift)).collect();
        for n in 0..314 {
            map.add_keyframe(keyframe(Se3::identity(), pictures[n.min(19)].clone()));
        }
        // Old ones, condensed.
        for id in (0..10).map(KeyframeId) {
            map.condense_picture(id, &camera(), describe_kept);
        }
        assert_eq!(map.detailed().len(), 304);
        let scale = MapScale::Unknown;
        let head = MapHead { id: MapId(3), reference: KeyframeId(0), frames: 9, scale, turns: Vec::new() };
        SavedMaps { frame_ns: 0, optics: optics.clone(), maps: vec![SavedMap { head, map }] }
    };
    for (localise_only, loops) in [(false, true), (false, false), (true, false)] {
        let config = ReconstructionConfig { loops, ..ReconstructionConfig::default() };
        let mut r = Reconstruction::new(&config, &camera(), Box::new(InlineWorker::default()), true);
        r.resume(saved(), localise_only);
        let mut counts = vec![r.loops.entered()];
        let dark = FrameFeatures { pyramid: Arc::new(Pyramid::new(4)), ..frame(FRAME_NS, 0) };
        while r.loops.entered() < 314 && counts.len() < 20 {
            r.map(&dark, &mut Feedback::default());
            counts.push(r.loops.entered());
        }
        // The newest first; then four with pictures at a frame, and then ten without.
        assert_eq!(counts, [300, 304, 314], "{localise_only} {loops}");
        let likely = r.loops.likely(&r.active.map, &wall(20 * 4));
        assert_eq!(likely.first(), Some(&KeyframeId(4)), "a condensed one is known: {likely:?}");
        if !localise_only {
            let id = r.active.map.add_keyframe(keyframe(Se3::identity(), wall(7)));
            r.look_for_loop(&frame(2 * FRAME_NS, 7), id);
            assert_eq!(r.loops.entered(), 315, "new ones are entered, whether loops are closed or not");
        }
    }
}

#[test]
fn where_a_map_that_was_begun_beside_a_lost_one_comes_to_nothing_that_one_is_looked_for_again() {
    // As a robot's that was lost, was deceived by something that moved, and stands where it is known: no other map begins there.
    let mut r = before_the_wall(Se3::identity());
    let black = |time_ns| FrameFeatures { pyramid: Arc::new(Pyramid::default()), ..frame(time_ns, 0) };
    r.active.odometry.lose(FRAME_NS);
    let next = r.active.successor();
    let old = std::mem::replace(&mut r.active, next);
    r.active.beside = Some(old.id);
    let number = old.map.keyframes.next_id();
    r.others.keep(OtherMap::new(old), 240);
    let deceived = r.active.map.add_keyframe(Keyframe { map: r.active.id, ..keyframe(Se3::identity(), wall(3)) });
    assert_eq!(deceived.0, number);
    r.active.reference = deceived;
    r.active.odometry = Odometry::begin(2 * FRAME_NS, Se3::identity());
    r.state = TrackingState::Tracking;
    let given_up = r.track(&black(3 * FRAME_NS));
    assert_eq!((given_up.state, given_up.map), (TrackingState::Lost, MapId(0)));
    assert!(r.others.kept.is_empty() && r.active.map.check_consistency().is_ok());
    let next = (r.active.map.keyframes.next_id(), r.active.next_id);
    assert_eq!(next, (deceived.0 + 1, MapId(3)), "what follows has ids of its own");
    let found = r.track(&frame(4 * FRAME_NS, 2));
    assert_eq!((found.state, found.map, found.reset_counter), (TrackingState::Tracking, MapId(0), 1));
    let x = found.world_from_camera.map_or(f64::NAN, |pose| pose.translation.x);
    assert!((x - 2.0 / FOCAL_PX).abs() < 0.002, "{x}");
}
