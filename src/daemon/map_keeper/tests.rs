//! What a keeper does where a disk fails, or somebody has been at the files.

use super::*;
use crate::geometry::CameraModel;
use crate::map::saved::{MapHead, SavedMap};
use crate::map::scale::MapScale;
use crate::map::{KeyframeId, Map, MapId};
use crate::reconstruction::{InlineWorker, Reconstruction, ReconstructionConfig};

fn begun() -> Reconstruction {
    let camera = CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).expect("camera");
    Reconstruction::new(&ReconstructionConfig::default(), &camera, Box::new(InlineWorker::default()), true)
}

#[test]
fn what_follows_a_write_that_failed_is_not_written_without_what_was_lost() {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("missing/a.map");
    let word = Arc::<KeeperWord>::default();
    let mut keeper = Keeper::new(path.clone(), None, None, word.clone());
    let mut reconstruction = begun();
    keeper.keep(&reconstruction.take_changes(true));
    assert!(keeper.outcome().is_err() && word.wants_everything.swap(false, Ordering::AcqRel));
    std::fs::create_dir(dir.path().join("missing")).expect("made");
    let some = reconstruction.take_changes(false);
    assert!(!some.is_everything);
    keeper.keep(&some);
    assert!(keeper.outcome().is_err() && !path.exists(), "a part of a map");
    assert!(word.wants_everything.load(Ordering::Acquire) && word.fails.load(Ordering::Acquire));
    keeper.keep(&reconstruction.take_changes(true));
    assert!(keeper.outcome().is_ok() && path.exists() && !word.fails.load(Ordering::Acquire));
}

#[test]
fn a_map_to_be_merged_is_nobody_elses_no_other_one_and_left_as_it_is() {
    let dir = tempfile::tempdir().expect("folder");
    let (path, empty) = (dir.path().join("a.map"), dir.path().join("b.map"));
    let given = Ids::default();
    let told =
        |path: &PathBuf, keeper: Option<&Keeper>| read_to_merge(path.clone(), given, keeper).expect_err("refused");
    assert!(told(&path, None).contains("cannot be read"));
    let changes = begun().take_changes(true);
    let held = MapFile::create(&path, &changes).expect("made");
    assert!(told(&path, None).contains("another process"));
    let keeper = Keeper::new(path.clone(), None, Some(held.edition()), Arc::default());
    assert!(told(&path, Some(&keeper)).contains("the present map"));
    held.close().expect("closed");
    MapFile::create(&empty, &changes).and_then(MapFile::close).expect("made");
    let bytes = std::fs::read(&empty).expect("read");
    assert!(told(&empty, Some(&keeper)).contains("no map in it"));
    assert_eq!(std::fs::read(&empty).expect("read"), bytes);
    let full = Ids { maps: 0, keyframes: u32::MAX - 5, landmarks: 0 };
    let one = SavedMap { head: head(), map: Map::default() };
    let saved = || SavedMaps { frame_ns: 0, optics: changes.optics.clone(), maps: vec![one] };
    assert!(of_this_run(saved(), full).err().is_some_and(|told| told.contains("used up")));
}

fn head() -> MapHead {
    MapHead { id: MapId(0), reference: KeyframeId(0), frames: 0, scale: MapScale::Unknown, turns: vec![] }
}

#[test]
fn a_copy_whose_path_fits_into_no_answer_is_not_made() {
    let dir = tempfile::tempdir().expect("folder");
    let deep = dir.path().join("d".repeat(200)).join("e".repeat(200)).join("f".repeat(100));
    let folder = MapFolder::new(deep.clone());
    let told = copy(&begun().take_changes(true), CopyTo::Sender(folder), None).expect_err("too long");
    assert!(told.contains("bytes"), "{told}");
    assert_eq!(std::fs::read_dir(deep.join("copies")).expect("made").count(), 0);
}

