//! Numbers of a calibration file with the place where they stand, and the camera that they make.

use super::error::CalibrationError;
use crate::geometry::plane_calibration::LensKind;
use crate::geometry::{CameraModel, LensModel};

/// Wider or higher is a typing error, pixels.
const MAX_SIZE_PX: f64 = 16_384.0;
/// Focal length in units of the longer side: 157 degrees of view (of a pinhole; a fisheye's 180 degrees are 0.32) to 3 degrees.
const FOCAL_RANGE: (f64, f64) = (0.1, 20.0);

/// Numbers of one key, and where they stand.
#[derive(Debug, Clone)]
pub(super) struct Field {
    pub path: String,
    pub key: String,
    pub line: usize,
    /// As written.
    pub text: String,
    pub numbers: Vec<f64>,
}

impl Field {
    pub(super) fn wrong(&self, unit: &'static str, reason: impl Into<String>) -> CalibrationError {
        CalibrationError::Value {
            path: self.path.clone(),
            line: self.line,
            key: self.key.clone(),
            value: if self.text.chars().count() > 80 {
                self.text.chars().take(77).chain("...".chars()).collect()
            } else {
                self.text.clone()
            },
            unit,
            reason: reason.into(),
        }
    }

    /// The only number, finite.
    fn single(&self) -> Result<f64, CalibrationError> {
        match self.numbers[..] {
            [n] if n.is_finite() => Ok(n),
            [_] => Err(self.wrong("px", "must be a finite number")),
            _ => Err(self.wrong("px", "must be one number")),
        }
    }

    fn size(&self) -> Result<u32, CalibrationError> {
        let value = self.single()?;
        if value.fract() != 0.0 || !(1.0..=MAX_SIZE_PX).contains(&value) {
            return Err(self.wrong("px", format!("must be a whole number from 1 to {MAX_SIZE_PX}")));
        }
        Ok(value as u32)
    }
}

/// Checks the fields and makes the model. `size` is width and height, `intrinsics` fx fy cx cy, one number each.
pub(super) fn camera(
    size: [&Field; 2],
    intrinsics: &[Field; 4],
    distortion: &Field,
    kind: LensKind,
) -> Result<CameraModel, CalibrationError> {
    let [width, height] = [size[0].size()?, size[1].size()?];
    let longer = f64::from(width.max(height));
    for field in &intrinsics[..2] {
        let value = field.single()?;
        if value <= 0.0 {
            return Err(field.wrong("px", "must be greater than 0"));
        }
        if !(FOCAL_RANGE.0 * longer..=FOCAL_RANGE.1 * longer).contains(&value) {
            let reason = format!(
                "must be from {} to {} times the picture's longer side of {longer} px (is it in mm, or for another size?)",
                FOCAL_RANGE.0, FOCAL_RANGE.1
            );
            return Err(field.wrong("px", reason));
        }
    }
    for (field, side) in intrinsics[2..].iter().zip([width, height]) {
        if !(0.0..=f64::from(side)).contains(&field.single()?) {
            return Err(field.wrong("px", format!("must be inside the picture, 0 to {side}")));
        }
    }
    let [fx, fy, cx, cy] = [0, 1, 2, 3].map(|i| intrinsics[i].numbers[0]);
    let lens = match kind {
        LensKind::RadialTangential => LensModel::RadialTangential(coefficients(distortion)?),
        LensKind::KannalaBrandt => LensModel::KannalaBrandt(wide_coefficients(distortion)?),
    };
    CameraModel::new(width, height, fx, fy, cx, cy, lens)
        .map_err(|e| CalibrationError::File { path: distortion.path.clone(), reason: e.to_string() })
}

/// k1 k2 p1 p2 k3. Four coefficients mean k3 = 0; a longer model passes when what is beyond k3 is zero.
fn coefficients(field: &Field) -> Result<[f64; 5], CalibrationError> {
    if field.numbers.iter().any(|n| !n.is_finite()) {
        return Err(field.wrong("", "must be finite numbers"));
    }
    let [k1, k2, p1, p2, ref rest @ ..] = field.numbers[..] else {
        return Err(
            field.wrong("", "must be four or five numbers: k1 k2 p1 p2 k3 (zeros for a lens without distortion)")
        );
    };
    let (k3, beyond) = rest.split_first().map_or((0.0, [].as_slice()), |(k3, beyond)| (*k3, beyond));
    if beyond.iter().any(|n| *n != 0.0) {
        return Err(field.wrong("", "has coefficients beyond k3: only k1 k2 p1 p2 k3 are handled"));
    }
    Ok([k1, k2, p1, p2, k3])
}

/// k1 k2 k3 k4 of the wide-angle model, which has no fewer and no more.
fn wide_coefficients(field: &Field) -> Result<[f64; 4], CalibrationError> {
    let [k1, k2, k3, k4] = field.numbers[..] else {
        return Err(field.wrong("", "must be four numbers: k1 k2 k3 k4 of the wide-angle model"));
    };
    if field.numbers.iter().any(|n| !n.is_finite()) {
        return Err(field.wrong("", "must be finite numbers"));
    }
    Ok([k1, k2, k3, k4])
}
