//! Calibrations by camera: where they lie, and which belongs to the camera at hand.
//!
//! Input: what a camera says of itself (USB vendor:product and, if it has one, its serial number) and the size of its pictures. Output:
//! the calibration of that camera at that size; else one at another size of the same aspect, scaled; else nothing. Files are
//! `*.toml` of ours with a key `camera = "046d:0825"` or `"046d:0825:SERIAL"`, whatever their names.
//!
//! A file without a serial number is for every camera of its kind (lenses of one kind differ by a percent or so; the file with the
//! serial comes first). A file with another serial number is another camera's, and not used.
//!
//! What the daemon found out about an uncalibrated lens by itself lies in a file of its own beside them (`...-WxH.estimated.toml`, key
//! `estimated = true`): [`find`] passes it over, [`find_estimate`] finds it, and nothing that a person put there is ever overwritten by it.
//!
//! Folders, in this order: `$STATE_DIRECTORY/cameras` (what systemd gives a service), `$XDG_STATE_HOME/cairn/cameras` or
//! `~/.local/state/cairn/cameras`, `/var/lib/cairn/cameras`; then `/etc/cairn/cameras` and `config/cameras` for files that were
//! put there by hand, and `/usr/share/cairn/cameras` for those that a package brings. The first of them that can be written takes new ones.

use std::fmt;
use std::path::{Path, PathBuf};

use super::{CalibrationError, CalibrationFile};
use crate::geometry::CameraModel;

/// Files of a folder that are looked at.
const MAX_FILES: usize = 500;

/// Which camera it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraIdentity {
    /// `vendor:product` of USB, four hexadecimal digits each; `card:NAME` for a camera that is not on USB.
    pub model: String,
    pub serial: Option<String>,
}

impl CameraIdentity {
    /// Characters that stand in no file name or key become `_`.
    pub fn new(model: &str, serial: Option<&str>) -> Self {
        let clean = |text: &str| -> String {
            let keep = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
            text.trim().chars().take(64).map(|c| if keep(c) { c } else { '_' }).collect()
        };
        let model = match model.split_once(':') {
            Some((a, b)) => format!("{}:{}", clean(a), clean(b)),
            None => clean(model),
        };
        Self { model, serial: serial.map(clean).filter(|s| !s.is_empty()) }
    }

    /// `vendor:product` or `vendor:product:serial`.
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.splitn(3, ':');
        let (vendor, product) = (parts.next()?, parts.next()?);
        Some(Self::new(&format!("{vendor}:{product}"), parts.next()))
    }

    /// Name of its file for pictures of a size.
    pub fn file_name(&self, (width, height): (u32, u32)) -> String {
        format!("{}-{width}x{height}.toml", self.to_string().replace(':', "_"))
    }
}

impl fmt::Display for CameraIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.serial {
            Some(serial) => write!(f, "{}:{serial}", self.model),
            None => f.write_str(&self.model),
        }
    }
}

/// A calibration that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    pub path: PathBuf,
    /// For the size that was asked for.
    pub camera: CameraModel,
    /// The size that was calibrated, if it was another.
    pub scaled_from: Option<(u32, u32)>,
    /// Seconds since 1970 when it was made, if the file says so.
    pub unix_s: Option<u64>,
    /// Standard deviation of fx at the calibrated size, pixels, if the file says so.
    pub fx_sigma_px: Option<f64>,
}

/// Folders with calibrations that may be written, the first choice first.
pub fn state_folders() -> Vec<PathBuf> {
    folders_of(|key| std::env::var_os(key).map(|v| v.to_string_lossy().into_owned()).filter(|v| !v.is_empty()))
}

fn folders_of(variable: impl Fn(&str) -> Option<String>) -> Vec<PathBuf> {
    let mut folders: Vec<PathBuf> = Vec::new();
    // systemd lists several with colons.
    folders.extend(variable("STATE_DIRECTORY").and_then(|v| Some(Path::new(v.split(':').next()?).join("cameras"))));
    let home = variable("HOME").map(|home| Path::new(&home).join(".local/state"));
    folders.extend(variable("XDG_STATE_HOME").map(PathBuf::from).or(home).map(|d| d.join("cairn/cameras")));
    let own = PathBuf::from("/var/lib/cairn/cameras");
    // Which is what systemd gives the service.
    if !folders.contains(&own) {
        folders.push(own);
    }
    folders
}

