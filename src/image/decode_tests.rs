//! Decoding held against libjpeg-turbo's and libpng's results, against files cut and damaged in seeded ways, and against
//! a real motion JPEG frame. The pictures under `tests/data/pictures` show one synthetic pattern; Pillow wrote them.

use super::super::jpeg::STANDARD_TABLES;
use super::super::png::luma;
use super::*;
use ::png::{BitDepth, ColorType, Encoder};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::path::PathBuf;

/// Of the random damage; proptest prints the smallest failing case.
const SEED: u64 = 20;
const JPEG_420: &[u8] = include_bytes!("../../tests/data/pictures/colour_420.jpg");
const JPEG_422_RESTART: &[u8] = include_bytes!("../../tests/data/pictures/colour_422_restart.jpg");
const JPEG_PROGRESSIVE: &[u8] = include_bytes!("../../tests/data/pictures/colour_progressive.jpg");
const JPEG_GREY: &[u8] = include_bytes!("../../tests/data/pictures/grey.jpg");
const PNG_COLOUR: &[u8] = include_bytes!("../../tests/data/pictures/colour.png");
const JPEGS: [&[u8]; 4] = [JPEG_420, JPEG_422_RESTART, JPEG_PROGRESSIVE, JPEG_GREY];

fn file(format: PixelFormat, data: &[u8]) -> RawFrame {
    RawFrame { format, data: data.to_vec(), ..RawFrame::default() }
}

fn rows(format: PixelFormat, width: u32, height: u32, stride: u32, data: Vec<u8>) -> RawFrame {
    RawFrame { format, width, height, stride, data, ..RawFrame::default() }
}

fn decode(frame: &RawFrame) -> Result<GreyImage, DecodeError> {
    let mut out = GreyImage::default();
    Decoder::default().decode(frame, &mut out)?;
    assert_eq!(out.data.len(), out.width * out.height);
    Ok(out)
}

/// Mean and largest absolute difference.
fn difference(a: &GreyImage, b: &GreyImage) -> (f64, u8) {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let diffs = a.data.iter().zip(&b.data).map(|(x, y)| x.abs_diff(*y));
    (diffs.clone().map(f64::from).sum::<f64>() / a.data.len() as f64, diffs.max().unwrap_or(0))
}

fn data_file(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let path = root.join(name);
    if !path.is_file() {
        println!("skipped: {} is not here", path.display());
        return None;
    }
    Some(path)
}

/// The segment with marker 0xff `marker` removed.
fn without_segment(data: &[u8], marker: u8) -> Vec<u8> {
    let mut out = data[..2].to_vec();
    let mut at = 2;
    while data[at + 1] != 0xda {
        let end = at + 2 + usize::from(u16::from_be_bytes([data[at + 2], data[at + 3]]));
        if data[at + 1] != marker {
            out.extend_from_slice(&data[at..end]);
        }
        at = end;
    }
    out.extend_from_slice(&data[at..]);
    out
}

/// A camera-sized frame; the pictures in the repository are too narrow to tell an early end from the decoder's read-ahead.
fn real_frame() -> Option<Vec<u8>> {
    Some(std::fs::read(data_file("tum_fr1_xyz/rgb/1305031102.175304.jpg")?).expect("readable"))
}

#[test]
fn grey_rows_are_copied_without_their_padding() {
    let data: Vec<u8> = (0..5 * 7).collect();
    let image = decode(&rows(PixelFormat::Grey, 4, 5, 7, data)).expect("whole");
    for y in 0..5 {
        assert_eq!(image.row(y), [0, 1, 2, 3].map(|x| (7 * y + x) as u8));
    }
}

#[test]
fn yuyv_luma_is_every_other_byte_for_any_width_and_stride() {
    for width in 1..40u32 {
        for padding in [0, 1, 6] {
            let stride = 4 * width.div_ceil(2) + padding;
            let data: Vec<u8> = (0..stride * 3).map(|i| (i * 37 % 251) as u8).collect();
            let image = decode(&rows(PixelFormat::Yuyv, width, 3, stride, data.clone())).expect("whole");
            for y in 0..3usize {
                for x in 0..width as usize {
                    assert_eq!(image.at(x, y), data[y * stride as usize + 2 * x], "({x}, {y}) of width {width}");
                }
            }
        }
    }
}

