//! Which corner of one picture is which of the other.
//!
//! Input: the [`Corners`] of both pictures and [`Matching`]. Output: [`Pair`]s of positions (pixels of each picture), each
//! corner at most once, the likeliest first.
//! - Binary descriptors: mutual nearest with a ratio test (`features::matching`).
//!
//! Cost: 1.5 ns a pair of descriptors.
//!
//! Deliberately not here: geometry (`geometry::ransac`), matching guided by it ([`super::guided`]).

use nalgebra::Vector2;

use super::detect::{Corners, Keypoint};
use crate::features::descriptor::Descriptor;
use crate::features::matching::{DescriptorMatcher, DescriptorMatching, Match};

/// How corners are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Matcher {
    /// 256-bit binary descriptors, turned with the patch
    Descriptors,
}

impl Matcher {
    pub const ALL: [Self; 1] = [Self::Descriptors];

    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Descriptors => "descriptors",
        }
    }

    /// Scales that corners are searched at when nobody says otherwise: what is compared must know scale to gain by it.
    pub fn default_scales(self) -> usize {
        match self {
            Self::Descriptors => 8,
        }
    }
}

/// A corner of each picture that are taken for the same.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Pixels of the first and of the second picture.
    pub a: Vector2<f64>,
    pub b: Vector2<f64>,
    /// Index into the first picture's corners and, where the matcher knows it, into the second's.
    pub first: usize,
    pub second: Option<usize>,
    /// How unlike they are, in the matcher's measure: bits, 1 - correlation, or a distance of attributes.
    pub distance: f64,
    /// What the positions are uncertain by: pixels of each picture a pixel of the scale that the corner was found at.
    pub size_px: [f64; 2],
}

impl Pair {
    /// A match that came from elsewhere, of the picture's own scale.
    pub fn given(index: usize, a: Vector2<f64>, b: Vector2<f64>) -> Self {
        Self { a, b, first: index, second: Some(index), distance: 0.0, size_px: [1.0; 2] }
    }
}

/// What of the matching can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matching {
    pub matcher: Matcher,
    pub descriptors: DescriptorMatching,
}

impl Matching {
    /// The usual figures of a matcher, for a single pair from two places.
    pub fn new(matcher: Matcher) -> Self {
        Self { matcher, descriptors: DescriptorMatching { max_distance: 80, max_ratio: 0.85 } }
    }
}

/// Matches the corners of two pictures.
pub fn pair_corners(first: &Corners, second: &Corners, options: &Matching) -> Vec<Pair> {
    let mut pairs = match options.matcher {
        Matcher::Descriptors => by_descriptors(first, second, &options.descriptors),
    };
    // Stable: equally alike ones keep their order.
    pairs.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    pairs
}

fn pair(first: &[Keypoint], second: &[Keypoint], i: usize, j: usize, distance: f32) -> Pair {
    let (p, q) = (&first[i], &second[j]);
    Pair {
        a: p.position,
        b: q.position,
        first: i,
        second: Some(j),
        distance: f64::from(distance),
        size_px: [p.size_px, q.size_px],
    }
}

fn by_descriptors(first: &Corners, second: &Corners, rule: &DescriptorMatching) -> Vec<Pair> {
    // Those that have one, and where they come from.
    let described = |corners: &Corners| -> (Vec<usize>, Vec<Descriptor>) {
        corners.keypoints.iter().enumerate().filter_map(|(i, k)| k.descriptor.map(|d| (i, d))).unzip()
    };
    let ((from_a, a), (from_b, b)) = (described(first), described(second));
    let mut matches: Vec<Match> = Vec::new();
    DescriptorMatcher::new().match_all(&a, &b, rule, &mut matches);
    matches
        .iter()
        .map(|m| {
            let (i, j) = (from_a[m.first as usize], from_b[m.second as usize]);
            pair(&first.keypoints, &second.keypoints, i, j, m.distance)
        })
        .collect()
}
