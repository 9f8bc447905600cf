use super::kernels::{count_row_body, smooth_row_body, smooth_strengths_body};
use super::usan::MASK_HALF_WIDTHS;
use super::*;
use proptest::prelude::*;

/// A picture by a rule.
fn picture(width: usize, height: usize, grey: impl Fn(i32, i32) -> u8) -> GreyImage {
    let mut image = GreyImage::new(width, height);
    for y in 0..height {
        for x in 0..width {
            image.data[y * width + x] = grey(x as i32, y as i32);
        }
    }
    image
}

/// Blocks of random grey with a little noise.
fn blocky(width: usize, height: usize, seed: u64) -> GreyImage {
    let mut image = GreyImage::new(width, height);
    let mut state = seed.wrapping_mul(2).wrapping_add(1);
    let mut next = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize
    };
    for _ in 0..40 {
        let (x, y, grey) = (next() % width, next() % height, next() % 256);
        let (w, h) = (3 + next() % 14, 3 + next() % 14);
        for yy in y..(y + h).min(height) {
            image.data[yy * width + x..yy * width + (x + w).min(width)].fill(grey as u8);
        }
    }
    for p in &mut image.data {
        *p = p.saturating_add((next() % 6) as u8);
    }
    image
}

/// The mask's offsets by the paper's radius, 3.4 pixels.
fn mask() -> Vec<(i32, i32)> {
    let all = (-3..=3).flat_map(|y| (-3..=3).map(move |x| (x, y)));
    all.filter(|&(x, y)| f64::from(x * x + y * y) <= 3.4 * 3.4).collect()
}

/// (area, sum of c x, sum of c y, sum of (1 - c) difference) by the definition, with similarities rounded as the table's.
fn plain_sums(image: &GreyImage, x: usize, y: usize, t: u8, response: SusanResponse) -> [f64; 4] {
    let nucleus = f64::from(image.at(x, y));
    let mut sums = [0.0; 4];
    for (dx, dy) in mask() {
        let p = f64::from(image.at((x as i32 + dx) as usize, (y as i32 + dy) as usize));
        let relative = (p - nucleus).abs() / f64::from(t);
        let c = match response {
            SusanResponse::Step => f64::from(u8::from(relative < 1.0)),
            SusanResponse::Exponential => ((-relative.powi(6)).exp() * 1024.0).round() / 1024.0,
        };
        let add = [c, c * f64::from(dx), c * f64::from(dy), (1.0 - c) * (p - nucleus).abs()];
        sums.iter_mut().zip(add).for_each(|(s, a)| *s += a);
    }
    sums
}

/// The whole detector by the definition, one cell threshold a pixel: corners for certain, and those with them that
/// are as strong as a neighbour up to the rounding of `f32`. Averaged moments alone may differ by rounding: areas are whole numbers.
fn plain_corners(image: &GreyImage, config: &SusanConfig, cells: &CellGrid) -> [Vec<(usize, usize)>; 2] {
    let (w, h, r) = (image.width, image.height, config.suppression_px);
    let image = if config.smooth {
        let clamp = |v: i32, n: usize| v.clamp(0, n as i32 - 1) as usize;
        picture(w, h, |x, y| {
            if x == 0 || x == w as i32 - 1 {
                return image.at(x as usize, y as usize);
            }
            let weight = |d: i32| 2 - d.abs();
            let sum: i32 = (-1..=1)
                .flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)))
                .map(|(dx, dy)| weight(dx) * weight(dy) * i32::from(image.at(clamp(x + dx, w), clamp(y + dy, h))))
                .sum();
            ((sum + 8) / 16) as u8
        })
    } else {
        image.clone()
    };
    let mut raw = vec![0.0f64; w * h];
    for y in 3..h.saturating_sub(3) {
        for x in 3..w.saturating_sub(3) {
            let Some(i) = cells.index(x as f32, y as f32) else { continue };
            if cells.cells[i].threshold.is_nan() {
                continue;
            }
            let [area, sx, sy, contrast] = plain_sums(&image, x, y, cells.cells[i].threshold as u8, config.response);
            let sd = area / 37.0;
            if sd < f64::from(config.geometric_threshold) {
                raw[y * w + x] = match config.strength {
                    SusanStrength::SalientDegree => 1.0 - sd,
                    SusanStrength::Moment => contrast * (sx * sx + sy * sy).sqrt() / area,
                };
            }
        }
    }
    let at = |map: &[f64], x: i32, y: i32| {
        if x < 0 || y < 0 || x >= w as i32 || y >= h as i32 { 0.0 } else { map[y as usize * w + x as usize] }
    };
    let mut strength = raw.clone();
    if config.strength == SusanStrength::Moment {
        for (i, s) in strength.iter_mut().enumerate().filter(|(_, s)| **s > 0.0) {
            let (x, y) = ((i % w) as i32, (i / w) as i32);
            let near = (-1..=1i32).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)));
            *s = near
                .map(|(dx, dy): (i32, i32)| {
                    f64::from((2 - dx.abs()) * (2 - dy.abs())) / 16.0 * at(&raw, x + dx, y + dy)
                })
                .sum();
        }
    }
    let (mut certain, mut possible) = (Vec::new(), Vec::new());
    for y in 0..h as i32 {
        for x in 0..w as i32 {
            let s = at(&strength, x, y);
            let r = r as i32;
            let rounding = if config.strength == SusanStrength::Moment { 1e-5 * s } else { 0.0 };
            let others: Vec<_> = (-r..=r).flat_map(|dy| (-r..=r).map(move |dx| (dx, dy))).collect();
            let wins = |margin: f64| {
                others.iter().filter(|&&d| d != (0, 0)).all(|&(dx, dy)| {
                    let ahead = s - at(&strength, x + dx, y + dy) + margin;
                    // Of equals the first in raster order.
                    ahead > 0.0 || (ahead == 0.0 && (dy, dx) > (0, 0))
                })
            };
            let wanted = cells.index(x as f32, y as f32).is_some_and(|i| cells.cells[i].wanted);
            if s > 0.0 && wanted {
                let pixel = (x as usize, y as usize);
                certain.extend(wins(-rounding).then_some(pixel));
                possible.extend(wins(rounding).then_some(pixel));
            }
        }
    }
    [certain, possible]
}

