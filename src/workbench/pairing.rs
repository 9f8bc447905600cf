//! Which corner of one picture is which of the other.
//!
//! Input: the [`Corners`] of both pictures and [`Matching`]. Output: [`Pair`]s of positions (pixels of each picture), each
//! corner at most once, the likeliest first.
//! - Binary descriptors: mutual nearest with a ratio test.
//! - Histograms of gradients: the same, with a ratio test against what is elsewhere.
//! - The study's attributes: grey level, salient degree and direction within a threshold each.
//! - Normalised cross-correlation of patches, over the whole picture; corners of the same scale with each other.
//! - Optical flow from the first picture's corners; the places need not be corners of the second.
//!
//! Places found by comparing corners are aligned to a fraction of a pixel where the patches look alike without being
//! turned ([`align_pairs`]), then all by an affine map ([`polish_pairs`]). Cost: 1.5 ns a pair of binary
//! descriptors, 20 ns of histograms, 50 ns of patches.
//!
//! Deliberately not here: geometry (`geometry::ransac`), matching guided by it ([`super::guided`]).

use nalgebra::{Matrix2, Vector2};

use super::detect::{Corners, Keypoint};
use super::polish::polish;
use crate::features::Corner;
use crate::features::alignment::{AlignOptions, PatchTemplate, align};
use crate::features::correlation::{CornerCorrelator, CorrelationMatching};
use crate::features::descriptor::Descriptor;
use crate::features::gradients::{GradientDescriptor, GradientMap};
use crate::features::matching::{
    AttributeMatching, DescriptorMatcher, DescriptorMatching, FlowMatching, Match, Place, PlaceMatching,
    match_attributes, match_flow, match_places,
};
use crate::image::{GreyImage, Pyramid};

/// Levels of halves that the flow descends through.
const FLOW_LEVELS: usize = 5;
/// An alignment counts when the patches are this much alike, and it moves the place by no more pixels of its scale.
const ALIGN_NCC: f32 = 0.85;
const ALIGN_PX: f32 = 1.5;
/// Scales from one polishing to the next: a factor of 1.7.
const POLISH_STEPS: usize = 3;

/// How corners are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Matcher {
    /// 256-bit binary descriptors, turned with the patch
    Descriptors,
    /// Histograms of gradients, 128 numbers, turned with the patch: dearer, and for views farther apart
    Gradients,
    /// The study's: grey level, salient degree and direction of each corner
    Attributes,
    /// The study's other way: normalised cross-correlation of patches
    Correlation,
    /// Optical flow from the first picture's corners
    Flow,
}

