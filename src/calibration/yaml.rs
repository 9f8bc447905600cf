//! The YAML dialects of calibration files: keys and numbers out of them.
//!
//! Told apart by their keys:
//!
//! | keys | written by |
//! |---|---|
//! | `width height fx fy cx cy distortion` | sequences' `camera.yaml`; every other key is free text |
//! | `resolution intrinsics distortion_coefficients` | EuRoC / ASL `sensor.yaml` |
//! | `cam0.resolution cam0.intrinsics cam0.distortion_coeffs` | Kalibr; the first camera |
//! | `image_width image_height camera_matrix.data distortion_coefficients.data` | ROS `camera_calibration`, OpenCV's sample |
//!
//! A wide-angle lens (Kannala-Brandt, four coefficients) is what says so, never what only has four coefficients: `distortion_model:
//! equidistant` (or `fisheye`), OpenCV's `fisheye_model: 1` as its calibration sample writes it (its functions write no model at all), or
//! `lens_model: kannala_brandt` in a sequence's `camera.yaml`. Four coefficients in OpenCV's layout without any of these are read as the
//! caller says, else as k1 k2 p1 p2 of a pinhole with a word about that: OpenCV itself writes five for a pinhole and four for a fisheye.
//!
//! A reader of lines and not a YAML library, for three reasons: free text need not be valid YAML (`note: see: below` is
//! none), OpenCV's header and tags (`%YAML:1.0`, `!!opencv-matrix`) are not YAML 1.2 and make conforming readers give
//! up, and a message should name the line. What is read: `key: value` nested by indentation, flow lists over several lines,
//! block lists, quotes, comments. What is not: anchors, flow maps, block scalars (skipped as text).
//!
//! Cost: linear in the text.

use super::error::CalibrationError;
use super::field::{Field, camera};
use crate::geometry::CameraModel;
use crate::geometry::plane_calibration::LensKind;

/// Deeper keys are nobody's numbers.
const MAX_DEPTH: usize = 4;

/// A list of so many lines was never closed.
const MAX_LIST_LINES: usize = 64;

/// Names that OpenCV's programs have used over the years.
const CAMERA_MATRIX: [&str; 4] = ["camera_matrix.data", "Camera_Matrix.data", "cameraMatrix.data", "K.data"];
const COEFFICIENTS: [&str; 5] =
    ["distortion_coefficients.data", "Distortion_Coefficients.data", "distCoeffs.data", "dist_coeffs.data", "D.data"];

/// Names of the lens models.
const PINHOLE_NAMES: [&str; 4] = ["radial-tangential", "radtan", "plumb_bob", "radial_tangential"];
const WIDE_NAMES: [&str; 3] = ["equidistant", "fisheye", "kannala_brandt"];

/// One `key: value`.
#[derive(Debug, Clone, PartialEq)]
struct Entry {
    /// With the keys that it is nested in, joined by dots.
    key: String,
    /// From 1.
    line: usize,
    value: Value,
}

#[derive(Debug, Clone, PartialEq)]
enum Value {
    Scalar(String),
    List(Vec<String>),
}

/// A camera, and what had to be assumed of it.
pub(super) type Parsed = Result<(CameraModel, Option<String>), CalibrationError>;

/// Reads the camera of whichever dialect the text is; `unsaid`: the lens model of a file that does not say it.
pub(super) fn parse(text: &str, path: &str, unsaid: Option<LensKind>) -> Parsed {
    let entries = read(text).map_err(|(line, reason)| CalibrationError::Syntax {
        path: path.into(),
        line,
        reason: reason.into(),
    })?;
    let has = |key: &str| entries.iter().any(|e| e.key == key);
    let file = Dialect { path, entries: &entries };
    let certain = |camera| (camera, None);
    if has("fx") {
        file.plain().map(certain) // first, because every other key is free text there
    } else if has("intrinsics") {
        file.asl("", "distortion_coefficients").map(certain)
    } else if has("cam0.intrinsics") {
        file.asl("cam0.", "distortion_coeffs").map(certain)
    } else if CAMERA_MATRIX.iter().any(|key| has(key)) {
        file.ros(unsaid)
    } else {
        file.plain().map(certain)
    }
}

