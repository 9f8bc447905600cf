use nalgebra::{Matrix3, Vector2};

use super::patch::{Ground, correlate, correlate_body, normalise, padded_area};
use super::*;
use crate::features::Corner;
use crate::features::matching::{Match, PointMatch};
use crate::image::GreyImage;
use proptest::prelude::*;

/// Value noise: 0 to 1, a new value every `scale` pixels, smooth between them.
pub(in crate::features) fn noise(x: f32, y: f32, scale: f32, seed: u32) -> f32 {
    let hash = |x: i32, y: i32| {
        let h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca6b) ^ seed;
        let h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        ((h ^ (h >> 13)).wrapping_mul(0x297a_2d39) >> 20) as f32 / 4096.0
    };
    let (u, v) = (x / scale, y / scale);
    let (i, j) = (u.floor(), v.floor());
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (fu, fv) = (ease(u - i), ease(v - j));
    let at = |di: i32, dj: i32| hash(i as i32 + di, j as i32 + dj);
    let above = at(0, 0) + (at(1, 0) - at(0, 0)) * fu;
    let below = at(0, 1) + (at(1, 1) - at(0, 1)) * fu;
    above + (below - above) * fv
}

/// Texture that nowhere repeats, smooth enough for sub-pixel places.
fn texture(x: f32, y: f32) -> f32 {
    30.0 + 110.0 * noise(x, y, 9.0, 1) + 80.0 * noise(x, y, 4.5, 2)
}

fn picture(width: usize, height: usize, grey: impl Fn(f32, f32) -> f32) -> GreyImage {
    let mut image = GreyImage::new(width, height);
    for (i, p) in image.data.iter_mut().enumerate() {
        *p = grey((i % width) as f32, (i / width) as f32).round().clamp(0.0, 255.0) as u8;
    }
    image
}

fn corner(x: f32, y: f32) -> Corner {
    Corner { x, y, response: 1.0 }
}

fn grid(width: usize, height: usize, step: usize) -> Vec<Corner> {
    let rows = (20..height - 20).step_by(step);
    rows.flat_map(|y| (20..width - 20).step_by(step).map(move |x| corner(x as f32, y as f32))).collect()
}

/// F of a camera that moved along x: lines are rows.
const ROWS: Matrix3<f64> = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);

#[test]
fn corners_find_each_other_through_another_exposure() {
    let first = picture(200, 150, texture);
    let second = picture(200, 150, |x, y| 0.6 * texture(x - 11.0, y + 7.0) + 40.0);
    let corners = grid(200, 150, 13);
    let moved: Vec<Corner> = corners.iter().rev().map(|c| corner(c.x + 11.0, c.y - 7.0)).collect();
    let mut out = Vec::new();
    let mut correlator = CornerCorrelator::new(CorrelationMatching::default()).expect("valid");
    correlator.match_all((&first, &corners), (&second, &moved), &mut out);
    assert!(out.len() > corners.len() * 9 / 10, "{} of {}", out.len(), corners.len());
    assert!(out.is_sorted_by_key(|m| m.first));
    let n = corners.len() as u32;
    assert!(out.iter().all(|m| m.second == n - 1 - m.first && m.distance < 0.01), "{out:?}");
}

#[test]
fn flat_repeated_and_outside_patches_match_nothing() {
    let noise = |x: f32, y: f32| 100.0 + ((x * 7.0 + y * 13.0) % 3.0);
    let flat = picture(100, 80, noise);
    let mut correlator = CornerCorrelator::new(CorrelationMatching::default()).expect("valid");
    let mut out = vec![Match { first: 0, second: 0, distance: 0.0 }];
    correlator.match_all((&flat, &grid(100, 80, 10)), (&flat, &grid(100, 80, 10)), &mut out);
    assert_eq!(out, []);
    // A pattern of period 20: each corner has doubles.
    let tiles = picture(100, 80, |x, y| texture(x % 20.0, y % 20.0));
    correlator.match_all((&tiles, &grid(100, 80, 20)), (&tiles, &grid(100, 80, 20)), &mut out);
    assert_eq!(out, []);
    let image = picture(100, 80, texture);
    let outside: Vec<Corner> =
        [(3.0, 40.0), (-5.0, 40.0), (f32::NAN, 40.0), (1e30, 1.0), (40.0, 77.0)].map(|(x, y)| corner(x, y)).to_vec();
    correlator.match_all((&image, &outside), (&image, &outside), &mut out);
    assert_eq!(out, []);
    let mut lines = EpipolarCorrelator::new(CorrelationMatching::default(), EpipolarSearch::default()).expect("valid");
    let mut points = Vec::new();
    for (a, b, corners) in
        [(&flat, &flat, grid(100, 80, 10)), (&tiles, &tiles, grid(100, 80, 20)), (&image, &image, outside)]
    {
        lines.match_lines(a, b, &ROWS, &corners, &mut points);
        assert_eq!(points, []);
    }
    // No picture, no line, no number.
    let corners = grid(100, 80, 10);
    for f in [Matrix3::zeros(), Matrix3::repeat(f64::NAN), Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)] {
        lines.match_lines(&image, &image, &f, &corners, &mut points);
        assert_eq!(points, []);
    }
    for empty in [GreyImage::default(), GreyImage::new(5, 5)] {
        lines.match_lines(&image, &empty, &ROWS, &corners, &mut points);
        assert_eq!(points, []);
        lines.match_lines(&empty, &image, &ROWS, &corners, &mut points);
        assert_eq!(points, []);
    }
}

