//! Calibration files: the field's dialects in, ours out.
//!
//! Input: a path. `*.toml` is our own format; everything else is read as what its text looks like: OpenCV's XML, TUM's plain
//! numbers (module `foreign`), or one of the YAML dialects that the field uses (listed in the module `yaml`). Output: a checked [`CameraModel`],
//! pixels and OpenCV's order of the coefficients, or an error with file, line, key, value, unit and reason. Our format:
//!
//! ```toml
//! width_px = 640
//! height_px = 480
//! fx_px = 517.306408
//! fy_px = 516.469215
//! cx_px = 318.64304
//! cy_px = 255.313989
//! distortion = [0.262383, -0.953104, -0.005358, 0.002628, 1.163314] # k1 k2 p1 p2 k3
//! ```
//!
//! The coefficients may also stand as `k1`, `k2`, `p1`, `p2`, `k3` of their own, or both ways if they are the same. A wide-angle lens says
//! `lens_model = "kannala_brandt"` and has `k1`, `k2`, `k3`, `k4` (all four); without that key, or with `"radial_tangential"`, it is the pinhole model.
//! Other keys (standard deviations, residual, date ...) are kept as they are and written back. Beyond what
//! [`CameraModel::new`] refuses, numbers are refused that no webcam has and that a wrong unit or a swapped key gives: a
//! principal point outside the picture, a focal length under a tenth of its longer side or over twenty times that.
//!
//! Not here: calibrating; lens models other than these two (refused by name); scaling a calibration to another picture size.

pub use super::error::CalibrationError;
use super::field::{Field, camera};
use super::{foreign, yaml};
use crate::atomic_file::write_atomically;
use crate::geometry::plane_calibration::LensKind;
use crate::geometry::{CameraModel, LensModel};
use std::io::{Read, Write};
use std::path::Path;

/// No calibration is longer, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// A calibration with whatever else its file says.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationFile {
    pub camera: CameraModel,
    /// The other keys of our TOML; empty for the YAML dialects.
    pub other: toml::Table,
    /// What the file does not say and was taken for granted, for a person to judge: file, line, key and how to say otherwise.
    pub assumed: Option<String>,
}

/// What is to be supposed of a file that does not say it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Unsaid {
    /// Width and height of the pictures, px.
    pub size: Option<(u32, u32)>,
    /// Model that the coefficients are of.
    pub lens: Option<LensKind>,
}

/// Reads the camera of a calibration file of any dialect; an assumption about it is a warning in the log.
pub fn load_camera(path: &Path) -> Result<CameraModel, CalibrationError> {
    load_camera_with(path, &Unsaid::default())
}

/// The same, with what the file does not say.
pub fn load_camera_with(path: &Path, unsaid: &Unsaid) -> Result<CameraModel, CalibrationError> {
    let file = CalibrationFile::load_with(path, unsaid)?;
    if let Some(assumed) = &file.assumed {
        tracing::warn!(assumed, "lens model of a calibration assumed");
    }
    Ok(file.camera)
}

/// Writes a camera alone as our TOML, whole or not at all.
pub fn save_camera(path: &Path, camera: &CameraModel) -> Result<(), CalibrationError> {
    CalibrationFile { camera: camera.clone(), other: toml::Table::new(), assumed: None }.save(path)
}

impl CalibrationFile {
    /// Reads a calibration file of any dialect.
    pub fn load(path: &Path) -> Result<Self, CalibrationError> {
        Self::load_with(path, &Unsaid::default())
    }

    /// The same, with what the file does not say.
    pub fn load_with(path: &Path, unsaid: &Unsaid) -> Result<Self, CalibrationError> {
        let name = path.display().to_string();
        let unreadable = |reason: String| CalibrationError::File { path: name.clone(), reason };
        let metadata = std::fs::metadata(path).map_err(|e| unreadable(e.to_string()))?;
        if !metadata.is_file() {
            return Err(unreadable("is not a file".into()));
        }
        let mut bytes = Vec::new();
        std::fs::File::open(path)
            .and_then(|f| f.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes))
            .map_err(|e| unreadable(e.to_string()))?;
        if bytes.len() as u64 > MAX_FILE_BYTES {
            return Err(unreadable(format!("is longer than {MAX_FILE_BYTES} bytes, so it is no calibration")));
        }
        let text = String::from_utf8(bytes).map_err(|_| unreadable("is not UTF-8 text".into()))?;
        Self::parse_with(&text, &name, path.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml")), unsaid)
    }

