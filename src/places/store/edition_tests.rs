//! Files that are other ones than those that were opened: nothing is written to them.

use super::tests::{changes, grow, is_there, optics, two_maps};
use super::*;
use crate::geometry::random::Random;
use crate::map::MapId;

#[test]
fn a_file_that_has_lost_its_name_takes_no_more() {
    let dir = tempfile::tempdir().unwrap();
    let [path, aside] = ["a.map", "aside.map"].map(|name| dir.path().join(name));
    let mut random = Random::new(81);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    for another in [false, true] {
        let mut file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
        file.write(&changes(&mut maps, &optics, false)).unwrap();
        std::fs::rename(&path, &aside).unwrap();
        if another {
            std::fs::write(&path, "somebody else's").unwrap();
        }
        let refused = file.write(&changes(&mut maps, &optics, false)).unwrap_err();
        assert!(matches!(refused.fault, Fault::Replaced), "{refused}");
        let left = file.edition();
        drop(file);
        is_there(&aside, &maps, &optics);
        assert_eq!(std::fs::read(&path).ok(), another.then(|| b"somebody else's".to_vec()));
        // Back in its place it is what it was.
        std::fs::rename(&aside, &path).unwrap();
        MapFile::open_again(&path, &left).unwrap().close().unwrap();
        std::fs::remove_file(&path).unwrap();
    }
}

#[test]
fn a_copy_that_somebody_has_gone_on_in_is_another_map() {
    let dir = tempfile::tempdir().unwrap();
    let [path, copy] = ["a.map", "copy.map"].map(|name| dir.path().join(name));
    let mut random = Random::new(82);
    let (mut maps, optics) = (two_maps(&mut random), optics(&mut random));
    let file = MapFile::create(&path, &changes(&mut maps, &optics, true)).unwrap();
    let made = file.edition();
    file.close().unwrap();
    let left = read(&path).unwrap().edition;
    assert_eq!(left, made);
    std::fs::copy(&path, &copy).unwrap();
    let mut file = MapFile::open_again(&copy, &left).unwrap();
    grow(&mut maps[1], MapId(7), &mut random);
    file.write(&changes(&mut maps, &optics, false)).unwrap();
    assert_ne!(file.edition(), left);
    file.close().unwrap();
    let grown = std::fs::read(&copy).unwrap();
    let refused = MapFile::open_again(&copy, &left).err().unwrap();
    assert!(matches!(refused.fault, Fault::Replaced), "{refused}");
    assert!(std::fs::read(&copy).unwrap() == grown);
    MapFile::open_again(&path, &left).unwrap();
    let other = MapFile::create(&dir.path().join("b.map"), &changes(&mut maps, &optics, true)).unwrap();
    assert!(MapFile::open_again(&path, &other.edition()).is_err(), "of the same records, and not this file");
}
