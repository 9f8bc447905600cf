use nalgebra::{UnitQuaternion, Vector3};

use super::*;
use crate::features::tags::{CELLS, is_white};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::random::Random;
use crate::geometry::sim3::Sim3;
use crate::map::{Correction, Keyframe, examples};

fn placed(edge: f64, corner_sigma: f64, view_sigma: f64) -> PlacedTag {
    PlacedTag {
        world_from_tag: Se3::identity(),
        log_edge: edge.ln(),
        corner_variance: corner_sigma * corner_sigma,
        view_variance: view_sigma * view_sigma,
        place_sigma: 0.01,
        turn_sigma: 0.01,
        residual_px: 0.2,
        corner_px: 0.15,
        views: 10,
    }
}

fn config(size_sigma_m: f64) -> TagConfig {
    TagConfig { size_m: 0.15, size_sigma_m, ..TagConfig::default() }
}

fn combine_all(tags: &[PlacedTag], config: &TagConfig) -> Option<ScaleMeasurement> {
    combine(tags.iter().map(|tag| (tag, config.size(Target::Tag(7)))))
}

fn combined(tags: &[PlacedTag], config: &TagConfig) -> ScaleMeasurement {
    combine_all(tags, config).expect("sure enough")
}

#[test]
fn one_tag_says_metres_per_map_unit() {
    let found = combined(&[placed(0.05, 0.003, 0.004)], &config(0.0));
    assert!((found.log_metres_per_unit - 3f64.ln()).abs() < 1e-12);
    assert!((found.sigma - 0.005).abs() < 1e-12 && found.source == ScaleSource::Tag);
    // 1.5 mm of 150.
    assert!((combined(&[placed(0.05, 0.0, 0.0001)], &config(0.0015)).sigma - 0.01).abs() < 1e-5);
    assert_eq!(combine_all(&[], &config(0.0)), None);
    assert_eq!(combine_all(&[placed(0.05, 0.2, 0.0)], &config(0.0)), None, "not sure enough");
}

#[test]
fn more_tags_average_their_corners_and_not_the_keyframes() {
    let corners = combined(&[placed(0.05, 0.01, 0.0); 4], &config(0.0)).sigma;
    let keyframes = combined(&[placed(0.05, 0.0, 0.01); 4], &config(0.0)).sigma;
    assert!((corners - 0.005).abs() < 1e-12 && (keyframes - 0.01).abs() < 1e-12, "{corners} {keyframes}");
}

#[test]
fn tags_that_disagree_raise_the_sigma_and_one_of_another_size_is_left_out() {
    let agree = combined(&[0.05, 0.05, 0.05].map(|e| placed(e, 0.002, 0.0)), &config(0.0)).sigma;
    let differ = combined(&[0.0492, 0.05, 0.0508].map(|e| placed(e, 0.002, 0.0)), &config(0.0)).sigma;
    assert!(differ > 5.0 * agree, "{differ} {agree}");
    let with_stranger = combined(&[0.05, 0.05, 0.05, 0.08].map(|e| placed(e, 0.002, 0.0)), &config(0.0));
    assert!((with_stranger.log_metres_per_unit - 3f64.ln()).abs() < 1e-9);
}

#[test]
fn without_a_majority_of_one_size_tags_say_nothing() {
    let of = |edges: &[f64]| {
        let tags: Vec<PlacedTag> = edges.iter().map(|edge| placed(*edge, 0.002, 0.0)).collect();
        combine_all(&tags, &config(0.0)).map(|found| (found.log_metres_per_unit - 3f64.ln()).abs() < 1e-9)
    };
    assert_eq!(of(&[0.05, 0.05, 0.08, 0.08]), None);
    assert_eq!(of(&[0.05, 0.08]), None);
    assert_eq!(of(&[0.05, 0.08, 0.12]), None);
    assert_eq!(of(&[0.05, 0.05, 0.08]), Some(true));
    assert_eq!(of(&[0.03, 0.03, 0.05, 0.05, 0.05]), Some(true));
}

