//! Messages as drivers write them, and what is wrong with others.

use super::picture::{Kind, camera_info, read};
use super::records::{Records, Step};
use super::survey;
use crate::frame::{PixelFormat, RawFrame};
use crate::geometry::LensModel;
use crate::image::GreyImage;
use crate::image::decode::Decoder;
use crate::ros::Writer;

/// A sensor_msgs/Image of `height` rows of `step` bytes.
fn image(width: u32, height: u32, encoding: &str, big_endian: bool, step: u32, data: &[u8]) -> Vec<u8> {
    let mut w = Writer::default();
    header(&mut w);
    w.number(height.to_le_bytes());
    w.number(width.to_le_bytes());
    text(&mut w, encoding);
    w.number([u8::from(big_endian)]);
    w.number(step.to_le_bytes());
    w.length(data.len());
    w.raw(data);
    w.into_bytes()
}

fn header(w: &mut Writer) {
    w.number(5_i32.to_le_bytes());
    w.number(7_u32.to_le_bytes());
    text(w, "cam");
}

fn text(w: &mut Writer, text: &str) {
    w.length(text.len() + 1);
    w.raw(text.as_bytes());
    w.raw(&[0]);
}

/// The grey picture that a raw message decodes to.
fn grey(message: &[u8]) -> Vec<u8> {
    let mut slot = RawFrame::default();
    assert_eq!(read(Kind::Raw, message, &mut slot), Ok(5_000_000_007));
    let mut out = GreyImage::default();
    Decoder::default().decode(&slot, &mut out).expect("decoded");
    out.data
}

#[test]
fn every_encoding_becomes_the_grey_that_it_shows() {
    // Two pixels a row: red and white, then black and a grey of 16 bits; rows are longer than their pixels.
    assert_eq!(grey(&image(2, 2, "mono8", false, 3, &[1, 2, 99, 3, 4])), [1, 2, 3, 4]);
    assert_eq!(grey(&image(2, 1, "rgb8", false, 6, &[255, 0, 0, 255, 255, 255])), [76, 255]);
    assert_eq!(grey(&image(2, 1, "bgr8", false, 6, &[0, 0, 255, 255, 255, 255])), [76, 255]);
    assert_eq!(grey(&image(1, 1, "rgba8", false, 4, &[255, 0, 0, 9])), [76]);
    assert_eq!(grey(&image(1, 1, "bgra8", false, 4, &[0, 0, 255, 9])), [76]);
    assert_eq!(grey(&image(2, 1, "yuv422_yuy2", false, 4, &[10, 128, 20, 128])), [10, 20]);
    assert_eq!(grey(&image(2, 1, "yuv422", false, 4, &[128, 10, 128, 20])), [10, 20]);
    assert_eq!(grey(&image(2, 1, "mono16", false, 4, &[1, 2, 3, 4])), [2, 4]);
    assert_eq!(grey(&image(2, 1, "mono16", true, 4, &[1, 2, 3, 4])), [1, 3]);
    // An even red of 200, green of 60 and blue of 20, in rows of five bytes; then the same with a byte below each.
    for (pattern, [a, b, c, d]) in [
        ("bayer_rggb", [200, 60, 60, 20]),
        ("bayer_bggr", [20, 60, 60, 200]),
        ("bayer_gbrg", [60, 20, 200, 60]),
        ("bayer_grbg", [60, 200, 20, 60]),
    ] {
        assert_eq!(grey(&image(2, 2, &format!("{pattern}8"), false, 5, &[a, b, 99, 99, 99, c, d])), [85; 4]);
        let (little, big) = ([9, a, 9, b, 9, c, 9, d], [a, 9, b, 9, c, 9, d, 9]);
        assert_eq!(grey(&image(2, 2, &format!("{pattern}16"), false, 4, &little)), [85; 4]);
        assert_eq!(grey(&image(2, 2, &format!("{pattern}16"), true, 4, &big)), [85; 4]);
    }
}

#[test]
fn a_message_that_is_not_what_it_says_is_refused_with_its_reason() {
    let mut slot = RawFrame::default();
    let mut refuse = |kind, message: &[u8], word: &str| {
        let reason = read(kind, message, &mut slot).expect_err(word);
        assert!(reason.contains(word), "{reason}");
    };
    refuse(Kind::Raw, &image(2, 2, "mono8", false, 2, &[1, 2, 3]), "3 bytes");
    refuse(Kind::Raw, &image(2, 2, "mono8", false, 1, &[1, 2, 3, 4]), "rows of 1 bytes");
    refuse(Kind::Raw, &image(u32::MAX, u32::MAX, "bgr8", false, u32::MAX, &[1]), "1 bytes");
    refuse(Kind::Raw, &image(2, 1, "bayer_rggb8", false, 2, &[1, 2]), "2x1 px of bayer_rggb8");
    refuse(Kind::Raw, &image(2, 2, "bayer_rggb16", false, 4, &[1; 6]), "6 bytes");
    refuse(Kind::Raw, &image(2, 2, "nv12", false, 2, &[1; 6]), "nv12");
    refuse(Kind::Raw, &image(2, 2, "mono8", false, 2, &[1; 4])[..30], "ends at byte");
    refuse(Kind::Raw, &[0, 0, 0, 0], "CDR");
    let mut w = Writer::default();
    header(&mut w);
    text(&mut w, "h264");
    w.length(4);
    w.raw(&[0, 0, 0, 1]);
    refuse(Kind::Compressed, &w.into_bytes(), "h264");
}