    /// Reads a calibration from text; `path` is for messages.
    pub fn parse(text: &str, path: &str, is_toml: bool) -> Result<Self, CalibrationError> {
        Self::parse_with(text, path, is_toml, &Unsaid::default())
    }

    /// The same, with what the text does not say.
    pub fn parse_with(text: &str, path: &str, is_toml: bool, unsaid: &Unsaid) -> Result<Self, CalibrationError> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        if is_toml {
            return parse_toml(text, path);
        }
        let (camera, assumed) = if text.trim_start().starts_with('<') {
            yaml::parse_xml(text, path, unsaid.lens)?
        } else if foreign::is_plain_numbers(text) {
            (foreign::parse_tum(text, path, unsaid.size)?, None)
        } else {
            yaml::parse(text, path, unsaid.lens)?
        };
        Ok(Self { camera, other: toml::Table::new(), assumed })
    }

    /// Writes our TOML, whole or not at all. Keys of `other` that are the camera's own are left out.
    pub fn save(&self, path: &Path) -> Result<(), CalibrationError> {
        let failed = |reason: String| CalibrationError::File { path: path.display().to_string(), reason };
        let text = self.to_toml().map_err(|e| failed(e.to_string()))?;
        write_atomically(path, |w| w.write_all(text.as_bytes())).map_err(|e| failed(e.source.to_string()))
    }

    /// Our TOML. Every number reads back as the very same one.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let c = &self.camera;
        let mut other = self.other.clone();
        other.retain(|key, _| !OWN_KEYS.contains(&key) && key != LENS_MODEL && !COEFFICIENTS.contains(&key));
        let rest = toml::to_string(&other)?;
        let (title, order, model) = match c.lens {
            LensModel::RadialTangential(_) => (
                "Pinhole camera with radial-tangential distortion.",
                "OpenCV's order; once as a list, once by name",
                String::new(),
            ),
            LensModel::KannalaBrandt(_) => (
                "Wide-angle camera (Kannala-Brandt): t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9, t the angle off the axis.",
                "OpenCV's fisheye, equidistant of ROS and Kalibr; once as a list, once by name",
                format!("{LENS_MODEL} = \"{}\"\n", c.lens.name()),
            ),
        };
        let list: Vec<String> = c.lens.coefficients().iter().map(|k| format!("{k:?}")).collect();
        let named: String = c.lens.names().iter().zip(&list).map(|(name, k)| format!("{name} = {k}\n")).collect();
        Ok(format!(
            "# {title} Pixel (0, 0) is the centre of the first pixel.\n\
             width_px = {}\nheight_px = {}\n\
             fx_px = {:?}\nfy_px = {:?}\ncx_px = {:?}\ncy_px = {:?}\n{model}\
             # {order}\n\
             distortion = [{}]\n{named}{rest}",
            c.width,
            c.height,
            c.fx,
            c.fy,
            c.cx,
            c.cy,
            list.join(", ")
        ))
    }
}

/// The camera's keys of our TOML.
const OWN_KEYS: [&str; 7] = ["width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion"];

/// The lens's model; pinhole with radial-tangential distortion without it.
const LENS_MODEL: &str = "lens_model";

/// The coefficients' keys of any lens.
const COEFFICIENTS: [&str; 6] = ["k1", "k2", "p1", "p2", "k3", "k4"];

