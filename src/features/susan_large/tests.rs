use super::counting::INSIDE;
use super::*;

fn picture(width: usize, height: usize, grey: impl Fn(i32, i32) -> u8) -> GreyImage {
    let mut image = GreyImage::new(width, height);
    for y in 0..height {
        for x in 0..width {
            image.data[y * width + x] = grey(x as i32, y as i32);
        }
    }
    image
}

/// An office-like scene of strong contrast: boxes, a triangle, a thin frame; noise of +-3 grey levels.
fn scene(width: i32, height: i32, seed: u32) -> GreyImage {
    picture(width as usize, height as usize, |x, y| {
        let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
        let mut grey: i32 = 40;
        if (0.15..0.45).contains(&u) && (0.2..0.7).contains(&v) {
            grey = 190;
        }
        if (0.22..0.33).contains(&u) && (0.3..0.5).contains(&v) {
            grey = 70;
        }
        if v > 0.35 && v < 0.8 && u > 0.6 && u - 0.6 < (0.8 - v) * 0.6 {
            grey = 230;
        }
        if (u - 0.8).abs() < 0.01 && v < 0.3 {
            grey = 160;
        }
        let h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca6b) ^ seed;
        let h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        (grey + ((h >> 24) % 7) as i32 - 3) as u8
    })
}

fn find(config: LargeSusanConfig, t: u8, image: &GreyImage) -> (Vec<Corner>, LargeSusanCounts) {
    let mut detector = LargeSusanDetector::new(config).expect("valid");
    let mut out = Vec::new();
    detector.detect_all(image, t, &mut out);
    (out, detector.counts())
}

#[test]
fn the_mask_has_1257_pixels() {
    assert_eq!(HALF_WIDTHS.iter().map(|&h| 2 * h as u32 + 1).sum::<u32>(), LARGE_AREA);
    assert_eq!(INSIDE.iter().flatten().map(|&i| u32::from(i)).sum::<u32>(), LARGE_AREA);
    assert_eq!((HALF_WIDTHS[0], HALF_WIDTHS[20], HALF_WIDTHS[40]), (0, 20, 0));
}

#[test]
fn perfect_corners_and_edges_have_the_digital_salient_degrees() {
    let of = |grey: &dyn Fn(i32, i32) -> u8, response| {
        let image = picture(60, 60, |x, y| grey(x - 30, y - 30));
        let config = LargeSusanConfig { geometric_threshold: 0.99, response, ..LargeSusanConfig::default() };
        let similarity = Similarity::new(response, 40);
        let area = measure(&image, (30, 30), &Bound::new(&config, 40, &similarity), &similarity);
        f64::from(area) / f64::from(AREA_SCALE) / f64::from(LARGE_AREA)
    };
    for response in [SusanResponse::Step, SusanResponse::Exponential] {
        let close = |sd: f64, expected: f64| assert!((sd - expected).abs() < 5e-4, "{sd} should be {expected}");
        close(of(&|x, y| if x >= 0 && y >= 0 { 200 } else { 20 }, response), 0.2665);
        close(of(&|x, y| if y >= x.abs() { 200 } else { 20 }, response), 0.2617);
        close(of(&|x, _| if x >= 0 { 200 } else { 20 }, response), 0.5163);
        close(of(&|x, y| if x >= y { 200 } else { 20 }, response), 0.5115);
    }
}

#[test]
fn two_passes_find_the_corners_of_the_single_pass_with_a_fifth_of_the_work() {
    for (width, height, seed) in [(280, 200, 1), (280, 200, 2), (320, 240, 3)] {
        let image = scene(width, height, seed);
        for response in [SusanResponse::Step, SusanResponse::Exponential] {
            let run = |scheme| find(LargeSusanConfig { response, scheme, ..LargeSusanConfig::default() }, 40, &image);
            let (single, all) = run(LargeSusanScheme::SinglePass);
            assert!(single.len() >= 10, "seed {seed}: the scene has corners, {single:?}");
            let (double, some) = run(LargeSusanScheme::SmallMask);
            assert_eq!(single, double, "{width}x{height} seed {seed} {response:?}");
            assert!(5 * some.measured <= all.measured, "measured {some:?} of {all:?}");
        }
    }
}

