//! Maps that are written and read again; files that are no maps any more.

use std::path::Path;
use std::sync::Arc;

use nalgebra::{Matrix2, Matrix3, UnitQuaternion, Vector2, Vector3};

use super::*;
use crate::features::descriptor::Descriptor;
use crate::features::thumbnail::thumbnail_of;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::random::Random;
use crate::geometry::{CameraModel, LensModel, Se3};
use crate::image::{GreyImage, Pyramid};
use crate::map::picture::KeyframePicture;
use crate::map::saved::{Ids, MapChanges, MapHead, SavedMap, SavedOptics, SavedTurn};
use crate::map::scale::{MapScale, ScaleSource, ScaleSources};
use crate::map::{
    AssumedDistance, FreeCorner, Keyframe, KeyframeId, Landmark, LandmarkId, Map, MapId, Observation, TurnId,
};

fn camera(lens: LensModel) -> CameraModel {
    CameraModel::new(128, 96, 100.3, 101.7, 63.2, 47.9, lens).unwrap()
}

pub(super) fn optics(random: &mut Random) -> SavedOptics {
    SavedOptics {
        calibration: camera(LensModel::PINHOLE),
        is_guessed: true,
        camera: camera(LensModel::RadialTangential([0.1, -0.02, 1e-3, -2e-3, 1e-4])),
        expected: camera(LensModel::KannalaBrandt([0.1, 0.2, -0.1, 0.01])),
        sigma: std::array::from_fn(|_| random.normal()),
        refined_sigma: std::array::from_fn(|_| random.normal()),
        begun_with_px: 99.125,
        restarts: 2,
        found_before: vec![(random.normal(), 0.1), (random.normal(), 0.05)],
        unsettled: 1.0 / 3.0,
        readout_s: 0.017,
        readout_information: 12_345.678,
    }
}

fn picture(random: &mut Random) -> KeyframePicture {
    let mut image = GreyImage::new(128, 96);
    let (a, b) = (random.uniform(3.0, 9.0), random.uniform(3.0, 9.0));
    for (i, v) in image.data.iter_mut().enumerate() {
        let (x, y) = ((i % 128) as f64, (i / 128) as f64);
        *v = (128.0 + 60.0 * (x / a).sin() * (y / b).cos() + random.uniform(-5.0, 5.0)) as u8;
    }
    let mut pyramid = Pyramid::new(3);
    pyramid.build(&image);
    KeyframePicture::new(Arc::new(pyramid))
}

fn vector(random: &mut Random) -> Vector3<f64> {
    Vector3::from_fn(|_, _| random.normal())
}

fn keyframe(random: &mut Random, map: MapId) -> Keyframe {
    let picture = picture(random);
    let corner = |random: &mut Random| {
        let pixel = Vector2::new(random.uniform(5.0, 120.0) as f32, random.uniform(5.0, 90.0) as f32);
        let follows = camera(LensModel::RadialTangential([0.1, -0.02, 1e-3, -2e-3, 1e-4])).undistort(&pixel.cast());
        let descriptor = Descriptor(std::array::from_fn(|_| (random.uniform(0.0, 1.0) * u64::MAX as f64) as u64));
        FreeCorner { pixel, normalised: follows.unwrap(), descriptor }
    };
    Keyframe {
        sequence: 7_000_000_000,
        timestamp_ns: 1_305_031_102_175_304_123,
        map,
        camera_from_world: Se3::new(UnitQuaternion::from_scaled_axis(vector(random)), vector(random)),
        motion: (random.uniform(0.0, 1.0) < 0.7).then(|| CameraMotion { turn: vector(random), shift: vector(random) }),
        thumbnail: thumbnail_of(picture.pyramid()),
        picture,
        scale_from: (random.uniform(0.0, 1.0) < 0.3).then_some(TurnId(1)),
        observations: Default::default(),
        covisible: Vec::new(),
        corners: (0..20).map(|_| corner(random)).collect(),
    }
}