fn pixels(corners: &[Corner]) -> Vec<(usize, usize)> {
    corners.iter().map(|c| (c.x as usize, c.y as usize)).collect()
}

#[test]
fn the_mask_has_37_pixels() {
    assert_eq!(mask().len(), 37);
    assert_eq!(MASK_HALF_WIDTHS.map(|h| 2 * h + 1).iter().sum::<usize>(), MASK_AREA as usize);
}

#[test]
fn perfect_corners_and_edges_have_the_digital_salient_degrees() {
    let corner = picture(20, 20, |x, y| if x >= 10 && y >= 10 { 200 } else { 20 });
    let diagonal = picture(20, 20, |x, y| if y - 10 >= (x - 10).abs() { 200 } else { 20 });
    let edge = picture(20, 20, |x, _| if x >= 10 { 200 } else { 20 });
    let slanting = picture(20, 20, |x, y| if x >= y { 200 } else { 20 });
    for response in [SusanResponse::Step, SusanResponse::Exponential] {
        let similarity = Similarity::new(response, 40);
        let sd = |image| usan(image, 10, 10, &similarity).expect("inside").salient_degree;
        assert_eq!(sd(&corner), 13.0 / 37.0, "0.35");
        assert_eq!(sd(&diagonal), 12.0 / 37.0, "0.32");
        assert_eq!(sd(&edge), 22.0 / 37.0, "0.59");
        assert_eq!(sd(&slanting), 21.0 / 37.0);
        assert_eq!(sd(&picture(20, 20, |_, _| 9)), 1.0);
    }
}

#[test]
fn one_corner_gives_one_point() {
    // A square, seen sharp and through a lens: four corners, whatever the response.
    let sharp = picture(64, 64, |x, y| if (20..44).contains(&x) && (20..44).contains(&y) { 210 } else { 30 });
    let mut blurred = sharp.clone();
    for _ in 0..2 {
        let from = blurred.clone();
        for y in 0..64 {
            smooth_row(
                from.row(y.max(1) - 1),
                from.row(y),
                from.row((y + 1).min(63)),
                &mut blurred.data[y * 64..][..64],
            );
        }
    }
    let mut out = Vec::new();
    let presets = [SusanConfig::default(), SusanConfig { response: SusanResponse::Step, ..Default::default() }];
    let study = (SusanConfig::study(), SusanConfig::STUDY_T);
    for (config, t) in presets.map(|c| (c, SusanConfig::DEFAULT_T)).into_iter().chain([study]) {
        for (name, image) in [("sharp", &sharp), ("blurred", &blurred)] {
            if name == "blurred" && t == SusanConfig::STUDY_T {
                // A ramp of two pixels is within t = 90 everywhere: the study's figures want sharp pictures.
                continue;
            }
            SusanDetector::new(config).expect("valid").detect_all(image, t, &mut out);
            assert_eq!(out.len(), 4, "{name}, {config:?}: {out:?}");
            for (x, y) in [(20, 20), (43, 20), (20, 43), (43, 43)] {
                let near = |c: &&Corner| (c.x - x as f32).abs() <= 2.0 && (c.y - y as f32).abs() <= 2.0;
                assert_eq!(out.iter().filter(near).count(), 1, "{name} {config:?}: {out:?}");
            }
        }
    }
}

