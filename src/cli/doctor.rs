//! `cairn doctor`: what this machine has, what is missing, and what to do next.

use std::fmt::Write as _;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

use super::camera_calibration::{identify, stored};
use super::{CliError, exit_code, session};
use crate::calibration::store;
use crate::camera::v4l2::{CameraInfo, list_cameras};
use crate::config::{self, Config, SourceKind};

/// Shared memory that a daemon of default size takes, with room to spare, bytes.
const SHM_NEEDED: u64 = 64 << 20;
/// Offers of a camera that are shown.
const MAX_OFFERS: usize = 24;

/// Check cameras, calibrations, configuration and shared memory, and say what to do next
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Configuration file [default: /etc/cairn/cairn.toml if it exists]
    #[arg(long, value_name = "FILE")]
    pub config: Option<std::path::PathBuf>,
}

/// The report as it grows.
#[derive(Default)]
struct Report {
    text: String,
    /// What keeps `cairn run` from working.
    problems: usize,
    next: Vec<String>,
}

impl Report {
    fn title(&mut self, title: &str) {
        let _ = writeln!(self.text, "{title}");
    }
    fn good(&mut self, line: &str) {
        let _ = writeln!(self.text, "  ok    {line}");
    }
    fn note(&mut self, line: &str) {
        let _ = writeln!(self.text, "  note  {line}");
    }
    fn bad(&mut self, line: &str, next: &str) {
        let _ = writeln!(self.text, "  FAIL  {line}");
        self.problems += 1;
        self.next.push(next.into());
    }
}

/// Prints the report on stdout; exit code 69 when something keeps `cairn run` from working.
pub fn run(args: &DoctorArgs) -> Result<ExitCode, CliError> {
    let mut report = Report::default();
    let config = configuration(&mut report, args);
    cameras(&mut report, &config);
    shared_memory(&mut report);
    wire(&mut report);
    folders(&mut report);
    report.title("next");
    let next = std::mem::take(&mut report.next);
    if next.is_empty() {
        report.good("nothing: `cairn run` has all it needs");
    }
    for (n, step) in next.iter().enumerate() {
        let _ = writeln!(report.text, "  {}. {step}", n + 1);
    }
    session::print(&report.text)?;
    Ok(if report.problems == 0 { ExitCode::SUCCESS } else { ExitCode::from(exit_code::UNAVAILABLE) })
}

fn configuration(report: &mut Report, args: &DoctorArgs) -> Config {
    report.title("configuration");
    match config::find(args.config.as_deref()) {
        Ok((config, origin)) => {
            report.good(&format!("{origin}, prefix {}", config.prefix));
            config
        }
        Err(error) => {
            report.bad(&error.to_string(), "correct the configuration file where the message says");
            Config::default()
        }
    }
}

fn cameras(report: &mut Report, config: &Config) {
    report.title("cameras");
    let needs_camera = config.daemon.source == SourceKind::Camera;
    let listed = list_cameras();
    let mut usable = 0;
    for camera in &listed {
        match camera {
            Ok(camera) => {
                usable += usize::from(!camera.offers.is_empty());
                one_camera(report, camera, config);
            }
            Err(error) => {
                let text = error.to_string();
                let next = if text.contains("group 'video'") {
                    "let this user use cameras: `sudo usermod -aG video $USER`, then log in anew"
                } else {
                    "see why the camera cannot be opened (message above)"
                };
                report.bad(&text, next);
            }
        }
    }
    if usable == 0 && needs_camera {
        let next = "plug a USB webcam in (or try the simulator: `cairn demo`)";
        report.bad("no camera that sends GREY, YUYV or MJPEG", next);
    }
}