#[test]
fn places_along_rows_are_found_to_a_twentieth_of_a_pixel() {
    // Disparity grows from 4 to 9.4 px down the picture.
    let disparity = |y: f32| 4.0 + 0.03 * y;
    let first = picture(240, 180, texture);
    let second = picture(240, 180, |x, y| 0.8 * texture(x + disparity(y), y) + 10.0);
    let corners: Vec<Corner> = grid(240, 180, 11).into_iter().map(|c| corner(c.x + 0.3, c.y - 0.2)).collect();
    for (align, limit) in [(false, 0.2), (true, 0.05)] {
        let search = EpipolarSearch { align, ..EpipolarSearch::default() };
        let mut lines = EpipolarCorrelator::new(CorrelationMatching::default(), search).expect("valid");
        let mut out = Vec::new();
        lines.match_lines(&first, &second, &ROWS, &corners, &mut out);
        assert!(out.len() * 5 >= corners.len() * 4, "{} of {}", out.len(), corners.len());
        assert!(out.is_sorted_by_key(|m| m.first));
        let mut off: Vec<f32> =
            out.iter().map(|m| error(m, &corners, |c| Vector2::new(c.x - disparity(c.y), c.y))).collect();
        off.sort_by(f32::total_cmp);
        assert!(off[off.len() / 2] < limit && off[off.len() * 19 / 20] < 4.0 * limit, "align {align}: {off:?}");
    }
}

fn error(m: &PointMatch, corners: &[Corner], truth: impl Fn(&Corner) -> Vector2<f32>) -> f32 {
    (m.position - truth(&corners[m.first as usize])).norm()
}

#[test]
fn slanting_and_steep_lines_are_searched_within_their_band() {
    // Everything moves along one direction by an amount of its own: F = [d]x, whose epipole lies at infinity.
    for (dx, dy) in [(0.8f32, 0.6f32), (0.28, -0.96), (0.0, 1.0), (-0.6, 0.8)] {
        let amount = |x: f32, y: f32| 12.0 + 6.0 * ((x + y) * 0.008).sin();
        let first = picture(220, 200, texture);
        let second = picture(220, 200, |x, y| texture(x - dx * amount(x, y), y - dy * amount(x, y)));
        let (a, b) = (f64::from(dx), f64::from(dy));
        let f = Matrix3::new(0.0, 0.0, b, 0.0, 0.0, -a, -b, a, 0.0);
        let mut lines =
            EpipolarCorrelator::new(CorrelationMatching::default(), EpipolarSearch::default()).expect("valid");
        let corners = grid(220, 200, 15);
        let mut out = Vec::new();
        lines.match_lines(&first, &second, &f, &corners, &mut out);
        assert!(out.len() * 10 >= corners.len() * 7, "({dx}, {dy}): {} of {}", out.len(), corners.len());
        for m in &out {
            let c = corners[m.first as usize];
            let line = f * Vector2::new(f64::from(c.x), f64::from(c.y)).push(1.0);
            let off = line.dot(&m.position.map(f64::from).push(1.0)).abs() / line.xy().norm();
            assert!(off < 0.3, "({dx}, {dy}): {c:?} {m:?} {off} px off its line");
            let (x, y) = (m.position.x, m.position.y);
            let source = Vector2::new(x - dx * amount(x, y), y - dy * amount(x, y));
            assert!((source - Vector2::new(c.x, c.y)).norm() < 0.3, "({dx}, {dy}): {c:?} {m:?}");
        }
        // A bound on the motion that the truth exceeds.
        let near = EpipolarSearch { max_motion_px: 4.0, ..EpipolarSearch::default() };
        let mut lines = EpipolarCorrelator::new(CorrelationMatching::default(), near).expect("valid");
        lines.match_lines(&first, &second, &f, &corners, &mut out);
        assert!(out.len() * 20 <= corners.len(), "{} of {}", out.len(), corners.len());
    }
}

