//! Pictures of keyframes far from the robot, on disk for as long as a run lasts.
//!
//! In: condensed pictures. Out: copies ([`PictureCopy`]) by which any thread can read them again, the same to the bit. One file without a name, so that
//! nothing is left behind however the process ends; it is made with the first picture. A picture takes the room of `BLOCK`s that it needs, some 20 kB,
//! which others may have once nobody holds its copy. At `MAX_SPOOL_BYTES` nothing more is taken: pictures stay in memory then.
//!
//! Cost: 0.2 ms to write one, 0.1 ms to read it, and the disk's own time, which of an SD card may be many times that. Memory: 32 bytes a copy here.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};

use super::store::picture::{decode_condensed, encode_condensed};
use crate::atomic_file::create_unique;
use crate::map::away::{Condensed, CopyFault, PictureCopy};
use crate::map::picture::KeyframePicture;

/// Size at which a spool stops growing: a hundred thousand pictures.
const MAX_SPOOL_BYTES: u64 = 2 << 30;
const BLOCK: u64 = 4096;
/// Copies that are looked at for each new one, whether anybody holds them still.
const SWEPT: usize = 8;

/// See the module.
#[derive(Debug)]
pub struct PictureSpool {
    folder: PathBuf,
    file: Option<Arc<File>>,
    end: u64,
    limit_bytes: u64,
    /// Places that nobody holds, by the blocks that they have.
    free: BTreeMap<u64, Vec<u64>>,
    /// Those given out, in turn.
    given: VecDeque<(Weak<Place>, u64, u64)>,
}

/// Where a copy lies.
#[derive(Debug)]
struct Place {
    file: Arc<File>,
    offset: u64,
    bytes: usize,
}

impl PictureCopy for Place {
    fn read(&self) -> Result<Condensed, CopyFault> {
        let mut record = vec![0; self.bytes];
        self.file.read_exact_at(&mut record, self.offset).map_err(|e| CopyFault::NotRead(e.to_string()))?;
        let picture = decode_condensed(&record).and_then(|picture| picture.condensed());
        picture.ok_or_else(|| CopyFault::Senseless("what was spooled makes no sense any more".into()))
    }
}

impl PictureSpool {
    /// `folder`: where the file is to lie; choose none in memory.
    pub fn new(folder: &Path) -> Self {
        // A path without a folder has the empty path as its parent.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        Self {
            folder: folder.into(),
            file: None,
            end: 0,
            limit_bytes: MAX_SPOOL_BYTES,
            free: BTreeMap::new(),
            given: VecDeque::new(),
        }
    }

    /// Writes a condensed picture; `None` where it is another.
    pub fn put(&mut self, picture: &KeyframePicture) -> io::Result<Option<Arc<dyn PictureCopy>>> {
        let Some(record) = encode_condensed(picture) else { return Ok(None) };
        let file = match &self.file {
            Some(file) => file.clone(),
            None => {
                let (file, path) = create_unique(&self.folder, ".cairn-spool", true)?;
                std::fs::remove_file(&path)?;
                self.file.insert(Arc::new(file)).clone()
            }
        };
        let blocks = (record.len() as u64).div_ceil(BLOCK);
        let (offset, blocks) = self.place(blocks)?;
        if let Err(error) = file.write_all_at(&record, offset) {
            self.free.entry(blocks).or_default().push(offset);
            return Err(error);
        }
        let place = Arc::new(Place { file, offset, bytes: record.len() });
        self.given.push_back((Arc::downgrade(&place), offset, blocks));
        Ok(Some(place))
    }

    /// Room for so many blocks, and how many it has: a place that was given back stays as large as it is.
    fn place(&mut self, blocks: u64) -> io::Result<(u64, u64)> {
        for _ in 0..SWEPT.min(self.given.len()) {
            let Some(given) = self.given.pop_front() else { break };
            match given.0.strong_count() {
                0 => self.free.entry(given.2).or_default().push(given.1),
                _ => self.given.push_back(given),
            }
        }
        // The smallest that is large enough.
        if let Some(place) = self.free.range_mut(blocks..).find_map(|(has, places)| Some((places.pop()?, *has))) {
            return Ok(place);
        }
        let offset = self.end;
        if offset + blocks * BLOCK > self.limit_bytes {
            return Err(io::Error::other(format!("limit of {} bytes reached", self.limit_bytes)));
        }
        self.end += blocks * BLOCK;
        Ok((offset, blocks))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::descriptor::Descriptor;
    use crate::features::gradients::{GradientDescriptor, NUMBERS};
    use crate::geometry::random::Random;
    use crate::image::GreyImage;
    use crate::map::view::{CoarseDescriptor, View};

    fn picture(random: &mut Random, views: u32) -> KeyframePicture {
        let mut image = GreyImage::new(80, 60);
        image.data.iter_mut().for_each(|v| *v = random.below(256) as u8);
        let described = [Some(CoarseDescriptor::of(&GradientDescriptor([40; NUMBERS]))); 3];
        let views = (0..views).map(|landmark| View { landmark, patches: [None, None], described }).collect();
        KeyframePicture::restored_condensed(image, 5, views, vec![Descriptor([random.bits(); 4])])
    }

    fn text(picture: &Condensed) -> String {
        format!("{:?} {:?} {:?}", picture.pyramid, picture.views, picture.place)
    }

    #[test]
    fn what_is_spooled_comes_back_as_it_was_and_its_room_is_used_again() {
        let (dir, mut random) = (tempfile::tempdir().expect("folder"), Random::new(5));
        let mut spool = PictureSpool::new(dir.path());
        let pictures: Vec<KeyframePicture> = (0..40).map(|_| picture(&mut random, 28)).collect();
        let copies: Vec<_> = pictures.iter().map(|p| spool.put(p).expect("written").expect("a copy")).collect();
        for (picture, copy) in pictures.iter().zip(&copies) {
            assert_eq!(text(&copy.read().expect("read")), text(&picture.condensed().expect("it is one")));
        }
        assert_eq!(std::fs::read_dir(dir.path()).expect("there").count(), 0, "the file has no name");
        let end = spool.end;
        drop(copies);
        for picture in pictures.iter().cycle().take(400) {
            spool.put(picture).expect("written");
        }
        assert!(spool.end <= end + 2 * BLOCK * 8, "{} after {end} bytes", spool.end);
    }

    #[test]
    fn at_its_limit_and_without_a_folder_it_takes_nothing_and_says_so() {
        let (dir, mut random) = (tempfile::tempdir().expect("folder"), Random::new(5));
        let mut picture_with = |views| picture(&mut random, views);
        let picture = picture_with(3);
        let mut spool = PictureSpool::new(dir.path());
        spool.limit_bytes = 4 * BLOCK;
        let mut held = Vec::new();
        while let Ok(copy) = spool.put(&picture) {
            held.push(copy);
        }
        assert!(!held.is_empty() && spool.end <= 4 * BLOCK);
        held.clear();
        assert!(spool.put(&picture).is_ok(), "there is room again");
        // A smaller one fits into a larger one's place as well.
        let (large, small) = (picture_with(60), picture_with(0));
        let mut spool = PictureSpool::new(dir.path());
        drop(spool.put(&large).expect("written"));
        let end = spool.end;
        let held = spool.put(&small).expect("written").expect("a copy");
        assert_eq!((spool.end, text(&held.read().expect("read"))), (end, text(&small.condensed().expect("it is one"))));
        assert!(PictureSpool::new(&dir.path().join("missing")).put(&picture).is_err());
        assert!(spool.put(&KeyframePicture::default()).is_ok_and(|copy| copy.is_none()));
    }
}
