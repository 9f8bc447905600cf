//! Single pictures from files.
//!
//! Input: a path to a JPEG, a PNG, or a binary PGM or PPM of 8 bits (P5, P6: what data sets of picture pairs often are).
//! Output: the grey picture, luma by BT.601; or an error that names the file and says what is wrong with it.
//! The format is told by the first bytes, never by the name. Cost: a read and a decoding.
//!
//! Deliberately not here: pictures larger than the decoder handles (a camera's, up to 1920x1200 px), colour.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::frame::{PixelFormat, RawFrame};
use crate::image::GreyImage;
use crate::image::decode::{Decoder, MAX_LONGER, MAX_SHORTER, is_handled, sniff};

/// Longest file that is read, bytes.
const MAX_BYTES: u64 = 32 << 20;

/// Why there is no picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PictureError {
    /// It is not there, or cannot be read.
    #[error("{path}: {reason}")]
    Read { path: String, reason: String },
    /// It is no picture, or a broken one.
    #[error("{path}: {reason}")]
    Corrupt { path: String, reason: String },
}

/// A picture and where it came from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    pub path: PathBuf,
    pub grey: GreyImage,
}

impl Picture {
    /// Reads and decodes.
    pub fn load(path: &Path) -> Result<Self, PictureError> {
        let name = path.display().to_string();
        let unreadable = |reason: String| PictureError::Read { path: name.clone(), reason };
        // Looked at before opening: opening a pipe would wait for somebody to write to it.
        let metadata = std::fs::metadata(path).map_err(|e| unreadable(e.to_string()))?;
        if !metadata.is_file() {
            return Err(unreadable("is not a file".into()));
        }
        let corrupt = |reason: String| PictureError::Corrupt { path: name.clone(), reason };
        if metadata.len() > MAX_BYTES {
            return Err(corrupt(format!("{} bytes are more than the {MAX_BYTES} that are read", metadata.len())));
        }
        let mut data = Vec::new();
        File::open(path)
            .and_then(|file| file.take(MAX_BYTES).read_to_end(&mut data))
            .map_err(|e| unreadable(e.to_string()))?;
        let grey = decode(data).map_err(corrupt)?;
        Ok(Self { path: path.into(), grey })
    }

    /// The file's name without its folder.
    pub fn name(&self) -> String {
        self.path.file_name().map_or_else(|| self.path.display().to_string(), |n| n.to_string_lossy().into_owned())
    }
}

/// The grey picture of a file's bytes.
fn decode(data: Vec<u8>) -> Result<GreyImage, String> {
    if data.starts_with(b"P5") || data.starts_with(b"P6") {
        return decode_pnm(&data);
    }
    let Some(format) = sniff(&data) else {
        let begin = data.get(..data.len().min(8)).unwrap_or_default();
        return Err(format!("neither JPEG nor PNG nor binary PGM or PPM, begins with {begin:02x?}"));
    };
    debug_assert!(matches!(format, PixelFormat::Jpeg | PixelFormat::Png));
    let frame = RawFrame { format, data, ..RawFrame::default() };
    let mut grey = GreyImage::default();
    Decoder::default().decode(&frame, &mut grey).map_err(|e| e.to_string())?;
    Ok(grey)
}

/// P5 or P6 with a maximum of 255.
fn decode_pnm(data: &[u8]) -> Result<GreyImage, String> {
    let mut at = 2;
    let mut header = [0usize; 3];
    for (value, name) in header.iter_mut().zip(["width", "height", "maximum"]) {
        *value = number(data, &mut at).ok_or_else(|| format!("PNM header: no {name}"))?;
    }
    let [width, height, maximum] = header;
    if maximum != 255 {
        return Err(format!("PNM maximum {maximum}: only 255 is handled"));
    }
    if !is_handled(width, height) {
        return Err(format!(
            "PNM picture of {width}x{height} px is refused: up to {MAX_LONGER}x{MAX_SHORTER} px, lying or upright, are handled"
        ));
    }
    let samples = if data.starts_with(b"P6") { 3 } else { 1 };
    let needed = width * height * samples;
    // One blank ends the header.
    let pixels = data.get(at + 1..at + 1 + needed).ok_or_else(|| {
        format!("PNM picture of {width}x{height} px is cut short: {needed} bytes of pixels are needed")
    })?;
    let grey = match samples {
        1 => pixels.to_vec(),
        _ => pixels.chunks_exact(3).map(|p| luma(p[0], p[1], p[2])).collect(),
    };
    Ok(GreyImage { width, height, data: grey })
}

/// BT.601, as the decoders of the daemon have it.
fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((u32::from(r) * 299 + u32::from(g) * 587 + u32::from(b) * 114 + 500) / 1000) as u8
}

/// The next number of a PNM header, after blanks and comments.
fn number(data: &[u8], at: &mut usize) -> Option<usize> {
    loop {
        match data.get(*at)? {
            b'#' => *at += data.get(*at..)?.iter().position(|b| *b == b'\n')?,
            b if b.is_ascii_whitespace() => *at += 1,
            _ => break,
        }
    }
    let digits = data.get(*at..)?.iter().take(9).take_while(|b| b.is_ascii_digit()).count();
    let text = std::str::from_utf8(data.get(*at..*at + digits)?).ok()?;
    *at += digits;
    text.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pgm_and_ppm_become_grey() {
        let grey = decode(b"P5\n# a comment\n2 2\n255\n\x01\x02\x03\xff".to_vec()).expect("a picture");
        assert_eq!((grey.width, grey.height, grey.data.as_slice()), (2, 2, &[1, 2, 3, 255][..]));
        let colour = decode(b"P6 1 1 255\n\xc8\x1e\x5a".to_vec()).expect("a picture");
        assert_eq!(colour.data, [(0.299 * 200.0 + 0.587 * 30.0 + 0.114 * 90.0f64).round() as u8]);
    }

    #[test]
    fn broken_files_are_named_with_a_reason() {
        for (bytes, word) in [
            (&b"P5 2 2 255\n\x01\x02"[..], "cut short"),
            (b"P5 2 2 65535\n", "maximum"),
            (b"P5 99999 2 255\n", "refused"),
            (b"P6 x", "width"),
            (b"P5", "width"),
            (b"GIF89a", "neither JPEG"),
            (b"", "neither JPEG"),
            (b"\xff\xd8\xff\xe0", "JPEG"),
        ] {
            let error = decode(bytes.to_vec()).expect_err("broken");
            assert!(error.contains(word), "{bytes:?}: {error}");
        }
        let missing = Picture::load(Path::new("/no/such/picture.png")).expect_err("missing");
        assert!(matches!(&missing, PictureError::Read { .. }) && missing.to_string().contains("/no/such/picture.png"));
        assert!(matches!(Picture::load(Path::new("/")), Err(PictureError::Read { .. })));
    }
}
