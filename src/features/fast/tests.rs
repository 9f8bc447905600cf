use super::*;
use proptest::prelude::*;

/// The definition: nine neighbouring ring pixels all brighter, or all darker, by more than t. `None`: at no t.
fn plain_response(image: &GreyImage, x: usize, y: usize) -> Option<u8> {
    const OFFSETS: [(i32, i32); 16] = [
        (0, -3),
        (1, -3),
        (2, -2),
        (3, -1),
        (3, 0),
        (3, 1),
        (2, 2),
        (1, 3),
        (0, 3),
        (-1, 3),
        (-2, 2),
        (-3, 1),
        (-3, 0),
        (-3, -1),
        (-2, -2),
        (-1, -3),
    ];
    let centre = i32::from(image.at(x, y));
    let difference = |k: usize| {
        let (dx, dy) = OFFSETS[k % 16];
        i32::from(image.at((x as i32 + dx) as usize, (y as i32 + dy) as usize)) - centre
    };
    (0..=254u8).rev().find(|&t| {
        let t = i32::from(t);
        (0..16).any(|k| (k..k + 9).all(|i| difference(i) > t) || (k..k + 9).all(|i| difference(i) < -t))
    })
}

/// Everything by the definition, cell thresholds and suppression included.
fn plain_corners(image: &GreyImage, cells: &CellGrid) -> Vec<Corner> {
    let (w, h) = (image.width, image.height);
    let mut score = vec![-1i32; w * h];
    for y in 3..h.saturating_sub(3) {
        for x in 3..w.saturating_sub(3) {
            score[y * w + x] = plain_response(image, x, y).map_or(-1, i32::from);
        }
    }
    let mut out = Vec::new();
    for y in 3..h.saturating_sub(3) {
        for x in 3..w.saturating_sub(3) {
            let Some(cell) = cells.index(x as f32, y as f32).map(|i| cells.cells[i]) else { continue };
            let s = score[y * w + x];
            let beats = |dx: i32, dy: i32| {
                let other = score[(y as i32 + dy) as usize * w + (x as i32 + dx) as usize];
                if (dy, dx) < (0, 0) { s > other } else { s >= other }
            };
            let all = (-1..=1).all(|dy| (-1..=1).all(|dx| (dx, dy) == (0, 0) || beats(dx, dy)));
            if cell.wanted && s >= 0 && s as f32 >= cell.threshold && all {
                out.push(Corner { x: x as f32, y: y as f32, response: s as f32 });
            }
        }
    }
    out
}

/// Blocks of random grey: corners of every contrast, ties included.
fn blocky(width: usize, height: usize, seed: u64) -> GreyImage {
    let mut image = GreyImage::new(width, height);
    let mut state = seed.wrapping_mul(2).wrapping_add(1);
    let mut next = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize
    };
    for _ in 0..60 {
        let (x, y, grey) = (next() % width, next() % height, next() % 256);
        let (w, h) = (1 + next() % 14, 1 + next() % 14);
        for yy in y..(y + h).min(height) {
            image.data[yy * width + x..yy * width + (x + w).min(width)].fill(grey as u8);
        }
    }
    image
}

#[test]
fn response_is_the_largest_threshold_of_the_segment_test() {
    for seed in 0..6 {
        let image = blocky(83, 41, seed);
        let cells = CellGrid::new(83, 41, 83, 0.0);
        let mut out = Vec::new();
        FastDetector::new().detect(&image, &cells, &mut out);
        assert!(out.len() > 20, "seed {seed}: the picture has corners");
        assert_eq!(out, plain_corners(&image, &cells), "seed {seed}");
    }
}

#[test]
fn a_detector_used_again_gives_the_same_as_a_new_one() {
    let mut detector = FastDetector::new();
    let mut out = Vec::new();
    for (seed, width, height) in [(1, 90, 50), (2, 40, 60), (3, 120, 33), (1, 90, 50)] {
        let image = blocky(width, height, seed);
        detector.detect_all(&image, 12, &mut out);
        let mut fresh = Vec::new();
        FastDetector::new().detect_all(&image, 12, &mut fresh);
        assert_eq!(out, fresh, "{width}x{height}, seed {seed}");
    }
}

#[test]
fn pictures_smaller_than_the_ring_have_no_corners() {
    let mut out = vec![Corner { x: 0.0, y: 0.0, response: 0.0 }];
    for (width, height) in [(0, 0), (6, 100), (100, 6), (1, 1)] {
        FastDetector::new().detect_all(&blocky(width.max(1), height.max(1), 1), 1, &mut out);
        assert!(out.is_empty(), "{width}x{height}");
    }
    let mut dot = GreyImage::new(7, 7);
    dot.data[3 * 7 + 3] = 200;
    FastDetector::new().detect_all(&dot, 10, &mut out);
    assert_eq!(out, [Corner { x: 3.0, y: 3.0, response: 199.0 }]);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn cells_choose_and_threshold_but_do_not_change_corners(
        seed in any::<u64>(), width in 7usize..130, height in 7usize..60, side in 1usize..40,
        thresholds in prop::collection::vec(prop::option::of(0u8..60), 1..40),
    ) {
        let image = blocky(width, height, seed);
        let mut cells = CellGrid::new(width, height, side, 10.0);
        for (i, cell) in cells.cells.iter_mut().enumerate() {
            let t = thresholds[i % thresholds.len()];
            cell.wanted = t.is_some();
            cell.threshold = t.map_or(f32::NAN, f32::from);
        }
        let mut out = Vec::new();
        FastDetector::new().detect(&image, &cells, &mut out);
        prop_assert_eq!(out, plain_corners(&image, &cells));
    }

    #[test]
    fn the_wide_kernels_agree_with_their_scalar_twins(
        seed in any::<u64>(), width in 7usize..150, threshold in 0u8..60,
    ) {
        let image = blocky(width, 7, seed);
        let rows: Rows = std::array::from_fn(|i| image.row(i));
        let thresholds = vec![threshold; width];
        let run = |f: fn(&Rows, &[u8], &mut [u8], &mut [bool])| {
            let (mut scores, mut scored) = (vec![0; width], vec![false; width / BLOCK + 1]);
            f(&rows, &thresholds, &mut scores, &mut scored);
            (scores, scored)
        };
        prop_assert_eq!(run(score_row), run(score_row_body));
        let run = |f: fn([&[u8; BLOCK + 2]; 3], &[u8; BLOCK], &mut [u8; BLOCK])| {
            let mut kept = [0; BLOCK];
            let image = blocky(BLOCK + 2, 3, seed);
            f([0, 1, 2].map(|y| window(image.row(y), 0)), &[threshold; BLOCK], &mut kept);
            kept
        };
        prop_assert_eq!(run(keep_maxima), run(keep_maxima_body));
    }
}