#[test]
fn several_tags_with_common_errors_of_the_keyframes_keep_the_truth_in_the_interval() {
    let mut inside = 0;
    for seed in 0..200 {
        let random = &mut Random::new(seed);
        let common = random.normal() * 0.004;
        let truth = 0.05f64;
        let tags: Vec<PlacedTag> =
            (0..5).map(|_| placed(truth * (common + 0.006 * random.normal()).exp(), 0.006, 0.004)).collect();
        let found = combined(&tags, &config(0.0));
        inside += usize::from((found.log_metres_per_unit - 3f64.ln()).abs() <= 1.96 * found.sigma);
    }
    assert!((180..=196).contains(&inside), "{inside} of 200 inside");
}

#[test]
fn wrong_values_of_the_configuration_are_named() {
    let key = |size_m, size_sigma_m, ids: &[u16]| {
        TagConfig { size_m, size_sigma_m, ids: ids.to_vec(), ..TagConfig::default() }.validate().map_err(|(key, _)| key)
    };
    assert_eq!(key(0.0, 0.0003, &[]), Ok(()));
    assert_eq!(key(0.15, 0.0003, &[0, 586]), Ok(()));
    for size_m in [15.0, -0.1, 0.001, f64::NAN, f64::INFINITY] {
        assert_eq!(key(size_m, 0.0003, &[]), Err("size_m"), "{size_m}");
    }
    for sigma in [-0.001, 0.02, f64::NAN] {
        assert_eq!(key(0.15, sigma, &[]), Err("size_sigma_m"), "{sigma}");
    }
    assert_eq!(key(0.15, 0.0003, &[587]), Err("ids"));
    assert!(Tags::new(&TagConfig::default()).is_none());
    let board = |square_m, square_sigma_m, columns, rows| {
        let chessboard = ChessboardConfig { square_m, square_sigma_m, columns, rows };
        TagConfig { chessboard, ..TagConfig::default() }.validate().map_err(|(key, _)| key)
    };
    assert_eq!((board(0.03, 0.0001, 9, 6), board(0.0, 0.0, 8, 5)), (Ok(()), Ok(())));
    for square_m in [-0.1, 0.001, 30.0, f64::NAN] {
        assert_eq!(board(square_m, 0.0001, 9, 6), Err("chessboard.square_m"), "{square_m}");
    }
    assert_eq!(board(0.03, 0.01, 9, 6), Err("chessboard.square_sigma_m"));
    for (columns, rows) in [(9, 7), (8, 6), (2, 5), (9, 40)] {
        assert_eq!(board(0.03, 0.0001, columns, rows), Err("chessboard.columns"), "{columns} by {rows}");
    }
    let dock = DockConfig { enabled: true, id: 7, ..DockConfig::default() };
    let docked = |size_m, ids: &[u16]| TagConfig { size_m, ids: ids.to_vec(), dock, ..TagConfig::default() }.validate();
    assert!(docked(0.15, &[]).is_ok() && docked(0.15, &[3, 7]).is_ok());
    assert!(docked(0.15, &[3]).is_err() && docked(0.0, &[]).is_err(), "it is not looked for");
}

/// Brightness of a print on the plane z = 0 (x right, y down, m).
type Print = dyn Fn(Vector2<f64>) -> f64;

/// Tag `id` of side `size_m`, its middle in the origin.
fn tag_print(id: u16, size_m: f64) -> Box<Print> {
    Box::new(move |place| {
        let cell = (place / size_m + Vector2::repeat(0.5)) * CELLS as f64;
        let inside = |low: f64, high: f64| cell.min() >= low && cell.max() < high;
        match () {
            () if inside(0.0, 8.0) => [25.0, 210.0][usize::from(is_white(id, cell.x as usize, cell.y as usize))],
            () if inside(-1.0, 9.0) => 210.0,
            () => 120.0,
        }
    })
}

