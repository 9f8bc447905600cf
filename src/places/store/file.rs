//! A map file: made, read, written to.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::{File, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use super::backend::Access;
use super::error::{FORMAT, Fault, StoreError};
use super::front::Front;
use super::layout::{HeaderOf, HeaderRecord, MOST_IDS, Raw, encode_keyframe, encode_landmarks};
use super::naming::{folder_of, give_name, inode, is_at, lock, lock_soon, nameless, renewed};
use super::picture;
use super::records::{Kind, Records, Tally};
use crate::map::Keyframe;
use crate::map::away::CopyFault;
use crate::map::saved::{MapChanges, SavedMaps};
use crate::places::spool::PictureSpool;
use crate::telemetry::contained;

/// Condensed pictures that are in memory once a map is read to go on in it; others wait in a spool.
pub(super) const MOST_READ: usize = 400;

/// Everything that a file holds.
pub struct Contents {
    pub format: u32,
    /// Random, given when the file was made.
    pub id: [u8; 16],
    /// ns since 1970.
    pub created_ns: i64,
    pub written_ns: i64,
    /// Version of the program that wrote it last.
    pub cairn: String,
    pub bytes: u64,
    pub edition: Edition,
    /// Of the records: keyframes, their pictures, landmarks. The rest is the database's own, and room.
    pub record_bytes: [u64; 3],
    pub saved: SavedMaps,
}

/// Which map a file has, and as of which write: a copy that somebody else has gone on in is another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Edition {
    id: [u8; 16],
    /// Of its records. A write that failed may be in the file or not: then these are those before and after it.
    tallies: [Tally; 2],
}

impl Edition {
    fn is_one_of(&self, other: &Self) -> bool {
        self.id == other.id && other.tallies.contains(&self.tallies[0])
    }
}

/// Reads a file in full and verifies it; its bytes stay as they are.
pub fn read(path: &Path) -> Result<Contents, StoreError> {
    read_with(path, None)
}

/// The same for a robot that is to be located in its maps: most pictures of a large one wait in a spool beside it, if one can be made there.
pub fn read_to_locate(path: &Path) -> Result<Contents, StoreError> {
    read_with(path, Some(folder_of(path)))
}

fn read_with(path: &Path, spool: Option<&Path>) -> Result<Contents, StoreError> {
    let open = || {
        let file = File::open(path).map_err(Fault::Read)?;
        lock(file.try_lock_shared())?;
        look(&file, spool).map(|(contents, _, _)| contents)
    };
    open().map_err(|fault| fault.of(path))
}

/// What the file has of a keyframe.
#[derive(Debug, Clone, Copy)]
struct Stored {
    /// Of its picture; that of none, where the spool did not give the one that is to be stored.
    revision: u32,
    /// Says which keyframe it is: maps that are gone on in get other numbers.
    timestamp_ns: i64,
}

/// Of one keyframe.
#[derive(Default)]
struct PictureRecords {
    new: Option<(Kind, u32, Vec<u8>)>,
    /// To be removed.
    bare: Vec<(Kind, u32)>,
    /// The spool did not give it.
    is_unread: bool,
}

/// No picture has as many.
const NOT_STORED: u32 = u32::MAX;

/// A map file that this process writes to; another one that opens it is told so.
pub struct MapFile {
    path: PathBuf,
    edition: Edition,
    /// Device and number of the file itself, whatever its name is by now.
    inode: (u64, u64),
    /// It was verified and is locked; the library gets it with the first write, so that until then its bytes stay as they are.
    verified: Option<File>,
    /// `None` before the first write, and once it is given up.
    records: Option<Records>,
    tally: Tally,
    /// Keyframes in the file.
    keyframes: BTreeMap<u32, Stored>,
    /// Pages of landmarks in the file.
    pages: BTreeSet<u32>,
    /// What the spool does not give is left out of the next write, and how many pictures that were in the last one.
    without_unread: bool,
    left_out: usize,
}

