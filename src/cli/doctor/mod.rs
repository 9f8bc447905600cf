//! `cairn doctor`: what this machine has, what is missing, and what to do next.
//!
//! It looks at files and at /proc, asks systemd about the unit, hears what a running daemon of this user reports, and where none
//! runs opens the camera as the daemon would and counts pictures for a second. Each check is split: something that fetches, and
//! something that judges what was fetched, so that every fault is tested without having it.
//!
//! It changes nothing, and what it opens it closes again.

mod probe;
pub(super) mod processes;
mod report;
mod service;
mod wire;

use std::fmt::Write as _;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

use probe::Outcome;
use report::Report;

use super::camera_calibration::{identify, stored};
use super::endpoint_args::EndpointArgs;
use super::{CliError, exit_code, session};
use crate::calibration::store::{self, CameraIdentity};
use crate::calibration::{CalibrationFile, Unsaid};
use crate::camera::v4l2::{CameraInfo, list_cameras, meant};
use crate::config::{self, CalibrationConfig, Config, SourceKind};
use crate::messages::effective_uid;

/// Offers of a camera that are shown.
const MAX_OFFERS: usize = 24;

/// Check service, cameras, calibrations, configuration and shared memory, and say what to do next
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Configuration file [default: /etc/cairn/cairn.toml if it exists]
    #[arg(long, value_name = "FILE")]
    pub config: Option<std::path::PathBuf>,
    /// First part of the services' names [default: the configuration's]
    #[arg(long, env = "CAIRN_PREFIX", value_name = "PREFIX")]
    pub prefix: Option<String>,
}

/// Prints the report on stdout; exit code 69 when something keeps `cairn run` from working.
pub fn run(args: &DoctorArgs) -> Result<ExitCode, CliError> {
    let mut report = Report::default();
    let config = configuration(&mut report, args);
    let prefix = args.prefix.clone().unwrap_or_else(|| config.prefix.clone());
    let endpoint = EndpointArgs { prefix }.endpoint()?;
    let (proc, us) = (Path::new("/proc"), effective_uid());
    let passwd = std::fs::read_to_string("/etc/passwd").unwrap_or_default();
    let name_of = |uid: u32| wire::user_of(&passwd, uid).map_or_else(|| uid.to_string(), str::to_owned);

    report.title("service");
    service::judge_unit(&mut report, service::unit().as_deref());
    let running = processes::daemons(proc);
    service::daemons(&mut report, &running, us, &name_of);
    let heard = service::reported(&mut report, &endpoint);

    cameras(&mut report, &config);
    try_camera(&mut report, &config, heard);
    wire::shared_memory(&mut report, !running.is_empty());
    wire::counter(&mut report, endpoint.squatter(false));
    wire::root(&mut report, &endpoint.root(), us, wire::user_id(&passwd, "cairn"), &name_of);
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
    let listed = list_cameras(&config.camera);
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
        let program = if cfg!(feature = "tools") { "cairn" } else { "cairn-tools" };
        let next = format!("plug a USB webcam in (or try the simulator: `{program} demo`)");
        report.bad("no camera that sends GREY, YUYV or MJPEG", &next);
    }
}

