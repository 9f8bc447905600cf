//! Records by kind and number in a database of one table, each with a checksum of its own; the one place where the library's panics end.
//!
//! A record is its bytes, since format 3 deflated where that makes them fewer (the header and what is a PNG are not), behind their CRC-32 (of kind,
//! number and these bytes), in pieces of [`PIECE`] bytes: the library gives a value that is larger than its pages of 4 kB a power of two of them, which
//! would waste a quarter of the file. [`Tally`] counts the records and adds up their
//! checksums, and the header record says what that has to be: so a record that is missing, old or of somewhere else is noticed although it is
//! sound by itself.
//!
//! One write is one transaction: after a crash all of it is there or nothing.

use std::borrow::Cow;
use std::fs::File;
use std::io::{Read, Write};

use flate2::Compression;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;
use redb::{Builder, Database, ReadableDatabase, ReadableTable, TableDefinition};

use super::backend::{Access, Backend};
use super::error::Fault;
use crate::telemetry::contained;

/// Kind, number, piece.
type Key = (u8, u32, u16);
const TABLE: TableDefinition<Key, &[u8]> = TableDefinition::new("records");
/// Bytes of a piece: with the library's own it fills a page.
const PIECE: usize = 4000;
/// Memory that the library may keep pages in, bytes.
const CACHE_BYTES: usize = 4 << 20;
/// A record with more pieces is none of ours (16 MB).
const MOST_PIECES: u16 = 4096;
const MOST_BYTES: usize = PIECE * MOST_PIECES as usize - 4;
/// The kind of a deflated record has this bit as well.
const DEFLATED: u8 = 0x80;
/// Beyond so many bytes a record becomes at most so many times as long as it is in the file: ours become two to five times as long.
const MOST_PLAIN: usize = 1 << 16;
const MOST_INFLATED: usize = 64;

/// What a record is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Kind {
    Header = 0,
    Keyframe = 1,
    Picture = 2,
    /// A page of them.
    Landmarks = 3,
    /// A picture that was condensed, since format 2; its keyframe has no other.
    Condensed = 4,
}

/// Number of records and sum of their checksums, the header's left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    pub records: u64,
    pub sum: u64,
}

impl Tally {
    fn add(&mut self, checksum: u32) {
        (self.records, self.sum) = (self.records.wrapping_add(1), self.sum.wrapping_add(u64::from(checksum)));
    }

    fn take(&mut self, checksum: u32) {
        (self.records, self.sum) = (self.records.wrapping_sub(1), self.sum.wrapping_sub(u64::from(checksum)));
    }
}

/// What of a record goes into the file, and as which kind.
type Kept<'a> = (u8, Cow<'a, [u8]>);

/// See the module.
pub struct Records {
    /// `None` once it has failed: what the library holds then is not to be trusted.
    database: Option<Database>,
}

impl Records {
    /// Opens what is behind the file's front page. `Look`: nothing is written, and all of the library's own checksums are verified.
    pub fn open(file: File, access: Access) -> Result<Self, Fault> {
        let database = guarded(move || {
            let backend = Backend::new(file, access)?;
            let mut builder = Builder::new();
            builder.set_cache_size(CACHE_BYTES).set_check_integrity_on_open(access == Access::Look);
            Ok(builder.create_with_backend(backend)?)
        })?;
        Ok(Self { database: Some(database) })
    }

    /// All records given to `each`: kind, number, bytes, and how many these are in the file. First those that are not deflated, then the others, both
    /// ascending. What they add up to.
    pub fn read_all(
        &mut self,
        mut each: impl FnMut(u8, u32, &[u8], usize) -> Result<(), Fault>,
    ) -> Result<Tally, Fault> {
        let database = self.database.as_ref().ok_or_else(closed)?;
        let mut refused = None;
        let mut tally = Tally::default();
        let walked = guarded(|| {
            let reading = database.begin_read()?;
            let table = match reading.open_table(TABLE) {
                Err(redb::TableError::TableDoesNotExist(_)) => return Ok(()),
                other => other?,
            };
            let mut gathered = Gathered::default();
            for entry in table.iter()? {
                let (key, value) = entry?;
                let (kind, number, piece) = key.value();
                if piece == 0 {
                    refused = gathered.finish(&mut tally, &mut each).err();
                    gathered = Gathered { key: Some((kind, number)), pieces: 0, bytes: Vec::new() };
                }
                refused = refused.take().or_else(|| gathered.add(kind, number, piece, value.value()).err());
                if refused.is_some() {
                    return Ok(());
                }
            }
            refused = gathered.finish(&mut tally, &mut each).err();
            Ok(())
        });
        walked?;
        refused.map_or(Ok(tally), Err)
    }