/// All folders in which a calibration is looked for.
pub fn search_folders() -> Vec<PathBuf> {
    let mut folders = state_folders();
    folders.extend(["/etc/cairn/cameras", "config/cameras", "/usr/share/cairn/cameras"].map(PathBuf::from));
    folders
}

/// The calibration of a camera for pictures of a size. Files that cannot be read are skipped; what is wrong with them is in the second part.
pub fn find(
    folders: &[PathBuf],
    identity: &CameraIdentity,
    size: (u32, u32),
) -> (Option<Found>, Vec<CalibrationError>) {
    let mut faults = Vec::new();
    // Own serial, exact size, calibrated width: larger is better.
    let mut best: Option<((bool, bool, u32), Found)> = None;
    for folder in folders {
        for path in files(folder) {
            let file = match CalibrationFile::load(&path) {
                Ok(file) => file,
                Err(error) => {
                    faults.push(error);
                    continue;
                }
            };
            let Some(owner) = file.other.get("camera").and_then(|v| v.as_str()).and_then(CameraIdentity::parse) else {
                continue;
            };
            if is_estimate(&file) {
                continue;
            }
            let other_serial = owner.serial.is_some() && owner.serial != identity.serial;
            if owner.model != identity.model || other_serial {
                continue;
            }
            let own = (file.camera.width, file.camera.height);
            let Ok(camera) = (if own == size { Ok(file.camera.clone()) } else { file.camera.scaled(size.0, size.1) })
            else {
                continue;
            };
            let rank = (owner.serial.is_some(), own == size, own.0);
            if best.as_ref().is_none_or(|(r, _)| rank > *r) {
                let number = |key: &str| file.other.get(key);
                let found = Found {
                    camera,
                    scaled_from: (own != size).then_some(own),
                    unix_s: number("calibrated_unix_s")
                        .and_then(toml::Value::as_integer)
                        .and_then(|s| u64::try_from(s).ok()),
                    fx_sigma_px: number("fx_sigma_px").and_then(toml::Value::as_float),
                    path,
                };
                best = Some((rank, found));
            }
        }
    }
    (best.map(|(_, found)| found), faults)
}

/// Keeps the calibration in a file for a camera, in the first folder that can be written; where it lies then, and the camera model. `size`: of the
/// camera's pictures. A file that says of which camera it is must be of this one; one that does not is whoever's that hands it in.
pub fn adopt(
    folders: &[PathBuf],
    identity: &CameraIdentity,
    size: Option<(u32, u32)>,
    path: &Path,
) -> Result<(PathBuf, CameraModel), CalibrationError> {
    let mut file = CalibrationFile::load(path)?;
    let refuse = |reason: String| Err(CalibrationError::File { path: path.display().to_string(), reason });
    let owner = file.other.get("camera").and_then(toml::Value::as_str).map(str::to_owned);
    if let Some(owner) = owner.filter(|owner| CameraIdentity::parse(owner).as_ref() != Some(identity)) {
        return refuse(format!("camera = {owner:?}: the daemon's is {identity}"));
    }
    if is_estimate(&file) {
        return refuse("estimated = true: it is what a daemon supposed of a lens, no calibration".into());
    }
    if let Some((width, height)) = size
        && let Err(why) = file.camera.scaled(width, height)
    {
        let (from_width, from_height) = (file.camera.width, file.camera.height);
        return refuse(format!(
            "it is for {from_width}x{from_height} px, the pictures have {width}x{height} px: {why}"
        ));
    }
    file.other.insert("camera".into(), identity.to_string().into());
    Ok((save(folders, identity, &file)?, file.camera))
}

/// What motion has shown about a lens that nobody calibrated.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    pub camera: CameraModel,
    /// Standard deviation of the focal length, as a share of it.
    pub focal_sigma: f64,
    /// Standard deviation of the principal point, px.
    pub centre_sigma_px: f64,
}