/// Seen anywhere: half of the time what follows from the camera, half of the time by another.
fn observation(random: &mut Random, follows: bool) -> Observation {
    let pixel = Vector2::new(random.uniform(2.0, 126.0) as f32, random.uniform(2.0, 94.0) as f32);
    let own = camera(LensModel::RadialTangential([0.1, -0.02, 1e-3, -2e-3, 1e-4]));
    let (normalised, normalised_from_pixel) = match follows {
        true => own.undistort_jacobian(&pixel.cast()).unwrap(),
        false => (vector(random).xy(), Matrix2::from_fn(|_, _| random.normal())),
    };
    let displacement = vector(random).xy();
    let inv_sigma_px = random.uniform(0.3, 2.0);
    Observation { landmark: LandmarkId(0), pixel, normalised, displacement, inv_sigma_px, normalised_from_pixel }
}

/// Adds a keyframe, and landmarks that it shares with those before.
pub(super) fn grow(map: &mut Map, id: MapId, random: &mut Random) {
    let before: Vec<KeyframeId> = map.keyframes.iter().map(|(id, _)| KeyframeId(id)).collect();
    let new = map.add_keyframe(keyframe(random, id));
    let follows = random.uniform(0.0, 1.0) < 0.5;
    for _ in 0..30 * usize::from(!before.is_empty()) {
        let landmark = Landmark {
            position: vector(random),
            covariance: Matrix3::from_fn(|_, _| if follows { random.normal() } else { f64::NAN }),
            observers: Vec::new(),
            created_by: new,
            assumed: (random.uniform(0.0, 1.0) < 0.1).then_some(AssumedDistance { inverse: 0.1, sigma: 0.3 }),
            sought: 9,
            found: 8,
        };
        let other = before[(random.uniform(0.0, 1.0) * before.len() as f64) as usize % before.len()];
        map.add_landmark(landmark, &[(other, observation(random, follows)), (new, observation(random, follows))]);
    }
}

fn head(id: u32) -> MapHead {
    let turn = SavedTurn { keyframe: KeyframeId(2), centre: Vector3::new(0.1, 0.2, 0.3), variance: 0.25, before: None };
    let turns = vec![turn, SavedTurn { before: Some(TurnId(0)), ..turn }];
    let sources = ScaleSources::default().with(ScaleSource::Tag);
    let scale = MapScale::Metric { sigma: 0.004 + f64::from(id), sources };
    MapHead { id: MapId(id), reference: KeyframeId(1), frames: 345, scale, turns }
}

/// Two maps of one run that are not joined, with whole and reduced pictures.
pub(super) fn two_maps(random: &mut Random) -> [Map; 2] {
    let mut first = Map::default();
    (0..6).for_each(|_| grow(&mut first, MapId(4), random));
    let mut second = first.successor();
    (0..3).for_each(|_| grow(&mut second, MapId(7), random));
    for id in 0..3 {
        first.reduce_picture(KeyframeId(id));
    }
    [first, second]
}

pub(super) fn changes(maps: &mut [Map; 2], optics: &SavedOptics, everything: bool) -> MapChanges {
    let [first, second] = maps;
    MapChanges::take(optics.clone(), 77, vec![(head(4), first), (head(7), second)], everything)
}

/// Every number of it; floats are told apart by their last digit.
fn told(map: &Map) -> String {
    use std::fmt::Write;
    let mut text = format!("{} {}\n", map.keyframes.next_id(), map.landmarks.next_id());
    for (id, k) in map.keyframes.iter() {
        let Keyframe { sequence, timestamp_ns, map, camera_from_world, motion, picture, thumbnail, .. } = k;
        let patches: Vec<_> = picture.patches().collect();
        let levels = &picture.pyramid().levels;
        writeln!(text, "{id} {sequence} {timestamp_ns} {map:?} {camera_from_world:?} {motion:?} {thumbnail:?}")
            .unwrap();
        writeln!(text, "{:?} {:?} {:?} {:?}", k.scale_from, k.observations, k.covisible, k.corners).unwrap();
        writeln!(text, "{patches:?} {:08x}", levels.iter().fold(0, |sum, l| sum ^ crc32fast::hash(&l.data))).unwrap();
        writeln!(text, "{:?}", levels.iter().map(|l| (l.width, l.height)).collect::<Vec<_>>()).unwrap();
    }
    map.landmarks.iter().for_each(|l| writeln!(text, "{l:?}").unwrap());
    text
}