    /// One write: puts `records`, removes `gone`, and puts the header that `header` makes of the new tally. All of it is on the disk when this
    /// returns, or none.
    pub fn write(
        &mut self,
        tally: Tally,
        records: &[(Kind, u32, Vec<u8>)],
        gone: &[(Kind, u32)],
        header: impl FnOnce(Tally) -> Option<Vec<u8>>,
    ) -> Result<Tally, Fault> {
        self.write_as(deflated, tally, records, gone, header)
    }

    /// `form`: how a record is kept.
    pub(super) fn write_as(
        &mut self,
        form: fn(Kind, &[u8]) -> Kept<'_>,
        tally: Tally,
        records: &[(Kind, u32, Vec<u8>)],
        gone: &[(Kind, u32)],
        header: impl FnOnce(Tally) -> Option<Vec<u8>>,
    ) -> Result<Tally, Fault> {
        for (kind, number, bytes) in records {
            if bytes.len() > MOST_BYTES {
                let (kind, size) = (*kind as u8, bytes.len());
                let error = format!("record {number} of kind {kind} has {size} bytes, more than {MOST_BYTES}");
                return Err(Fault::Write(std::io::Error::other(error)));
            }
        }
        let database = self.database.take().ok_or_else(closed)?;
        let outcome = guarded(move || {
            let mut tally = tally;
            let writing = database.begin_write()?;
            {
                let mut table = writing.open_table(TABLE)?;
                for &(kind, number) in gone {
                    for kind in [kind as u8, kind as u8 | DEFLATED] {
                        remove(&mut table, kind, number, 0, &mut tally)?;
                    }
                }
                for (kind, number, bytes) in records {
                    let (kind, bytes) = form(*kind, bytes);
                    put(&mut table, kind, *number, &bytes, &mut tally)?;
                    remove(&mut table, kind ^ DEFLATED, *number, 0, &mut tally)?;
                }
                let mut aside = Tally::default();
                let header = header(tally).ok_or_else(|| redb::Error::Corrupted("no header can be made".into()))?;
                put(&mut table, Kind::Header as u8, 0, &header, &mut aside)?;
            }
            writing.commit()?;
            Ok((database, tally))
        });
        let (database, tally) = outcome?;
        self.database = Some(database);
        Ok(tally)
    }

    /// Gives back the space that older versions of records had, which may take a while; a file that cannot be made smaller is as good.
    pub fn compact(&mut self) -> Result<(), Fault> {
        let Some(mut database) = self.database.take() else { return Ok(()) };
        self.database = Some(guarded(move || {
            let _ = database.compact();
            Ok(database)
        })?);
        Ok(())
    }

    /// Closes it for good: what is on the disk needs no repair when it is opened next.
    pub fn close(mut self) -> Result<(), Fault> {
        let Some(database) = self.database.take() else { return Ok(()) };
        guarded(move || Ok(database.close()?))
    }
}

impl Drop for Records {
    fn drop(&mut self) {
        // Closing is work of the library's, too.
        if let Some(database) = self.database.take() {
            let _ = contained(move || drop(database));
        }
    }
}

/// The pieces of a record so far.
#[derive(Default)]
struct Gathered {
    key: Option<(u8, u32)>,
    pieces: u16,
    bytes: Vec<u8>,
}

impl Gathered {
    fn add(&mut self, kind: u8, number: u32, piece: u16, bytes: &[u8]) -> Result<(), Fault> {
        if self.key != Some((kind, number)) || piece != self.pieces || piece >= MOST_PIECES {
            return Err(broken(kind, number, "has lost a part"));
        }
        self.pieces += 1;
        self.bytes.extend(bytes);
        Ok(())
    }

