//! The first page of a map file: what it is, before any library looks at it.
//!
//! | bytes | what |
//! |---|---|
//! | 0..8 | `CAIRNMAP` |
//! | 8..12 | version of the format, u32 little-endian ([`FORMAT`]) |
//! | 12..28 | id of the map: random, given when the file was made |
//! | 28..36 | when the file was made, ns since 1970, i64 little-endian |
//! | 36..4092 | zero |
//! | 4092..4096 | CRC-32 (IEEE 802.3) of all bytes before, u32 little-endian |
//!
//! It is written once and never changed (a file of an older format becomes another file of the same name). The database follows.

use std::fs::File;
use std::os::unix::fs::FileExt;

use super::error::{FORMAT, Fault, OLDEST_FORMAT};

pub const FRONT_BYTES: u64 = 4096;

const MAGIC: [u8; 8] = *b"CAIRNMAP";
const CHECKSUM: usize = FRONT_BYTES as usize - 4;

/// What the front page says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Front {
    /// Of the file that it was read from.
    pub format: u32,
    pub id: [u8; 16],
    /// ns since 1970.
    pub created_ns: i64,
}

impl Front {
    /// Of the present format.
    pub fn page(&self) -> Vec<u8> {
        let mut page = Vec::with_capacity(FRONT_BYTES as usize);
        page.extend(MAGIC);
        page.extend(FORMAT.to_le_bytes());
        page.extend(self.id);
        page.extend(self.created_ns.to_le_bytes());
        page.resize(CHECKSUM, 0);
        page.extend(crc32fast::hash(&page).to_le_bytes());
        page
    }

    pub fn read(file: &File) -> Result<Self, Fault> {
        let mut page = vec![0; FRONT_BYTES as usize];
        let len = file.metadata().map_err(Fault::Read)?.len();
        let there = len.min(FRONT_BYTES) as usize;
        file.read_exact_at(&mut page[..there], 0).map_err(Fault::Read)?;
        if !page.starts_with(&MAGIC[..there.min(MAGIC.len())]) || there == 0 {
            return Err(Fault::Foreign);
        }
        if len <= FRONT_BYTES {
            return Err(Fault::Broken(format!("it is cut off after {len} bytes")));
        }
        let word = |at: usize| page.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
        if word(CHECKSUM) != Some(crc32fast::hash(&page[..CHECKSUM])) {
            return Err(Fault::Broken("the checksum of its first page is wrong".into()));
        }
        let format = word(8).unwrap_or_default();
        if !(OLDEST_FORMAT..=FORMAT).contains(&format) {
            return Err(Fault::Version(format));
        }
        let (mut id, mut created) = ([0; 16], [0; 8]);
        id.copy_from_slice(&page[12..28]);
        created.copy_from_slice(&page[28..36]);
        Ok(Self { format, id, created_ns: i64::from_le_bytes(created) })
    }
}
