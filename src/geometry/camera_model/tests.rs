//! Both lens models: there and back, folds, Jacobians, bad numbers, and points worked out elsewhere.

use super::*;

/// Lenses of real cameras: none, a strong pincushion with k3 = 1.16, a barrel, one that folds inside 60 degrees.
fn cameras() -> Vec<CameraModel> {
    [
        (525.0, 525.0, 319.5, 239.5, [0.0; 5]),
        (517.306408, 516.469215, 318.643040, 255.313989, [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]),
        (458.654, 457.296, 367.215, 248.375, [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0]),
        (420.0, 421.0, 330.0, 236.0, [-0.35, 0.02, 0.001, -0.002, 0.0]),
    ]
    .into_iter()
    .map(|(fx, fy, cx, cy, d)| CameraModel::new(640, 480, fx, fy, cx, cy, d).expect("valid numbers"))
    .collect()
}

/// Fisheyes: ideal equidistant, a circular one whose picture's corners lie beyond 90 degrees, a webcam of 150 degrees across
/// the diagonal, one whose polynomial folds at 66 degrees, outside of the picture.
fn wide_cameras() -> Vec<CameraModel> {
    [
        (640, 480, 300.0, 300.0, 319.5, 239.5, [0.0; 4]),
        (512, 512, 190.978, 190.973, 254.932, 256.897, [0.0034823894, 0.0007150348, -0.0020532361, 0.00020293673]),
        (640, 480, 300.5, 301.25, 323.25, 235.5, [0.03, -0.015, 0.004, -0.001]),
        (640, 480, 520.0, 520.0, 320.0, 240.0, [-0.25, 0.0, 0.0, 0.0]),
    ]
    .into_iter()
    .map(|(w, h, fx, fy, cx, cy, k)| {
        CameraModel::new(w, h, fx, fy, cx, cy, LensModel::KannalaBrandt(k)).expect("valid numbers")
    })
    .collect()
}

#[test]
fn kannala_brandt_puts_points_where_opencvs_fisheye_module_does() {
    // cv2.fisheye.projectPoints of OpenCV 5.0.0.
    let points = [(0.3, -0.2), (-1.7, 0.9), (0.0, 0.001), (2.5, -2.0)];
    let expected = [
        [
            (309.943302484331, 220.223758512009),
            (70.338224310818, 354.620557971325),
            (254.932, 257.087972937007),
            (444.085610866573, 105.578073095238),
        ],
        [
            (410.065293467001, 177.478686285227),
            (27.839768064535, 392.283985775674),
            (323.25, 235.801249908621),
            (626.572010630511, -7.763243134619),
        ],
    ];
    for (camera, expected) in wide_cameras()[1..3].iter().zip(expected) {
        for ((x, y), (u, v)) in points.into_iter().zip(expected) {
            let pixel = camera.project(&Vector3::new(x, y, 1.0)).expect("in front");
            assert!((pixel - Vector2::new(u, v)).norm() < 1e-9, "({x}, {y}) -> {pixel}, not ({u}, {v})");
        }
    }
}

#[test]
fn a_fisheye_is_undone_wherever_it_sees_less_than_85_degrees_off_its_axis() {
    for camera in wide_cameras() {
        let limit = (crate::geometry::lens_model::MAX_ANGLE_DEG * 1.0000001).to_radians().tan();
        let (mut defined, mut all) = (0, 0);
        for v in (0..camera.height).step_by(7) {
            for u in (0..camera.width).step_by(7) {
                let pixel = Vector2::new(f64::from(u), f64::from(v));
                all += 1;
                let Some(n) = camera.undistort(&pixel) else { continue };
                defined += 1;
                assert!(n.norm() < limit, "{pixel} -> {n}");
                let back = camera.distort(&n).expect("inside the valid radius");
                assert!((back - pixel).norm() < 1e-8, "{camera:?} {pixel} -> {n} -> {back}");
            }
        }
        assert!(camera.covers_picture(), "{camera:?}");
        // Beyond 90 degrees are the corners of the second picture alone: its circle of 85 degrees is 282 px wide to each side.
        assert_eq!(defined == all, camera.width != 512, "{defined} of {all}");
        assert!(defined > all * 17 / 20, "{defined} of {all}");
    }
}