#[test]
fn false_corner_rejection_drops_specks_and_lines_and_keeps_corners() {
    let image = picture(80, 40, |x, y| match (x, y) {
        (10, 10) => 255,
        (30, 5..35) => 215 + 9 * (y % 5) as u8,
        (50..70, 10..30) => 255,
        _ => 40,
    });
    let find = |config| {
        let mut out = Vec::new();
        SusanDetector::new(config).expect("valid").detect_all(&image, 20, &mut out);
        pixels(&out)
    };
    let plain = SusanConfig { response: SusanResponse::Exponential, geometric_threshold: 0.5, ..SusanConfig::study() };
    let all = find(plain);
    assert!(all.contains(&(10, 10)) && all.iter().any(|c| c.0 == 30 && (8..32).contains(&c.1)), "{all:?}");
    let asked = find(SusanConfig { min_centroid_px: 0.8, contiguous: true, ..plain });
    assert!(!asked.contains(&(10, 10)) && !asked.iter().any(|c| c.0 == 30 && (8..32).contains(&c.1)), "{asked:?}");
    for corner in [(50, 10), (69, 10), (50, 29), (69, 29)] {
        assert!(asked.contains(&corner), "{asked:?}");
    }
}

/// Corners of slanting squares through a lens, with noise: (near one of the true corners, elsewhere along the edges).
fn right_and_false(config: SusanConfig, t: u8) -> (usize, usize) {
    let (mut right, mut wrong) = (0, 0);
    for (k, degrees) in [5.0f32, 17.0, 29.0, 41.0].into_iter().enumerate() {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let image = picture(160, 160, |x, y| {
            let (dx, dy) = (x as f32 - 80.0, y as f32 - 80.0);
            let (u, v) = (cos * dx + sin * dy, cos * dy - sin * dx);
            // Distance inside the square, blurred over a pixel and a half.
            let inside = (45.0 - u.abs()).min(45.0 - v.abs());
            let share = (0.5 + inside / 1.5).clamp(0.0, 1.0);
            let h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca6b) ^ k as u32;
            let noise = ((h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d) >> 24) as f32 / 32.0;
            (50.0 + 130.0 * share + noise) as u8
        });
        let mut out = Vec::new();
        SusanDetector::new(config).expect("valid").detect_all(&image, t, &mut out);
        for c in out {
            let true_corner = |s: f32, r: f32| {
                let (u, v) = (45.0 * s, 45.0 * r);
                let (x, y) = (80.0 + cos * u - sin * v, 80.0 + sin * u + cos * v);
                (c.x - x).hypot(c.y - y) < 4.5
            };
            let near = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)].into_iter().any(|(s, r)| true_corner(s, r));
            if near { right += 1 } else { wrong += 1 }
        }
    }
    (right, wrong)
}

#[test]
fn rejecting_edges_leaves_the_corners_and_takes_false_ones() {
    let base = SusanConfig::default();
    let asks =
        |min_centroid_px, contiguous, reject_edges| SusanConfig { min_centroid_px, contiguous, reject_edges, ..base };
    let plain = right_and_false(asks(0.0, false, false), 20);
    let paper = right_and_false(asks(1.0, true, false), 20);
    let edges = right_and_false(base, 20);
    let by_degree =
        right_and_false(SusanConfig { strength: SusanStrength::SalientDegree, ..asks(0.0, false, false) }, 20);
    let by_degree_paper =
        right_and_false(SusanConfig { strength: SusanStrength::SalientDegree, ..asks(1.0, true, false) }, 20);
    println!(
        "right, false: plain {plain:?}, paper {paper:?}, edges {edges:?}; by degree {by_degree:?}, paper {by_degree_paper:?}"
    );
    assert!(
        edges.0 >= 16 && edges.1 <= plain.1 && by_degree_paper.1 <= by_degree.1,
        "{plain:?} {paper:?} {edges:?} {by_degree:?} {by_degree_paper:?}"
    );
}

#[test]
fn values_out_of_range_are_named() {
    let message = |config: SusanConfig| SusanDetector::new(config).expect_err("must be refused").to_string();
    let base = SusanConfig::default();
    assert!(message(SusanConfig { geometric_threshold: 1.0, ..base }).contains("susan.geometric_threshold is 1"));
    assert!(message(SusanConfig { geometric_threshold: f32::NAN, ..base }).contains("NaN"));
    assert!(message(SusanConfig { suppression_px: 0, ..base }).contains("susan.suppression_px is 0 px"));
    assert!(message(SusanConfig { suppression_px: 99, ..base }).contains("99 px"));
    assert!(message(SusanConfig { min_centroid_px: -1.0, ..base }).contains("susan.min_centroid_px is -1 px"));
}

