//! Calibrations in the formats of others, as text (ours too, for a caller that lets a person choose).
//!
//! | format | written by, read by | size | pinhole | wide angle (Kannala-Brandt) |
//! |---|---|---|---|---|
//! | `ros` | `camera_info` YAML of ROS | yes | `plumb_bob`, k1 k2 p1 p2 k3 | `equidistant`, k1 k2 k3 k4 |
//! | `opencv` | OpenCV's `FileStorage`, YAML | yes | k1 k2 p1 p2 k3 | `fisheye_model: 1`, k1 k2 k3 k4 |
//! | `opencv-xml` | the same as XML | yes | k1 k2 p1 p2 k3 | the same |
//! | `kalibr` | Kalibr's camchain | yes | `radtan`, k1 k2 p1 p2 | `equidistant`, k1 k2 k3 k4 |
//! | `euroc` | EuRoC's / ASL's `sensor.yaml` | yes | `radial-tangential`, k1 k2 p1 p2 | `equidistant`, k1 k2 k3 k4 |
//! | `tum` | TUM's `fx fy cx cy d0 d1 d2 d3 d4` | in a comment of ours | k1 k2 p1 p2 k3 | refused |
//!
//! OpenCV's functions write matrices and no lens model; the key `fisheye_model` is that of its calibration sample.
//!
//! Numbers are written with as many digits as bring the very same number back. What a format cannot say is refused, not rounded away:
//! a k3 in Kalibr's or EuRoC's. Rectification and projection of a ROS file are those of a single camera. Not here: reading
//! (`file`, `yaml`, `foreign`), extrinsics, time offsets, other lens models.

use super::file::{CalibrationError, CalibrationFile};
use crate::geometry::{CameraModel, LensModel};

/// A way to write a camera down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// Our TOML
    Cairn,
    /// ROS camera_info YAML
    Ros,
    /// OpenCV FileStorage YAML
    Opencv,
    /// OpenCV FileStorage XML
    OpencvXml,
    /// Kalibr camchain YAML
    Kalibr,
    /// EuRoC / ASL sensor.yaml
    Euroc,
    /// TUM's plain numbers
    Tum,
}

