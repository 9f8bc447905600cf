//! The records of one MCAP file, one after the other, read in pieces: a file may be larger than memory, and may end early.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};

/// Read at once, bytes.
const READ_BYTES: usize = 256 << 10;
/// A longer record is a broken length, bytes: an uncompressed picture of 1920x1200 with 16 bits and alpha is 18 MB, a cloud of a large lidar the same.
const MAX_RECORD_BYTES: usize = 256 << 20;
/// At the end of a file that was closed: a footer (opcode, length, start of the summary, two words more), and the format's eight bytes.
const FOOTER_BYTES: u64 = 1 + 8 + 20;
const END_BYTES: u64 = FOOTER_BYTES + MAGIC.len() as u64;

/// What one step came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// A record was shown.
    Record,
    End,
    /// The file ends in the middle of a record, as that of a killed recorder does.
    CutOff,
}

/// An open file.
pub struct Records {
    path: PathBuf,
    file: File,
    /// Bytes that have not been read.
    left: u64,
    /// The file was closed by who wrote it.
    closed: bool,
    reader: LinearReader,
}

impl std::fmt::Debug for Records {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Records").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Records {
    /// Opens a file and looks at its first bytes.
    pub fn open(path: &Path) -> Result<Self, String> {
        let metadata = std::fs::metadata(path).map_err(|e| e.to_string())?;
        if !metadata.is_file() {
            return Err("is not a file".into());
        }
        let mut file = File::open(path).map_err(|e| e.to_string())?;
        let mut begin = Vec::new();
        file.by_ref().take(MAGIC.len() as u64).read_to_end(&mut begin).map_err(|e| e.to_string())?;
        if begin.is_empty() {
            return Err("is no MCAP file, it is empty".into());
        }
        if begin != MAGIC {
            return Err(format!("is no MCAP file, begins with {begin:02x?}"));
        }
        let mut end = [0; MAGIC.len()];
        let at = metadata.len().saturating_sub(MAGIC.len() as u64);
        file.seek(SeekFrom::Start(at)).and_then(|_| file.read_exact(&mut end)).map_err(|e| e.to_string())?;
        file.seek(SeekFrom::Start(MAGIC.len() as u64)).map_err(|e| e.to_string())?;
        let left = metadata.len().saturating_sub(MAGIC.len() as u64);
        Ok(Self { path: path.to_owned(), file, left, closed: end == MAGIC && at > 0, reader: reader() })
    }

    /// The same file from its summary on; `None` if it has none.
    pub fn summary(&self) -> Option<Self> {
        let mut file = File::open(&self.path).ok()?;
        let size = file.metadata().ok()?.len();
        let footer_at = size.checked_sub(END_BYTES).filter(|_| self.closed)?;
        let mut footer = [0; FOOTER_BYTES as usize];
        file.seek(SeekFrom::Start(footer_at)).ok()?;
        file.read_exact(&mut footer).ok()?;
        let summary_at = u64::from_le_bytes(footer[9..17].try_into().ok()?);
        if footer[0] != op::FOOTER || !(MAGIC.len() as u64..footer_at).contains(&summary_at) {
            return None;
        }
        file.seek(SeekFrom::Start(summary_at)).ok()?;
        Some(Self { path: self.path.clone(), file, left: size - summary_at, closed: true, reader: reader() })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Shows the next record, if it is a schema, a channel, a message or the statistics: others are not looked into, as no picture depends on
    /// them. An error is damage, after which nothing is to be had.
    pub fn step(&mut self, mut show: impl FnMut(&Record)) -> Result<Step, String> {
        loop {
            match self.reader.next_event() {
                None => return Ok(if self.closed { Step::End } else { Step::CutOff }),
                Some(Err(McapError::UnexpectedEof)) => return Ok(Step::CutOff),
                // A recorder that writes a chunk's length last, and died before.
                Some(Err(McapError::UnexpectedEoc)) if !self.closed => return Ok(Step::CutOff),
                Some(Err(e)) => return Err(reason(&e)),
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    // A length that lies must not take more memory than the file has bytes.
                    let left = usize::try_from(self.left).unwrap_or(usize::MAX);
                    let piece = self.reader.insert(wanted.min(left).max(READ_BYTES));
                    let read = self.file.read(piece).map_err(|e| e.to_string())?;
                    self.left = self.left.saturating_sub(read as u64);
                    self.reader.notify_read(read);
                }
                // Behind it are copies of what was seen, and the index.
                Some(Ok(LinearReadEvent::Record { opcode: op::DATA_END | op::FOOTER, .. })) => return Ok(Step::End),
                // Chunks are opened by the reader; one that it shows as it is begins where a length has lied.
                Some(Ok(LinearReadEvent::Record { opcode: op::CHUNK, .. })) => {
                    return Err("is damaged: a record's length is not that of the record".into());
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    if let op::SCHEMA | op::CHANNEL | op::MESSAGE | op::STATISTICS = opcode {
                        show(&mcap::parse_record(opcode, data).map_err(|e| reason(&e))?);
                    }
                    return Ok(Step::Record);
                }
            }
        }
    }
}

fn reader() -> LinearReader {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(MAX_RECORD_BYTES);
    LinearReader::new_with_options(options)
}

/// What happened, not that something did.
fn reason(error: &McapError) -> String {
    match error {
        McapError::Io(e) => format!("is damaged: {e}"),
        McapError::Parse(_) => "is damaged: a record cannot be parsed".into(),
        e => format!("is damaged: {e}"),
    }
}
