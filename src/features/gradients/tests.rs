use super::*;
use crate::geometry::random::Random;

/// A smooth picture of 80x80 by its grey value at each place.
fn picture(grey: impl Fn(f32, f32) -> f32) -> GreyImage {
    let mut image = GreyImage::new(80, 80);
    for (i, pixel) in image.data.iter_mut().enumerate() {
        *pixel = grey((i % 80) as f32, (i / 80) as f32).round().clamp(0.0, 255.0) as u8;
    }
    image
}

fn texture(seed: u64) -> impl Fn(f32, f32) -> f32 {
    let mut random = Random::new(seed);
    let waves: Vec<[f32; 4]> = (0..25)
        .map(|_| {
            let (length, angle) = (random.uniform(9.0, 40.0) as f32, random.uniform(0.0, 1.0) as f32 * TAU);
            let k = TAU / length;
            [k * angle.cos(), k * angle.sin(), random.uniform(0.0, 6.3) as f32, random.uniform(4.0, 14.0) as f32]
        })
        .collect();
    move |x, y| 128.0 + waves.iter().map(|[u, v, phase, size]| size * (u * x + v * y + phase).sin()).sum::<f32>()
}

/// Distance of the nearest two descriptors, as a share of the length.
fn nearest(a: &[TurnedGradients], b: &[TurnedGradients]) -> f32 {
    let all = a.iter().flat_map(|p| b.iter().map(move |q| p.descriptor.distance_squared(&q.descriptor)));
    (all.min().expect("descriptors") as f32).sqrt() / LENGTH
}

#[test]
fn turned_darker_and_flatter_the_same_place_stays_near_and_strangers_are_far() {
    for seed in 0..10 {
        let grey = texture(seed);
        let other = texture(1000 + seed);
        let angle = seed as f32 * 0.61;
        let (sin, cos) = angle.sin_cos();
        let first = GradientMap::new(&picture(&grey)).describe(40.0, 40.0);
        let turned = picture(|x, y| {
            let (dx, dy) = (x - 40.0, y - 40.0);
            30.0 + 0.6 * grey(40.0 + cos * dx + sin * dy, 40.0 + cos * dy - sin * dx)
        });
        let same = nearest(&first, &GradientMap::new(&turned).describe(40.0, 40.0));
        let stranger = nearest(&first, &GradientMap::new(&picture(&other)).describe(40.0, 40.0));
        assert!(same < 0.35 && stranger > 0.5 && same < 0.6 * stranger, "seed {seed}: {same} {stranger}");
    }
}

#[test]
fn borders_flat_pictures_and_bad_numbers_have_none() {
    let map = GradientMap::new(&picture(texture(1)));
    for (x, y) in [(15.0, 40.0), (40.0, 64.5), (f32::NAN, 40.0), (-1e9, 40.0), (40.0, f32::INFINITY)] {
        assert!(map.describe(x, y).is_empty(), "{x} {y}");
    }
    assert!(!map.describe(16.0, 63.0).is_empty());
    assert!(GradientMap::new(&picture(|_, _| 90.0)).describe(40.0, 40.0).is_empty());
    for (width, height) in [(0, 0), (1, 1), (3, 50)] {
        assert!(GradientMap::new(&GreyImage::new(width, height)).describe(1.0, 1.0).is_empty());
    }
}

#[test]
fn a_row_of_distances_is_the_distances() {
    let all: Vec<GradientDescriptor> = (0..9)
        .flat_map(|s| GradientMap::new(&picture(texture(s))).describe(40.0, 40.0))
        .map(|d| d.descriptor)
        .collect();
    let mut row = vec![0; all.len()];
    let many = Widened::new(&all);
    many.distances_squared(0, &many, &mut row);
    for (found, other) in row.iter().zip(&all) {
        let plain: i64 = all[0].0.iter().zip(&other.0).map(|(a, b)| (i64::from(*a) - i64::from(*b)).pow(2)).sum();
        assert_eq!(i64::from(*found), plain);
    }
}

#[test]
fn a_map_that_is_filled_again_is_that_of_the_new_picture_alone() {
    let of = |size: usize, seed: u64| {
        let (grey, mut image) = (texture(seed), GreyImage::new(size, size - 10));
        let pixels = image.data.iter_mut().enumerate();
        pixels.for_each(|(i, v)| *v = grey((i % size) as f32, (i / size) as f32).clamp(0.0, 255.0) as u8);
        image
    };
    let mut map = GradientMap::default();
    for (size, seed) in [(90, 1), (60, 2), (120, 3), (90, 4)] {
        let picture = of(size, seed);
        map.fill(&picture);
        let fresh = GradientMap::new(&picture);
        for (x, y) in [(16.0, 16.0), (30.0, 25.0), (size as f32 - 17.0, size as f32 - 27.0)] {
            let described = map.describe(x, y);
            assert!(!described.is_empty() && described == fresh.describe(x, y), "{size} {x} {y}");
        }
    }
}

/// Turned by a quarter the same pixels are sampled, to a half of one: directions and histograms go round.
#[test]
fn a_quarter_turn_of_the_picture_turns_the_direction_and_little_else() {
    for seed in 0..10 {
        let grey = texture(seed);
        let upright = GradientMap::new(&picture(&grey)).describe(40.0, 40.0);
        let turned = GradientMap::new(&picture(|x, y| grey(y, 80.0 - x))).describe(40.0, 40.0);
        assert_eq!(upright.len(), turned.len(), "seed {seed}");
        for (a, b) in upright.iter().zip(&turned) {
            let turn = (b.turn_rad - a.turn_rad).rem_euclid(TAU);
            let off = (turn - 0.25 * TAU).abs();
            let apart = (a.descriptor.distance_squared(&b.descriptor) as f32).sqrt() / LENGTH;
            assert!(off < 0.02 && apart < 0.1, "seed {seed}: turned by {turn}, {apart} apart");
        }
    }
}