/// Opens the camera, unless a daemon that can be heard has it: that one has said what it sees. With `auto` the next one when the first is not
/// to be had, as the daemon does.
fn try_camera(report: &mut Report, config: &Config, heard: bool) {
    if config.daemon.source != SourceKind::Camera {
        return;
    }
    let listed: Vec<CameraInfo> = list_cameras(&config.camera).into_iter().flatten().collect();
    let meant = meant(&config.camera, listed.iter());
    if meant.is_empty() && config.camera.device != "auto" && !listed.is_empty() {
        let line = format!("camera.device = \"{}\" is none of these cameras", config.camera.device);
        report.bad(&line, "plug that camera in, or set camera.device to one of them, or to \"auto\"");
    }
    let mut busy = Vec::new();
    for camera in meant.into_iter().filter(|c| !c.offers.is_empty()) {
        let holders = processes::holders(Path::new("/proc"), &camera.path);
        let device = camera.path.display().to_string();
        if let Some(daemon) = holders.0.iter().find(|p| p.name == "cairn") {
            return report.good(&format!("{device} is used by a daemon (pid {})", daemon.pid));
        }
        if heard {
            continue;
        }
        let outcome = probe::try_camera(&config.camera, &camera.path);
        if matches!(outcome, Outcome::NotOpened(_)) {
            busy.push((device, outcome, holders));
            continue;
        }
        for (device, ..) in &busy {
            report.note(&format!("{device} cannot be had now, so the daemon would take the next one"));
        }
        return probe::judge(report, &device, &outcome, &holders);
    }
    for (device, outcome, holders) in &busy {
        probe::judge(report, device, outcome, holders);
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
    let size = camera.picture_size(&config.camera);
    if !file.as_os_str().is_empty() {
        let (width, height) = size;
        let unsaid = Unsaid { size: None, lens: config.calibration.unsaid_lens() };
        match CalibrationFile::load_with(file, &unsaid) {
            Ok(CalibrationFile { camera: c, .. })
                if (c.width, c.height) != (width, height) && c.scaled(width, height).is_err() =>
            {
                report.bad(
                    &format!(
                        "calibration {} is for {}x{} px, {path} will send {width}x{height} px, another shape",
                        file.display(),
                        c.width,
                        c.height
                    ),
                    "set camera.width_px and height_px to the calibrated shape, or calibrate at this size: `cairn calibrate`",
                );
            }
            Ok(CalibrationFile { camera: c, assumed, .. }) => {
                if let Some(assumed) = assumed {
                    report.note(&assumed);
                }
                let lens = if c.lens.is_wide_angle() { ", wide-angle lens" } else { "" };
                report.good(&format!(
                    "calibration {} for {}x{} px{lens} (configured)",
                    file.display(),
                    c.width,
                    c.height
                ))
            }
            Err(error) => report.bad(&error.to_string(), "correct calibration.file, or leave it empty"),
        }
        return;
    }
    match stored(&identity, size) {
        Some(found) => {
            let scaled = found.scaled_from.map_or(String::new(), |(w, h)| format!(", scaled from {w}x{h}"));
            let lens = if found.camera.lens.is_wide_angle() { ", wide-angle lens" } else { "" };
            let sigma = found.fx_sigma_px.map_or(String::new(), |s| format!(" +- {s:.2}"));
            report.good(&format!(
                "calibration {} ({}), fx {:.1}{sigma} px{scaled}{lens}",
                found.path.display(),
                age(found.unix_s),
                found.camera.fx
            ));
        }
        None => {
            let next =
                format!("calibrate it, one minute: `cairn calibrate --camera {path} --pattern 9x6 --square 0.025`");
            report.note(&format!("{path}: no calibration for {}x{} px", size.0, size.1));
            kept_lens(report, &config.calibration, &store::state_folders(), &identity, size);
            report.next.push(next);
        }
    }
}

/// What earlier runs found of a lens that nobody calibrated.
fn kept_lens(
    report: &mut Report,
    config: &CalibrationConfig,
    folders: &[PathBuf],
    identity: &CameraIdentity,
    size: (u32, u32),
) {
    match store::find_estimate(folders, identity, size) {
        Some((kept, path)) => {
            let (fx, percent) = (kept.camera.fx, 100.0 * kept.focal_sigma);
            let what = if config.keep_estimate {
                "the next start begins with it"
            } else {
                "not used: calibration.keep_estimate = false"
            };
            report.note(&format!(
                "its lens as earlier runs found it: fx {fx:.1} px +- {percent:.1} % ({}); {what}; a calibration is better",
                path.display()
            ));
        }
        None => {
            report.note("nothing is known of its lens yet: focal length and distortion are estimated while it moves")
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
    use crate::geometry::CameraModel;

    #[test]
    fn a_wrong_configuration_is_a_failure_with_a_next_step() {
        let dir = tempfile::tempdir().expect("folder");
        let file = dir.path().join("cairn.toml");
        std::fs::write(&file, "[camera]\nwidth = 3\n").expect("written");
        let mut report = Report::default();
        configuration(&mut report, &DoctorArgs { config: Some(file), prefix: None });
        assert_eq!((report.problems, report.next.len()), (1, 1));
        assert!(report.text.contains("cairn.toml:2"), "{}", report.text);
    }

    #[test]
    fn a_kept_lens_is_told_with_where_it_lies_and_how_sure_it_is() {
        let dir = tempfile::tempdir().expect("folder");
        let folders = [dir.path().to_path_buf()];
        let me = CameraIdentity::new("046d:0825", Some("ABC"));
        let told = |config: &CalibrationConfig| {
            let mut report = Report::default();
            kept_lens(&mut report, config, &folders, &me, (640, 480));
            assert_eq!(report.problems, 0);
            report.text
        };
        let mut config = CalibrationConfig::default();
        assert!(told(&config).contains("nothing is known"));
        let camera = CameraModel::new(640, 480, 420.0, 420.0, 322.0, 236.0, [-0.1, 0.0, 0.0, 0.0, 0.0]).expect("valid");
        let estimate = store::Estimate { camera, focal_sigma: 0.045, centre_sigma_px: 6.4 };
        let path = store::save_estimate(&folders, &me, &estimate, 0).expect("kept");
        let text = told(&config);
        for part in ["fx 420.0 px +- 4.5 %", &path.display().to_string(), "next start begins with it"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        config.keep_estimate = false;
        assert!(told(&config).contains("not used"), "{}", told(&config));
    }

    #[test]
    fn ages_are_told_in_days() {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_secs();
        assert_eq!(age(Some(now - 100)), "made today");
        assert_eq!(age(Some(now - 86_400 * 12 - 5)), "12 days old");
        assert_eq!(age(None), "age unknown");
    }
}