#[test]
fn a_fisheye_that_folds_inside_the_picture_does_not_cover_it() {
    let camera =
        CameraModel::new(640, 480, 300.0, 300.0, 320.0, 240.0, LensModel::KannalaBrandt([-0.25, 0.0, 0.0, 0.0]))
            .expect("valid");
    // 1 + 3 k1 t² = 0
    let fold = (4.0f64 / 3.0).sqrt();
    assert!((camera.valid_radius() - fold.tan()).abs() < 1e-6, "{}", camera.valid_radius());
    assert!(!camera.covers_picture());
    assert!(camera.project(&Vector3::new(1.01 * fold.tan(), 0.0, 1.0)).is_none());
    assert!(camera.undistort(&Vector2::new(639.0, 240.0)).is_none(), "nothing lands farther out than the fold");
}

#[test]
fn jacobians_of_a_fisheye_equal_numeric_differences_from_the_axis_to_its_rim() {
    let h = 1e-6;
    for camera in wide_cameras() {
        for radius in [0.0, 1e-9, 3e-5, 2e-4, 0.01, 0.4, 1.0, 2.0] {
            let n = Vector2::new(0.8, -0.6) * radius;
            let (_, j) = camera.distort_jacobian(&n).expect("inside");
            for k in 0..2 {
                let mut step = Vector2::zeros();
                step[k] = h;
                let (plus, minus) = (camera.distort(&(n + step)), camera.distort(&(n - step)));
                let numeric = (plus.expect("inside") - minus.expect("inside")) / (2.0 * h);
                assert!((numeric - j.column(k)).norm() < 1e-5, "{radius}, {k}: {numeric} and {j}");
            }
            assert!((camera.pixel_scale(&n) - j).norm() < 1e-12);
            let pixel = camera.distort(&n).expect("inside");
            let (_, back) = camera.undistort_jacobian(&pixel).expect("inside");
            assert!((back * j - Matrix2::identity()).norm() < 1e-6, "{radius}: {back} {j}");
        }
    }
}

#[test]
fn a_pinholes_pixel_scale_is_its_focal_lengths_everywhere() {
    for camera in cameras() {
        let n = Vector2::new(0.7, -0.5);
        assert_eq!(camera.pixel_scale(&n), Matrix2::new(camera.fx, 0.0, 0.0, camera.fy));
        assert!(camera.is_central(&(n * 3.0)));
    }
    let wide = &wide_cameras()[0];
    assert!(wide.is_central(&Vector2::new(49f64.to_radians().tan(), 0.0)));
    assert!(!wide.is_central(&Vector2::new(0.0, 51f64.to_radians().tan())));
}

#[test]
fn undistort_inverts_distort_over_the_whole_picture() {
    for camera in cameras() {
        let mut defined = 0;
        for v in (0..480).step_by(9) {
            for u in (0..640).step_by(9) {
                let pixel = Vector2::new(f64::from(u), f64::from(v));
                if let Some(n) = camera.undistort(&pixel) {
                    let back = camera.distort(&n).expect("inside the valid radius");
                    assert!((back - pixel).norm() < 1e-8, "{camera:?} {pixel} -> {n} -> {back}");
                    defined += 1;
                }
            }
        }
        assert_eq!(camera.covers_picture(), defined == 54 * 72, "{camera:?}: {defined} pixels");
        // The last lens folds inside this picture: its corners have no preimage.
        assert!(defined > 54 * 72 * 7 / 10, "{camera:?}: {defined}");
    }
}

#[test]
fn distort_inverts_undistort_up_to_the_valid_radius() {
    for camera in cameras() {
        let radius = camera.valid_radius().min(2.0);
        for i in 0..400 {
            let angle = f64::from(i) * 0.37;
            let n = Vector2::new(angle.cos(), angle.sin()) * (radius * 0.999 * f64::from(i) / 400.0);
            let pixel = camera.distort(&n).expect("inside the valid radius");
            let back = camera.undistort(&pixel).expect("a pixel of a valid point");
            assert!((back - n).norm() < 1e-7, "{:?} {n} -> {back}", camera.lens);
        }
    }
}