    fn finish(
        &self,
        tally: &mut Tally,
        each: &mut impl FnMut(u8, u32, &[u8], usize) -> Result<(), Fault>,
    ) -> Result<(), Fault> {
        let Some((kind, number)) = self.key else { return Ok(()) };
        let (told, bytes) = self.bytes.split_at_checked(4).ok_or_else(|| broken(kind, number, "is cut off"))?;
        let checksum = checksum(kind, number, bytes);
        if told != checksum.to_le_bytes() {
            return Err(broken(kind, number, "has a wrong checksum"));
        }
        if kind != Kind::Header as u8 {
            tally.add(checksum);
        }
        if kind & DEFLATED == 0 {
            return each(kind, number, bytes, bytes.len());
        }
        let (own, mut inflated) = (kind & !DEFLATED, Vec::new());
        let most = MOST_BYTES.min(MOST_INFLATED * bytes.len() + MOST_PLAIN);
        let read = DeflateDecoder::new(bytes).take(most as u64 + 1).read_to_end(&mut inflated);
        if read.is_err() || inflated.len() > most || [Kind::Header, Kind::Picture].iter().any(|k| *k as u8 == own) {
            return Err(broken(kind, number, "cannot be inflated"));
        }
        each(own, number, &inflated, bytes.len())
    }
}

/// A record as it is kept. What is deflated already, and the header, by which all else is judged, stay as they are.
fn deflated(kind: Kind, bytes: &[u8]) -> Kept<'_> {
    let own = (kind as u8, Cow::Borrowed(bytes));
    if matches!(kind, Kind::Header | Kind::Picture) {
        return own;
    }
    let mut encoder = DeflateEncoder::new(Vec::with_capacity(bytes.len()), Compression::fast());
    let smaller = encoder.write_all(bytes).and_then(|()| encoder.finish()).ok().filter(|d| d.len() < bytes.len());
    smaller.map_or(own, |smaller| (kind as u8 | DEFLATED, Cow::Owned(smaller)))
}

fn broken(kind: u8, number: u32, how: &str) -> Fault {
    let what = match kind & !DEFLATED {
        0 => "the header".into(),
        1 => format!("keyframe {number}"),
        2 | 4 => format!("the picture of keyframe {number}"),
        3 => format!("page {number} of the landmarks"),
        _ => format!("record {number} of kind {kind}"),
    };
    Fault::Broken(format!("{what} {how}"))
}

fn closed() -> Fault {
    Fault::GivenUp("an earlier write failed".into())
}

fn checksum(kind: u8, number: u32, bytes: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&[kind]);
    hasher.update(&number.to_le_bytes());
    hasher.update(bytes);
    hasher.finalize()
}

type Table<'a> = redb::Table<'a, Key, &'static [u8]>;

fn put(table: &mut Table<'_>, kind: u8, number: u32, bytes: &[u8], tally: &mut Tally) -> Result<(), redb::Error> {
    let checksum = checksum(kind, number, bytes);
    let framed = [&checksum.to_le_bytes()[..], bytes].concat();
    let mut pieces = 0;
    for piece in framed.chunks(PIECE) {
        let old = table.insert((kind, number, pieces), piece)?;
        if let (0, Some(old)) = (pieces, old) {
            tally.take(first_word(old.value()));
        }
        pieces += 1;
    }
    tally.add(checksum);
    remove(table, kind, number, pieces, tally)
}

/// Removes the pieces of a record from this one on.
fn remove(table: &mut Table<'_>, kind: u8, number: u32, from: u16, tally: &mut Tally) -> Result<(), redb::Error> {
    for piece in from..MOST_PIECES {
        let Some(old) = table.remove((kind, number, piece))? else { break };
        if piece == 0 {
            tally.take(first_word(old.value()));
        }
    }
    Ok(())
}

fn first_word(bytes: &[u8]) -> u32 {
    bytes.first_chunk().map_or(0, |word| u32::from_le_bytes(*word))
}

/// The library's answer; its panics, which a broken file can bring about, are errors like any other.
fn guarded<T>(work: impl FnOnce() -> Result<T, redb::Error>) -> Result<T, Fault> {
    match contained(work) {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(redb::Error::Io(error))) => Err(Fault::Write(error)),
        Ok(Err(error)) => Err(Fault::Broken(error.to_string())),
        Err(panic) => Err(Fault::Broken(format!("the database cannot make sense of it ({panic})"))),
    }
}