fn parse_toml(text: &str, path: &str) -> Result<CalibrationFile, CalibrationError> {
    let mut table: toml::Table = toml::from_str(text).map_err(|e: toml::de::Error| CalibrationError::Syntax {
        path: path.into(),
        line: e.span().map_or(1, |s| 1 + text.as_bytes().iter().take(s.start).filter(|b| **b == b'\n').count()),
        reason: e.message().into(),
    })?;
    let number = |value: &toml::Value| match value {
        toml::Value::Integer(i) => Some(*i as f64),
        toml::Value::Float(f) => Some(*f),
        _ => None,
    };
    let field = |key: &'static str, value: toml::Value| -> Result<Field, CalibrationError> {
        let numbers = match &value {
            toml::Value::Array(items) => items.iter().map(number).collect(),
            single => number(single).map(|n| vec![n]),
        };
        let line = line_of_key(text, key);
        let field = Field { path: path.into(), key: key.into(), line, text: value.to_string(), numbers: Vec::new() };
        match numbers {
            Some(numbers) => Ok(Field { numbers, ..field }),
            None if COEFFICIENTS.contains(&key) => Err(field.wrong("", "must be a number")),
            None if key == "distortion" => Err(field.wrong("", "must be a list of numbers")),
            None => Err(field.wrong("px", "must be a number")),
        }
    };
    let missing = |key: &str| CalibrationError::Missing {
        path: path.into(),
        key: key.into(),
        reason: format!("a calibration needs {}", OWN_KEYS.join(", ")),
    };
    let mut take = |key: &'static str| match table.remove(key) {
        Some(value) => field(key, value),
        None => Err(missing(key)),
    };
    let [width, height] = [take("width_px")?, take("height_px")?];
    let intrinsics = [take("fx_px")?, take("fy_px")?, take("cx_px")?, take("cy_px")?];
    let kind = match table.remove(LENS_MODEL) {
        None => LensKind::RadialTangential,
        Some(value) => match value.as_str() {
            Some("radial_tangential") => LensKind::RadialTangential,
            Some("kannala_brandt") => LensKind::KannalaBrandt,
            _ => {
                let (line, text) = (line_of_key(text, LENS_MODEL), value.to_string());
                let field = Field { path: path.into(), key: LENS_MODEL.into(), line, text, numbers: Vec::new() };
                return Err(field.wrong("", "must be \"radial_tangential\" or \"kannala_brandt\""));
            }
        },
    };
    // Without fx fy cx cy.
    let keys = kind.parameter_names().get(4..).unwrap_or_default();
    let mut named = Vec::new();
    for key in COEFFICIENTS {
        let Some(value) = table.remove(key) else { continue };
        let one = field(key, value)?;
        if !keys.contains(&key) {
            let reason = match kind {
                LensKind::RadialTangential => "is of lens_model = \"kannala_brandt\", which this file does not say",
                LensKind::KannalaBrandt => "is not of lens_model = \"kannala_brandt\", which has k1 k2 k3 k4",
            };
            return Err(one.wrong("", reason));
        }
        named.push((key, one));
    }
    let list = match table.remove("distortion") {
        Some(value) => Some(field("distortion", value)?),
        None => None,
    };
    let distortion = match list {
        Some(list) => {
            // Said twice: then the same.
            for (key, one) in &named {
                let at = keys.iter().position(|k| k == key).unwrap_or(0);
                if one.numbers != [list.numbers.get(at).copied().unwrap_or(0.0)] {
                    return Err(one.wrong("", format!("differs from the list `distortion` on line {}", list.line)));
                }
            }
            list
        }
        None if named.is_empty() => return Err(missing("distortion")),
        None => {
            if let (LensKind::KannalaBrandt, Some(absent)) =
                (kind, keys.iter().find(|key| !named.iter().any(|(k, _)| k == *key)))
            {
                return Err(CalibrationError::Missing {
                    path: path.into(),
                    key: (*absent).into(),
                    reason: "lens_model = \"kannala_brandt\" needs k1, k2, k3 and k4, or distortion = [k1, k2, k3, k4]"
                        .into(),
                });
            }
            let value = |key| named.iter().find(|(k, _)| *k == key).map_or(&[0.0][..], |(_, f)| &f.numbers);
            let numbers: Vec<f64> = keys.iter().flat_map(|key| value(*key).iter().copied()).collect();
            Field { numbers, key: keys.join(" "), ..named[0].1.clone() }
        }
    };
    let camera = camera([&width, &height], &intrinsics, &distortion, kind)?;
    Ok(CalibrationFile { camera, other: table, assumed: None })
}

/// Line, from 1, on which a top-level key stands.
fn line_of_key(text: &str, key: &str) -> usize {
    let is_key = |line: &str| {
        line.trim_start()
            .trim_start_matches(['"', '\''])
            .strip_prefix(key)
            .is_some_and(|rest| rest.trim_start_matches(['"', '\'']).trim_start().starts_with('='))
    };
    text.lines().position(is_key).map_or(1, |at| at + 1)
}

#[cfg(test)]
mod tests;