#[test]
fn small_and_even_pictures_have_no_corners() {
    let mut detector = SusanDetector::new(SusanConfig::default()).expect("valid");
    let mut out = vec![Corner { x: 0.0, y: 0.0, response: 0.0 }];
    for (w, h) in [(0, 0), (6, 40), (40, 6), (7, 7), (50, 40)] {
        detector.detect_all(&picture(w, h, |_, _| 77), 20, &mut out);
        assert!(out.is_empty(), "{w}x{h}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    #[test]
    fn the_detector_is_its_definition_in_every_cell(
        seed in any::<u64>(), width in 7usize..90, height in 7usize..50, side in 1usize..40, variant in 0usize..8,
        radius in 1usize..5, g in 0.3f32..0.8, thresholds in prop::collection::vec((any::<bool>(), 0u8..50), 1..20),
    ) {
        let image = blocky(width, height, seed);
        let mut cells = CellGrid::new(width, height, side, 0.0);
        for (i, cell) in cells.cells.iter_mut().enumerate() {
            let (wanted, t) = thresholds[i % thresholds.len()];
            *cell = Cell { wanted, threshold: if t == 0 { f32::NAN } else { f32::from(t) } };
        }
        let config = SusanConfig {
            response: [SusanResponse::Step, SusanResponse::Exponential][variant % 2],
            strength: [SusanStrength::SalientDegree, SusanStrength::Moment][variant / 2 % 2],
            smooth: variant / 4 == 1,
            geometric_threshold: g,
            suppression_px: radius,
            reject_edges: false,
            ..SusanConfig::default()
        };
        let mut out = Vec::new();
        let mut detector = SusanDetector::new(config).expect("valid");
        detector.detect(&blocky(30, 20, seed), &CellGrid::new(30, 20, 8, 20.0), &mut out);
        detector.detect(&image, &cells, &mut out);
        let (found, [certain, possible]) = (pixels(&out), plain_corners(&image, &config, &cells));
        prop_assert!(found.is_sorted_by_key(|&(x, y)| (y, x)), "raster order: {:?}", found);
        let missed: Vec<_> = certain.iter().filter(|c| !found.contains(c)).collect();
        let extra: Vec<_> = found.iter().filter(|c| !possible.contains(c)).collect();
        prop_assert!(missed.is_empty() && extra.is_empty(), "missed {:?}, too many {:?}", missed, extra);
        // Areas leave nothing open.
        prop_assert!(config.strength == SusanStrength::Moment || certain == found);
    }

    #[test]
    fn the_wide_kernels_agree_with_their_scalar_twins(
        seed in any::<u64>(), width in 7usize..120, difference in any::<u8>(), limit in 0u8..37,
    ) {
        let image = blocky(width, 7, seed);
        let rows: [&[u8]; 7] = std::array::from_fn(|i| image.row(i));
        let (mut a, mut b) = (vec![0; width], vec![0; width]);
        count_row(&rows, &vec![difference; width], &vec![limit; width], &mut a);
        count_row_body(&rows, &vec![difference; width], &vec![limit; width], &mut b);
        prop_assert_eq!(&a, &b);
        smooth_row(rows[0], rows[1], rows[2], &mut a);
        smooth_row_body(rows[0], rows[1], rows[2], &mut b);
        prop_assert_eq!(a, b);
        let floats: Vec<Vec<f32>> = rows[..3].iter().map(|r| r.iter().map(|&p| f32::from(p) * 1.7).collect()).collect();
        let (mut a, mut b) = (vec![0.0; width - 2], vec![0.0; width - 2]);
        smooth_strengths([&floats[0], &floats[1], &floats[2]], &mut a);
        smooth_strengths_body([&floats[0], &floats[1], &floats[2]], &mut b);
        prop_assert_eq!(a, b);
    }

    #[test]
    fn usan_sums_are_the_definition(seed in any::<u64>(), t in 1u8..=255, exponential in any::<bool>()) {
        let image = blocky(16, 16, seed);
        let response = if exponential { SusanResponse::Exponential } else { SusanResponse::Step };
        let u = usan(&image, 8, 7, &Similarity::new(response, t)).expect("inside");
        let [area, sx, sy, contrast] = plain_sums(&image, 8, 7, t, response);
        prop_assert!((f64::from(u.salient_degree) - area / 37.0).abs() < 1e-5);
        prop_assert!((f64::from(u.centroid[0]) - sx / area).abs() < 1e-4);
        prop_assert!((f64::from(u.centroid[1]) - sy / area).abs() < 1e-4);
        prop_assert!((f64::from(u.contrast) - contrast).abs() < 1e-2);
    }
}