impl MapFile {
    /// Makes a file with these maps in it; it is whole from the first moment on that it has its name.
    pub fn create(path: &Path, first: &MapChanges) -> Result<Self, StoreError> {
        Self::make(path, first, false).map_err(|fault| fault.of(path))
    }

    /// The same, without pictures that the spool does not give.
    pub fn create_without_unread(path: &Path, first: &MapChanges) -> Result<Self, StoreError> {
        Self::make(path, first, true).map_err(|fault| fault.of(path))
    }

    fn make(path: &Path, first: &MapChanges, without_unread: bool) -> Result<Self, Fault> {
        let mut id = [0; 16];
        File::open("/dev/urandom").and_then(|mut r| std::io::Read::read_exact(&mut r, &mut id)).map_err(Fault::Read)?;
        let (file, temporary) = nameless(path)?;
        let front = Front { format: FORMAT, id, created_ns: now_ns() };
        let filled = || {
            lock(file.try_lock())?;
            file.write_all_at(&front.page(), 0).map_err(Fault::Write)?;
            let handle = file.try_clone().map_err(Fault::Write)?;
            let mut own = Self {
                path: path.into(),
                edition: Edition { id, tallies: [Tally::default(); 2] },
                inode: inode(&file)?,
                verified: None,
                records: Some(Records::open(handle, Access::Write)?),
                tally: Tally::default(),
                keyframes: BTreeMap::new(),
                pages: BTreeSet::new(),
                without_unread,
                left_out: 0,
            };
            own.put_in(first)?;
            file.sync_all().map_err(Fault::Write)?;
            give_name(&temporary, path)?;
            Ok(own)
        };
        filled().inspect_err(|_: &Fault| {
            // Nobody knows it by this name but us.
            let _ = std::fs::remove_file(&temporary);
        })
    }

    /// Opens a file to go on in its maps. It is read in full and verified, and stays as it is until the first write. Most pictures of a large map
    /// wait in a spool beside the file.
    pub fn open(path: &Path) -> Result<(Self, Contents), StoreError> {
        let open = || {
            let file = OpenOptions::new().read(true).write(true).open(path).map_err(Fault::Read)?;
            lock_soon(&file)?;
            let (contents, tally, pages) = look(&file, Some(folder_of(path)))?;
            let keyframes = contents.saved.maps.iter().flat_map(|m| m.map.keyframes.iter());
            let stored = |k: &Keyframe| Stored { revision: k.picture.revision(), timestamp_ns: k.timestamp_ns };
            let keyframes = keyframes.map(|(id, k)| (id, stored(k))).collect();
            let own = Self {
                path: path.into(),
                edition: contents.edition,
                inode: inode(&file)?,
                verified: Some(file),
                records: None,
                tally,
                keyframes,
                pages,
                without_unread: false,
                left_out: 0,
            };
            Ok((own, contents))
        };
        open().map_err(|fault: Fault| fault.of(path))
    }

