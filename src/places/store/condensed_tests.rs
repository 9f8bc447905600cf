//! Condensed pictures in a file, and files of older formats.

use crate::map::examples;
use std::borrow::Cow;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;

use nalgebra::{Vector2, Vector3};

use super::backend::Access;
use super::error::{FORMAT, OLDEST_FORMAT};
use super::file::MOST_READ;
use super::layout::HeaderRecord;
use super::records::{Kind, Records, Tally};
use super::*;
use crate::features::descriptor::Descriptor;
use crate::features::gradients::{GradientDescriptor, NUMBERS};
use crate::geometry::random::Random;
use crate::geometry::{CameraModel, LensModel, Se3};
use crate::image::{GreyImage, Pyramid};
use crate::map::picture::KeyframePicture;
use crate::map::saved::MapChanges;
use crate::map::view::{CoarseDescriptor, Description, View};
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map, Observation};

fn camera() -> CameraModel {
    CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, LensModel::PINHOLE).expect("a camera")
}

/// Three keyframes with 40 landmarks that all of them see.
fn map(random: &mut Random) -> Map {
    let mut image = GreyImage::new(320, 240);
    image.data.iter_mut().for_each(|v| *v = random.below(256) as u8);
    let mut pyramid = Pyramid::new(5);
    pyramid.build(&image);
    let pyramid = Arc::new(pyramid);
    let mut map = Map::default();
    let ids = [0, 1, 2].map(|sequence| {
        map.add_keyframe(Keyframe { sequence, ..examples::keyframe(pyramid.clone(), Se3::identity()) })
    });
    for _ in 0..40 {
        let pixel = Vector2::new(random.uniform(3.0, 317.0) as f32, random.uniform(3.0, 237.0) as f32);
        let (normalised, normalised_from_pixel) = camera().undistort_jacobian(&pixel.cast()).expect("in the picture");
        let seen = Observation {
            landmark: LandmarkId(0),
            pixel,
            normalised,
            displacement: Vector2::zeros(),
            inv_sigma_px: 1.0,
            normalised_from_pixel,
        };
        let landmark = examples::landmark(Vector3::z(), ids[0]);
        map.add_landmark(landmark, &ids.map(|id| (id, seen)));
    }
    map
}

fn condense(map: &mut Map, id: u32, random: &mut Random) {
    map.condense_picture(KeyframeId(id), &camera(), |_, landmarks| {
        let mut described = || {
            let of = GradientDescriptor(std::array::from_fn::<u8, NUMBERS, _>(|_| random.below(166) as u8));
            (random.below(4) > 0).then(|| CoarseDescriptor::of(&of))
        };
        let landmarks = landmarks.iter().map(|_| std::array::from_fn(|_| described())).collect();
        let place = (0..9).map(|i| Descriptor(std::array::from_fn(|k| u64::MAX / (i + k as u64 + 1)))).collect();
        Description { landmarks, place }
    });
}

fn changes(map: &mut Map, everything: bool) -> MapChanges {
    examples::changes(&camera(), map, everything)
}

fn views(map: &Map) -> Vec<(u32, Vec<View>, Vec<GreyImage>)> {
    let of = |(id, k): (u32, &Keyframe)| (id, k.picture.views().to_vec(), k.picture.pyramid().levels.clone());
    map.keyframes.iter().map(of).collect()
}

#[test]
fn a_condensed_keyframe_comes_back_whenever_it_was_condensed() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.map");
    let mut random = Random::new(71);
    let mut map = map(&mut random);
    condense(&mut map, 0, &mut random);
    let mut file = MapFile::create(&path, &changes(&mut map, true)).expect("made");
    condense(&mut map, 1, &mut random);
    file.write(&changes(&mut map, false)).expect("written");
    file.close().expect("closed");
    let contents = read(&path).expect("whole");
    let saved = &contents.saved.maps[0].map;
    assert!(views(saved) == views(&map));
    let place = |map: &Map| map.keyframe(KeyframeId(1)).expect("there").picture.place_descriptors().to_vec();
    assert!(place(saved) == place(&map) && place(saved).len() == 9);
    assert!(saved.detailed().eq(map.detailed()) && saved.detailed().eq([KeyframeId(2)]));
    saved.check_consistency().expect("consistent");
    map.remove_keyframe(KeyframeId(0));
    let (mut file, _) = MapFile::open(&path).expect("opened");
    file.write(&changes(&mut map, false)).expect("written");
    drop(file);
    assert!(views(&read(&path).expect("nothing of it is left").saved.maps[0].map) == views(&map));
}