#[test]
fn what_lies_beside_the_line_is_not_taken() {
    // The truth is three rows above the line: its flank reaches into the band, its peak does not.
    let first = picture(200, 150, texture);
    let second = picture(200, 150, |x, y| texture(x + 9.0, y + 3.0));
    let corners = grid(200, 150, 12);
    let rule = CorrelationMatching { min_ncc: 0.3, ..CorrelationMatching::default() };
    let mut lines = EpipolarCorrelator::new(rule, EpipolarSearch::default()).expect("valid");
    let mut out = Vec::new();
    lines.match_lines(&first, &second, &ROWS, &corners, &mut out);
    assert!(out.len() * 20 <= corners.len(), "{} of {}", out.len(), corners.len());
}

#[test]
fn values_out_of_range_are_named() {
    let base = CorrelationMatching::default();
    let message = |rule: CorrelationMatching| CornerCorrelator::new(rule).expect_err("must be refused").to_string();
    assert!(message(CorrelationMatching { patch_radius_px: 1, ..base }).contains("patch_radius_px is 1 px"));
    assert!(message(CorrelationMatching { patch_radius_px: 16, ..base }).contains("2 to 15 px"));
    assert!(message(CorrelationMatching { min_ncc: f32::NAN, ..base }).contains("min_ncc is NaN"));
    assert!(message(CorrelationMatching { max_ratio: 0.0, ..base }).contains("max_ratio is 0"));
    assert!(message(CorrelationMatching { min_contrast: -1.0, ..base }).contains("min_contrast is -1 grey"));
    let message = |search| EpipolarCorrelator::new(base, search).expect_err("must be refused").to_string();
    let search = EpipolarSearch::default();
    assert!(message(EpipolarSearch { band_px: 21.0, ..search }).contains("band_px is 21 px"));
    assert!(message(EpipolarSearch { max_return_px: f32::NAN, ..search }).contains("max_return_px is NaN px"));
    assert!(message(EpipolarSearch { max_motion_px: 0.0, ..search }).contains("max_motion_px is 0 px"));
}

/// NCC by its definition.
fn plain_ncc(a: &GreyImage, (ax, ay): (usize, usize), b: &GreyImage, (bx, by): (usize, usize), r: usize) -> f64 {
    let patch = |image: &GreyImage, x: usize, y: usize| {
        let v: Vec<f64> = (y - r..=y + r)
            .flat_map(|y| (x - r..=x + r).map(move |x| (x, y)))
            .map(|(x, y)| f64::from(image.at(x, y)))
            .collect();
        let mean = v.iter().sum::<f64>() / v.len() as f64;
        v.into_iter().map(|p| p - mean).collect::<Vec<_>>()
    };
    let (a, b) = (patch(a, ax, ay), patch(b, bx, by));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]

    #[test]
    fn ncc_is_its_definition_and_the_wide_kernel_agrees(
        data in prop::collection::vec(any::<u8>(), 40 * 36), other in prop::collection::vec(0u8..30, 40 * 36), r in 2usize..=15,
        u in 0.0f32..1.0, v in 0.0f32..1.0,
    ) {
        let a = GreyImage { width: 40, height: 36, data };
        let b = GreyImage { width: 40, height: 36, data: other };
        let place = |share: f32, size: usize| r + (share * (size - 1 - 2 * r) as f32) as usize;
        let (from, to) = ((place(u, 40), place(v, 36)), (place(v, 40), place(u, 36)));
        let mut template = vec![7; padded_area(r)];
        prop_assert!(normalise(&a, from, r, 0.0, &mut template));
        let mut ground = Ground::default();
        ground.fill(&b);
        // The last pixel that a patch fits at is the one whose vectors reach past the picture.
        let places = [[to.0 as u32, to.1 as u32], [39 - r as u32, 35 - r as u32]];
        let (mut wide, mut plain) = ([0.0; 2], [0.0; 2]);
        correlate(&template, r, 0.0, &ground, &places, &mut wide);
        correlate_body(&template, r, 0.0, &ground, &places, &mut plain);
        prop_assert_eq!(wide, plain);
        for (ncc, at) in wide.iter().zip([to, (39 - r, 35 - r)]) {
            let truth = plain_ncc(&a, from, &b, at, r);
            prop_assert!((f64::from(*ncc) - truth).abs() < 5e-4, "{ncc} should be {truth}");
        }
    }
}
