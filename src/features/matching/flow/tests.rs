use super::*;
use crate::features::correlation::tests::noise;
use crate::image::GreyImage;

/// Texture of every scale, so that each level of a pyramid has some.
fn texture(x: f32, y: f32) -> f32 {
    20.0 + 90.0 * noise(x, y, 47.0, 1) + 70.0 * noise(x, y, 17.0, 2) + 50.0 * noise(x, y, 6.0, 3)
}

/// The texture moved by `warp` (from this picture's pixels to the texture's), as a pyramid.
fn seen(warp: impl Fn(f32, f32) -> (f32, f32)) -> Pyramid {
    let mut image = GreyImage::new(320, 240);
    for (i, p) in image.data.iter_mut().enumerate() {
        let (x, y) = warp((i % 320) as f32, (i / 320) as f32);
        *p = texture(x, y).clamp(0.0, 255.0) as u8;
    }
    let mut pyramid = Pyramid::new(5);
    pyramid.build(&image);
    pyramid
}

fn grid() -> Vec<Corner> {
    (0..100)
        .map(|i| Corner { x: 24.0 + 30.0 * (i % 10) as f32, y: 20.0 + 22.0 * (i / 10) as f32, response: 1.0 })
        .collect()
}

#[test]
fn corners_are_found_at_their_sub_pixel_places() {
    let (first, second) = (seen(|x, y| (x, y)), seen(|x, y| (x - 6.3, y + 3.6)));
    let mut out = Vec::new();
    match_flow(&first, &second, &grid(), &FlowMatching::default(), &mut out);
    assert!(out.len() >= 85, "{} of 100", out.len());
    assert!(out.is_sorted_by_key(|m| m.first));
    let mut off: Vec<f32> = out
        .iter()
        .map(|m| (grid()[m.first as usize], m.position))
        .map(|(c, found)| (found - Vector2::new(c.x + 6.3, c.y - 3.6)).norm())
        .collect();
    off.sort_by(f32::total_cmp);
    assert!(off[off.len() / 2] < 0.05 && off[off.len() - 1] < 0.3, "{off:?}");
    assert!(out.iter().all(|m| m.distance < 0.05), "{out:?}");
}

#[test]
fn lost_corners_are_found_from_their_neighbours() {
    // The motion grows across the picture from 2 to 40 px: too much for the start that all share.
    let warp = |x: f32, y: f32| (x - 2.0 - 0.06 * x - 0.0002 * x * x, y);
    let (first, second) = (seen(|x, y| (x, y)), seen(warp));
    let count = |rounds| {
        let rule = FlowMatching { rounds, coarsest_level: 1, min_thumbnail_ncc: 2.0, ..FlowMatching::default() };
        let mut out = Vec::new();
        match_flow(&first, &second, &grid(), &rule, &mut out);
        let right = |m: &&PointMatch| {
            let c = grid()[m.first as usize];
            let (x, y) = warp(m.position.x, m.position.y);
            (x - c.x).abs() < 1.0 && (y - c.y).abs() < 1.0
        };
        (out.iter().filter(right).count(), out.len())
    };
    let (alone, with) = (count(0), count(6));
    assert!(with.0 >= alone.0 + 10, "right, all: {alone:?} without neighbours, {with:?} with");
}

#[test]
fn pictures_without_a_common_size_or_texture_match_nothing() {
    let first = seen(|x, y| (x, y));
    let (mut small, mut flat) = (Pyramid::new(4), Pyramid::new(4));
    small.build(&GreyImage::new(100, 80));
    flat.build(&GreyImage::new(320, 240));
    for second in [&small, &flat, &Pyramid::new(3)] {
        let mut out = vec![PointMatch { first: 0, position: Vector2::zeros(), distance: 0.0 }];
        match_flow(&first, second, &grid(), &FlowMatching::default(), &mut out);
        assert_eq!(out, []);
    }
    let nowhere = [Corner { x: f32::NAN, y: 1.0, response: 0.0 }, Corner { x: -900.0, y: 1e30, response: 0.0 }];
    let mut out = Vec::new();
    match_flow(&first, &first, &nowhere, &FlowMatching::default(), &mut out);
    assert_eq!(out, []);
}