#[test]
fn points_beyond_the_fold_do_not_project() {
    let camera = CameraModel::new(640, 480, 420.0, 420.0, 320.0, 240.0, [-0.35, 0.02, 0.0, 0.0, 0.0]).expect("ok");
    // f'(r) = 1 - 1.05 s + 0.1 s² = 0
    let fold = ((1.05 - (1.05f64 * 1.05 - 0.4).sqrt()) / 0.2).sqrt();
    assert!((camera.valid_radius() - fold).abs() < 1e-8, "{} and {fold}", camera.valid_radius());
    assert!(camera.project(&Vector3::new(fold * 0.999, 0.0, 1.0)).is_some());
    assert!(camera.project(&Vector3::new(fold * 1.001, 0.0, 1.0)).is_none());
    // No point at all lands farther out than the fold's image.
    let rim = camera.distort(&Vector2::new(fold * 0.999999, 0.0)).expect("inside");
    assert!(camera.undistort(&Vector2::new(rim.x + 1.0, 240.0)).is_none());
}

#[test]
fn behind_the_camera_and_nan_do_not_project() {
    for camera in cameras().into_iter().chain(wide_cameras()) {
        assert!(camera.project(&Vector3::new(0.1, 0.1, 0.0)).is_none());
        assert!(camera.project(&Vector3::new(0.1, 0.1, -1.0)).is_none());
        assert!(camera.project(&Vector3::new(f64::NAN, 0.1, 1.0)).is_none());
        assert!(camera.project(&Vector3::new(0.1, 0.1, f64::NAN)).is_none());
        assert!(camera.undistort(&Vector2::new(f64::NAN, 0.0)).is_none());
        assert!(camera.undistort(&Vector2::new(f64::INFINITY, 0.0)).is_none());
        assert!(!camera.contains(&Vector2::new(f64::NAN, 5.0), 0.0));
    }
}

#[test]
fn jacobians_equal_numeric_differences() {
    let h = 1e-6;
    for camera in cameras().into_iter().chain(wide_cameras()) {
        for point in [Vector3::new(0.3, -0.2, 1.5), Vector3::new(-0.9, 0.5, 2.0), Vector3::new(0.05, 0.6, 1.1)].iter() {
            let (pixel, j) = camera.project_jacobian(point).expect("visible");
            assert_eq!(pixel, camera.project(point).expect("visible"));
            for k in 0..3 {
                let mut step = Vector3::zeros();
                step[k] = h;
                let plus = camera.project(&(point + step)).expect("visible");
                let minus = camera.project(&(point - step)).expect("visible");
                let numeric = (plus - minus) / (2.0 * h);
                // 500 px times the third derivative times h², and rounding 1e-13 * 500 / h.
                assert!((numeric - j.column(k)).norm() < 1e-5, "{k}: {numeric} and {j}");
            }
        }
    }
}

#[test]
fn bad_numbers_are_named() {
    let make = |w, fx, cy, k3| CameraModel::new(w, 480, fx, 500.0, 320.0, cy, [0.0, 0.0, 0.0, 0.0, k3]);
    assert_eq!(make(0, 500.0, 240.0, 0.0), Err(CameraModelError::EmptyPicture { width: 0, height: 480 }));
    assert!(matches!(make(640, -3.0, 240.0, 0.0), Err(CameraModelError::NotPositive { key: "fx", .. })));
    assert!(matches!(make(640, 500.0, f64::NAN, 0.0), Err(CameraModelError::NotFinite { key: "cy", .. })));
    let error = make(640, 500.0, 240.0, f64::INFINITY).expect_err("infinite k3");
    assert!(error.to_string().contains("k3 = inf"), "{error}");
    let fisheye = LensModel::KannalaBrandt([0.0, 0.0, 0.0, f64::NAN]);
    let error = CameraModel::new(640, 480, 300.0, 300.0, 320.0, 240.0, fisheye).expect_err("NaN k4");
    assert!(error.to_string().contains("k4 = NaN"), "{error}");
}

#[test]
fn scaling_moves_pixels_as_resampling_does() {
    for camera in cameras().into_iter().chain(wide_cameras()) {
        let half = camera.scaled(camera.width / 2, camera.height / 2).expect("same aspect");
        let n = Vector2::new(0.21, -0.13);
        let (full, small) = (camera.distort(&n).expect("inside"), half.distort(&n).expect("inside"));
        assert!(((full.x + 0.5) * 0.5 - 0.5 - small.x).abs() < 1e-9);
        assert!(((full.y + 0.5) * 0.5 - 0.5 - small.y).abs() < 1e-9);
        assert!(matches!(camera.scaled(640, 360), Err(CameraModelError::OtherAspect { .. })));
        assert!(camera.scaled(0, 0).is_err());
    }
}
