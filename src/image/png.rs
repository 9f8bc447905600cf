//! PNG to grey.
//!
//! Input: a PNG file of any colour type and depth. Output: `width * height` bytes of luma. Sixteen bits keep their upper
//! eight; a palette is looked up; colour becomes BT.601 luma (0.299 R + 0.587 G + 0.114 B), as JPEG's is, so that one
//! recording may mix the two; alpha is left out, because a camera's picture has nothing behind it.
//!
//! Cost: inflating dominates, see [`decode`](super::decode). The crate allocates its inflater for each picture. Not here:
//! colour profiles and gamma, later frames of an animation.

use super::GreyImage;
use super::error::{DecodeError, check_size};
use ::png::{BitDepth, ColorType, Decoder, Limits, Transformations};
use std::io::Cursor;

/// First bytes of every PNG.
pub(super) const MAGIC: [u8; 8] = [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a];

/// Memory that the crate may take for itself, bytes; ancillary chunks count, and they may claim any size.
const LIMIT_BYTES: usize = 8 << 20;

/// (width, height) of the header chunk, unchecked.
pub(super) fn read_size(data: &[u8]) -> Option<(usize, usize)> {
    let word = |at: usize| {
        let bytes = data.get(at..at + 4)?;
        Some(u32::from_be_bytes(bytes.try_into().ok()?) as usize)
    };
    (data.starts_with(&MAGIC) && data.get(12..16) == Some(b"IHDR".as_slice())).then_some(())?;
    Some((word(16)?, word(20)?))
}

/// Decodes into `out`. `pixels` is scratch space that is kept between pictures, for those that are not plain grey.
pub(super) fn decode(data: &[u8], pixels: &mut Vec<u8>, out: &mut GreyImage) -> Result<(), DecodeError> {
    let corrupt = |reason: String| DecodeError::Corrupt { format: "PNG", bytes: data.len(), reason };
    let (width, height) = read_size(data).ok_or_else(|| corrupt("no header chunk".into()))?;
    check_size("PNG", width, height)?;

    let mut decoder = Decoder::new_with_limits(Cursor::new(data), Limits { bytes: LIMIT_BYTES });
    decoder.set_transformations(Transformations::EXPAND | Transformations::STRIP_16);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(|e| corrupt(e.to_string()))?;
    let size = reader.output_buffer_size().ok_or_else(|| corrupt("size overflows".into()))?;
    let (color, depth) = reader.output_color_type();
    let samples = color.samples();
    if depth != BitDepth::Eight || size != width * height * samples {
        return Err(corrupt(format!("unexpected layout: {depth:?} bits, {size} bytes for {width}x{height}")));
    }

    if color == ColorType::Grayscale {
        out.resize(width, height);
        reader.next_frame(&mut out.data).map_err(|e| corrupt(e.to_string()))?;
        return Ok(());
    }
    pixels.resize(size, 0);
    reader.next_frame(pixels).map_err(|e| corrupt(e.to_string()))?;
    out.resize(width, height);
    match color {
        ColorType::GrayscaleAlpha => map_pixels::<2>(pixels, out, |p| p[0]),
        ColorType::Rgb => map_pixels::<3>(pixels, out, |p| luma(p[0], p[1], p[2])),
        ColorType::Rgba => map_pixels::<4>(pixels, out, |p| luma(p[0], p[1], p[2])),
        _ => return Err(corrupt(format!("unexpected colour type {color:?}"))),
    }
    Ok(())
}

fn map_pixels<const N: usize>(pixels: &[u8], out: &mut GreyImage, grey: impl Fn(&[u8; N]) -> u8) {
    let (pixels, _) = pixels.as_chunks::<N>();
    for (g, p) in out.data.iter_mut().zip(pixels) {
        *g = grey(p);
    }
}

/// BT.601 luma in 16-bit fixed point, rounded; the weights add up to 1 exactly, so that white stays white.
#[inline]
pub(crate) fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((19_595 * u32::from(r) + 38_470 * u32::from(g) + 7_471 * u32::from(b) + 32_768) >> 16) as u8
}