pub(super) fn is_there(path: &Path, maps: &[Map; 2], optics: &SavedOptics) {
    let contents = read(path).expect("whole");
    assert_eq!(contents.saved.optics, *optics);
    assert_eq!((contents.saved.frame_ns, contents.saved.maps.len()), (77, 2));
    for (saved, (map, id)) in contents.saved.maps.iter().zip(maps.iter().zip([4, 7])) {
        assert_eq!(saved.head, head(id));
        saved.map.check_consistency().expect("consistent");
        assert!(told(&saved.map).split_once('\n').unwrap().1 == told(map).split_once('\n').unwrap().1);
        let next = (maps[1].keyframes.next_id(), maps[1].landmarks.next_id());
        assert_eq!((saved.map.keyframes.next_id(), saved.map.landmarks.next_id()), next, "ids go on behind all maps'");
    }
}

#[test]
fn maps_may_get_other_ids_and_a_file_follows() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(43);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap().close().unwrap();
    // Some are ids that the file has given to other keyframes.
    let from = Ids { maps: 10, keyframes: 2, landmarks: 1000 };
    let (mut file, contents) = MapFile::open(&path).unwrap();
    let mut moved = contents.saved.renumbered(from).unwrap();
    assert_eq!(moved.first_ids(), Some(Ids { maps: 11, keyframes: 3, landmarks: 1001 }));
    for (saved, map) in moved.maps.iter().zip(&maps) {
        saved.map.check_consistency().expect("consistent");
        assert_eq!((saved.map.keyframes.len(), saved.map.landmarks.len()), (map.keyframes.len(), map.landmarks.len()));
        assert_eq!((saved.head.reference, saved.head.turns[0].keyframe), (KeyframeId(4), KeyframeId(5)));
        for ((id, k), (before, old)) in saved.map.keyframes.iter().zip(map.keyframes.iter()) {
            assert_eq!((id, k.map.0), (before + 3, if old.map.0 == 4 { 11 } else { 12 }));
            assert!(
                k.observations.iter().zip(old.observations.iter()).all(|(a, b)| a.landmark.0 == b.landmark.0 + 1001)
            );
            let patches = |k: &Keyframe, by: u32| k.picture.patches().map(|p| p.0 + by).collect::<Vec<_>>();
            assert_eq!(patches(k, 0), patches(old, 1001));
        }
        for ((id, l), (before, old)) in saved.map.landmarks.iter().zip(map.landmarks.iter()) {
            assert_eq!((id, l.position, l.created_by.0), (before + 1001, old.position, old.created_by.0 + 3));
        }
    }
    // Everything under its new ids, and nothing of the old ones.
    let heads: Vec<MapHead> = moved.maps.iter().map(|m| m.head.clone()).collect();
    let all = heads.into_iter().zip(moved.maps.iter_mut().map(|m| &mut m.map)).collect();
    file.write(&MapChanges::take(optics.clone(), 77, all, true)).unwrap();
    file.close().unwrap();
    let again = read(&path).unwrap().saved;
    for (saved, written) in again.maps.iter().zip(&moved.maps) {
        assert!(saved.head == written.head && told(&saved.map) == told(&written.map));
    }
    // Above a run that has given many, and back: what was used up before uses up nothing.
    let far = Ids { landmarks: MOST_IDS - 1000, ..from };
    let far = again.renumbered(far).unwrap();
    let near = far.renumbered(Ids::default()).unwrap();
    assert_eq!(near.first_ids(), Some(Ids { maps: 1, keyframes: 1, landmarks: 1 }));
    assert_eq!(near.next_id() as usize, 1 + maps.iter().map(|map| map.landmarks.len()).sum::<usize>());
    let none_left = Ids { landmarks: u32::MAX - 1, ..from };
    assert!(near.renumbered(none_left).is_err_and(|reason| reason.contains("ids")));
}