/// A file of an older format, which is this one with nothing deflated, and for the first format without condensed pictures.
fn make_older(path: &Path, map: &mut Map, format: u32) {
    MapFile::create(path, &changes(map, true)).expect("made").close().expect("closed");
    let open = || std::fs::OpenOptions::new().read(true).write(true).open(path).expect("there");
    let mut records = Records::open(open(), Access::Write).expect("opened");
    let (mut header, mut all) = (None, Vec::new());
    let kinds = [Kind::Keyframe, Kind::Picture, Kind::Landmarks, Kind::Condensed];
    let tally = records.read_all(|kind, number, bytes, _| {
        match kind {
            0 => header = HeaderRecord::decode(bytes),
            kind => all.push((kinds[usize::from(kind) - 1], number, bytes.to_vec())),
        }
        Ok(())
    });
    let with_tally = |Tally { records, sum }| {
        let mut header: HeaderRecord = header?;
        (header.records, header.checksums) = (records, sum);
        postcard::to_stdvec(&header).ok()
    };
    let plain = |kind, bytes: &[u8]| (kind as u8, Cow::Owned(bytes.to_vec()));
    records.write_as(plain, tally.expect("sound"), &all, &[], with_tally).expect("written");
    records.close().expect("closed");
    let raw = open();
    let mut page = [0; 4096];
    raw.read_exact_at(&mut page, 0).expect("a front page");
    page[8..12].copy_from_slice(&format.to_le_bytes());
    let checksum = crc32fast::hash(&page[..4092]);
    page[4092..].copy_from_slice(&checksum.to_le_bytes());
    raw.write_all_at(&page, 0).expect("written");
}

#[test]
fn a_file_of_the_format_before_is_read_and_gone_on_with_as_one_of_this() {
    for format in OLDEST_FORMAT..FORMAT {
        goes_on_with(format);
    }
}

fn goes_on_with(format: u32) {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.map");
    let mut random = Random::new(72);
    let mut map = map(&mut random);
    if format > 1 {
        condense(&mut map, 1, &mut random);
    }
    make_older(&path, &mut map, format);
    let old = std::fs::read(&path).expect("bytes");
    let before = read(&path).expect("read");
    assert!(before.format == format && views(&before.saved.maps[0].map) == views(&map));
    let link = dir.path().join("link.map");
    std::os::unix::fs::symlink(&path, &link).expect("a link");
    let (mut file, contents) = MapFile::open(&link).expect("opened");
    assert!(std::fs::read(&path).expect("bytes") == old, "it stays as it is until something is written");
    condense(&mut map, 2, &mut random);
    file.write(&changes(&mut map, false)).expect("written");
    assert!(matches!(MapFile::open(&path), Err(StoreError { fault: Fault::Busy, .. })), "it is locked");
    drop(file);
    let renewed = read(&path).expect("whole");
    assert_eq!((renewed.format, renewed.id, renewed.created_ns), (FORMAT, contents.id, contents.created_ns));
    assert!(views(&renewed.saved.maps[0].map) == views(&map));
    // Everything is written anew once: each record is there in one form.
    let (mut file, _) = MapFile::open(&path).expect("opened");
    file.write(&changes(&mut map, true)).expect("written");
    drop(file);
    let deflated = read(&path).expect("whole");
    assert!(views(&deflated.saved.maps[0].map) == views(&map));
    for of in [0, 2] {
        assert!(deflated.record_bytes[of] < before.record_bytes[of], "{of}");
    }
    assert!(link.is_symlink() && std::fs::read_dir(dir.path()).expect("a folder").count() == 2, "nothing else is left");
}

#[test]
fn a_map_that_was_put_in_the_place_of_an_older_file_meanwhile_is_not_written_over() {
    let dir = tempfile::tempdir().expect("a folder");
    let [path, aside, other] = ["a.map", "aside.map", "other.map"].map(|name| dir.path().join(name));
    let mut random = Random::new(73);
    let mut map = map(&mut random);
    for taken_away in [false, true] {
        make_older(&path, &mut map, 1);
        let old = std::fs::read(&path).expect("bytes");
        let (mut file, _) = MapFile::open(&path).expect("opened");
        std::fs::rename(&path, &aside).expect("moved");
        if !taken_away {
            std::fs::write(&path, "somebody else's").expect("written");
        }
        let refused = file.write(&changes(&mut map, true)).expect_err("not ours");
        assert!(matches!(refused.fault, Fault::Replaced), "{refused}");
        assert!(refused.to_string().contains("another file now"), "{refused}");
        drop(file);
        assert_eq!(std::fs::read(&path).ok(), (!taken_away).then(|| b"somebody else's".to_vec()));
        assert!(std::fs::read(&aside).expect("bytes") == old, "what was opened is what it was");
        let left = std::fs::read_dir(dir.path()).expect("a folder").count();
        assert_eq!(left, if taken_away { 1 } else { 2 }, "no copy is left");
        let _ = std::fs::remove_file(&path);
        std::fs::rename(&aside, &other).expect("moved");
        std::fs::remove_file(&other).expect("removed");
    }
}