impl Matcher {
    pub const ALL: [Self; 5] = [Self::Descriptors, Self::Gradients, Self::Attributes, Self::Correlation, Self::Flow];

    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Descriptors => "descriptors",
            Self::Gradients => "gradients",
            Self::Attributes => "attributes",
            Self::Correlation => "correlation",
            Self::Flow => "flow",
        }
    }

    /// Scales that corners are searched at when nobody says otherwise: what is compared must know scale to gain by it.
    pub fn default_scales(self) -> usize {
        match self {
            Self::Descriptors | Self::Gradients => 8,
            Self::Attributes | Self::Correlation | Self::Flow => 1,
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
    /// How unlike they are, in the matcher's measure: bits, a distance of histograms or attributes, or 1 - correlation.
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
    pub gradients: PlaceMatching,
    pub attributes: AttributeMatching,
    pub correlation: CorrelationMatching,
    pub flow: FlowMatching,
}

impl Matching {
    /// The usual figures of a matcher, for a single pair from two places.
    pub fn new(matcher: Matcher) -> Self {
        Self {
            matcher,
            descriptors: DescriptorMatching { max_distance: 80, max_ratio: 0.85 },
            gradients: PlaceMatching::default(),
            attributes: AttributeMatching::default(),
            correlation: CorrelationMatching::default(),
            flow: FlowMatching::default(),
        }
    }
}

/// Matches the corners of two pictures.
pub fn pair_corners(first: &Corners, second: &Corners, options: &Matching) -> Vec<Pair> {
    let mut pairs = match options.matcher {
        Matcher::Descriptors => by_descriptors(first, second, &options.descriptors),
        Matcher::Gradients => by_gradients(first, second, &options.gradients),
        Matcher::Attributes => by_attributes(first, second, &options.attributes),
        Matcher::Correlation => by_correlation(first, second, &options.correlation),
        Matcher::Flow => by_flow(first, second, &options.flow),
    };
    if options.matcher != Matcher::Flow {
        align_pairs(first, second, &mut pairs);
    }
    polish_pairs(first, second, &mut pairs);
    // Stable: equally alike ones keep their order.
    pairs.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    pairs
}

/// Moves the second place of each pair to where its patch looks most like the first one's, at the coarser scale of both;
/// pairs that are turned or look different stay as they are.
pub fn align_pairs(first: &Corners, second: &Corners, pairs: &mut [Pair]) {
    let options = AlignOptions { max_shift_px: ALIGN_PX, ..AlignOptions::default() };
    for pair in pairs {
        let Some(k) = pair.second.and_then(|j| second.keypoints.get(j)).map(|q| q.scale) else { continue };
        let scale = k.max(first.keypoints.get(pair.first).map_or(0, |p| p.scale));
        let (Some(from), Some(to)) = (first.scales.get(scale), second.scales.get(scale)) else { continue };
        let template = PatchTemplate::<16>::from_image(&from.image, from.local(&pair.a).cast::<f32>());
        let Some(template) = template else { continue };
        if let Ok(found) = align(&template, &to.image, to.local(&pair.b).cast::<f32>(), &options)
            && found.ncc >= ALIGN_NCC
        {
            pair.b = to.base(&found.position.cast::<f64>());
        }
    }
}

/// [`polish_pair`] of each; what cannot be placed better stays.
pub fn polish_pairs(first: &Corners, second: &Corners, pairs: &mut [Pair]) {
    for pair in pairs {
        polish_pair(first, second, pair);
    }
}

/// Moves the second place of a pair to a small fraction of a pixel, by an affine map of its patch ([`polish`]): from the coarser
/// scale of both down to the finest at which the patches are alike. Tells whether that was possible at all.
pub fn polish_pair(first: &Corners, second: &Corners, pair: &mut Pair) -> bool {
    let of = |corners: &Corners, index: Option<usize>| index.and_then(|i| corners.keypoints.get(i)).map(|k| k.scale);
    let from = of(first, Some(pair.first)).unwrap_or(0);
    let mut scale = from.max(of(second, pair.second).unwrap_or(from));
    let mut map = Matrix2::identity() * (pair.size_px[1] / pair.size_px[0]);
    let mut polished = false;
    while let (Some(a), Some(b)) = (first.scales.get(scale), second.scales.get(scale)) {
        let Some(found) = polish(&a.image, &b.image, &a.local(&pair.a), &b.local(&pair.b), &map) else { break };
        (pair.b, map, polished) = (b.base(&found.place), found.map, true);
        pair.size_px = [a.size_px(), b.size_px()];
        if scale == 0 {
            break;
        }
        scale = scale.saturating_sub(POLISH_STEPS);
    }
    polished
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

/// Histograms of gradients of each keypoint: none at the border, up to two for its directions.
pub fn gradients_of(corners: &Corners) -> Vec<Vec<GradientDescriptor>> {
    let maps: Vec<GradientMap> = corners.scales.iter().map(|s| GradientMap::new(&s.image)).collect();
    let of = |k: &Keypoint| {
        let at = corners.scales[k.scale].local(&k.position).cast::<f32>();
        maps[k.scale].describe(at.x, at.y)
    };
    corners.keypoints.iter().map(of).collect()
}

fn by_gradients(first: &Corners, second: &Corners, rule: &PlaceMatching) -> Vec<Pair> {
    // The descriptors, the keypoints that they are of, and their places.
    let described = |corners: &Corners| -> (Vec<usize>, Vec<GradientDescriptor>, Vec<Place>) {
        let (mut from, mut all, mut places) = (Vec::new(), Vec::new(), Vec::new());
        for (i, (k, own)) in corners.keypoints.iter().zip(gradients_of(corners)).enumerate() {
            for descriptor in own {
                from.push(i);
                all.push(descriptor);
                places.push(Place { at: k.position.cast::<f32>().into(), size_px: k.size_px as f32 });
            }
        }
        (from, all, places)
    };
    let ((from_a, a, places_a), (from_b, b, places_b)) = (described(first), described(second));
    // The nearest first: a corner that was described twice keeps its better match.
    let mut used = [vec![false; first.keypoints.len()], vec![false; second.keypoints.len()]];
    let mut pairs = Vec::new();
    for m in match_places((&a, &places_a), (&b, &places_b), rule) {
        let (i, j) = (from_a[m.first as usize], from_b[m.second as usize]);
        if !used[0][i] && !used[1][j] {
            (used[0][i], used[1][j]) = (true, true);
            pairs.push(pair(&first.keypoints, &second.keypoints, i, j, m.distance));
        }
    }
    pairs
}

fn by_attributes(first: &Corners, second: &Corners, rule: &AttributeMatching) -> Vec<Pair> {
    let known = |corners: &Corners| -> (Vec<usize>, Vec<_>) {
        corners.keypoints.iter().enumerate().filter_map(|(i, k)| k.attributes.map(|a| (i, a))).unzip()
    };
    let ((from_a, a), (from_b, b)) = (known(first), known(second));
    let mut matches: Vec<Match> = Vec::new();
    match_attributes(&a, &b, rule, &mut matches);
    matches
        .iter()
        .map(|m| {
            let (i, j) = (from_a[m.first as usize], from_b[m.second as usize]);
            pair(&first.keypoints, &second.keypoints, i, j, m.distance)
        })
        .collect()
}

/// Corners of one scale with their places in it.
fn of_scale(corners: &Corners, scale: usize) -> (Vec<usize>, Vec<Corner>) {
    let place = |k: &Keypoint| {
        let at = corners.scales[scale].local(&k.position);
        Corner { x: at.x as f32, y: at.y as f32, response: k.response }
    };
    corners.keypoints.iter().enumerate().filter(|(_, k)| k.scale == scale).map(|(i, k)| (i, place(k))).unzip()
}

fn by_correlation(first: &Corners, second: &Corners, rule: &CorrelationMatching) -> Vec<Pair> {
    let Ok(mut correlator) = CornerCorrelator::new(*rule) else { return Vec::new() };
    let mut pairs = Vec::new();
    let mut matches: Vec<Match> = Vec::new();
    for scale in 0..first.scales.len().min(second.scales.len()) {
        let ((from_a, a), (from_b, b)) = (of_scale(first, scale), of_scale(second, scale));
        correlator.match_all((&first.scales[scale].image, &a), (&second.scales[scale].image, &b), &mut matches);
        pairs.extend(matches.iter().map(|m| {
            let (i, j) = (from_a[m.first as usize], from_b[m.second as usize]);
            pair(&first.keypoints, &second.keypoints, i, j, m.distance)
        }));
    }
    pairs
}

fn by_flow(first: &Corners, second: &Corners, rule: &FlowMatching) -> Vec<Pair> {
    let (Some(a), Some(b)) = (first.scales.first(), second.scales.first()) else { return Vec::new() };
    let pyramid = |image: &GreyImage| {
        let mut pyramid = Pyramid::new(FLOW_LEVELS);
        pyramid.build(image);
        pyramid
    };
    let corner = |k: &Keypoint| Corner { x: k.position.x as f32, y: k.position.y as f32, response: k.response };
    let corners: Vec<Corner> = first.keypoints.iter().map(corner).collect();
    let mut found = Vec::new();
    match_flow(&pyramid(&a.image), &pyramid(&b.image), &corners, rule, &mut found);
    found
        .iter()
        .map(|m| {
            let p = &first.keypoints[m.first as usize];
            Pair {
                a: p.position,
                b: m.position.cast::<f64>(),
                first: m.first as usize,
                second: None,
                distance: f64::from(m.distance),
                size_px: [1.0; 2],
            }
        })
        .collect()
}
