//! The journal of systemd: whether stderr is connected to it, and the layer that speaks its own protocol.
//!
//! A record's fields become the journal's, in capitals and without a prefix: `journalctl -u cairn STATE=LOST`. PRIORITY is 3
//! for errors, 4 for warnings, 6 for info, 7 below. What stderr would have got goes there alone.

use std::ffi::OsStr;
use std::io;
use std::os::fd::AsFd;

use tracing_journald::{Priority, PriorityMappings};

/// Whether stderr of this process is connected to the journal: systemd says which device and inode it connected, and
/// somebody in between may have sent stderr elsewhere since.
pub(super) fn is_stderr() -> bool {
    std::env::var_os("JOURNAL_STREAM").is_some_and(|stream| is_stream(&stream, io::stderr()))
}

/// Whether a file is the `device:inode` of JOURNAL_STREAM.
fn is_stream(stream: &OsStr, file: impl AsFd) -> bool {
    let parts = stream.to_str().and_then(|text| text.split_once(':'));
    let numbers = parts.and_then(|(device, inode)| Some((device.parse::<u64>().ok()?, inode.parse::<u64>().ok()?)));
    // Both are what the kernel calls them, whatever their width on this machine.
    #[allow(clippy::unnecessary_cast)]
    numbers.is_some_and(|(device, inode)| {
        rustix::fs::fstat(file).is_ok_and(|stat| stat.st_dev as u64 == device && stat.st_ino as u64 == inode)
    })
}

/// The layer, or why the journal cannot be reached.
pub(super) fn layer() -> io::Result<tracing_journald::Layer> {
    let priorities = PriorityMappings {
        error: Priority::Error,
        warn: Priority::Warning,
        info: Priority::Informational,
        debug: Priority::Debug,
        trace: Priority::Debug,
    };
    Ok(tracing_journald::layer()?
        .with_field_prefix(None)
        .with_syslog_identifier("cairn".into())
        .with_priority_mappings(priorities))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::MetadataExt;

    #[test]
    fn only_the_very_file_that_systemd_connected_is_the_journal() {
        let file = tempfile::tempfile().expect("file");
        let meta = file.metadata().expect("metadata");
        let is = |text: String| is_stream(OsStr::new(&text), &file);
        assert!(is(format!("{}:{}", meta.dev(), meta.ino())));
        assert!(!is(format!("{}:{}", meta.dev(), meta.ino() + 1)), "stderr was sent elsewhere");
        for nonsense in ["", ":", "1", "a:b", "1:2:3"] {
            assert!(!is(nonsense.into()), "{nonsense}");
        }
    }
}