/// Soft hills, steps and noise: what the small mask does not see everywhere.
fn hills(width: usize, height: usize, seed: u64) -> GreyImage {
    let phase = (seed % 1000) as f32 * 0.01;
    picture(width, height, |x, y| {
        let (fx, fy) = (x as f32, y as f32);
        let hill = 60.0 * (0.09 * fx + phase).sin() * (0.11 * fy - phase).cos();
        let step = if (x / 23 + y / 19) % 3 == 0 { 50.0 } else { 0.0 };
        let noise = (x * 7919 + y * 104_729 + (seed % 97) as i32) * 31 % 11;
        (110.0 + hill + step + noise as f32) as u8
    })
}

#[test]
fn the_small_mask_may_miss_corners_but_adds_none() {
    for seed in 0..4 {
        let image = hills(150, 120, seed * 77);
        let run = |scheme| find(LargeSusanConfig { scheme, ..LargeSusanConfig::default() }, 30, &image).0;
        let (single, double) = (run(LargeSusanScheme::SinglePass), run(LargeSusanScheme::SmallMask));
        assert!(!double.is_empty() && double.iter().all(|c| single.contains(c)), "seed {seed}");
    }
}

#[test]
fn a_square_has_four_corners() {
    let image = picture(120, 110, |x, y| if (35..80).contains(&x) && (30..75).contains(&y) { 220 } else { 20 });
    for (response, t) in [(SusanResponse::Step, 90), (SusanResponse::Step, 20), (SusanResponse::Exponential, 90)] {
        let (corners, _) = find(LargeSusanConfig { response, ..LargeSusanConfig::default() }, t, &image);
        let at: Vec<_> = corners.iter().map(|c| (c.x, c.y)).collect();
        assert_eq!(at, [(35.0, 30.0), (79.0, 30.0), (35.0, 74.0), (79.0, 74.0)]);
        assert!(corners.iter().all(|c| (c.response - (1.0 - 0.2665)).abs() < 1e-3), "{corners:?}");
    }
}

#[test]
fn cells_choose_without_changing_corners() {
    let image = scene(280, 200, 5);
    let mut detector = LargeSusanDetector::new(LargeSusanConfig::default()).expect("valid");
    let (all, _) = find(LargeSusanConfig::default(), 40, &image);
    let mut cells = CellGrid::new(280, 200, 32, 40.0);
    cells.cells.iter_mut().enumerate().for_each(|(i, c)| c.wanted = i % 3 != 0);
    let mut some = Vec::new();
    detector.detect(&image, &cells, &mut some);
    let wanted = |c: &&Corner| cells.index(c.x, c.y).is_some_and(|i| cells.cells[i].wanted);
    assert_eq!(some, all.iter().filter(wanted).copied().collect::<Vec<_>>());
    assert!(some.len() < all.len());
}

#[test]
fn values_out_of_range_are_named_and_small_pictures_empty() {
    let base = LargeSusanConfig::default();
    let message = |config| LargeSusanDetector::new(config).expect_err("must be refused").to_string();
    assert!(message(LargeSusanConfig { geometric_threshold: 0.0, ..base }).contains("geometric_threshold is 0"));
    assert!(message(LargeSusanConfig { small_mask_below: f32::NAN, ..base }).contains("small_mask_below is NaN"));
    assert!(message(LargeSusanConfig { suppression_px: 17, ..base }).contains("suppression_px is 17 px"));
    for (w, h) in [(0, 0), (40, 90), (90, 40), (41, 41)] {
        assert_eq!(find(base, 20, &picture(w, h, |_, _| 9)).0, []);
    }
}