/// The camera as text of a format other than ours; `path` is for messages.
pub fn write(camera: &CameraModel, format: Format, path: &str) -> Result<String, CalibrationError> {
    let c = camera;
    let wide = c.lens.is_wide_angle();
    let (w, h, fx, fy, cx, cy) = (c.width, c.height, c.fx, c.fy, c.cx, c.cy);
    let matrix = format!("{fx:?}, 0.0, {cx:?}, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 1.0");
    let list = |numbers: &[f64]| numbers.iter().map(|k| format!("{k:?}")).collect::<Vec<_>>().join(", ");
    let (all, count) = (list(c.lens.coefficients()), c.lens.coefficients().len());
    let refused = |reason: String| CalibrationError::File { path: path.into(), reason };
    // k1 k2 p1 p2, or k1 k2 k3 k4.
    let four = |name: &str| match c.lens {
        LensModel::RadialTangential([k1, k2, p1, p2, 0.0]) => Ok(list(&[k1, k2, p1, p2])),
        LensModel::RadialTangential([.., k3]) => Err(refused(format!(
            "k3 = {k3}: {name} has k1 k2 p1 p2 only; calibrate with --distortion radial-tangential for a camera without k3"
        ))),
        LensModel::KannalaBrandt(k) => Ok(list(&k)),
    };
    Ok(match format {
        Format::Cairn => CalibrationFile { camera: camera.clone(), other: toml::Table::new(), assumed: None }
            .to_toml()
            .map_err(|e| refused(e.to_string()))?,
        Format::Ros => format!(
            "image_width: {w}\nimage_height: {h}\ncamera_name: camera\n\
             camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{matrix}]\n\
             distortion_model: {}\n\
             distortion_coefficients:\n  rows: 1\n  cols: {count}\n  data: [{all}]\n\
             rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n\
             projection_matrix:\n  rows: 3\n  cols: 4\n  \
             data: [{fx:?}, 0.0, {cx:?}, 0.0, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 0.0, 1.0, 0.0]\n",
            if wide { "equidistant" } else { "plumb_bob" }
        ),
        Format::Opencv => format!(
            "%YAML:1.0\n---\nimage_width: {w}\nimage_height: {h}\n{}\
             camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {matrix} ]\n\
             distortion_coefficients: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [ {all} ]\n",
            if wide { "fisheye_model: 1\n" } else { "" },
            if wide { count } else { 1 },
            if wide { 1 } else { count },
        ),
        Format::OpencvXml => {
            let data = |list: &str| list.replace(',', "");
            format!(
                "<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_width>{w}</image_width>\n<image_height>{h}</image_height>\n{}\
                 <camera_matrix type_id=\"opencv-matrix\">\n  <rows>3</rows>\n  <cols>3</cols>\n  <dt>d</dt>\n  \
                 <data>\n    {}</data></camera_matrix>\n\
                 <distortion_coefficients type_id=\"opencv-matrix\">\n  <rows>{}</rows>\n  <cols>{}</cols>\n  <dt>d</dt>\n  \
                 <data>\n    {}</data></distortion_coefficients>\n</opencv_storage>\n",
                if wide { "<fisheye_model>1</fisheye_model>\n" } else { "" },
                data(&matrix),
                if wide { count } else { 1 },
                if wide { 1 } else { count },
                data(&all)
            )
        }
        Format::Kalibr => format!(
            "cam0:\n  camera_model: pinhole\n  intrinsics: [{fx:?}, {fy:?}, {cx:?}, {cy:?}]\n  \
             distortion_model: {}\n  distortion_coeffs: [{}]\n  resolution: [{w}, {h}]\n",
            if wide { "equidistant" } else { "radtan" },
            four("Kalibr's radtan")?
        ),
        Format::Euroc => format!(
            "sensor_type: camera\nresolution: [{w}, {h}]\ncamera_model: pinhole\n\
             intrinsics: [{fx:?}, {fy:?}, {cx:?}, {cy:?}] #fu, fv, cu, cv\n\
             distortion_model: {}\ndistortion_coefficients: [{}]\n",
            if wide { "equidistant" } else { "radial-tangential" },
            four("EuRoC's radial-tangential")?
        ),
        Format::Tum if wide => {
            return Err(refused(
                "TUM's plain numbers cannot say that a lens is a wide-angle one (kannala_brandt): choose cairn, ros, opencv, kalibr or euroc"
                    .into(),
            ));
        }
        Format::Tum => format!(
            "# fx fy cx cy d0 d1 d2 d3 d4 (k1 k2 p1 p2 k3)\n# size_px {w} {h}\n\
             {fx:?} {fy:?} {cx:?} {cy:?} {}\n",
            all.replace(',', "")
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::{CalibrationFile, Unsaid};
    use crate::geometry::plane_calibration::LensKind;
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    const ALL: [Format; 7] =
        [Format::Cairn, Format::Ros, Format::Opencv, Format::OpencvXml, Format::Kalibr, Format::Euroc, Format::Tum];

    fn read(text: &str, format: Format) -> Result<CameraModel, CalibrationError> {
        CalibrationFile::parse(text, "camera", format == Format::Cairn).map(|f| f.camera)
    }

    #[test]
    fn a_k3_is_not_lost_silently() {
        let camera = CameraModel::new(640, 480, 500.0, 501.0, 320.0, 240.0, [0.1, 0.0, 0.0, 0.0, 0.2]).unwrap();
        for format in [Format::Kalibr, Format::Euroc] {
            let message = write(&camera, format, "out.yaml").expect_err("refused").to_string();
            assert!(message.contains("k3 = 0.2") && message.contains("out.yaml"), "{message}");
        }
    }

    #[test]
    fn a_fisheye_is_told_by_its_name_and_not_by_four_coefficients() {
        let k = [0.03, -0.015, 0.004, -0.001];
        let fisheye = CameraModel::new(640, 480, 300.0, 301.0, 320.0, 240.0, LensModel::KannalaBrandt(k)).unwrap();
        let without = |format: Format, from: &str, to: &str| {
            let text = write(&fisheye, format, "x").unwrap();
            assert!(text.contains(from), "{text}");
            read(&text.replace(from, to), format)
        };
        let pinhole = LensModel::RadialTangential([k[0], k[1], k[2], k[3], 0.0]);
        for (format, from) in [
            (Format::Ros, "distortion_model: equidistant\n"),
            (Format::Opencv, "fisheye_model: 1\n"),
            (Format::OpencvXml, "<fisheye_model>1</fisheye_model>\n"),
            (Format::Kalibr, "  distortion_model: equidistant\n"),
            (Format::Euroc, "distortion_model: equidistant\n"),
            (Format::Cairn, "lens_model = \"kannala_brandt\"\n"),
        ] {
            // Our own file names k4 as well, so it is no pinhole's.
            let read = without(format, from, "");
            assert_eq!(read.as_ref().ok().map(|c| c.lens), (format != Format::Cairn).then_some(pinhole), "{read:?}");
        }
        for (format, from, to, expected) in [
            (
                Format::Ros,
                "equidistant",
                "rational_polynomial",
                "distortion_model = rational_polynomial: is not handled",
            ),
            (Format::Ros, "-0.001]", "-0.001, 0.5]", "must be four numbers: k1 k2 k3 k4"),
            (Format::Kalibr, ", -0.001]", "]", "must be four numbers: k1 k2 k3 k4"),
            (Format::Opencv, "fisheye_model: 1", "fisheye_model: 2", "camera:5: fisheye_model = 2: must be 0 or 1"),
            (
                Format::Opencv,
                "fisheye_model: 1",
                "fisheye_model: 1\ndistortion_model: plumb_bob",
                "fisheye_model = 1: contradicts distortion_model",
            ),
        ] {
            let message = without(format, from, to).expect_err(to).to_string();
            assert!(message.contains(expected), "{to}: {message}");
        }
        let message = write(&fisheye, Format::Tum, "out.txt").expect_err("refused").to_string();
        assert!(message.contains("out.txt") && message.contains("kannala_brandt"), "{message}");
    }

    #[test]
    fn four_coefficients_without_a_model_are_not_taken_for_a_pinhole_silently() {
        let k = [0.03, -0.015, 0.004, -0.001];
        let fisheye = CameraModel::new(640, 480, 300.0, 301.0, 320.0, 240.0, LensModel::KannalaBrandt(k)).unwrap();
        for (format, flag, line) in
            [(Format::Opencv, "fisheye_model: 1\n", 14), (Format::OpencvXml, "<fisheye_model>1</fisheye_model>\n", 15)]
        {
            let text = write(&fisheye, format, "x").unwrap();
            let read = |text: &str, lens| {
                CalibrationFile::parse_with(text, "cam.yml", false, &Unsaid { size: None, lens }).expect("read")
            };
            assert_eq!(read(&text, None).assumed, None, "the flag says it");
            let bare = text.replace(flag, "");
            let assumed = read(&bare, None).assumed.expect("said aloud");
            let place = format!("cam.yml:{line}: distortion_coefficients.data");
            assert!(assumed.starts_with(&place) && assumed.contains("fisheye_model"), "{assumed}");
            let said = read(&bare, Some(LensKind::KannalaBrandt));
            assert_eq!((said.camera, said.assumed), (fisheye.clone(), None));
            assert_eq!(read(&bare, Some(LensKind::RadialTangential)).assumed, None);
        }
    }

    #[test]
    fn what_is_missing_or_wrong_is_named_with_its_line() {
        let size = "# size_px 640 480\n";
        for (text, expected) in [
            ("517.3 516.5 318.6 255.3".to_string(), "size_px is missing: TUM's numbers"),
            (format!("{size}517.3 516.5 318.6"), "camera:2: must be fx fy cx cy"),
            (format!("{size}-517.3 516.5 318.6 255.3"), "camera:2: fx = -517.3 px: must be greater than 0"),
            ("# size_px 640 x\n517.3 516.5 318.6 255.3".into(), "camera:1: size_px[1] = x px"),
            ("<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_width>640\n</opencv_storage>".into(), "camera:4: "),
            ("<a><image_width>640</image_width></a>".into(), "image_height is missing"),
        ] {
            let message = read(&text, Format::Tum).expect_err("refused").to_string();
            assert!(message.contains(expected), "{text}: {message}");
        }
        let unsaid = Unsaid { size: Some((640, 480)), lens: None };
        let given = CalibrationFile::parse_with("517.3 516.5 318.6 255.3", "camera", false, &unsaid);
        assert_eq!(given.expect("valid").camera.lens, LensModel::PINHOLE);
    }

    #[test]
    fn names_of_old_opencv_samples_are_known() {
        let text = "<opencv_storage><image_Width>640</image_Width>\n<image_Height>480</image_Height><Camera_Matrix><data>\n\
                    500. 0. 320. 0. 501. 240. 0. 0. 1.</data></Camera_Matrix>\n<Distortion_Coefficients><data>\n\
                    -1.e-01 0. 0. 0. 0.</data></Distortion_Coefficients></opencv_storage>";
        let camera = read(text, Format::OpencvXml).expect("valid");
        assert_eq!((camera.fy, camera.lens.coefficients()[0]), (501.0, -0.1));
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 400, rng_seed: RngSeed::Fixed(11), failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn every_format_brings_the_very_same_numbers_back(
            width in 16u32..4_000, height in 16u32..4_000, f in 0.2f64..10.0, c in 0.0f64..1.0, k in prop::array::uniform5(-2.0f64..2.0),
        ) {
            let side = f64::from(width.max(height));
            for format in ALL {
                let mut k = k;
                if matches!(format, Format::Kalibr | Format::Euroc) {
                    k[4] = 0.0;
                }
                for lens in [LensModel::RadialTangential(k), LensModel::KannalaBrandt([k[0], k[1], k[2], k[3]])] {
                    let camera = CameraModel::new(width, height, f * side, f * side * 1.01, c * f64::from(width), c * f64::from(height), lens).unwrap();
                    if format == Format::Tum && lens.is_wide_angle() {
                        prop_assert!(write(&camera, format, "x").is_err());
                        continue;
                    }
                    let text = write(&camera, format, "x").unwrap();
                    prop_assert_eq!(&read(&text, format).unwrap(), &camera, "{:?}:\n{}", format, text);
                }
            }
        }

        #[test]
        fn damaged_files_are_read_or_refused_with_their_name(
            which in 0usize..7, wide in any::<bool>(), at in 0usize..700, cut in 0usize..40, put in "[\\[\\]:,.# \n\t'\"!|>e0-9é<>/&-]{0,12}",
        ) {
            let lens = match wide && ALL[which] != Format::Tum {
                false => LensModel::RadialTangential([0.26, -0.95, -0.005, 0.003, 0.0]),
                true => LensModel::KannalaBrandt([0.03, -0.015, 0.004, -0.001]),
            };
            let camera = CameraModel::new(640, 480, 517.3, 516.5, 318.6, 255.3, lens).unwrap();
            let text = write(&camera, ALL[which], "x").unwrap();
            let chars: Vec<char> = text.chars().collect();
            let at = at.min(chars.len());
            let after = (at + cut).min(chars.len());
            let damaged: String = chars[..at].iter().copied().chain(put.chars()).chain(chars[after..].iter().copied()).collect();
            match read(&damaged, ALL[which]) {
                Ok(camera) => prop_assert!(camera.fx > 0.0 && camera.lens.coefficients().iter().all(|k| k.is_finite())),
                Err(error) => prop_assert!(error.to_string().starts_with("camera"), "{error}"),
            }
        }
    }
}