#[test]
fn the_last_row_may_come_without_padding_but_not_short() {
    let mut frame = rows(PixelFormat::Grey, 4, 3, 8, vec![1; 20]);
    assert!(decode(&frame).is_ok());
    frame.data.pop();
    let message = decode(&frame).expect_err("one byte short").to_string();
    assert!(message.contains("GREY picture of 19 bytes") && message.contains("stride 8 bytes"), "{message}");
}

#[test]
fn a_stride_below_the_row_is_refused() {
    assert!(decode(&rows(PixelFormat::Yuyv, 640, 480, 640, vec![0; 640 * 480 * 2])).is_err());
    assert!(decode(&rows(PixelFormat::Yuyv, 640, 480, 0, vec![0; 640 * 480 * 2])).is_err());
}

#[test]
fn sizes_out_of_range_are_refused_before_anything_is_allocated() {
    let mut out = GreyImage::default();
    let mut decoder = Decoder::default();
    for (width, height) in [(0, 480), (640, 0), (1921, 100), (100, 1921), (1201, 1201), (u32::MAX, u32::MAX)] {
        let frame = rows(PixelFormat::Yuyv, width, height, u32::MAX, vec![0; 16]);
        assert!(matches!(decoder.decode(&frame, &mut out), Err(DecodeError::Size { .. })), "{width}x{height}");
    }
    for picture in JPEGS {
        let frame_header = picture.windows(2).position(|w| w == [0xff, 0xc0] || w == [0xff, 0xc2]).expect("SOF");
        let mut huge = picture.to_vec();
        huge[frame_header + 5..frame_header + 9].copy_from_slice(&[0xff, 0xff, 0xff, 0xff]);
        let result = decoder.decode(&file(PixelFormat::Jpeg, &huge), &mut out);
        assert_eq!(result, Err(DecodeError::Size { format: "JPEG", width: 65_535, height: 65_535 }));
    }
    let mut huge = PNG_COLOUR.to_vec();
    huge[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    assert!(matches!(decoder.decode(&file(PixelFormat::Png, &huge), &mut out), Err(DecodeError::Size { .. })));
    assert_eq!(out.data.capacity(), 0);
}

#[test]
fn the_largest_picture_may_stand_upright() {
    for (width, height) in [(1920, 1200), (1200, 1920)] {
        let picture = decode(&rows(PixelFormat::Grey, width, height, width, vec![7; 1920 * 1200])).expect("decoded");
        assert_eq!((picture.width, picture.height), (width as usize, height as usize));
    }
}

#[test]
fn every_kind_of_jpeg_shows_the_pattern_of_the_png() {
    let truth = decode(&file(PixelFormat::Png, PNG_COLOUR)).expect("PNG");
    for (i, picture) in JPEGS.iter().enumerate() {
        let image = decode(&file(PixelFormat::Jpeg, picture)).expect("JPEG");
        let (mean, _) = difference(&image, &truth);
        assert!(mean < 2.5, "JPEG {i}: mean difference {mean}");
    }
}

#[test]
fn the_format_is_read_from_the_bytes_and_not_from_its_name() {
    assert_eq!(
        decode(&file(PixelFormat::Png, JPEG_420)).expect("JPEG"),
        decode(&file(PixelFormat::Jpeg, JPEG_420)).expect("JPEG")
    );
    assert!(decode(&file(PixelFormat::Jpeg, PNG_COLOUR)).is_ok());
    let message = decode(&file(PixelFormat::Jpeg, b"GIF89a..")).expect_err("GIF").to_string();
    assert!(message.contains("neither JPEG nor PNG, begins with [47, 49, 46"), "{message}");
    assert!(decode(&file(PixelFormat::Jpeg, &[])).is_err());
}

#[test]
fn sizes_are_read_from_headers_alone() {
    for picture in JPEGS.into_iter().chain([PNG_COLOUR]) {
        assert_eq!(picture_size(picture), Some((104, 72)));
    }
    assert_eq!(picture_size(&PNG_COLOUR[..20]), None);
    assert_eq!(picture_size(&JPEG_420[..100]), None);
}

#[test]
fn the_standard_tables_are_those_that_encoders_write() {
    let mut written = Vec::new();
    let mut rest = JPEG_422_RESTART;
    while let Some(at) = rest.windows(2).position(|w| w == [0xff, 0xc4]) {
        let length = usize::from(u16::from_be_bytes([rest[at + 2], rest[at + 3]]));
        written.extend_from_slice(&rest[at + 4..at + 2 + length]);
        rest = &rest[at + 2 + length..];
    }
    assert_eq!(written, STANDARD_TABLES[4..]);
}

#[test]
fn motion_jpeg_without_huffman_tables_decodes_as_with_them() {
    for picture in [JPEG_420, JPEG_422_RESTART, JPEG_GREY] {
        let bare = without_segment(picture, 0xc4);
        assert!(bare.len() < picture.len());
        assert_eq!(decode(&file(PixelFormat::Jpeg, &bare)), decode(&file(PixelFormat::Jpeg, picture)));
    }
}

#[test]
fn a_webcams_frame_with_avi1_marker_and_restarts_matches_its_reference() {
    let (Some(frame), Some(reference)) =
        (data_file("mjpeg/jpeg-decoder_mjpeg.jpg"), data_file("mjpeg/jpeg-decoder_mjpeg_reference.png"))
    else {
        return;
    };
    let read = |path| file(PixelFormat::Jpeg, &std::fs::read(path).expect("readable"));
    let image = decode(&read(frame)).expect("motion JPEG");
    let (mean, largest) = difference(&image, &decode(&read(reference)).expect("PNG"));
    assert!(mean < 0.05 && largest <= 8, "mean {mean}, largest {largest}");
}

#[test]
fn a_jpeg_cut_anywhere_is_an_error() {
    for picture in JPEGS {
        // The last two bytes are the end marker; a file without it is whole all the same.
        for length in (0..picture.len() - 24).step_by(7) {
            assert!(
                decode(&file(PixelFormat::Jpeg, &picture[..length])).is_err(),
                "{length} of {} bytes",
                picture.len()
            );
        }
    }
}

#[test]
fn a_camera_frame_that_lost_packets_is_an_error_although_its_end_is_there() {
    let Some(whole) = real_frame() else { return };
    for at in (1_000..whole.len() - 6_000).step_by(9_001) {
        let mut damaged = whole.clone();
        damaged.drain(at..at + 3_000);
        assert!(decode(&file(PixelFormat::Jpeg, &damaged)).is_err(), "3000 bytes lost at {at}");
    }
    assert!(decode(&file(PixelFormat::Jpeg, &whole)).is_ok());
    let end_lost = &whole[..whole.len() - 2];
    assert_eq!(decode(&file(PixelFormat::Jpeg, end_lost)), decode(&file(PixelFormat::Jpeg, &whole)));
}

#[test]
fn a_decoder_goes_on_after_a_broken_frame() {
    let mut decoder = Decoder::default();
    let mut out = GreyImage::default();
    let whole = file(PixelFormat::Jpeg, &without_segment(JPEG_420, 0xc4));
    assert!(decoder.decode(&file(PixelFormat::Jpeg, &JPEG_422_RESTART[..1_000]), &mut out).is_err());
    assert!(decoder.decode(&file(PixelFormat::Png, &PNG_COLOUR[..1_000]), &mut out).is_err());
    decoder.decode(&whole, &mut out).expect("whole");
    assert_eq!(out, decode(&whole).expect("whole"));
}

/// `samples` in the given PNG layout.
fn encode_png(color: ColorType, depth: BitDepth, width: u32, height: u32, samples: &[u8], palette: &[u8]) -> Vec<u8> {
    let mut data = Vec::new();
    let mut encoder = Encoder::new(&mut data, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if !palette.is_empty() {
        encoder.set_palette(palette.to_vec());
    }
    encoder.write_header().and_then(|mut w| w.write_image_data(samples)).expect("encoder");
    data
}

#[test]
fn png_of_every_colour_type_and_depth_becomes_bt601_luma() {
    let (r, g, b) = (200u8, 30u8, 90u8);
    let y = luma(r, g, b);
    assert_eq!(y, (0.299 * 200.0 + 0.587 * 30.0 + 0.114 * 90.0f64).round() as u8);
    let palette = [1, 2, 3, r, g, b];
    let cases: [(&str, ColorType, BitDepth, Vec<u8>, u8); 10] = [
        ("grey 1", ColorType::Grayscale, BitDepth::One, vec![0b1100_0000; 2], 255),
        ("grey 4", ColorType::Grayscale, BitDepth::Four, vec![0x55; 2], 0x55),
        ("grey 8", ColorType::Grayscale, BitDepth::Eight, vec![77; 4], 77),
        ("grey 16", ColorType::Grayscale, BitDepth::Sixteen, [77, 200].repeat(4), 77),
        ("grey alpha", ColorType::GrayscaleAlpha, BitDepth::Eight, [77, 0].repeat(4), 77),
        ("rgb 8", ColorType::Rgb, BitDepth::Eight, [r, g, b].repeat(4), y),
        ("rgb 16", ColorType::Rgb, BitDepth::Sixteen, [r, 9, g, 9, b, 9].repeat(4), y),
        ("rgba 8", ColorType::Rgba, BitDepth::Eight, [r, g, b, 5].repeat(4), y),
        ("rgba 16", ColorType::Rgba, BitDepth::Sixteen, [r, 9, g, 9, b, 9, 0, 0].repeat(4), y),
        ("palette 1", ColorType::Indexed, BitDepth::One, vec![0b1100_0000; 2], y),
    ];
    for (name, color, depth, samples, expected) in cases {
        let entries: &[u8] = if color == ColorType::Indexed { &palette } else { &[] };
        let data = encode_png(color, depth, 2, 2, &samples, entries);
        let image = decode(&file(PixelFormat::Png, &data)).expect(name);
        assert_eq!((image.width, image.height, image.data), (2, 2, vec![expected; 4]), "{name}");
    }
}

#[test]
fn luma_keeps_grey_values() {
    for v in 0..=255u8 {
        assert_eq!(luma(v, v, v), v);
    }
}

#[test]
fn a_png_cut_anywhere_before_its_last_chunk_is_an_error() {
    for length in (0..PNG_COLOUR.len() - 16).step_by(97) {
        assert!(decode(&file(PixelFormat::Png, &PNG_COLOUR[..length])).is_err(), "{length} bytes");
    }
}

#[test]
fn buffers_are_kept_between_frames() {
    let mut decoder = Decoder::default();
    let mut out = GreyImage::default();
    let bare = file(PixelFormat::Jpeg, &without_segment(JPEG_420, 0xc4));
    let png = file(PixelFormat::Png, PNG_COLOUR);
    let mut run = || {
        decoder.decode(&bare, &mut out).expect("JPEG");
        decoder.decode(&png, &mut out).expect("PNG");
        (out.data.as_ptr(), decoder.jpeg_with_tables.as_ptr(), decoder.png_pixels.as_ptr())
    };
    let first = run();
    assert_eq!(run(), first);
}

/// What may happen to a file on its way.
#[derive(Debug, Clone)]
enum Damage {
    Set(usize, u8),
    Cut(usize, usize),
    Insert(usize, Vec<u8>),
    Truncate(usize),
}

fn damage() -> impl Strategy<Value = Damage> {
    // Headers are small, and they are where a decoder is led astray: half of the positions lie there.
    let position = prop_oneof![0usize..700, 0usize..14_000];
    let byte = prop_oneof![any::<u8>(), Just(0xff), 0xc0u8..=0xef];
    prop_oneof![
        (position.clone(), byte.clone()).prop_map(|(at, value)| Damage::Set(at, value)),
        (position.clone(), 1usize..200).prop_map(|(at, count)| Damage::Cut(at, count)),
        (position.clone(), prop::collection::vec(byte, 1..8)).prop_map(|(at, bytes)| Damage::Insert(at, bytes)),
        position.prop_map(Damage::Truncate),
    ]
}

fn damaged(original: &[u8], damages: &[Damage]) -> Vec<u8> {
    let mut data = original.to_vec();
    for d in damages {
        match d {
            Damage::Set(at, value) => {
                if let Some(byte) = data.get_mut(*at) {
                    *byte = *value;
                }
            }
            Damage::Cut(at, count) => drop(data.drain((*at).min(data.len())..(at + count).min(data.len()))),
            Damage::Insert(at, bytes) => {
                let at = (*at).min(data.len());
                drop(data.splice(at..at, bytes.iter().copied()));
            }
            Damage::Truncate(at) => data.truncate(*at),
        }
    }
    data
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 5_000, rng_seed: RngSeed::Fixed(SEED), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_pictures_are_refused_or_decoded_but_never_panic(
        which in 0usize..5,
        damages in prop::collection::vec(damage(), 1..5),
    ) {
        let original = JPEGS.into_iter().chain([PNG_COLOUR]).nth(which).expect("five pictures");
        let _ = decode(&file(PixelFormat::Jpeg, &damaged(original, &damages)));
    }

    #[test]
    fn rows_of_any_claimed_size_are_refused_or_copied_but_never_panic(
        yuyv: bool, width in 0u32..70, height in 0u32..70, stride in 0u32..300, bytes in 0usize..9_000,
    ) {
        let format = if yuyv { PixelFormat::Yuyv } else { PixelFormat::Grey };
        let _ = decode(&rows(format, width, height, stride, vec![1; bytes]));
    }
}