/// The estimate that was kept of a camera for pictures of a size, and where it lies. Files that cannot be read or say impossible
/// things are passed over: the daemon wrote them, and finds out anew.
pub fn find_estimate(folders: &[PathBuf], identity: &CameraIdentity, size: (u32, u32)) -> Option<(Estimate, PathBuf)> {
    let mut best: Option<(Estimate, PathBuf)> = None;
    for path in folders.iter().flat_map(|folder| files(folder)) {
        let Ok(file) = CalibrationFile::load(&path) else { continue };
        let owner = file.other.get("camera").and_then(|v| v.as_str()).and_then(CameraIdentity::parse);
        if !is_estimate(&file) || owner.as_ref() != Some(identity) {
            continue;
        }
        let number = |key: &str| file.other.get(key).and_then(toml::Value::as_float).filter(|v| *v > 0.0 && *v < 1e4);
        let (Some(fx_sigma_px), Some(cx_sigma_px)) = (number("fx_sigma_px"), number("cx_sigma_px")) else { continue };
        let Ok(camera) = file.camera.scaled(size.0, size.1) else { continue };
        let estimate = Estimate {
            focal_sigma: fx_sigma_px / file.camera.fx,
            centre_sigma_px: cx_sigma_px * f64::from(size.0) / f64::from(file.camera.width),
            camera,
        };
        if best.as_ref().is_none_or(|(b, _)| estimate.focal_sigma < b.focal_sigma) {
            best = Some((estimate, path));
        }
    }
    best
}

/// Keeps an estimate for the next start, in the first folder that can be written.
pub fn save_estimate(
    folders: &[PathBuf],
    identity: &CameraIdentity,
    estimate: &Estimate,
    unix_s: u64,
) -> Result<PathBuf, CalibrationError> {
    let c = &estimate.camera;
    let mut other = toml::Table::new();
    other.insert("camera".into(), identity.to_string().into());
    other.insert("estimated".into(), true.into());
    other.insert("fx_sigma_px".into(), (estimate.focal_sigma * c.fx).into());
    other.insert("cx_sigma_px".into(), estimate.centre_sigma_px.into());
    other.insert("calibrated_unix_s".into(), i64::try_from(unix_s).unwrap_or(i64::MAX).into());
    let name = identity.file_name((c.width, c.height)).replace(".toml", ".estimated.toml");
    save_as(folders, &name, &CalibrationFile { camera: c.clone(), other, assumed: None })
}

/// The daemon's own finding, not a person's.
fn is_estimate(file: &CalibrationFile) -> bool {
    file.other.get("estimated").and_then(toml::Value::as_bool) == Some(true)
}

/// `*.toml` of a folder, by name.
fn files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let is_toml = |path: &PathBuf| path.extension().is_some_and(|e| e == "toml");
    let mut files: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(is_toml).take(MAX_FILES).collect();
    files.sort();
    files
}

/// Saves a calibration into the first folder that can be written; where it lies now. The error tells of the first folder.
pub fn save(
    folders: &[PathBuf],
    identity: &CameraIdentity,
    file: &CalibrationFile,
) -> Result<PathBuf, CalibrationError> {
    save_as(folders, &identity.file_name((file.camera.width, file.camera.height)), file)
}