/// A chessboard with 10 by 7 squares (9 by 6 inner corners), its middle in the origin.
fn chessboard_print(square_m: f64) -> Box<Print> {
    Box::new(move |place| {
        let square = place / square_m + Vector2::new(5.0, 3.5);
        let inside = |rim: f64| square.min() >= -rim && square.x < 10.0 + rim && square.y < 7.0 + rim;
        match () {
            () if inside(0.0) => [25.0, 210.0][(square.x as usize + square.y as usize) % 2],
            () if inside(0.7) => 210.0,
            () => 120.0,
        }
    })
}

/// What a camera with a lens sees of a print.
fn picture(
    camera: &CameraModel,
    camera_from_metres: &Se3<Camera, World>,
    print: &Print,
    tone: impl Fn(f64) -> f64,
) -> GreyImage {
    let metres_from_camera = camera_from_metres.inverse();
    let value = |pixel: Vector2<f64>| {
        let ray = metres_from_camera.rotation * camera.undistort(&pixel).expect("inside").push(1.0);
        let eye = metres_from_camera.translation;
        print((eye - ray * (eye.z / ray.z)).xy())
    };
    let mut image = GreyImage::new(camera.width as usize, camera.height as usize);
    for (i, v) in image.data.iter_mut().enumerate() {
        let at = Vector2::new((i % camera.width as usize) as f64, (i / camera.width as usize) as f64);
        let around = [[-0.3, -0.1], [0.1, -0.3], [0.3, 0.1], [-0.1, 0.3]];
        *v = tone(around.map(|by| value(at + Vector2::from(by))).iter().sum::<f64>() / 4.0).round() as u8;
    }
    image
}

/// A map whose unit is 2.5 m, with five keyframes that look at tag 9 of 0.15 m, and their pictures through a lens that bends.
fn map_before_a_tag() -> (CameraModel, Map, Vec<(KeyframeId, GreyImage)>) {
    map_before(&tag_print(9, 0.15), |light| light)
}

fn map_before(print: &Print, tone: impl Fn(f64) -> f64) -> (CameraModel, Map, Vec<(KeyframeId, GreyImage)>) {
    let camera =
        CameraModel::new(240, 180, 220.0, 221.0, 118.0, 91.0, [-0.25, 0.08, 0.001, -0.001, 0.0]).expect("valid");
    let mut map = Map::default();
    let mut pictures = Vec::new();
    for i in 0..5 {
        let angle = 0.12 * (f64::from(i) - 2.0);
        let eye = Vector3::new(angle.sin() + 0.05, -0.1, -angle.cos()) * 0.75;
        let aim = Vector3::new(0.1, 0.03 * f64::from(i), 0.0);
        let look = UnitQuaternion::face_towards(&(aim - eye), &Vector3::y()).inverse();
        let camera_from_metres: Se3<Camera, World> = Se3::new(look, -(look * eye));
        let pose = Se3::new(look, camera_from_metres.translation / 2.5);
        let id = map.add_keyframe(Keyframe { map: MapId(3), ..examples::keyframe(Default::default(), pose) });
        pictures.push((id, picture(&camera, &camera_from_metres, print, &tone)));
    }
    (camera, map, pictures)
}

