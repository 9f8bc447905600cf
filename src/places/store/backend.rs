//! Where the database's bytes lie: behind a front page of our own, in the file itself or in a copy that forgets what is written to it.
//!
//! The library's own `open` writes to a file before it has looked at it in full. So a file is looked at through [`Access::Look`] first:
//! what the library writes meanwhile (a repair after a power cut, its notes of who has opened it) goes to memory, and the file stays as it is to the
//! byte. Memory: 4 kB for each page written, [`MOST_WRITTEN`] at the most.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileExt;
use std::sync::{Mutex, PoisonError};

use redb::StorageBackend;

use super::front::FRONT_BYTES;

/// Bytes of a page of the copy.
const PAGE: u64 = 4096;
/// A look at a file of the size that a map has writes a few pages; one that wants more than these is no map's.
const MOST_WRITTEN: usize = 16_384;

/// What is done with writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// They go to the file.
    Write,
    /// They go to memory and are forgotten.
    Look,
}

/// See the module. Offsets are those behind the front page.
#[derive(Debug)]
pub struct Backend {
    file: File,
    overlay: Option<Mutex<Overlay>>,
}

#[derive(Debug)]
struct Overlay {
    len: u64,
    /// Of the file; beyond it there are zeros.
    file_len: u64,
    pages: BTreeMap<u64, Box<[u8; PAGE as usize]>>,
}

impl Backend {
    pub fn new(file: File, access: Access) -> io::Result<Self> {
        let len = file.metadata()?.len().saturating_sub(FRONT_BYTES);
        let overlay = || Mutex::new(Overlay { len, file_len: len, pages: BTreeMap::new() });
        Ok(Self { file, overlay: (access == Access::Look).then(overlay) })
    }

    fn overlay(&self) -> Option<std::sync::MutexGuard<'_, Overlay>> {
        // What a panic left half done is forgotten with the rest.
        self.overlay.as_ref().map(|o| o.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Overlay {
    /// One page as it is now, what lies beyond the file being zero.
    fn page(&self, file: &File, number: u64) -> io::Result<Box<[u8; PAGE as usize]>> {
        if let Some(page) = self.pages.get(&number) {
            return Ok(page.clone());
        }
        let mut page = Box::new([0; PAGE as usize]);
        let begin = number * PAGE;
        let there = self.file_len.saturating_sub(begin).min(PAGE) as usize;
        file.read_exact_at(&mut page[..there], FRONT_BYTES + begin)?;
        Ok(page)
    }

    fn read(&self, file: &File, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let end = offset.checked_add(out.len() as u64).filter(|end| *end <= self.len);
        end.ok_or_else(|| io::Error::new(ErrorKind::UnexpectedEof, "read beyond the end"))?;
        let mut done = 0;
        while done < out.len() {
            let at = offset + done as u64;
            let (number, within) = (at / PAGE, (at % PAGE) as usize);
            let count = (PAGE as usize - within).min(out.len() - done);
            out[done..done + count].copy_from_slice(&self.page(file, number)?[within..within + count]);
            done += count;
        }
        Ok(())
    }

    fn write(&mut self, file: &File, offset: u64, data: &[u8]) -> io::Result<()> {
        let mut done = 0;
        while done < data.len() {
            let at = offset + done as u64;
            let (number, within) = (at / PAGE, (at % PAGE) as usize);
            let count = (PAGE as usize - within).min(data.len() - done);
            let mut page = self.page(file, number)?;
            page[within..within + count].copy_from_slice(&data[done..done + count]);
            self.pages.insert(number, page);
            done += count;
        }
        if self.pages.len() > MOST_WRITTEN {
            return Err(io::Error::other("opening it takes more changes than any map's file does"));
        }
        self.len = self.len.max(offset + data.len() as u64);
        Ok(())
    }
}

impl StorageBackend for Backend {
    fn len(&self) -> Result<u64, io::Error> {
        match self.overlay() {
            Some(overlay) => Ok(overlay.len),
            None => Ok(self.file.metadata()?.len().saturating_sub(FRONT_BYTES)),
        }
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> Result<(), io::Error> {
        match self.overlay() {
            Some(overlay) => overlay.read(&self.file, offset, out),
            None => self.file.read_exact_at(out, FRONT_BYTES + offset),
        }
    }

    fn set_len(&self, len: u64) -> Result<(), io::Error> {
        match self.overlay() {
            Some(mut overlay) => {
                overlay.pages.retain(|number, _| number * PAGE < len);
                (overlay.len, overlay.file_len) = (len, overlay.file_len.min(len));
                Ok(())
            }
            None => self.file.set_len(FRONT_BYTES + len),
        }
    }

    fn sync_data(&self) -> Result<(), io::Error> {
        match self.overlay {
            Some(_) => Ok(()),
            None => self.file.sync_data(),
        }
    }

    fn write(&self, offset: u64, data: &[u8]) -> Result<(), io::Error> {
        match self.overlay() {
            Some(mut overlay) => overlay.write(&self.file, offset, data),
            None => self.file.write_all_at(data, FRONT_BYTES + offset),
        }
    }
}