fn save_as(folders: &[PathBuf], name: &str, file: &CalibrationFile) -> Result<PathBuf, CalibrationError> {
    let mut first = None;
    for folder in folders {
        let path = folder.join(name);
        // A person may have put anything under any name.
        let taken =
            is_estimate(file) && path.exists() && !CalibrationFile::load(&path).is_ok_and(|old| is_estimate(&old));
        if taken {
            let reason = "is there already and no estimate of the daemon's: not overwritten".into();
            first = first.or(Some(CalibrationError::File { path: path.display().to_string(), reason }));
            continue;
        }
        let saved = std::fs::create_dir_all(folder)
            .map_err(|e| CalibrationError::File { path: folder.display().to_string(), reason: e.to_string() })
            .and_then(|()| file.save(&path));
        match saved {
            Ok(()) => return Ok(path),
            Err(error) => first = first.or(Some(error)),
        }
    }
    Err(first.unwrap_or(CalibrationError::File { path: "cameras".into(), reason: "no folder to save to".into() }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(camera: &str, (width, height): (u32, u32), fx: f64) -> CalibrationFile {
        let (w, h) = (f64::from(width), f64::from(height));
        let camera_model = CameraModel::new(width, height, fx, fx, w / 2.0, h / 2.0, [0.0; 5]).expect("valid");
        let mut other = toml::Table::new();
        other.insert("camera".into(), camera.into());
        CalibrationFile { camera: camera_model, other, assumed: None }
    }

    #[test]
    fn a_calibration_that_is_handed_in_is_the_cameras_own_unless_it_says_otherwise() {
        let dir = tempfile::tempdir().expect("folder");
        let (kept, handed) = (dir.path().join("kept"), dir.path().join("handed.toml"));
        let folders = [dir.path().join("handed.toml/no folder"), kept];
        let me = CameraIdentity::parse("046d:0825:ABC").expect("valid");
        let put = |mut file: CalibrationFile, key: &str, value: toml::Value| {
            file.other.insert(key.into(), value);
            file.save(&handed).expect("saved");
        };
        let adopt = |size| adopt(&folders, &me, size, &handed);
        let mut nobodys = file("", (640, 480), 500.0);
        nobodys.other.clear();
        put(nobodys.clone(), "rms_px", 0.2.into());
        let (path, camera) = adopt(Some((320, 240))).expect("kept");
        assert_eq!((&path, camera.fx), (&folders[1].join("046d_0825_ABC-640x480.toml"), 500.0));
        let (found, faults) = find(&folders, &me, (640, 480));
        assert_eq!((found.expect("found").camera.fx, faults.len()), (500.0, 0));
        assert_eq!(CalibrationFile::load(&path).expect("whole").other["rms_px"].as_float(), Some(0.2));

        let refused = |size, reason: &str| {
            let why = adopt(size).expect_err("refused").to_string();
            assert!(why.contains("handed.toml") && why.contains(reason), "{why}");
        };
        refused(Some((640, 360)), "it is for 640x480 px, the pictures have 640x360 px");
        put(nobodys.clone(), "camera", "046d:0825:XYZ".into());
        refused(None, "the daemon's is 046d:0825:ABC");
        put(nobodys, "estimated", true.into());
        refused(None, "estimated = true");
        std::fs::write(&handed, "fx_px = -3").expect("written");
        refused(None, "fx_px");
        assert_eq!(find(&folders, &me, (640, 480)).0.expect("as before").path, path);
    }

    #[test]
    fn the_own_camera_comes_before_its_kind_and_the_own_size_before_a_scaled_one() {
        let dir = tempfile::tempdir().expect("folder");
        let folders = [dir.path().join("none"), dir.path().to_path_buf()];
        let put = |name: &str, f: CalibrationFile| f.save(&dir.path().join(name)).expect("saved");
        let me = CameraIdentity::parse("046d:0825:ABC").expect("valid");
        let fx = |size| find(&folders, &me, size).0.map(|f| (f.camera.fx, f.scaled_from));
        assert_eq!(fx((640, 480)), None);
        put("a.toml", file("1234:5678", (640, 480), 100.0));
        put("b.toml", file("046d:0825:XYZ", (640, 480), 200.0));
        assert_eq!(fx((640, 480)), None, "another camera's");
        put("c.toml", file("046d:0825", (1280, 960), 1000.0));
        assert_eq!(fx((640, 480)), Some((500.0, Some((1280, 960)))));
        assert_eq!(fx((640, 360)), None, "cropped, nobody knows where");
        put("d.toml", file("046d:0825", (640, 480), 510.0));
        assert_eq!(fx((640, 480)), Some((510.0, None)));
        put("e.toml", file("046d:0825:ABC", (1280, 960), 1040.0));
        assert_eq!(fx((640, 480)), Some((520.0, Some((1280, 960)))));
        std::fs::write(dir.path().join("f.toml"), "fx_px = \n").expect("written");
        let (found, faults) = find(&folders, &me, (640, 480));
        assert!(found.is_some() && faults.len() == 1 && faults[0].to_string().contains("f.toml:1"), "{faults:?}");
    }

    #[test]
    fn what_was_saved_is_found_again_in_the_first_folder_that_can_be_written() {
        let dir = tempfile::tempdir().expect("folder");
        let blocked = dir.path().join("file");
        std::fs::write(&blocked, "").expect("written");
        let folders = [blocked.join("cameras"), dir.path().join("state/cameras")];
        let me = CameraIdentity::new("046d:0825", Some("A B/C"));
        assert_eq!(me.to_string(), "046d:0825:A_B_C");
        let path = save(&folders, &me, &file(&me.to_string(), (640, 480), 512.0)).expect("saved");
        assert_eq!(path, folders[1].join("046d_0825_A_B_C-640x480.toml"));
        assert_eq!(find(&folders, &me, (640, 480)).0.map(|f| f.camera.fx), Some(512.0));
        assert!(
            save(&folders[..1], &me, &file("x:y", (640, 480), 512.0))
                .expect_err("blocked")
                .to_string()
                .contains("file")
        );
    }

    #[test]
    fn an_estimate_is_kept_for_the_next_start_and_is_never_taken_for_a_calibration() {
        let dir = tempfile::tempdir().expect("folder");
        let folders = [dir.path().to_path_buf()];
        let me = CameraIdentity::parse("046d:0825:ABC").expect("valid");
        let camera =
            CameraModel::new(640, 480, 531.25, 530.5, 318.0, 243.0, [0.1, -0.2, 1e-3, 0.0, 0.0]).expect("valid");
        let estimate = Estimate { camera, focal_sigma: 0.04, centre_sigma_px: 6.0 };
        let path = save_estimate(&folders, &me, &estimate, 1_700_000_000).expect("saved");
        assert_eq!(path, dir.path().join("046d_0825_ABC-640x480.estimated.toml"));
        let (found, at) = find_estimate(&folders, &me, (640, 480)).expect("found");
        assert_eq!((&found.camera, &at), (&estimate.camera, &path));
        assert!((found.focal_sigma - 0.04).abs() < 1e-12 && found.centre_sigma_px == 6.0);
        let (small, _) = find_estimate(&folders, &me, (320, 240)).expect("scaled");
        assert_eq!((small.camera.fx, small.centre_sigma_px), (265.625, 3.0));
        assert_eq!(find(&folders, &me, (640, 480)).0, None, "an estimate is no calibration");
        let twin = CameraIdentity::parse("046d:0825:XYZ").expect("valid");
        assert!(find_estimate(&folders, &twin, (640, 480)).is_none(), "another camera's");
        save(&folders, &me, &file("046d:0825:ABC", (640, 480), 512.0)).expect("saved");
        save_estimate(&folders, &me, &estimate, 1_700_000_001).expect("its own file");
        assert_eq!(find(&folders, &me, (640, 480)).0.map(|f| f.camera.fx), Some(512.0), "untouched");
        std::fs::write(&path, "fx_px = 1\n").expect("written by hand");
        let refused = save_estimate(&folders, &me, &estimate, 1_700_000_002).expect_err("a person's file");
        assert!(refused.to_string().contains("not overwritten"), "{refused}");
        assert_eq!(std::fs::read_to_string(&path).expect("there"), "fx_px = 1\n");
        assert!(find_estimate(&folders, &me, (640, 480)).is_none());
    }

    #[test]
    fn folders_follow_systemd_and_xdg() {
        let with = |pairs: &'static [(&str, &str)]| {
            folders_of(move |key| pairs.iter().find(|(k, _)| *k == key).map(|(_, v)| v.to_string()))
        };
        assert_eq!(with(&[("STATE_DIRECTORY", "/var/lib/cairn:/x")])[0], Path::new("/var/lib/cairn/cameras"));
        assert_eq!(with(&[("XDG_STATE_HOME", "/s"), ("HOME", "/h")])[0], Path::new("/s/cairn/cameras"));
        assert_eq!(with(&[("HOME", "/h")])[0], Path::new("/h/.local/state/cairn/cameras"));
        let service = with(&[("STATE_DIRECTORY", "/var/lib/cairn")]);
        assert_eq!(service, [Path::new("/var/lib/cairn/cameras")], "each is read once");
        assert_eq!(with(&[]), [Path::new("/var/lib/cairn/cameras")]);
    }
}