    /// Opens a file to write to it what began from this edition, or was left in it: another one is refused, and stays as it is.
    pub fn open_again(path: &Path, left: &Edition) -> Result<Self, StoreError> {
        let (own, _) = Self::open(path)?;
        if own.edition.is_one_of(left) { Ok(own) } else { Err(Fault::Replaced.of(path)) }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What is in it.
    pub fn edition(&self) -> Edition {
        self.edition
    }

    /// In the next write a picture that the spool does not give is left out, instead of nothing being written: one bad block of a disk must not keep a
    /// whole map from it. What the file has of that picture stays; a keyframe of which it has nothing is written without one.
    pub fn do_without_unread(&mut self) {
        self.without_unread = true;
    }

    /// Pictures that were left out of the last write.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// Writes what has changed; it is on the disk when this returns, under the file's name. Bytes that were handed over to be written.
    ///
    /// After an error nothing of the changes is in the file, and it takes no more.
    pub fn write(&mut self, changes: &MapChanges) -> Result<u64, StoreError> {
        let path = self.path.clone();
        self.put(changes).map_err(|fault| fault.of(&path))
    }

    fn put(&mut self, changes: &MapChanges) -> Result<u64, Fault> {
        // Moved or removed it would take all there is, and nobody find it.
        if !is_at(self.inode, &self.path)? {
            return Err(Fault::Replaced);
        }
        self.put_in(changes)
    }

    fn put_in(&mut self, changes: &MapChanges) -> Result<u64, Fault> {
        if changes.next_keyframe.max(changes.next_landmark) > MOST_IDS {
            // No reader would take it. What is in the file is whole, and gets small ids when a run begins with it.
            return Err(Fault::GivenUp("ids are used up; a restart makes room for others".into()));
        }
        let camera = &changes.optics.camera;
        let senseless = || Fault::GivenUp("a record cannot be made of the map".into());
        let (mut new, mut stored, mut bare) = (Vec::new(), Vec::new(), Vec::new());
        let (without_unread, mut left_out) = (std::mem::take(&mut self.without_unread), 0);
        for (id, keyframe) in &changes.keyframes {
            new.push((Kind::Keyframe, *id, encode_keyframe(keyframe, camera).ok_or_else(senseless)?));
            let (mut revision, timestamp_ns) = (keyframe.picture.revision(), keyframe.timestamp_ns);
            let records = self.picture_records(*id, keyframe, without_unread)?;
            if records.is_unread {
                (left_out, revision) = (left_out + 1, NOT_STORED);
            }
            new.extend(records.new);
            bare.extend(records.bare);
            stored.push((*id, Stored { revision, timestamp_ns }));
        }
        let (filled, emptied): (Vec<_>, Vec<_>) = changes.landmarks.iter().partition(|(_, page)| !page.is_empty());
        for (page, landmarks) in &filled {
            new.push((Kind::Landmarks, **page, encode_landmarks(landmarks).ok_or_else(senseless)?));
        }

        let kept: BTreeSet<u32> = changes.maps.iter().flat_map(|(_, keyframes)| keyframes).copied().collect();
        let gone: Vec<u32> = self.keyframes.keys().filter(|id| !kept.contains(id)).copied().collect();
        let emptied = emptied.into_iter().map(|(page, _)| *page).filter(|page| self.pages.contains(page));
        let left = |page: &&u32| changes.is_everything && !changes.landmarks.contains_key(page);
        let emptied: Vec<u32> = emptied.chain(self.pages.iter().filter(left).copied()).collect();
        let removed =
            gone.iter().flat_map(|id| [Kind::Keyframe, Kind::Picture, Kind::Condensed].map(|kind| (kind, *id)));
        let removed: Vec<_> = removed.chain(bare).chain(emptied.iter().map(|page| (Kind::Landmarks, *page))).collect();

        let MapChanges { frame_ns, optics, maps, next_keyframe, next_landmark, .. } = changes;
        let (frame_ns, next_keyframe, next_landmark) = (*frame_ns, *next_keyframe, *next_landmark);
        let header = HeaderOf { frame_ns, optics, maps, next_keyframe, next_landmark, written_ns: now_ns() };
        // What cannot be written leaves a file of an older format what it is, too.
        if let Some(verified) = &self.verified {
            let renewed = renewed(verified, &self.path)?;
            if let Some(copy) = &renewed {
                self.inode = inode(copy)?;
            }
            let own = self.verified.take();
            let file = renewed.or(own).ok_or(Fault::Replaced)?;
            self.records = Some(Records::open(file, Access::Write)?);
        }
        let records = self.records.as_mut().ok_or_else(|| Fault::GivenUp("an earlier write failed".into()))?;
        let mut attempted = self.tally;
        let outcome = records.write(self.tally, &new, &removed, |tally| {
            attempted = tally;
            HeaderRecord::encode(&header, tally)
        });
        match outcome {
            Ok(tally) => (self.tally, self.edition.tallies) = (tally, [tally; 2]),
            Err(fault) => {
                self.edition.tallies[1] = attempted;
                self.records = None;
                return Err(fault);
            }
        }
        self.left_out = left_out;
        self.keyframes.extend(stored);
        self.keyframes.retain(|id, _| kept.contains(id));
        self.pages.extend(filled.iter().map(|(page, _)| **page));
        self.pages.retain(|page| !emptied.contains(page));
        Ok(new.iter().map(|(_, _, bytes)| bytes.len() as u64).sum())
    }

    /// What is to be written and removed of a keyframe's picture, if the file has not this one.
    fn picture_records(&self, id: u32, keyframe: &Keyframe, without_unread: bool) -> Result<PictureRecords, Fault> {
        let mut records = PictureRecords::default();
        let before = self.keyframes.get(&id);
        let same = before.filter(|before| before.timestamp_ns == keyframe.timestamp_ns);
        if same.is_some_and(|before| before.revision == keyframe.picture.revision()) {
            return Ok(records);
        }
        let mut own = keyframe.picture.clone();
        match own.bring_back() {
            Err(CopyFault::NotRead(_)) if without_unread => records.is_unread = true,
            // The spool may give it later, and the whole write is tried again.
            Err(CopyFault::NotRead(reason)) => return Err(Fault::Spool(reason)),
            Ok(_) | Err(CopyFault::Senseless(_)) => {}
        }
        if own.is_lost() || records.is_unread {
            // Of one that cannot be had the file may have a record that is better than none; another keyframe's is not.
            if before.is_some() && same.is_none() {
                records.bare.extend([Kind::Picture, Kind::Condensed].map(|kind| (kind, id)));
            }
            return Ok(records);
        }
        let (kind, other, record) = match own.is_condensed() {
            true => (Kind::Condensed, Kind::Picture, picture::encode_condensed(&own)),
            false => (Kind::Picture, Kind::Condensed, picture::encode(&own)),
        };
        match own.kept() {
            Some(_) => {
                let record = record.ok_or_else(|| Fault::GivenUp("a record cannot be made of a picture".into()))?;
                records.new = Some((kind, id, record));
            }
            None => records.bare.push((Kind::Picture, id)),
        }
        // It is of one kind only.
        records.bare.push((other, id));
        Ok(records)
    }

    /// Closes it, as small as it can be; the next one to open it has nothing to repair.
    pub fn close(mut self) -> Result<(), StoreError> {
        let path = self.path.clone();
        self.records.as_mut().map_or(Ok(()), Records::compact).map_err(|fault| fault.of(&path))?;
        self.close_now()
    }

    /// The same without making it smaller first, for whoever is waited for.
    pub fn close_now(mut self) -> Result<(), StoreError> {
        let path = self.path.clone();
        self.records.take().map_or(Ok(()), Records::close).map_err(|fault| fault.of(&path))
    }
}

/// Makes a file of what `fill` writes into it, which is another process's map: verified in full, as by [`read`], before it has its name. Where anything
/// is wrong there is no such file afterwards.
pub fn adopt<E: From<StoreError>>(path: &Path, fill: impl FnOnce(&File) -> Result<(), E>) -> Result<Contents, E> {
    let named = |fault: Fault| E::from(fault.of(path));
    let (file, temporary) = nameless(path).map_err(named)?;
    let filled = || {
        fill(&file)?;
        let (contents, _, _) = look(&file, None).map_err(named)?;
        file.sync_all().map_err(Fault::Write).and_then(|()| give_name(&temporary, path)).map_err(named)?;
        Ok(contents)
    };
    filled().inspect_err(|_| {
        // Nobody knows it by this name but us.
        let _ = std::fs::remove_file(&temporary);
    })
}

/// Reads all there is without a change to the file. Also: what the records add up to, and the pages of landmarks.
/// `spool`: where pictures may wait.
fn look(file: &File, spool: Option<&Path>) -> Result<(Contents, Tally, BTreeSet<u32>), Fault> {
    let panicked = |panic| Err(Fault::Broken(format!("no sense can be made of it ({panic})")));
    contained(|| look_inside(file, spool)).unwrap_or_else(panicked)
}

fn look_inside(file: &File, spool: Option<&Path>) -> Result<(Contents, Tally, BTreeSet<u32>), Fault> {
    let front = Front::read(file)?;
    let bytes = file.metadata().map_err(Fault::Read)?.len();
    let mut records = Records::open(file.try_clone().map_err(Fault::Read)?, Access::Look).map_err(as_look)?;
    let (mut raw, mut pages) = (Raw::default(), BTreeSet::new());
    let (mut spool, mut condensed) = (spool.map(PictureSpool::new), VecDeque::new());
    let mut record_bytes = [0; 3];
    let tally = records.read_all(|kind, number, bytes, stored| {
        let like = if kind == Kind::Condensed as u8 { Kind::Picture as u8 } else { kind };
        if let Some(sum) = usize::from(like).checked_sub(1).and_then(|i| record_bytes.get_mut(i)) {
            *sum += stored as u64;
        }
        let sense = match kind {
            k if k == Kind::Header as u8 => {
                raw.header = HeaderRecord::decode(bytes);
                raw.header.is_some()
            }
            k if k == Kind::Keyframe as u8 => {
                if raw.keyframes.insert(number, bytes.to_vec()).is_some() {
                    return Err(Fault::Broken(format!("keyframe {number} is there twice")));
                }
                true
            }
            k if k == Kind::Picture as u8 || k == Kind::Condensed as u8 => {
                let picture =
                    if k == Kind::Picture as u8 { picture::decode(bytes) } else { picture::decode_condensed(bytes) };
                let sense = picture.is_some();
                if picture.is_some_and(|picture| raw.pictures.insert(number, picture).is_some()) {
                    return Err(Fault::Broken(format!("keyframe {number} has two pictures")));
                }
                if k == Kind::Condensed as u8 {
                    condensed.push_back(number);
                }
                // The newest, which come last (but for those that were not deflated), are the likeliest to be asked for first.
                if condensed.len() > MOST_READ
                    && let Some(picture) = condensed.pop_front().and_then(|oldest| raw.pictures.get_mut(&oldest))
                    && let Some(open) = &mut spool
                {
                    // Without one they stay in memory.
                    let is_away = picture.put_away(|picture| open.put(picture).ok().flatten());
                    if !is_away {
                        spool = None;
                    }
                }
                sense
            }
            k if k == Kind::Landmarks as u8 => pages.insert(number) && raw.add_landmarks(number, bytes).is_some(),
            _ => false,
        };
        sense.then_some(()).ok_or_else(|| Fault::Broken(format!("record {number} of kind {kind} makes no sense")))
    });
    let tally = tally.map_err(as_look)?;
    drop(records);
    let header = raw.header.clone().ok_or_else(|| Fault::Broken("it has no header".into()))?;
    if header.tally() != tally {
        let (told, there) = (header.records, tally.records);
        return Err(Fault::Broken(format!("{told} records were written, {there} are there or others than those")));
    }
    let contents = Contents {
        format: front.format,
        id: front.id,
        created_ns: front.created_ns,
        written_ns: header.written_ns,
        cairn: header.cairn,
        bytes,
        edition: Edition { id: front.id, tallies: [tally; 2] },
        record_bytes,
        saved: raw.maps().map_err(Fault::Broken)?,
    };
    Ok((contents, tally, pages))
}

/// Nothing is written where a file is only looked at.
fn as_look(fault: Fault) -> Fault {
    match fault {
        // The system's errors have its number, those of a file that is too short have none.
        Fault::Write(error) if error.raw_os_error().is_some() => Fault::Read(error),
        Fault::Write(error) => Fault::Broken(error.to_string()),
        other => other,
    }
}

fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn a_disk_that_fails_is_no_broken_map() {
        let failed = as_look(Fault::Write(io::Error::from_raw_os_error(libc::EIO)));
        assert!(matches!(failed, Fault::Read(_)) && !failed.is_in_the_data());
        assert!(as_look(Fault::Write(io::ErrorKind::UnexpectedEof.into())).is_in_the_data());
    }
}