/// A keeper that has made its file, and the reconstruction whose map it keeps.
fn keeping(path: &Path) -> (Keeper, Reconstruction) {
    let mut reconstruction = begun();
    let mut keeper = Keeper::new(path.into(), None, None, Arc::default());
    keeper.keep(&reconstruction.take_changes(true));
    assert!(keeper.outcome().is_ok() && path.exists());
    (keeper, reconstruction)
}

/// The next changes, and everything once that is wanted.
fn keep_next(keeper: &mut Keeper, reconstruction: &mut Reconstruction) {
    keeper.keep(&reconstruction.take_changes(false));
    assert!(keeper.outcome().is_err() && keeper.word.wants_everything.swap(false, Ordering::AcqRel));
    keeper.keep(&reconstruction.take_changes(true));
    assert!(keeper.outcome().is_ok() && !keeper.word.fails.load(Ordering::Acquire), "{:?}", keeper.outcome());
}

#[test]
fn a_file_that_was_moved_or_removed_is_made_anew() {
    let dir = tempfile::tempdir().expect("folder");
    let [path, aside] = ["a.map", "aside.map"].map(|name| dir.path().join(name));
    let (mut keeper, mut reconstruction) = keeping(&path);
    std::fs::rename(&path, &aside).expect("moved");
    let left = keeper.file.as_ref().map(MapFile::edition);
    keep_next(&mut keeper, &mut reconstruction);
    std::fs::remove_file(&path).expect("removed");
    // The last word comes once.
    keeper.keep(&reconstruction.take_changes(true));
    assert_eq!(keeper.close(), Ok(Some(path.clone())));
    crate::places::store::read(&path).expect("whole");
    let moved = crate::places::store::read(&aside).expect("whole").edition;
    assert_eq!(Some(moved), left, "what was moved is as it was then");
}

#[test]
fn another_map_or_file_in_the_place_of_ours_stays_and_ours_is_kept_beside_it() {
    let dir = tempfile::tempdir().expect("folder");
    let [path, beside, third] = ["a.map", "a-2.map", "a-2-2.map"].map(|name| dir.path().join(name));
    let (mut keeper, mut reconstruction) = keeping(&path);
    std::fs::remove_file(&path).expect("removed");
    MapFile::create(&path, &begun().take_changes(true)).and_then(MapFile::close).expect("another map");
    let other = std::fs::read(&path).expect("bytes");
    keep_next(&mut keeper, &mut reconstruction);
    assert!(std::fs::read(&path).expect("bytes") == other);
    std::fs::rename(&beside, dir.path().join("b")).and_then(|()| std::fs::write(&beside, "no map")).expect("replaced");
    keeper.keep(&reconstruction.take_changes(true));
    assert_eq!(keeper.close(), Ok(Some(third.clone())));
    crate::places::store::read(&third).expect("whole");
    assert_eq!(std::fs::read(&beside).expect("bytes"), b"no map");
    assert!(std::fs::read(&path).expect("bytes") == other);
}

#[test]
fn a_map_that_comes_back_to_its_place_is_gone_on_in() {
    let dir = tempfile::tempdir().expect("folder");
    let [path, copy] = ["a.map", "b.map"].map(|name| dir.path().join(name));
    let (mut keeper, mut reconstruction) = keeping(&path);
    std::fs::copy(&path, &copy).and_then(|_| std::fs::rename(&copy, &path)).expect("put back from a copy");
    keep_next(&mut keeper, &mut reconstruction);
    assert_eq!(keeper.close(), Ok(Some(path)));
    assert_eq!(std::fs::read_dir(dir.path()).expect("folder").count(), 1);
}

#[test]
fn a_name_beside_is_one_that_commands_know() {
    let folder = MapFolder::new("/maps".into());
    let long = "x".repeat(64);
    for name in ["kitchen", "1.5", &long] {
        let beside = beside(&folder.file(name).expect("a name"));
        let name = beside.file_name().expect("a name").to_string_lossy();
        assert_eq!(folder.file(&name), Ok(beside.clone()));
        assert!(name.ends_with("-2.map"), "{name}");
    }
}