#[test]
fn keyframes_that_see_a_tag_through_a_lens_tell_the_maps_scale() {
    let (camera, map, pictures) = map_before_a_tag();
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    let mut tags = Tags::new(&config(0.0003)).expect("on");
    for (i, (keyframe, picture)) in pictures.iter().enumerate() {
        assert!(tags.see((&map, MapId(3)), *keyframe, picture, &optics), "the tag is in every picture");
        assert_eq!(tags.measurement(MapId(3)).is_some(), i >= 2, "three views");
    }
    let found = tags.measurement(MapId(3)).expect("told");
    let error = found.log_metres_per_unit - 2.5f64.ln();
    assert!(error.abs() < 0.005 && error.abs() < 2.0 * found.sigma && found.sigma < 0.01, "off by {error}: {found:?}");
    let [Known { target: Target::Tag(9), placed: Some(placed), .. }] = &tags.known[..] else { panic!("tag 9") };
    assert!(placed.world_from_tag.translation.norm() < 0.005 && placed.views == 5, "{placed:?}");
    assert!(placed.world_from_tag.rotation.angle() < 0.03, "{placed:?}");

    assert_eq!(tags.measurement(MapId(4)), None, "another map");
    assert!(tags.rest_on(&map).iter().eq(pictures.iter().map(|(id, _)| id)), "all five have seen it");
    assert!(tags.rest_on(&Map::default()).is_empty());
    tags.rescale(2.5);
    let metric = tags.measurement(MapId(3)).expect("told").log_metres_per_unit;
    assert!((metric - error).abs() < 1e-12, "the map is in metres now: {metric}");
    tags.forget();
    assert_eq!(tags.measurement(MapId(3)), None);
}

#[test]
fn a_chessboard_tells_the_scale_as_a_tag_does() {
    let (camera, map, pictures) = map_before(&chessboard_print(0.04), |light| light);
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    let chessboard = ChessboardConfig { square_m: 0.04, ..ChessboardConfig::default() };
    let mut tags = Tags::new(&TagConfig { chessboard, ..TagConfig::default() }).expect("on");
    for (i, (keyframe, picture)) in pictures.iter().enumerate() {
        assert!(tags.see((&map, MapId(3)), *keyframe, picture, &optics), "the board is in every picture");
        assert_eq!(tags.measurement(MapId(3)).is_some(), i >= 2, "three views");
    }
    let found = tags.measurement(MapId(3)).expect("told");
    let error = found.log_metres_per_unit - 2.5f64.ln();
    assert!(error.abs() < 0.003 && error.abs() < 2.0 * found.sigma && found.sigma < 0.005, "off by {error}: {found:?}");
    // It has no number to be told by.
    let mut told = Vec::new();
    tags.tell(&map, &optics, &mut told);
    assert!(told.is_empty() && tags.rest_on(&map).len() == 5);
    // Where only tags are looked for, or another board, it is nothing.
    let other = ChessboardConfig { columns: 7, rows: 4, ..chessboard };
    let others = [config(0.0003), TagConfig { chessboard: other, ..TagConfig::default() }];
    for config in others {
        let mut tags = Tags::new(&config).expect("on");
        assert!(!tags.see((&map, MapId(3)), pictures[0].0, &pictures[0].1, &optics), "{config:?}");
    }
}

#[test]
fn in_a_metric_map_tags_are_held_at_the_size_that_all_sources_give_them() {
    let (camera, mut map, pictures) = map_before_a_tag();
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    let mut tags = Tags::new(&config(0.0003)).expect("on");
    let mut fusion = ScaleFusion::default();
    for (keyframe, picture) in &pictures {
        tags.see((&map, MapId(3)), *keyframe, picture, &optics);
        fusion.add(&tags.measurement(MapId(3)).unwrap_or(ScaleMeasurement {
            source: ScaleSource::Tag,
            log_metres_per_unit: 0.0,
            sigma: 1.0,
        }));
    }
    assert!(tags.held(&map, &fusion).is_empty(), "nobody knows metres yet");
    // The map becomes metric.
    let log = fusion.fused().expect("told").0;
    map.transform(&Sim3::new(log.exp(), Default::default(), Vector3::zeros()));
    tags.rescale(log.exp());
    fusion.rescale(log.exp());
    let [held] = &tags.held(&map, &fusion)[..] else { panic!("one tag") };
    let edge = |held: &HeldTag| (held.places[1] - held.places[0]).norm();
    assert!((edge(held) - 0.15).abs() < 1e-9 && held.seen.len() == 5 && held.sigma_px < 0.3, "{held:?}");
    // It lies where it is: its middle in the origin.
    let mut lies = held.from.1;
    lies.translation *= 0.15;
    let tag_from_world = lies * map.keyframe(held.from.0).expect("there").camera_from_world;
    assert!(tag_from_world.translation.norm() < 0.01, "{tag_from_world:?}");
    // Wheels that say more, as surely, are believed half.
    let sigma = tags.measurement(MapId(3)).expect("told").sigma;
    fusion.add(&ScaleMeasurement { source: ScaleSource::Wheels, log_metres_per_unit: 0.01, sigma });
    let [held] = &tags.held(&map, &fusion)[..] else { panic!("one tag") };
    assert!((edge(held) / 0.15 - 0.005f64.exp()).abs() < 1e-6, "{held:?}");
    // Behind a turn on the spot nothing is held.
    pictures.iter().for_each(|(keyframe, _)| map.set_scale_origin(*keyframe, Some(TurnId(0))));
    assert!(tags.held(&map, &fusion).is_empty());
}

