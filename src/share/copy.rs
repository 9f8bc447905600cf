//! All messages of a file of ours into another one.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use mcap::records::{Record as McapRecord, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::ShareError;
use super::file::{McapFile, reason};
use super::records::{Record, Topic};

/// Read at once, bytes.
const READ_BYTES: usize = 1 << 20;
/// No record of ours is longer: a picture, or a chunk's worth of a map.
const MAX_RECORD_BYTES: usize = 256 << 20;

/// Appends what `from` holds. The inner error says why it ends early; what came before is copied. The outer one is of the target.
pub fn copy(from: &Path, to: &mut McapFile) -> Result<Result<(), String>, ShareError> {
    let mut file = match File::open(from) {
        Ok(file) => file,
        Err(e) => return Ok(Err(e.to_string())),
    };
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(MAX_RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    let mut topics = BTreeMap::<u16, Topic>::new();
    let names = Topic::ALL.map(|topic| (topic, topic.name(to.prefix())));
    while let Some(event) = reader.next_event() {
        let record = match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let read = file.read(reader.insert(wanted.max(READ_BYTES)));
                match read {
                    Ok(bytes) => reader.notify_read(bytes),
                    Err(e) => return Ok(Err(e.to_string())),
                }
                continue;
            }
            Ok(LinearReadEvent::Record { opcode: op::DATA_END, .. }) => break,
            Ok(LinearReadEvent::Record { data, opcode }) => mcap::parse_record(opcode, data),
            Err(e) => Err(e),
        };
        match record {
            Ok(McapRecord::Channel(channel)) => {
                let own = names.iter().find(|(_, name)| *name == channel.topic);
                topics.extend(own.map(|(topic, _)| (channel.id, *topic)));
            }
            Ok(McapRecord::Message { header, data }) => {
                if let Some(topic) = topics.get(&header.channel_id) {
                    let time_ns = i64::try_from(header.log_time).unwrap_or(i64::MAX);
                    to.write(&Record { topic: *topic, time_ns, data: data.into_owned() })?;
                }
            }
            Ok(_) => {}
            Err(e) => return Ok(Err(reason(&e))),
        }
    }
    Ok(Ok(()))
}
