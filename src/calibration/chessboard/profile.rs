//! Which saddle points are corners where four squares meet, and how they lie.
//!
//! Input: a [`SaddleMap`]. Output: [`XCorner`]s. Grey values on a circle around a corner cross their middle exactly four times,
//! opposite crossings are half a turn apart (two straight edges), and all four sectors are clearly on their side. Two
//! radii are tried, the larger first: the smaller one is for small squares and for the picture's rim.
//!
//! The bisector of the bright sectors is perpendicular to that of the dark ones, at any perspective; so neighbours on a
//! board, which have dark and bright exchanged, differ by a right angle in it.

use std::f32::consts::{PI, TAU};

use nalgebra::Vector2;

use super::saddle::SaddleMap;

/// Radii of the circle, pixels.
const RADII: [f32; 2] = [4.0, 2.5];
const SAMPLES: usize = 32;
/// Bright minus dark at the least, grey levels.
const MIN_CONTRAST: f32 = 6.0;
/// Share of the contrast by which every sector's extreme is beyond the middle.
const MIN_EXTREME: f32 = 0.22;
/// Narrowest sector, rad.
const MIN_SECTOR: f32 = 0.28;
/// Opposite crossings are so near to half a turn apart, rad.
const STRAIGHTNESS: f32 = 0.5;
/// Corners of a level at the most.
const MAX_CORNERS: usize = 900;

/// A corner where four squares meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct XCorner {
    /// Level pixels.
    pub at: Vector2<f64>,
    /// Direction of the bright sectors' bisector, rad modulo pi.
    pub bright: f64,
    /// Directions of the two edges, rad modulo pi.
    pub edges: [f64; 2],
    /// Bright minus dark, grey levels.
    pub contrast: f32,
}

impl XCorner {
    /// +1 for the same colouring as `other`, -1 for the opposite one, 0 for neither.
    pub fn agreement(&self, bright: f64) -> f64 {
        (2.0 * (self.bright - bright)).cos()
    }

    /// Is one of the edges within `tolerance` rad of a direction?
    pub fn has_edge(&self, direction: f64, tolerance: f64) -> bool {
        self.edges.iter().any(|edge| line_angle(*edge, direction) < tolerance)
    }
}

/// Angle between two undirected lines, 0 to pi/2.
pub fn line_angle(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(std::f64::consts::PI);
    d.min(std::f64::consts::PI - d)
}

/// Corners of a map, in the order of their strength.
pub fn find(map: &SaddleMap, corners: &mut Vec<XCorner>) {
    corners.clear();
    for (_, x, y) in &map.candidates {
        let at = map.peak(*x as usize, *y as usize);
        corners.extend(RADII.iter().find_map(|radius| describe(map, at, *radius)));
        if corners.len() >= MAX_CORNERS {
            break;
        }
    }
}

fn circle() -> &'static [(f32, f32); SAMPLES] {
    static CIRCLE: std::sync::OnceLock<[(f32, f32); SAMPLES]> = std::sync::OnceLock::new();
    CIRCLE.get_or_init(|| {
        std::array::from_fn(|k| {
            let angle = k as f32 * TAU / SAMPLES as f32;
            (angle.cos(), angle.sin())
        })
    })
}

fn ring(map: &SaddleMap, at: Vector2<f64>, radius: f32) -> Option<[f32; SAMPLES]> {
    let (x, y) = (at.x as f32, at.y as f32);
    let mut values = [0.0; SAMPLES];
    for (value, (c, s)) in values.iter_mut().zip(circle()) {
        *value = map.sample(x + radius * c, y + radius * s)?;
    }
    Some(values)
}

fn describe(map: &SaddleMap, at: Vector2<f64>, radius: f32) -> Option<XCorner> {
    let values = ring(map, at, radius)?;
    let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let contrast = high - low;
    if contrast < MIN_CONTRAST {
        return None;
    }
    let middle = 0.5 * (low + high);
    let mut crossings = [0.0f32; 4];
    let mut count = 0;
    for k in 0..SAMPLES {
        let (a, b) = (values[k] - middle, values[(k + 1) % SAMPLES] - middle);
        if (a < 0.0) != (b < 0.0) {
            *crossings.get_mut(count)? = (k as f32 + a / (a - b)) * (TAU / SAMPLES as f32);
            count += 1;
        }
    }
    if count != 4 {
        return None;
    }
    let [c0, c1, c2, c3] = crossings;
    let sectors = [c1 - c0, c2 - c1, c3 - c2, c0 + TAU - c3];
    let straight = |a: f32, b: f32| ((b - a) - PI).abs() < STRAIGHTNESS;
    if !straight(c0, c2) || !straight(c1, c3) || sectors.iter().any(|s| *s < MIN_SECTOR) {
        return None;
    }
    // Each of the four sectors is clearly dark or bright.
    let mut extremes = [0.0f32; 4];
    for (k, value) in values.iter().enumerate() {
        let angle = k as f32 * (TAU / SAMPLES as f32);
        let sector = crossings.iter().filter(|c| angle >= **c).count() % 4;
        extremes[sector] = extremes[sector].max((value - middle).abs());
    }
    if extremes.iter().any(|e| *e < MIN_EXTREME * contrast) {
        return None;
    }
    // Mean directions of the two edges: opposite crossings together.
    let first = f64::from(0.5 * (c0 + c2 - PI));
    let second = f64::from(0.5 * (c1 + c3 - PI));
    // Between the first crossing and the second; the sector there is bright if it follows a rise.
    let bisector = 0.5 * (first + second);
    let at_bisector = (0.5 * (c0 + c1) * (SAMPLES as f32 / TAU)) as usize % SAMPLES;
    let is_bright = values[at_bisector] + values[(at_bisector + 1) % SAMPLES] > 2.0 * middle;
    let bright = if is_bright { bisector } else { bisector + std::f64::consts::FRAC_PI_2 };
    Some(XCorner { at, bright, edges: [first, second], contrast })
}

/// Strength and direction of the two-fold pattern around a place, for one that has failed [`describe`]: amplitude in
/// grey levels and the bright sectors' bisector.
pub fn two_fold(map: &SaddleMap, at: Vector2<f64>, radius: f32) -> Option<(f64, f64)> {
    let values = ring(map, at, radius)?;
    let (mut re, mut im) = (0.0f64, 0.0f64);
    for (value, (c, s)) in values.iter().zip(circle()) {
        // cos 2a, sin 2a
        re += f64::from(value * (c * c - s * s));
        im += f64::from(value * (2.0 * c * s));
    }
    Some((re.hypot(im) * 2.0 / SAMPLES as f64, 0.5 * im.atan2(re)))
}

/// How far the darker of the two bright sectors is above the brighter of the two dark ones, grey levels, when the bright ones lie
/// along `bright`. At the rim of a board, where one square meets the paper, this is below zero.
pub fn margin(map: &SaddleMap, at: Vector2<f64>, radius: f32, bright: f64) -> Option<f64> {
    let mut means = [0.0f64; 4];
    for (sector, mean) in means.iter_mut().enumerate() {
        for spread in [-0.3, 0.0, 0.3] {
            let angle = bright + sector as f64 * std::f64::consts::FRAC_PI_2 + spread;
            let (x, y) = (at.x as f32 + radius * angle.cos() as f32, at.y as f32 + radius * angle.sin() as f32);
            *mean += f64::from(map.sample(x, y)?) / 3.0;
        }
    }
    Some(means[0].min(means[2]) - means[1].max(means[3]))
}