/// What a run gives when it is older than anybody thought.
#[test]
fn a_file_takes_no_ids_that_no_reader_would_take() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(48);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let mut file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
    let many = MapChanges { next_landmark: MOST_IDS + 1, ..changes(&mut maps, &optics, true) };
    assert!(file.write(&many).is_err_and(|error| matches!(error.fault, Fault::GivenUp(_))));
    drop(file);
    is_there(&path, &maps, &optics);
}

#[test]
fn a_map_comes_back_bit_for_bit_whenever_it_was_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(41);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let mut file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
    // Of each change only what it has touched is written.
    let write = |file: &mut MapFile, maps: &mut [Map; 2]| file.write(&changes(maps, &optics, false)).unwrap();
    assert_eq!(write(&mut file, &mut maps), 0);
    grow(&mut maps[1], MapId(7), &mut random);
    let grown = write(&mut file, &mut maps);
    maps[0].reduce_picture(KeyframeId(3));
    maps[0].place_keyframe(KeyframeId(0), Se3::new(UnitQuaternion::identity(), vector(&mut random)));
    maps[0].remove_keyframe(KeyframeId(1));
    let ids: Vec<u32> = maps[0].landmarks.iter().map(|(id, _)| id).collect();
    maps[0].fuse(LandmarkId(ids[0]), LandmarkId(ids[ids.len() - 1]));
    ids[3..40].iter().for_each(|id| maps[0].remove_landmark(LandmarkId(*id)));
    write(&mut file, &mut maps);
    file.close().unwrap();
    assert!(grown < std::fs::metadata(&path).unwrap().len() / 3, "{grown} bytes for one keyframe");
    is_there(&path, &maps, &optics);
    let bytes = std::fs::read(&path).unwrap();
    MapFile::open(&path).unwrap().0.close().unwrap();
    assert!(std::fs::read(&path).unwrap() == bytes, "nothing was written");
    // Another process goes on; a second one must not.
    let (mut file, contents) = MapFile::open(&path).unwrap();
    assert!(matches!(MapFile::open(&path).err().unwrap().fault, Fault::Busy));
    assert!(matches!(read(&path).err().unwrap().fault, Fault::Busy));
    let mut again: Vec<Map> = contents.saved.maps.into_iter().map(|SavedMap { map, .. }| map).collect();
    let mut again: [Map; 2] = [again.remove(0), again.remove(0)];
    assert_eq!(write(&mut file, &mut again), 0, "nothing has changed yet");
    grow(&mut again[1], MapId(7), &mut random);
    write(&mut file, &mut again);
    // As after `kill -9`: nobody closes it.
    drop(file);
    is_there(&path, &again, &optics);
}

#[test]
fn a_map_that_is_gone_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(42);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let mut file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
    let [_, mut second] = maps;
    file.write(&MapChanges::take(optics.clone(), 77, vec![(head(7), &mut second)], true)).unwrap();
    let mut empty = second.successor();
    file.close().unwrap();
    let contents = read(&path).unwrap();
    assert_eq!(contents.saved.maps.len(), 1);
    let (mut file, contents_again) = MapFile::open(&path).unwrap();
    assert_eq!(told(&contents_again.saved.maps[0].map), told(&second));
    file.write(&MapChanges::take(optics, 77, vec![(head(8), &mut empty)], true)).unwrap();
    file.close().unwrap();
    let contents = read(&path).unwrap();
    assert_eq!((contents.saved.maps.len(), contents.record_bytes), (0, [0; 3]));
}