#[test]
fn a_cameras_tone_curve_moves_no_scale_out_of_its_interval() {
    for exposure in [1.0, 1.5] {
        let (camera, map, pictures) =
            map_before(&tag_print(9, 0.15), |light| 255.0 * (exposure * light / 255.0).min(1.0).powf(1.0 / 2.2));
        let optics = Optics { camera: &camera, readout_s: 0.0 };
        let mut tags = Tags::new(&config(0.0003)).expect("on");
        for (keyframe, picture) in &pictures {
            assert!(tags.see((&map, MapId(3)), *keyframe, picture, &optics));
        }
        let found = tags.measurement(MapId(3)).expect("told");
        let error = found.log_metres_per_unit - 2.5f64.ln();
        eprintln!("exposure {exposure}: off by {:.3} %, sigma {:.3} %", 100.0 * error, 100.0 * found.sigma);
        assert!(error.abs() < 0.005 && error.abs() < 1.96 * found.sigma, "exposure {exposure}: {error}: {found:?}");
    }
}

#[test]
fn one_wrong_sighting_silences_no_tag_and_one_that_was_moved_is_told_anew() {
    let (camera, map, pictures) = map_before_a_tag();
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    for (wrong, kept) in [(1, 4), (2, LEAST_VIEWS)] {
        let mut tags = Tags::new(&config(0.0003)).expect("on");
        for (keyframe, picture) in &pictures[..4] {
            tags.see((&map, MapId(3)), *keyframe, picture, &optics);
        }
        for sighting in &mut tags.known[0].sightings[..wrong] {
            sighting.corners.iter_mut().for_each(|c| *c += Vector2::new(40.0, -25.0));
        }
        let (keyframe, picture) = &pictures[4];
        tags.see((&map, MapId(3)), *keyframe, picture, &optics);
        assert_eq!(tags.known[0].sightings.len(), kept, "{wrong} wrong");
        // The newest come again.
        tags.see((&map, MapId(3)), *keyframe, picture, &optics);
        let found = tags.measurement(MapId(3)).expect("told");
        let error = found.log_metres_per_unit - 2.5f64.ln();
        assert!(error.abs() < 0.01 && error.abs() < 2.0 * found.sigma, "{wrong} wrong: {error}: {found:?}");
    }
}

#[test]
fn tags_that_are_not_named_and_keyframes_that_are_gone_say_nothing() {
    let (camera, mut map, pictures) = map_before_a_tag();
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    let mut others = Tags::new(&TagConfig { ids: vec![8], ..config(0.0003) }).expect("on");
    let mut tags = Tags::new(&config(0.0003)).expect("on");
    for (keyframe, picture) in &pictures {
        assert!(!others.see((&map, MapId(3)), *keyframe, picture, &optics));
        tags.see((&map, MapId(3)), *keyframe, picture, &optics);
    }
    assert_eq!(others.measurement(MapId(3)), None);
    let (last, picture) = &pictures[4];
    for (keyframe, _) in &pictures[..3] {
        map.remove_keyframe(*keyframe);
    }
    tags.see((&map, MapId(3)), *last, picture, &optics);
    assert_eq!(tags.measurement(MapId(3)), None, "two views are left");
}

