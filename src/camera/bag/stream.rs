//! The messages of one topic of a recording, file after file.

use std::path::{Path, PathBuf};

use mcap::records::Record;
use tracing::warn;

use super::super::SourceError;
use super::records::{Records, Step};

/// The messages of one topic, file after file.
#[derive(Debug)]
pub struct Stream {
    files: Vec<PathBuf>,
    next_file: usize,
    topic: String,
    open: Option<(Records, Vec<u16>)>,
}

impl Stream {
    pub fn new(files: Vec<PathBuf>, topic: &str) -> Self {
        Self { files, next_file: 0, topic: topic.into(), open: None }
    }

    /// The next message's bytes into `message`, and its log time; `None` at the end.
    pub fn next(&mut self, message: &mut Vec<u8>) -> Result<Option<i64>, SourceError> {
        loop {
            if self.open.is_none() {
                let Some(path) = self.files.get(self.next_file) else { return Ok(None) };
                let records = Records::open(path).map_err(|reason| failed(path, reason))?;
                self.next_file += 1;
                self.open = Some((records, Vec::new()));
            }
            let Some((records, channels)) = &mut self.open else { return Ok(None) };
            let mut found = None;
            let step = records.step(|record| match record {
                Record::Channel(channel) if channel.topic == self.topic && !channels.contains(&channel.id) => {
                    channels.push(channel.id);
                }
                Record::Message { header, data } if channels.contains(&header.channel_id) => {
                    message.clear();
                    message.extend_from_slice(data);
                    found = Some(i64::try_from(header.log_time).unwrap_or(i64::MAX));
                }
                _ => {}
            });
            match step.map_err(|reason| failed(records.path(), reason))? {
                Step::Record => {}
                Step::End => self.open = None,
                Step::CutOff => {
                    warn!(path = %records.path().display(), "recording is cut off, what is before the cut is replayed");
                    self.open = None;
                }
            }
            if found.is_some() {
                return Ok(found);
            }
        }
    }
}

fn failed(path: &Path, reason: String) -> SourceError {
    SourceError::Open { path: path.display().to_string(), reason }
}