#[test]
fn what_exists_or_is_foreign_or_newer_is_left_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(43);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap().close().unwrap();
    let whole = std::fs::read(&path).unwrap();
    let error = MapFile::create(&path, &changes(&mut maps, &optics, true)).err().unwrap();
    assert!(matches!(error.fault, Fault::Exists) && error.to_string().contains("a.map"), "{error}");
    assert!(std::fs::read(&path).unwrap() == whole);
    assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 1, "nothing temporary stays");
    let newer = {
        let mut bytes = whole.clone();
        bytes[8] = 9;
        let sum = crc32fast::hash(&bytes[..4092]);
        bytes[4092..4096].copy_from_slice(&sum.to_le_bytes());
        bytes
    };
    let zeros = vec![0; 10_000];
    let text = b"# timestamp tx ty tz qx qy qz qw\n".to_vec();
    let cases: [(&[u8], &str); 6] = [
        (&newer, "version 9"),
        (&zeros, "no map of Cairn's"),
        (&text, "no map of Cairn's"),
        (b"", "no map of Cairn's"),
        (b"CAIRN", "cut off"),
        (&whole[..4096], "cut off"),
    ];
    for (bytes, word) in cases {
        std::fs::write(&path, bytes).unwrap();
        for error in [read(&path).err().unwrap(), MapFile::open(&path).err().unwrap()] {
            let text = error.to_string();
            assert!(text.contains(word) && text.contains("a.map") && error.fault.is_in_the_data(), "{text}");
        }
        assert!(std::fs::read(&path).unwrap() == bytes, "{word}");
    }
    assert!(matches!(read(&dir.path().join("none")).err().unwrap().fault, Fault::Read(_)));
}

#[test]
fn what_lies_beside_a_map_file_by_a_name_like_its_own_is_nobodys_to_write() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let other = dir.path().join(format!(".a.map.{}", std::process::id()));
    std::fs::write(&other, "of a process of the same number").unwrap();
    let mut random = Random::new(45);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap().close().unwrap();
    assert_eq!(std::fs::read(&other).unwrap(), b"of a process of the same number");
}

#[test]
fn a_record_that_no_reader_takes_is_not_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(46);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let mut file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
    // One that still has free corners: its picture is whole.
    let corners = maps[0].keyframe(KeyframeId(4)).unwrap().corners.clone();
    maps[0].set_corners(KeyframeId(4), corners.iter().cycle().take(450_000).copied().collect());
    let told = changes(&mut maps, &optics, false);
    let sizes: Vec<(u32, usize)> = told.keyframes.iter().map(|(id, k)| (*id, k.corners.len())).collect();
    let error = match file.write(&told) {
        Err(error) => error,
        Ok(bytes) => panic!("{bytes} bytes were written, of keyframes with so many corners: {sizes:?}"),
    };
    assert!(matches!(error.fault, Fault::Write(_)), "{error}");
    drop(file);
    maps[0].set_corners(KeyframeId(4), corners);
    is_there(&path, &maps, &optics);
}

/// Numbers that are none, and ids that would make room for more than there is.
#[test]
fn a_map_with_senseless_numbers_is_refused() {
    let refused = |spoil: &dyn Fn(&mut MapChanges)| {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.map");
        let mut random = Random::new(47);
        let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
        let mut all = changes(&mut maps, &optics, true);
        spoil(&mut all);
        MapFile::create(&path, &all).unwrap().close().unwrap();
        read(&path).err().is_some_and(|error| matches!(error.fault, Fault::Broken(_)))
    };
    assert!(!refused(&|_| {}));
    let assumes = |c: &mut MapChanges, assumed: AssumedDistance| {
        c.landmarks.values_mut().next().unwrap()[0].1.assumed = Some(assumed);
    };
    let cases: [&dyn Fn(&mut MapChanges); 12] = [
        &|c| c.next_keyframe = 2,
        &|c| c.next_landmark = 2,
        &|c| c.maps[0].0.id = MapId(u32::MAX),
        &|c| c.maps[0].0.id = c.maps[1].0.id,
        &|c| c.maps[0].0.scale = MapScale::Metric { sigma: f64::NAN, sources: ScaleSources::default() },
        &|c| c.keyframes[0].1.map = MapId(u32::MAX),
        &|c| {
            let seen = &mut c.keyframes[0].1.observations;
            *seen = seen.iter().map(|o| Observation { inv_sigma_px: f64::INFINITY, ..o }).collect();
        },
        &|c| c.keyframes[0].1.motion = Some(CameraMotion { turn: Vector3::x() * f64::NAN, shift: Vector3::x() }),
        &|c| c.landmarks.values_mut().next().unwrap()[0].1.position.y = f64::NAN,
        &|c| c.landmarks.values_mut().next().unwrap()[0].0 += 64,
        &|c| assumes(c, AssumedDistance { inverse: -0.1, sigma: 0.3 }),
        &|c| assumes(c, AssumedDistance { inverse: 0.1, sigma: 0.0 }),
    ];
    for (n, case) in cases.iter().enumerate() {
        assert!(refused(*case), "case {n}");
    }
}

