//! JPEG and motion JPEG to grey.
//!
//! Input: a JPEG file, or what a webcam sends as motion JPEG: often with an `AVI1` marker, with restart intervals and
//! *without* Huffman tables, because those are always the standard's typical ones (ITU-T T.81, tables K.3 to K.6).
//! Output: the luma plane alone, `width * height` bytes. Chroma is skipped over, not reconstructed; JPEG's luma is
//! BT.601 full range already.
//!
//! What is done here rather than by the decoder crate: the header is walked once, so that the size is known and bounded
//! before anything is allocated; the standard tables are put before the scan where none came; and the end marker is kept
//! from the decoder, so that a frame whose data ends early is an error and not a half-grey picture.
//!
//! Cost: see [`decode`](super::decode). The crate offers no decoder that lives longer than a picture, so a handful of
//! row buffers is allocated for each. Not here: colour, arithmetic coding, 12 bit, CMYK and RGB JPEG (refused).

use super::GreyImage;
use super::error::{DecodeError, check_size};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// First bytes of every JPEG: start of image, then another marker.
pub(super) const MAGIC: [u8; 3] = [0xff, 0xd8, 0xff];

/// From this width on, a row of blocks takes more bytes even if it is black than the decoder reads ahead (8), so that a
/// whole picture without its end marker never looks cut short. Two bits a block is the least that Huffman codes allow.
const MIN_WIDTH_WITHOUT_END: usize = 320;

/// What the segments before the first scan say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    pub width: usize,
    pub height: usize,
    /// A DHT segment is there.
    has_tables: bool,
    /// Offset of the first SOS marker's 0xff.
    scan_start: usize,
    /// Sequential, and the first scan holds every component: what cameras send.
    single_scan: bool,
}

fn corrupt(data: &[u8], reason: impl Into<String>) -> DecodeError {
    DecodeError::Corrupt { format: "JPEG", bytes: data.len(), reason: reason.into() }
}

/// Walks the segments up to the first scan.
pub(super) fn read_header(data: &[u8]) -> Result<Header, DecodeError> {
    let truncated = || corrupt(data, "truncated before the first scan");
    let byte = |at: usize| data.get(at).copied().ok_or_else(truncated);
    let word = |at: usize| Ok::<usize, DecodeError>(usize::from(byte(at)?) << 8 | usize::from(byte(at + 1)?));
    if !data.starts_with(&MAGIC) {
        return Err(corrupt(data, "does not begin with a start-of-image marker"));
    }
    let mut at = 2;
    let mut frame = None;
    let mut has_tables = false;
    loop {
        // Every round moves `at` forward, so the walk ends with the data.
        if byte(at)? != 0xff {
            return Err(corrupt(data, format!("no marker where one is due, at byte {at}")));
        }
        let marker = byte(at + 1)?;
        match marker {
            0xff => at += 1,               // fill byte
            0x01 | 0xd0..=0xd8 => at += 2, // markers without a length
            0xd9 => return Err(corrupt(data, "ends before the first scan")),
            0xda => {
                let (width, height, components, sequential) =
                    frame.ok_or_else(|| corrupt(data, "no frame header before the first scan"))?;
                let single_scan = sequential && byte(at + 4)? == components;
                return Ok(Header { width, height, has_tables, scan_start: at, single_scan });
            }
            _ => {
                let length = word(at + 2)?;
                if length < 2 {
                    return Err(corrupt(data, format!("segment of length {length} at byte {at}")));
                }
                match marker {
                    0xc4 => has_tables = true,
                    // Start of frame: baseline, extended, progressive; the rest is refused by the decoder.
                    0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                        frame = Some((word(at + 7)?, word(at + 5)?, byte(at + 9)?, matches!(marker, 0xc0 | 0xc1)));
                    }
                    _ => {}
                }
                at += 2 + length;
            }
        }
    }
}

/// Decodes the luma plane into `out`. `with_tables` is scratch space that is kept between pictures.
pub(super) fn decode(data: &[u8], with_tables: &mut Vec<u8>, out: &mut GreyImage) -> Result<(), DecodeError> {
    let header = read_header(data)?;
    check_size("JPEG", header.width, header.height)?;
    let data = if header.single_scan && header.width >= MIN_WIDTH_WITHOUT_END {
        without_end_marker(data, header.scan_start)
    } else {
        data
    };
    let picture = if header.has_tables {
        data
    } else {
        let (before, scan) = data.split_at(header.scan_start);
        with_tables.clear();
        with_tables.extend_from_slice(before);
        with_tables.extend_from_slice(&STANDARD_TABLES);
        with_tables.extend_from_slice(scan);
        with_tables.as_slice()
    };
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(header.width)
        .set_max_height(header.height)
        .jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(picture), options);
    decoder.decode_headers().map_err(|e| corrupt(data, e.to_string()))?;
    match decoder.input_colorspace() {
        Some(ColorSpace::YCbCr | ColorSpace::Luma) => {}
        other => return Err(corrupt(data, format!("colour space {other:?} is not supported, only YCbCr and grey"))),
    }
    out.resize(header.width, header.height);
    decoder.decode_into(&mut out.data).map_err(|e| corrupt(data, e.to_string()))
}

/// The data without its end-of-image marker and what follows it.
///
/// A decoder that meets the marker early fills the rest of the picture with grey and calls it a success. USB cameras
/// lose packets in the middle of a frame and still send the end. Without the marker the decoder runs out of data and
/// says so.
fn without_end_marker(data: &[u8], scan_start: usize) -> &[u8] {
    let scan = data.get(scan_start..).unwrap_or_default();
    match scan.windows(2).rposition(|w| w == [0xff, 0xd9]) {
        Some(at) => &data[..scan_start + at],
        None => data,
    }
}

/// The typical Huffman tables of ITU-T T.81 K.3 to K.6 as one DHT segment (marker, length, four tables).
#[rustfmt::skip]
pub(super) const STANDARD_TABLES: [u8; 420] = [
    0xff, 0xc4, 0x01, 0xa2,
    // K.3: DC, luminance: class and number, codes of each length 1 to 16, values.
    0x00, 0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0,
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11,
    // K.5: AC, luminance.
    0x10, 0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125,
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
    0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72,
    0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37,
    0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
    0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3,
    0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
    0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2,
    0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
    // K.4: DC, chrominance.
    0x01, 0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0,
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11,
    // K.6: AC, chrominance.
    0x11, 0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119,
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1,
    0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36,
    0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
    0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
    0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
    0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
    0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];