fn one_camera(report: &mut Report, camera: &CameraInfo, config: &Config) {
    let identity = identify(camera);
    let path = camera.path.display();
    report.good(&format!("{path}: {} ({}, {}), {identity}", camera.card, camera.driver, camera.bus));
    if let Ok(meta) = std::fs::metadata(&camera.path) {
        report.note(&format!("{path}: permissions {:o}, group {}", meta.mode() & 0o777, meta.gid()));
    }
    if camera.offers.is_empty() {
        report.note(&format!("{path}: sends no GREY, YUYV or MJPEG, so it cannot be used"));
        return;
    }
    let mut offers: Vec<String> =
        camera.offers.iter().map(|o| format!("{} {}x{}", o.format, o.width, o.height)).collect();
    offers.dedup();
    let more = offers.len().saturating_sub(MAX_OFFERS);
    offers.truncate(MAX_OFFERS);
    let rest = if more > 0 { format!(" and {more} more") } else { String::new() };
    report.note(&format!("{path}: {}{rest}", offers.join(", ")));
    let file = &config.calibration.file;
    if !file.as_os_str().is_empty() {
        match crate::calibration::load_camera(file) {
            Ok(c) => {
                report.good(&format!("calibration {} for {}x{} px (configured)", file.display(), c.width, c.height))
            }
            Err(error) => report.bad(&error.to_string(), "correct calibration.file, or leave it empty"),
        }
        return;
    }
    match stored(&identity, (config.camera.width_px, config.camera.height_px)) {
        Some(found) => {
            let scaled = found.scaled_from.map_or(String::new(), |(w, h)| format!(", scaled from {w}x{h}"));
            let sigma = found.fx_sigma_px.map_or(String::new(), |s| format!(" +- {s:.2}"));
            report.good(&format!(
                "calibration {} ({}), fx {:.1}{sigma} px{scaled}",
                found.path.display(),
                age(found.unix_s),
                found.camera.fx
            ));
        }
        None => {
            let size = format!("{}x{} px", config.camera.width_px, config.camera.height_px);
            let next =
                format!("calibrate it, one minute: `cairn calibrate --camera {path} --pattern 9x6 --square 0.025`");
            report.note(&format!("{path}: no calibration for {size}"));
            report.next.push(next);
        }
    }
}

/// How long ago.
fn age(unix_s: Option<u64>) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    match unix_s.map(|s| now.saturating_sub(s) / 86_400) {
        None => "age unknown".into(),
        Some(0) => "made today".into(),
        Some(1) => "1 day old".into(),
        Some(days) => format!("{days} days old"),
    }
}

fn shared_memory(report: &mut Report) {
    report.title("shared memory");
    match rustix::fs::statvfs("/dev/shm") {
        Ok(stat) => {
            let free = stat.f_bavail.saturating_mul(stat.f_frsize);
            let line =
                format!("/dev/shm: {} MB free of {} MB", free >> 20, stat.f_blocks.saturating_mul(stat.f_frsize) >> 20);
            if free < SHM_NEEDED {
                let next = "make room: `ls -l /dev/shm`, or `sudo mount -o remount,size=256M /dev/shm`";
                report.bad(&format!("{line}, {} MB are needed", SHM_NEEDED >> 20), next);
            } else {
                report.good(&line);
            }
        }
        Err(error) => report.bad(&format!("/dev/shm: {error}"), "mount a tmpfs on /dev/shm"),
    }
}

/// Files of the wire that another user owns keep this user from connecting.
fn wire(report: &mut Report) {
    report.title("iceoryx2");
    let root = Path::new("/tmp/iceoryx2");
    let own = std::fs::metadata("/proc/self").map(|m| m.uid()).ok();
    match std::fs::metadata(root).map(|m| m.uid()) {
        Err(_) => report.good("/tmp/iceoryx2 does not exist yet: made at the first start"),
        Ok(owner) if Some(owner) == own => report.good("/tmp/iceoryx2 belongs to this user"),
        Ok(owner) => report.bad(
            &format!(
                "/tmp/iceoryx2 belongs to user {owner}, this is user {}",
                own.map_or("?".into(), |u| u.to_string())
            ),
            "run daemon and planners as one user, or remove /tmp/iceoryx2 while nothing runs",
        ),
    }
}

fn folders(report: &mut Report) {
    report.title("calibrations are kept in");
    for folder in store::search_folders() {
        let count = std::fs::read_dir(&folder)
            .map(|d| d.flatten().filter(|e| e.path().extension().is_some_and(|x| x == "toml")).count());
        match count {
            Ok(count) => report.good(&format!("{}: {count} files", folder.display())),
            Err(_) => report.note(&format!("{}: not there", folder.display())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_configuration_is_a_failure_with_a_next_step() {
        let dir = tempfile::tempdir().expect("folder");
        let file = dir.path().join("cairn.toml");
        std::fs::write(&file, "[camera]\nwidth = 3\n").expect("written");
        let mut report = Report::default();
        configuration(&mut report, &DoctorArgs { config: Some(file) });
        assert_eq!((report.problems, report.next.len()), (1, 1));
        assert!(report.text.contains("cairn.toml:2"), "{}", report.text);
    }

    #[test]
    fn ages_are_told_in_days() {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_secs();
        assert_eq!(age(Some(now - 100)), "made today");
        assert_eq!(age(Some(now - 86_400 * 12 - 5)), "12 days old");
        assert_eq!(age(None), "age unknown");
    }
}
