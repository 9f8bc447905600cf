//! Calibrations in the formats of others that are not YAML (those: `yaml`): OpenCV's XML and TUM's plain numbers.
//!
//! Which formats there are and what each can say is a table in [`export`](super::export), which writes them.

use super::error::CalibrationError;
use super::field::{Field, camera};
use crate::geometry::CameraModel;
use crate::geometry::plane_calibration::LensKind;

/// Is this nothing but numbers and `#` comments?
pub(super) fn is_plain_numbers(text: &str) -> bool {
    let mut any = false;
    for token in text.lines().map(without_comment).flat_map(tokens) {
        any = true;
        if token.parse::<f64>().is_err() {
            return false;
        }
    }
    any
}

fn without_comment(line: &str) -> &str {
    line.split('#').next().unwrap_or_default()
}

fn tokens(line: &str) -> impl Iterator<Item = &str> {
    line.split([' ', '\t', ',', ';']).filter(|t| !t.is_empty())
}

/// TUM's numbers: fx fy cx cy and none, four or five coefficients. `size`: of the pictures, if the text does not say.
pub(super) fn parse_tum(text: &str, path: &str, size: Option<(u32, u32)>) -> Result<CameraModel, CalibrationError> {
    let field = |key: &str, line: usize, text: &str, numbers: Vec<f64>| Field {
        path: path.into(),
        key: key.into(),
        line,
        text: text.into(),
        numbers,
    };
    let mut values: Vec<(usize, &str, f64)> = Vec::new();
    let mut stated = None;
    for (index, line) in text.lines().enumerate() {
        if let Some(rest) = line.trim().strip_prefix('#').map(str::trim).and_then(|l| l.strip_prefix("size_px")) {
            let mut parts = tokens(rest);
            let mut side = |key: &str| {
                let text = parts.next().unwrap_or_default();
                let number = text.parse::<f64>().ok().into_iter().collect();
                field(key, index + 1, text, number)
            };
            stated = Some([side("size_px[0]"), side("size_px[1]")]);
        }
        for token in tokens(without_comment(line)) {
            let number = token.parse::<f64>().map_err(|_| CalibrationError::Syntax {
                path: path.into(),
                line: index + 1,
                reason: format!("'{token}' is no number"),
            })?;
            values.push((index + 1, token, number));
        }
    }
    if ![4, 8, 9].contains(&values.len()) {
        return Err(CalibrationError::Syntax {
            path: path.into(),
            line: values.last().map_or(1, |v| v.0),
            reason: format!("must be fx fy cx cy and k1 k2 p1 p2 k3 (4, 8 or 9 numbers), not {} numbers", values.len()),
        });
    }
    let given = size.map(|(w, h)| {
        [("--size width", w), ("--size height", h)].map(|(key, v)| field(key, 1, &v.to_string(), vec![f64::from(v)]))
    });
    let [width, height] = given.or(stated).ok_or_else(|| CalibrationError::Missing {
        path: path.into(),
        key: "size_px".into(),
        reason: "TUM's numbers do not say the pictures' size: give --size, or a comment line '# size_px 640 480'"
            .into(),
    })?;
    let one = |i: usize, key: &str| field(key, values[i].0, values[i].1, vec![values[i].2]);
    let intrinsics = [one(0, "fx"), one(1, "fy"), one(2, "cx"), one(3, "cy")];
    let rest: Vec<f64> = if values.len() == 4 { vec![0.0; 5] } else { values[4..].iter().map(|v| v.2).collect() };
    let line = values.get(4).map_or(1, |v| v.0);
    let text = rest.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    camera([&width, &height], &intrinsics, &field("k1 k2 p1 p2 k3", line, &text, rest), LensKind::RadialTangential)
}

/// One element of an OpenCV XML: dotted key, line, words.
pub(super) struct XmlEntry {
    pub key: String,
    pub line: usize,
    pub words: Vec<String>,
}

/// The elements of an OpenCV XML that hold text, keys below the root.
pub(super) fn read_xml(text: &str, path: &str) -> Result<Vec<XmlEntry>, CalibrationError> {
    let options = roxmltree::ParsingOptions { nodes_limit: 100_000, ..Default::default() };
    let document = roxmltree::Document::parse_with_options(text, options).map_err(|e| CalibrationError::Syntax {
        path: path.into(),
        line: e.pos().row as usize,
        reason: e.to_string(),
    })?;
    let mut entries = Vec::new();
    for node in document.root_element().descendants().filter(roxmltree::Node::is_element) {
        let Some(text) = node.text().filter(|t| !t.trim().is_empty()) else { continue };
        let mut key: Vec<&str> =
            node.ancestors().filter(roxmltree::Node::is_element).map(|n| n.tag_name().name()).take(8).collect();
        key.pop();
        key.reverse();
        entries.push(XmlEntry {
            key: key.join("."),
            line: document.text_pos_at(node.range().start).row as usize,
            words: text.split_whitespace().map(String::from).collect(),
        });
    }
    Ok(entries)
}