#[test]
fn changes_that_cannot_be_written_leave_a_file_of_the_format_before_as_it_is() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.map");
    let mut map = map(&mut Random::new(74));
    make_older(&path, &mut map, 1);
    let old = std::fs::read(&path).expect("bytes");
    let (mut file, _) = MapFile::open(&path).expect("opened");
    let too_many = MapChanges { next_landmark: MOST_IDS + 1, ..changes(&mut map, true) };
    assert!(matches!(file.write(&too_many), Err(StoreError { fault: Fault::GivenUp(_), .. })));
    assert!(std::fs::read(&path).expect("bytes") == old);
    assert!(matches!(MapFile::open(&path), Err(StoreError { fault: Fault::Busy, .. })), "it is held yet");
    file.write(&changes(&mut map, true)).expect("written");
    assert_eq!(read(&path).map(|_| ()).expect_err("held").fault.to_string(), Fault::Busy.to_string());
    drop(file);
    assert_eq!(read(&path).expect("whole").format, FORMAT);
}

#[test]
fn a_keyframe_with_two_pictures_is_refused() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.map");
    let mut random = Random::new(75);
    let mut map = map(&mut random);
    condense(&mut map, 1, &mut random);
    MapFile::create(&path, &changes(&mut map, true)).expect("made").close().expect("closed");
    assert_eq!(read(&path).expect("whole").saved.maps.len(), 1);
    let raw = std::fs::OpenOptions::new().read(true).write(true).open(&path).expect("there");
    let mut records = Records::open(raw, Access::Write).expect("opened");
    let mut header = Vec::new();
    let tally = records.read_all(|kind, _, bytes, _| {
        if kind == Kind::Header as u8 {
            header = bytes.to_vec();
        }
        Ok(())
    });
    let other =
        map.keyframe(KeyframeId(1)).and_then(|k| super::picture::encode_condensed(&k.picture)).expect("a record");
    records.write(tally.expect("sound"), &[(Kind::Condensed, 2, other)], &[], |_| Some(header)).expect("written");
    records.close().expect("closed");
    let refused = read(&path).map(|_| ()).expect_err("which is it?");
    assert!(matches!(refused.fault, Fault::Broken(_)), "{refused}");
    assert!(refused.to_string().contains("keyframe 2 has two pictures"), "{refused}");
}

#[test]
fn of_a_large_map_that_is_gone_on_with_most_pictures_wait_beside_it() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.map");
    let mut random = Random::new(76);
    let mut map = map(&mut random);
    let first = map.keyframe(KeyframeId(0)).expect("there").clone();
    let more = MOST_READ as u32 + 60;
    for sequence in 1..=more {
        map.add_keyframe(Keyframe { sequence: sequence.into(), observations: Default::default(), ..first.clone() });
    }
    (0..more).for_each(|id| condense(&mut map, id, &mut random));
    MapFile::create(&path, &changes(&mut map, true)).expect("made").close().expect("closed");
    let bytes = std::fs::read(&path).expect("bytes");
    let whole = views(&read(&path).expect("whole").saved.maps[0].map);
    for go_on in [false, true] {
        let (file, contents) = match go_on {
            false => (None, read_to_locate(&path).expect("whole")),
            true => MapFile::open(&path).map(|(file, contents)| (Some(file), contents)).expect("whole"),
        };
        let mut maps = contents.saved.maps;
        let map = &mut maps[0].map;
        let (away, here) = (map.away(), map.condensed_here().len());
        assert_eq!((away, here), (60, MOST_READ));
        assert!((0..60).all(|id| map.keyframe(KeyframeId(id)).is_some_and(|k| k.picture.is_away())), "the oldest");
        assert_eq!(std::fs::read_dir(dir.path()).expect("a folder").count(), 1, "the spool has no name");
        for id in map.keyframes.ids().collect::<Vec<_>>() {
            map.bring_picture_back(KeyframeId(id)).expect("read");
        }
        assert!(views(map) == whole);
        map.check_consistency().expect("consistent");
        drop(file);
        assert!(std::fs::read(&path).expect("bytes") == bytes, "the file stays as it is");
    }
}