#[test]
fn of_more_sightings_than_anybody_counts_the_share_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(48);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let mut all = changes(&mut maps, &optics, true);
    for (_, landmark) in all.landmarks.values_mut().flatten() {
        (landmark.sought, landmark.found) = (u32::MAX, u32::MAX / 4);
    }
    MapFile::create(&path, &all).unwrap().close().unwrap();
    for saved in read(&path).unwrap().saved.maps {
        for (_, l) in saved.map.landmarks.iter() {
            assert!(l.sought < Landmark::MOST_SOUGHT);
            assert!((f64::from(l.found) / f64::from(l.sought) - 0.25).abs() < 1e-6, "{} of {}", l.found, l.sought);
        }
    }
}

/// A flipped byte, several, a page of something else, cut off, or longer.
fn spoiled(whole: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = whole.to_vec();
    let mut below = |n: usize| (random.uniform(0.0, 1.0) * n as f64) as usize % n;
    match below(6) {
        0 | 1 => {
            for _ in 0..=below(8) {
                let at = below(bytes.len());
                bytes[at] ^= 1 << below(8);
            }
        }
        // Where the database keeps what it is.
        2 => {
            let at = below(4096 + 512);
            bytes[at] = bytes[at].wrapping_add(1 + below(255) as u8);
        }
        3 => {
            let (from, to) = (below(bytes.len() / 4096) * 4096, below(bytes.len() / 4096) * 4096);
            bytes.copy_within(from..from + 4096, to);
        }
        4 => bytes.truncate(below(bytes.len())),
        _ => {
            let at = below(bytes.len());
            let end = (at + 1 + below(20_000)).min(bytes.len());
            bytes[at..end].fill(below(2) as u8 * 255);
        }
    }
    bytes
}

/// Where the newest write is spoiled the one before is found, as after a power cut in the middle of a write.
#[test]
fn a_spoiled_file_is_an_error_or_the_very_same_map_of_either_write() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.map");
    let mut random = Random::new(44);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let mut file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
    let all = |contents: Contents| contents.saved.maps.iter().map(|m| told(&m.map)).collect::<Vec<_>>();
    let copy = dir.path().join("first.map");
    std::fs::copy(&path, &copy).unwrap();
    let first = all(read(&copy).unwrap());
    grow(&mut maps[1], MapId(7), &mut random);
    file.write(&changes(&mut maps, &optics, false)).unwrap();
    // Half of them as a power cut leaves it, half as it is closed.
    let open = std::fs::read(&path).unwrap();
    file.close().unwrap();
    let closed = std::fs::read(&path).unwrap();
    let second = all(read(&path).unwrap());
    assert!(first != second);
    let (mut refused, mut older) = (0, 0);
    for case in 0..300 {
        let bytes = spoiled(if case % 2 == 0 { &open } else { &closed }, &mut random);
        std::fs::write(&path, &bytes).unwrap();
        let found = read(&path);
        assert!(std::fs::read(&path).unwrap() == bytes, "case {case} (seed 44): looking has changed it");
        match found {
            Ok(contents) => {
                let maps = all(contents);
                assert!(maps == second || maps == first, "case {case} (seed 44): another map");
                older += u32::from(maps == first);
            }
            Err(error) => {
                refused += 1;
                let text = error.to_string();
                assert!(text.contains("a.map") && error.fault.is_in_the_data(), "case {case} (seed 44): {text}");
                assert!(MapFile::open(&path).is_err(), "case {case} (seed 44)");
                assert!(std::fs::read(&path).unwrap() == bytes, "case {case} (seed 44): opening has changed it");
            }
        }
    }
    assert!((60..300).contains(&refused), "{refused} of 300 were refused: the test spoils nothing or everything");
    assert!(older < 60, "{older} of 300 gave the write before");
    println!("{refused} of 300 refused, {older} as of the write before");
}