#[test]
fn keyframes_behind_a_turn_with_another_unit_tell_of_that_alone() {
    let (camera, mut map, pictures) = map_before_a_tag();
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    // The last three are of a part whose unit is 5 m: the same places are half as far.
    let motion = |i: usize| if i < 2 { Sim3::identity() } else { Sim3::new(0.5, Default::default(), Vector3::zeros()) };
    let keyframes = pictures.iter().enumerate().map(|(i, (keyframe, _))| (*keyframe, motion(i))).collect();
    map.correct(&Correction { keyframes, younger: None });
    for (keyframe, _) in &pictures[2..] {
        map.set_scale_origin(*keyframe, Some(TurnId(0)));
    }
    let mut tags = Tags::new(&config(0.0003)).expect("on");
    for (i, (keyframe, picture)) in pictures.iter().enumerate() {
        tags.see((&map, MapId(3)), *keyframe, picture, &optics);
        assert_eq!(tags.measurement(MapId(3)).is_some(), i == 4, "three views of one part, at view {i}");
    }
    let found = tags.measurement(MapId(3)).expect("told");
    let error = found.log_metres_per_unit - 5f64.ln();
    assert!(error.abs() < 0.01 && error.abs() < 2.0 * found.sigma, "off by {error}: {found:?}");
}

#[test]
fn tags_are_told_where_the_keyframes_of_now_see_them() {
    let (camera, mut map, pictures) = map_before_a_tag();
    let optics = Optics { camera: &camera, readout_s: 0.0 };
    let mut tags = Tags::new(&config(0.0003)).expect("on");
    let (mut told, mut seen) = (Vec::new(), Vec::new());
    for (keyframe, picture) in &pictures {
        tags.see((&map, MapId(3)), *keyframe, picture, &optics);
        tags.tell(&map, &optics, &mut told);
        let [tag] = told[..] else { panic!("tag 9 alone: {told:?}") };
        seen.push((tag.id, tag.sightings, tag.placed.is_some()));
    }
    assert_eq!(seen, [(9, 1, false), (9, 2, false), (9, 3, true), (9, 4, true), (9, 5, true)]);
    // In map units of 2.5 m: the tag's middle is the origin.
    let placed = told[0].placed.expect("placed");
    let off = placed.world_from_tag.translation.norm();
    assert!(off < 0.005 && off < 3.0 * placed.place_sigma && placed.place_sigma < 0.01, "{placed:?}");
    let turned = placed.world_from_tag.rotation.angle();
    assert!(turned < 3.0 * placed.turn_sigma && placed.turn_sigma < 0.03, "off by {turned}: {placed:?}");

    // A loop moves the keyframes: the tag goes with them, without being seen again.
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.1, -0.3, 0.2));
    let motion = Sim3::new(1.02, turn, Vector3::new(0.4, 0.0, -0.7));
    let keyframes = pictures.iter().map(|(keyframe, _)| (*keyframe, motion)).collect();
    map.correct(&Correction { keyframes, younger: None });
    tags.tell(&map, &optics, &mut told);
    let moved = told[0].placed.expect("placed");
    let want = motion.transform(&placed.world_from_tag.translation);
    assert!((moved.world_from_tag.translation - want).norm() < 1e-4, "{moved:?}");
    assert!(moved.world_from_tag.rotation.angle_to(&(turn * placed.world_from_tag.rotation)) < 1e-3);
    assert!((moved.log_edge - placed.log_edge - 1.02f64.ln()).abs() < 1e-4);

    for (keyframe, _) in &pictures[..3] {
        map.remove_keyframe(*keyframe);
    }
    tags.tell(&map, &optics, &mut told);
    assert!(told[0].sightings == 2 && told[0].placed.is_none(), "two views are left");
    tags.tell(&Map::default(), &optics, &mut told);
    assert!(told.is_empty(), "another map has no such keyframes");
}