#[test]
fn a_spool_that_fails_takes_nothing_out_of_the_file() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.map");
    let mut random = Random::new(77);
    let mut map = map(&mut random);
    (0..3).for_each(|id| condense(&mut map, id, &mut random));
    MapFile::create(&path, &changes(&mut map, true)).expect("made").close().expect("closed");
    let stored = || read(&path).expect("whole").saved.maps.remove(0).map;
    let whole = views(&stored());
    // Whoever opens it anew does not know what pictures it has, and gets all of them.
    let write = |map: &mut Map| {
        let (mut file, _) = MapFile::open(&path).expect("whole");
        file.write(&changes(map, true)).map(|_| ())
    };
    assert!(map.put_picture_away(KeyframeId(0), |picture| examples::copied(picture, 1)));
    assert!(matches!(write(&mut map), Err(StoreError { fault: Fault::Spool(_), .. })));
    assert!(views(&stored()) == whole, "nothing of it is in the file");
    write(&mut map).expect("it is read at the second attempt");
    assert!(views(&stored()) == whole);

    let spoiled = |_: &KeyframePicture| examples::copied(&KeyframePicture::default(), 0);
    assert!(map.put_picture_away(KeyframeId(1), spoiled));
    write(&mut map).expect("written");
    assert!(views(&stored()) == whole, "the map does not know yet");
    map.bring_picture_back(KeyframeId(1)).expect_err("it is spoiled");
    assert!(map.keyframe(KeyframeId(1)).is_some_and(|k| k.picture.is_lost()));
    write(&mut map).expect("written");
    assert!(stored().keyframe(KeyframeId(1)).is_some_and(|k| k.picture.can_be_away()), "what the file had");
    map.check_consistency().expect("consistent");

    // A block that is never read again holds up neither the map's own file nor a copy.
    assert!(map.put_picture_away(KeyframeId(2), |picture| examples::copied(picture, u32::MAX)));
    assert!(matches!(write(&mut map), Err(StoreError { fault: Fault::Spool(_), .. })));
    let (mut file, _) = MapFile::open(&path).expect("whole");
    file.do_without_unread();
    file.write(&changes(&mut map, true)).expect("written");
    assert_eq!(file.left_out(), 1);
    // It is asked for again with the next write, which does not do without it by itself.
    assert!(matches!(file.write(&changes(&mut map, true)), Err(StoreError { fault: Fault::Spool(_), .. })));
    file.close().expect("closed");
    assert!(stored().keyframe(KeyframeId(2)).is_some_and(|k| k.picture.can_be_away()), "what the file had");
    let copy = dir.path().join("copy.map");
    assert!(MapFile::create(&copy, &changes(&mut map, true)).is_err() && !copy.exists());
    let copied = MapFile::create_without_unread(&copy, &changes(&mut map, true)).expect("made");
    assert_eq!(copied.left_out(), 1);
    copied.close().expect("closed");
    let copied = read(&copy).expect("whole").saved.maps.remove(0).map;
    assert!(copied.keyframe(KeyframeId(2)).is_some_and(|k| k.picture.kept().is_none()));
    copied.check_consistency().expect("consistent");

    // Nor does one of a keyframe that the file does not have yet, as of a map that was merged: it is written without.
    let later = dir.path().join("later.map");
    let (whole, mut fewer) = (changes(&mut map, true), changes(&mut map, true));
    fewer.keyframes.retain(|(id, _)| *id != 2);
    fewer.maps.iter_mut().for_each(|(_, keyframes)| keyframes.retain(|id| *id != 2));
    let mut file = MapFile::create(&later, &fewer).expect("made");
    assert!(matches!(file.write(&whole), Err(StoreError { fault: Fault::Spool(_), .. })));
    file.do_without_unread();
    file.write(&whole).expect("written");
    assert_eq!(file.left_out(), 1);
    file.close().expect("closed");
    let written = read(&later).expect("whole").saved.maps.remove(0).map;
    assert!(written.keyframe(KeyframeId(2)).is_some_and(|k| k.picture.kept().is_none()));
    written.check_consistency().expect("consistent");
}