/// Reads the camera of an OpenCV XML: the same keys as its YAML.
pub(super) fn parse_xml(text: &str, path: &str, unsaid: Option<LensKind>) -> Parsed {
    let entries: Vec<Entry> = super::foreign::read_xml(text, path)?
        .into_iter()
        .map(|e| Entry { key: e.key, line: e.line, value: Value::List(e.words) })
        .collect();
    Dialect { path, entries: &entries }.ros(unsaid)
}

struct Dialect<'a> {
    path: &'a str,
    entries: &'a [Entry],
}

impl Dialect<'_> {
    fn plain(&self) -> Result<CameraModel, CalibrationError> {
        let need = "width, height, fx, fy, cx, cy and distortion are needed";
        let size = [self.numbers("width", need)?, self.numbers("height", need)?];
        let intrinsics = [
            self.numbers("fx", need)?,
            self.numbers("fy", need)?,
            self.numbers("cx", need)?,
            self.numbers("cy", need)?,
        ];
        // Other programs' names of the model may be free text here; ours may not.
        let kind = match self.lens("lens_model")? {
            Some(kind) => kind,
            None => self.lens("distortion_model").ok().flatten().unwrap_or_default(),
        };
        camera([&size[0], &size[1]], &intrinsics, &self.numbers("distortion", need)?, kind)
    }

    fn asl(&self, prefix: &str, distortion: &str) -> Result<CameraModel, CalibrationError> {
        let need = "resolution [width, height], intrinsics [fx, fy, cx, cy] and the distortion coefficients are needed";
        self.expect_model(&format!("{prefix}camera_model"), &["pinhole"])?;
        let kind = self.lens(&format!("{prefix}distortion_model"))?.unwrap_or_default();
        let size = parts(&self.numbers(&format!("{prefix}resolution"), need)?, [0, 1], 2)?;
        let intrinsics = parts(&self.numbers(&format!("{prefix}intrinsics"), need)?, [0, 1, 2, 3], 4)?;
        camera([&size[0], &size[1]], &intrinsics, &self.numbers(&format!("{prefix}{distortion}"), need)?, kind)
    }

    fn ros(&self, unsaid: Option<LensKind>) -> Parsed {
        let need = "image_width, image_height, camera_matrix and distortion_coefficients are needed";
        let stated = self.lens("distortion_model")?;
        let stated = match self.fisheye_model()? {
            Some((field, kind)) if stated.is_some_and(|s| s != kind) => {
                return Err(field.wrong("", "contradicts distortion_model"));
            }
            Some((_, kind)) => Some(kind),
            None => stated,
        };
        let kind = stated.or(unsaid).unwrap_or_default();
        let size = [
            self.numbers(self.known(&["image_width", "image_Width"]), need)?,
            self.numbers(self.known(&["image_height", "image_Height"]), need)?,
        ];
        let matrix = self.numbers(self.known(&CAMERA_MATRIX), need)?;
        let intrinsics = parts(&matrix, [0, 4, 2, 5], 9)?;
        if [1, 3, 6, 7].iter().any(|i| matrix.numbers[*i] != 0.0) || matrix.numbers[8] != 1.0 {
            return Err(matrix.wrong("px", "must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]: skew is not handled"));
        }
        let coefficients = self.numbers(self.known(&COEFFICIENTS), need)?;
        let ambiguous = stated.or(unsaid).is_none()
            && coefficients.numbers.len() == 4
            && coefficients.numbers.iter().any(|k| *k != 0.0);
        let assumed = ambiguous.then(|| {
            let Field { path, line, key, .. } = &coefficients;
            format!(
                "{path}:{line}: {key} has four numbers and no lens model: taken for k1 k2 p1 p2 of a pinhole (radial_tangential); if \
                 they are k1 k2 k3 k4 of OpenCV's fisheye, say lens_model = \"kannala_brandt\" ([calibration] of the \
                 configuration, --lens-model of `cairn calibrate --convert`) or add fisheye_model: 1 to the file"
            )
        });
        Ok((camera([&size[0], &size[1]], &intrinsics, &coefficients, kind)?, assumed))
    }

    /// OpenCV's flag, if it is there.
    fn fisheye_model(&self) -> Result<Option<(Field, LensKind)>, CalibrationError> {
        if !self.entries.iter().any(|e| e.key == "fisheye_model") {
            return Ok(None);
        }
        let field = self.numbers("fisheye_model", "")?;
        match field.numbers[..] {
            [0.0] => Ok(Some((field, LensKind::RadialTangential))),
            [1.0] => Ok(Some((field, LensKind::KannalaBrandt))),
            _ => Err(field.wrong("", "must be 0 or 1")),
        }
    }

    /// The first of several names that is there, else the first.
    fn known(&self, names: &[&'static str]) -> &'static str {
        let there = names.iter().find(|name| self.entries.iter().any(|e| e.key == **name));
        there.or(names.first()).copied().unwrap_or_default()
    }

    /// The numbers of a key that must be there once.
    fn numbers(&self, key: &str, need: &str) -> Result<Field, CalibrationError> {
        let mut found = self.entries.iter().filter(|e| e.key == key);
        let entry = found.next().ok_or_else(|| CalibrationError::Missing {
            path: self.path.into(),
            key: key.into(),
            reason: need.into(),
        })?;
        let (items, text) = match &entry.value {
            Value::Scalar(text) => (std::slice::from_ref(text), text.clone()),
            Value::List(items) => (items.as_slice(), format!("[{}]", items.join(", "))),
        };
        let numbers: Option<Vec<f64>> = items.iter().map(|item| item.parse().ok()).collect();
        let field = Field {
            path: self.path.into(),
            key: key.into(),
            line: entry.line,
            text,
            numbers: numbers.unwrap_or_default(),
        };
        if let Some(again) = found.next() {
            return Err(field.wrong("", format!("stands again on line {}", again.line)));
        }
        if field.numbers.is_empty() {
            return Err(field.wrong("", "must be a number or a list of numbers"));
        }
        Ok(field)
    }

    /// The lens model that a file names, which must be one of ours; a file that names none is believed.
    fn lens(&self, key: &str) -> Result<Option<LensKind>, CalibrationError> {
        let known = [&PINHOLE_NAMES[..], &WIDE_NAMES[..]].concat();
        Ok(self.expect_model(key, &known)?.map(|name| match WIDE_NAMES.contains(&name) {
            true => LensKind::KannalaBrandt,
            false => LensKind::RadialTangential,
        }))
    }

    /// The value of a key that must be one of `known` if it is there.
    fn expect_model(&self, key: &str, known: &[&str]) -> Result<Option<&str>, CalibrationError> {
        let Some(entry) = self.entries.iter().find(|e| e.key == key) else { return Ok(None) };
        let text = match &entry.value {
            Value::Scalar(name) => name.clone(),
            Value::List(items) => items.join(", "),
        };
        match &entry.value {
            Value::Scalar(name) if known.contains(&name.as_str()) => Ok(Some(name)),
            // XML: one word.
            Value::List(items) if items.len() == 1 && known.contains(&items[0].as_str()) => Ok(Some(&items[0])),
            _ => {
                let field =
                    Field { path: self.path.into(), key: key.into(), line: entry.line, text, numbers: Vec::new() };
                Err(field.wrong("", format!("is not handled, only {} is", known.join(", "))))
            }
        }
    }
}

/// The elements `which` of a list of `length` numbers as fields of their own, each with the element's value in messages.
fn parts<const N: usize>(list: &Field, which: [usize; N], length: usize) -> Result<[Field; N], CalibrationError> {
    if list.numbers.len() != length {
        return Err(list.wrong("px", format!("must be {length} numbers, not {}", list.numbers.len())));
    }
    Ok(which.map(|i| Field {
        key: format!("{}[{i}]", list.key),
        text: list.numbers[i].to_string(),
        numbers: vec![list.numbers[i]],
        ..list.clone()
    }))
}

/// All entries, in the text's order; else the line and what is wrong with it.
fn read(text: &str) -> Result<Vec<Entry>, (usize, &'static str)> {
    let mut entries: Vec<Entry> = Vec::new();
    // Keys that the current line may be nested in, with their indentation.
    let mut parents: Vec<(usize, String)> = Vec::new();
    // Lines that are indented deeper than this belong to a block scalar.
    let mut text_block: Option<usize> = None;
    let mut lines = text.lines().enumerate();
    while let Some((index, raw)) = lines.next() {
        let content = raw.trim();
        let indent = raw.len() - raw.trim_start().len();
        if content.is_empty() || content.starts_with(['#', '%']) || content.starts_with("---") || content == "..." {
            continue;
        }
        if text_block.is_some_and(|block| indent > block) {
            continue;
        }
        text_block = None;
        if let Some(item) = content.strip_prefix("- ") {
            // A block list's item: it belongs to the key before it if that has no value of its own.
            if let Some(Entry { value, .. }) = entries.last_mut() {
                match value {
                    Value::Scalar(text) if text.is_empty() => *value = Value::List(vec![scalar(item)]),
                    Value::List(items) => items.push(scalar(item)),
                    Value::Scalar(_) => {}
                }
            }
            continue;
        }
        let Some((key, value)) = split_key(content) else {
            // The rest of free text that goes over several lines is indented; anything else is a slip.
            if indent == 0 {
                return Err((index + 1, "is neither 'key: value' nor a comment"));
            }
            continue;
        };
        while parents.last().is_some_and(|(outer, _)| *outer >= indent) {
            parents.pop();
        }
        if parents.len() >= MAX_DEPTH {
            continue;
        }
        parents.push((indent, key.to_string()));
        let key = parents.iter().map(|(_, k)| k.as_str()).collect::<Vec<_>>().join(".");
        let value = if let Some(first) = value.strip_prefix('[') {
            let mut list = without_comment(first).to_string();
            let mut closed = list.contains(']');
            for _ in 0..MAX_LIST_LINES {
                if closed {
                    break;
                }
                let Some((_, more)) = lines.next() else { break };
                list.push(' ');
                list.push_str(without_comment(more.trim()));
                closed = more.contains(']');
            }
            if !closed {
                return Err((index + 1, "list is not closed with ']'"));
            }
            let inside = list.split(']').next().unwrap_or_default();
            Value::List(inside.split(',').map(|i| i.trim().to_string()).filter(|i| !i.is_empty()).collect())
        } else if value.starts_with(['|', '>']) {
            text_block = Some(indent);
            Value::Scalar("(text)".into())
        } else {
            Value::Scalar(scalar(value))
        };
        entries.push(Entry { key, line: index + 1, value });
    }
    Ok(entries)
}

/// `key: value` at the first colon that ends the line or has a space behind it.
fn split_key(content: &str) -> Option<(&str, &str)> {
    let at = content.char_indices().find_map(|(at, c)| {
        let rest = &content[at + c.len_utf8()..];
        (c == ':' && (rest.is_empty() || rest.starts_with([' ', '\t']))).then_some(at)
    })?;
    let key = content[..at].trim().trim_matches(['"', '\'']);
    (!key.is_empty()).then_some((key, content[at + 1..].trim()))
}

/// A scalar without its quotes, comment or tag.
fn scalar(text: &str) -> String {
    let text = text.trim();
    for quote in ['"', '\''] {
        if let Some(inside) = text.strip_prefix(quote) {
            return inside.split(quote).next().unwrap_or_default().to_string();
        }
    }
    if text.starts_with('!') {
        return String::new();
    }
    without_comment(text).trim().to_string()
}

fn without_comment(text: &str) -> &str {
    match text.find(" #") {
        Some(at) => &text[..at],
        None if text.starts_with('#') => "",
        None => text,
    }
}