#[test]
fn bytes_of_a_jpeg_or_png_are_handed_on_whatever_the_format_is_called() {
    let jpeg = [0xff, 0xd8, 0xff, 0xe0, 1, 2, 3];
    let mut w = Writer::default();
    header(&mut w);
    text(&mut w, "rgb8; jpeg compressed bgr8");
    w.length(jpeg.len());
    w.raw(&jpeg);
    let mut slot = RawFrame::default();
    assert_eq!(read(Kind::Compressed, &w.into_bytes(), &mut slot), Ok(5_000_000_007));
    assert_eq!((slot.format, slot.data.as_slice()), (PixelFormat::Jpeg, jpeg.as_slice()));
}

fn info(model: &str, d: &[f64], fx: f64) -> Vec<u8> {
    let mut w = Writer::default();
    header(&mut w);
    w.number(480_u32.to_le_bytes());
    w.number(640_u32.to_le_bytes());
    text(&mut w, model);
    w.length(d.len());
    d.iter().for_each(|v| w.number(v.to_le_bytes()));
    let k = if fx > 0.0 { [fx, 0.0, 320.0, 0.0, fx, 240.0, 0.0, 0.0, 1.0] } else { [0.0; 9] };
    k.iter().chain(&[0.0; 21]).for_each(|v| w.number(v.to_le_bytes()));
    // Binning in both directions; place and size of the region of interest.
    (0..6).for_each(|_| w.number(0_u32.to_le_bytes()));
    w.into_bytes()
}

#[test]
fn rectified_pictures_have_no_distortion() {
    // Its projection is all zero: there is no such camera, and the raw one is not taken instead.
    let info = info("plumb_bob", &[0.1, 0.2, 0.3, 0.4, 0.5], 500.0);
    assert!(camera_info(&info, true).is_err());
    assert!(survey::is_rectified("/cam/image_rect") && survey::is_rectified("/cam/image_rect_color/compressed"));
    assert!(!survey::is_rectified("/cam/image_raw") && !survey::is_rectified("/rect_cam/image"));
}

/// Its length says 32 bytes and its inner lengths say none of them: mcap 0.26 panics when it looks into such a record.
#[test]
fn an_attachment_is_not_looked_into() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("hostile.mcap");
    let mut bytes = mcap::MAGIC.to_vec();
    bytes.push(mcap::records::op::ATTACHMENT);
    bytes.extend(32_u64.to_le_bytes());
    bytes.extend([0; 32]);
    std::fs::write(&path, &bytes).expect("file");
    let mut records = Records::open(&path).expect("opens");
    assert_eq!(records.step(|_| panic!("shown")), Ok(Step::Record));
    assert_eq!(records.step(|_| panic!("shown")), Ok(Step::CutOff));
    // The same as a summary.
    let at = mcap::MAGIC.len() as u64;
    bytes.push(mcap::records::op::FOOTER);
    bytes.extend(20_u64.to_le_bytes());
    bytes.extend(at.to_le_bytes());
    bytes.extend([0; 12]);
    bytes.extend(mcap::MAGIC);
    std::fs::write(&path, &bytes).expect("file");
    let mut summary = Records::open(&path).expect("opens").summary().expect("a summary");
    assert_eq!(summary.step(|_| panic!("shown")), Ok(Step::Record));
    assert_eq!(summary.step(|_| panic!("shown")), Ok(Step::End));
}

#[test]
fn a_camera_info_is_a_camera_or_says_that_there_is_none() {
    let camera =
        camera_info(&info("plumb_bob", &[0.1, 0.2, 0.3, 0.4, 0.5], 500.0), false).expect("read").expect("a camera");
    assert_eq!((camera.width, camera.height, camera.fx, camera.cy), (640, 480, 500.0, 240.0));
    assert_eq!(camera.lens, LensModel::RadialTangential([0.1, 0.2, 0.3, 0.4, 0.5]));
    let fisheye =
        camera_info(&info("equidistant", &[0.1, 0.2, 0.3, 0.4], 300.0), false).expect("read").expect("a camera");
    assert_eq!(fisheye.lens, LensModel::KannalaBrandt([0.1, 0.2, 0.3, 0.4]));
    let rational = [0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0];
    assert!(camera_info(&info("rational_polynomial", &rational, 500.0), false).is_ok_and(|c| c.is_some()));
    assert_eq!(camera_info(&info("plumb_bob", &[0.0; 5], 0.0), false), Ok(None));
    for (model, d) in
        [("rational_polynomial", [0.1; 8].as_slice()), ("equidistant", &[0.1; 5]), ("panoramic", &[0.1; 4])]
    {
        assert!(camera_info(&info(model, d, 500.0), false).is_err_and(|e| e.contains(model) && e.contains("--camera")));
    }
    assert!(camera_info(&[0, 1, 0, 0, 1], false).is_err());
}
