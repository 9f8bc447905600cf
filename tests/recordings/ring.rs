//! A ring that is kept by itself: tracking that is lost, a daemon that is gone.

use cairn::messages::{Pose, STATE_LOST, STATE_TRACKING};

use super::*;

/// The lens is covered for a second and a half, again and again: the first map may take its time.
const BLACKOUT: &str = "[simulator.blackout]\nenabled = true\nstart_s = 6.0\nframes = 45\nperiod_s = 20.0\n";

/// Waits for a file that was kept for this event; whole, as it gets its name at its beginning.
fn kept(folder: &Path, event: &str) -> PathBuf {
    let begin = Instant::now();
    let is_whole =
        |path: &PathBuf| fs::read(path).is_ok_and(|bytes| mcap::Summary::read(&bytes).is_ok_and(|s| s.is_some()));
    loop {
        let mut files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let ending = format!("Z-{event}.mcap");
        let found = files.find(|path| path.to_string_lossy().ends_with(&ending));
        if let Some(path) = found.filter(is_whole) {
            return path;
        }
        assert!(begin.elapsed() < Duration::from_secs(90), "nothing was kept for {event}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// States of the poses in a file, each once in a row.
fn states(path: &Path) -> Vec<u8> {
    let bytes = fs::read(path).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap());
    let poses = messages.filter(|message| message.channel.topic.ends_with("/pose"));
    // Behind CDR's four bytes it lies as on the wire.
    let mut states: Vec<u8> = poses.map(|pose| pose.data[4 + std::mem::offset_of!(Pose, state)]).collect();
    states.dedup();
    states
}

#[test]
fn a_ring_is_kept_when_tracking_is_lost_and_when_the_daemon_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("cairn.toml");
    fs::write(&config, format!("{SIMULATOR}{BLACKOUT}")).unwrap();
    let mut recorder = recorder("lost", &dir.path().join("run.mcap"), &["--ring", "1"]);
    let mut running = daemon("lost", &config);
    let lost = states(&kept(dir.path(), "LOST"));
    assert!(lost.windows(2).any(|pair| pair == [STATE_TRACKING, STATE_LOST]), "{lost:?}");
    running.0.kill().unwrap();
    running.0.wait().unwrap();
    let gone = states(&kept(dir.path(), "GONE"));
    assert!(gone.contains(&STATE_TRACKING), "{gone:?}");
    assert!(recorder.0.try_wait().unwrap().is_none(), "the recorder waits for the next daemon");
    recorder.signal("-TERM");
    assert_eq!(recorder.ends(), Some(0));
    kept(dir.path(), "STOPPED");
    assert!(!dir.path().join("run.ring").exists());
}
