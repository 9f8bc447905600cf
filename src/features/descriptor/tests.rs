use super::*;
use proptest::prelude::*;

/// Soft blobs: structure at every scale, no flat parts.
fn textured(width: usize, height: usize, seed: u64) -> GreyImage {
    let mut image = GreyImage::new(width, height);
    let phase = seed as f32 * 0.37;
    for y in 0..height {
        for x in 0..width {
            image.data[y * width + x] = texture(x as f32, y as f32, phase);
        }
    }
    image
}

fn texture(x: f32, y: f32, phase: f32) -> u8 {
    let mut v = 127.0;
    for (k, &(fx, fy, a)) in
        [(0.11, 0.05, 40.0), (-0.07, 0.16, 35.0), (0.31, 0.22, 20.0), (0.41, -0.35, 18.0)].iter().enumerate()
    {
        v += a * (fx * x + fy * y + phase * (k + 1) as f32).sin();
    }
    v.clamp(0.0, 255.0) as u8
}

#[test]
fn distance_counts_differing_bits() {
    let a = Descriptor([0, u64::MAX, 5, 1 << 63]);
    let b = Descriptor([1, 0, 5, 0]);
    assert_eq!(a.distance(&b), 1 + 64 + 1);
    assert_eq!(a.distance(&a), 0);
    assert_eq!(Descriptor([0; 4]).distance(&Descriptor([u64::MAX; 4])), BITS);
}

#[test]
fn bits_are_the_comparisons_of_gaussian_smoothed_pixels() {
    let image = textured(80, 70, 4);
    let (x, y) = (37usize, 33usize);
    let blur = |px: usize, py: usize| {
        let across = |row: usize| {
            let sum: u32 = (0..7).map(|k| u32::from(BLUR[k]) * u32::from(image.at(px + k - 3, row))).sum();
            (sum + 128) >> 8
        };
        (0..7).map(|k| u32::from(BLUR[k]) * across(py + k - 3)).sum::<u32>()
    };
    let d = describe(&image, x as f32, y as f32, Orientation::Upright).expect("inside");
    for (k, pair) in draw_pairs().iter().enumerate() {
        let at = |[px, py]: [f64; 2]| (blur((x as f64 + px) as usize, (y as f64 + py) as usize) + 128) >> 8;
        let bit = d.descriptor.0[k / 64] >> (k % 64) & 1 == 1;
        assert_eq!(bit, at(pair[0]) < at(pair[1]), "bit {k}");
    }
    assert_eq!(d.angle_rad, 0.0);
}

#[test]
fn a_patch_turned_by_the_camera_keeps_its_descriptor() {
    for step in 0..16 {
        let angle = step as f32 * std::f32::consts::TAU / 16.0 + 0.05;
        let (sin, cos) = angle.sin_cos();
        let mut turned = GreyImage::new(64, 64);
        for y in 0..64 {
            for x in 0..64 {
                let (dx, dy) = (x as f32 - 32.0, y as f32 - 32.0);
                turned.data[y * 64 + x] = texture(cos * dx + sin * dy, cos * dy - sin * dx, 1.0);
            }
        }
        let mut plain = GreyImage::new(64, 64);
        for y in 0..64 {
            for x in 0..64 {
                plain.data[y * 64 + x] = texture(x as f32 - 32.0, y as f32 - 32.0, 1.0);
            }
        }
        let of = |image| describe(image, 32.0, 32.0, Orientation::IntensityCentroid).expect("inside");
        let (a, b) = (of(&plain), of(&turned));
        assert!(
            a.descriptor.distance(&b.descriptor) < 40,
            "turned by {angle} rad: {}",
            a.descriptor.distance(&b.descriptor)
        );
        let off = (b.angle_rad - a.angle_rad - angle).rem_euclid(std::f32::consts::TAU);
        assert!(off.min(std::f32::consts::TAU - off) < 0.25, "turned by {angle} rad: angle is off by {off}");
    }
}

#[test]
fn positions_near_the_edge_or_not_numbers_have_no_descriptor() {
    let image = textured(60, 50, 1);
    let some = |x: f32, y: f32| describe(&image, x, y, Orientation::default()).is_some();
    assert!(some(19.0, 19.0) && some(40.0, 30.0) && some(40.4, 30.4));
    assert!(!some(18.4, 25.0) && !some(25.0, 18.0) && !some(41.0, 25.0) && !some(25.0, 31.0));
    assert!(!some(f32::NAN, 25.0) && !some(25.0, f32::INFINITY) && !some(-5.0, 25.0) && !some(1e30, 25.0));
    assert!(describe(&GreyImage::new(0, 0), 0.0, 0.0, Orientation::Upright).is_none());
}

#[test]
fn a_level_is_described_at_its_own_pixels() {
    let mut pyramid = Pyramid::new(2);
    pyramid.levels = vec![textured(200, 160, 2), textured(100, 80, 3)];
    let at = describe_at_level(&pyramid, 1, 100.5, 80.5, Orientation::default());
    assert_eq!(at, describe(&pyramid.levels[1], 50.0, 40.0, Orientation::default()));
    assert!(at.is_some());
    assert!(describe_at_level(&pyramid, 2, 100.0, 80.0, Orientation::default()).is_none());
    assert!(describe_at_level(&pyramid, 99, 100.0, 80.0, Orientation::default()).is_none());
}

#[test]
fn every_turned_point_stays_in_the_disc_and_pairs_differ() {
    for pairs in &TABLES.pairs {
        for &[a, b] in pairs {
            assert!(a != b);
            for i in [a, b].map(usize::from) {
                assert!(i / PATCH < PATCH_ROWS && i % PATCH < PATCH_ROWS);
            }
        }
    }
}

proptest! {
    #[test]
    fn the_wide_kernel_agrees_with_its_scalar_twin(data in prop::collection::vec(any::<u8>(), 64 * 48), x in 19usize..45, y in 19usize..29) {
        let image = GreyImage { width: 64, height: 48, data };
        for direction in [None, Some(0), Some(13)] {
            let (mut a, mut b) = ([0; 4], [0; 4]);
            let da = describe_patch(&image, x, y, direction, &TABLES, &mut a);
            let db = describe_patch_body(&image, x, y, direction, &TABLES, &mut b);
            prop_assert_eq!((a, da), (b, db));
        }
    }
}
