//! Which corner of one picture is which of the other.
//!
//! Input: the [`Corners`] of both pictures and [`Matching`]. Output: [`Pair`]s of positions (pixels of each picture), each
//! corner at most once, the likeliest first.
//! - Binary descriptors and histograms of gradients: mutual nearest, with a ratio test against what is elsewhere; in tilted views, too,
//!   where there are any.
//! - The study's attributes: grey level, salient degree and direction within a threshold each.
//! - Normalised cross-correlation of patches, over the whole picture; corners of the same scale with each other.
//! - Optical flow from the first picture's corners; the places need not be corners of the second.
//!
//! Places found by comparing corners are aligned to a fraction of a pixel where the patches look alike without being
//! turned ([`align_pairs`]), then all by an affine map, turned as the descriptors were ([`polish_pairs`]). Cost: 1.5 ns a pair of binary
//! descriptors, 20 ns of histograms, 50 ns of patches.
//!
//! Deliberately not here: geometry (`geometry::ransac`), matching guided by it ([`super::guided`]).

use nalgebra::{Matrix2, Rotation2, Vector2};

use super::detect::{Corners, Keypoint};
use super::polish::polish;
use crate::features::Corner;
use crate::features::alignment::{AlignOptions, PatchTemplate, align};
use crate::features::correlation::{CornerCorrelator, CorrelationMatching};
use crate::features::descriptor::Descriptor;
use crate::features::gradients::{GradientDescriptor, GradientMap, TurnedGradients};
use crate::features::matching::{
    AttributeMatching, Comparable, FlowMatching, Match, Place, PlaceMatching, SAME_CORNER_PX, match_attributes,
    match_flow, match_places,
};
use crate::image::{GreyImage, Pyramid};

/// Levels of halves that the flow descends through.
const FLOW_LEVELS: usize = 5;
/// An alignment counts when the patches are this much alike, and it moves the place by no more pixels of its scale.
const ALIGN_NCC: f32 = 0.85;
const ALIGN_PX: f32 = 1.5;
/// Pixels of one polishing by those of the next.
const POLISH_STEP: f64 = 1.7;

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

    /// Can it gain by tilted views? What is compared must know scale and direction.
    pub fn knows_tilt(self) -> bool {
        matches!(self, Self::Descriptors | Self::Gradients)
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
    /// Second picture's pixels by first picture's, around the place: as the descriptors were turned and their scales or views are, or as
    /// the patches were laid onto each other.
    pub map: Matrix2<f64>,
    /// Whether the patches could be laid onto each other.
    pub polished: bool,
}

impl Pair {
    /// A match that came from elsewhere, of the picture's own scale.
    pub fn given(index: usize, a: Vector2<f64>, b: Vector2<f64>) -> Self {
        Self {
            a,
            b,
            first: index,
            second: Some(index),
            distance: 0.0,
            size_px: [1.0; 2],
            map: Matrix2::identity(),
            polished: false,
        }
    }
}

/// What of the matching can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matching {
    pub matcher: Matcher,
    pub descriptors: PlaceMatching,
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
            descriptors: PlaceMatching { max_distance: 80.0, max_ratio: 0.8, noise: 8.0 },
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
        let size_px = pair.size_px[0].max(pair.size_px[1]);
        let (Some(from), Some(to)) = (first.nearest_scale(size_px), second.nearest_scale(size_px)) else { continue };
        let template = PatchTemplate::<16>::from_image(&from.image, from.local(&pair.a).cast::<f32>());
        let Some(template) = template else { continue };
        if let Some(found) = align(&template, &to.image, to.local(&pair.b).cast::<f32>(), &options)
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

/// Moves the second place of a pair to a small fraction of a pixel, by an affine map of its patch ([`polish`]) that starts from that of the
/// descriptors: in the pictures as the camera took them, from the scales at which the corner was found down to the finest at which the
/// patches are alike, always at such scales of both that the patches are equally large. A direction may be wrong by more than the polishing
/// can turn: then once more without one. Tells whether that was possible at all.
pub fn polish_pair(first: &Corners, second: &Corners, pair: &mut Pair) -> bool {
    let upright = Matrix2::identity() * pair.map.determinant().abs().sqrt();
    polish_from(first, second, pair) || {
        let turned = std::mem::replace(&mut pair.map, upright);
        let polished = polish_from(first, second, pair);
        if !polished {
            pair.map = turned;
        }
        polished
    }
}

/// [`polish_pair`] from the pair's own map on.
fn polish_from(first: &Corners, second: &Corners, pair: &mut Pair) -> bool {
    // Pixels of a scale of the second picture by one of the first that show as much.
    let ratio = |map: &Matrix2<f64>| map.determinant().abs().sqrt();
    let finest = |ratio: f64| [(1.0 / ratio).max(1.0), ratio.max(1.0)];
    let least = finest(ratio(&pair.map));
    let mut coarseness = (pair.size_px[0] / least[0]).max(pair.size_px[1] / least[1]).max(1.0);
    loop {
        let sizes = finest(ratio(&pair.map)).map(|px| px * coarseness);
        let (Some(a), Some(b)) = (first.nearest_scale(sizes[0]), second.nearest_scale(sizes[1])) else { break };
        let map = b.back() * pair.map * a.linear();
        let Some(found) = polish(&a.image, &b.image, &a.local(&pair.a), &b.local(&pair.b), &map) else { break };
        pair.b = b.base(&found.place);
        pair.map = b.linear() * found.map * a.back();
        pair.size_px = [a.size_px(), b.size_px()];
        pair.polished = true;
        if coarseness <= 1.0 {
            break;
        }
        coarseness = (coarseness / POLISH_STEP).max(1.0);
    }
    pair.polished
}

/// The pair of two keypoints whose patches were described under these directions, radians; alike in that their scales or views are.
pub fn pair_of(corners: [&Corners; 2], [i, j]: [usize; 2], distance: f64, turns_rad: [f32; 2]) -> Pair {
    let [first, second] = corners;
    let (p, q) = (&first.keypoints[i], &second.keypoints[j]);
    let turn = Rotation2::new(f64::from(turns_rad[1] - turns_rad[0]));
    let (from, to) = (first.scales.get(p.scale), second.scales.get(q.scale));
    let map = match (from, to) {
        (Some(from), Some(to)) => to.linear() * turn.matrix() * from.back(),
        _ => Matrix2::identity(),
    };
    let size_px = [p.size_px, q.size_px];
    Pair { a: p.position, b: q.position, first: i, second: Some(j), distance, size_px, map, polished: false }
}

/// What a picture's corners are compared by: each description with the keypoint that it is of, its direction, and where it was taken.
struct Described<D> {
    of: Vec<usize>,
    descriptors: Vec<D>,
    turns_rad: Vec<f32>,
    places: Vec<Place>,
    /// How many of them are of the picture as the camera took it: the first ones.
    plain: usize,
}

impl<D> Described<D> {
    fn new(corners: &Corners, each: impl Iterator<Item = (usize, D, f32)>) -> Self {
        let mut out =
            Self { of: Vec::new(), descriptors: Vec::new(), turns_rad: Vec::new(), places: Vec::new(), plain: 0 };
        for (i, descriptor, turn) in each {
            out.of.push(i);
            out.descriptors.push(descriptor);
            out.turns_rad.push(turn);
            out.places.push(place(&corners.keypoints[i]));
        }
        let plain = corners.plain_count();
        out.plain = out.of.partition_point(|i| *i < plain);
        out
    }

    fn slice(&self, plain_only: bool) -> (&[D], &[Place]) {
        let count = if plain_only { self.plain } else { self.of.len() };
        (&self.descriptors[..count], &self.places[..count])
    }
}

fn place(k: &Keypoint) -> Place {
    Place { at: k.position.cast::<f32>().into(), size_px: k.size_px as f32 }
}

fn by_descriptors(first: &Corners, second: &Corners, rule: &PlaceMatching) -> Vec<Pair> {
    let described = |corners: &Corners| {
        let each = corners.keypoints.iter().enumerate();
        let each = each.filter_map(|(i, k)| k.descriptor.map(|d| (i, d.descriptor, d.angle_rad)));
        Described::<Descriptor>::new(corners, each)
    };
    by_places([first, second], [described(first), described(second)], rule)
}

/// Histograms of gradients of each keypoint: none at the border, up to two for its directions.
pub fn gradients_of(corners: &Corners) -> Vec<Vec<TurnedGradients>> {
    let mut all = Vec::with_capacity(corners.keypoints.len());
    // A scale's corners follow each other, so one map at a time is enough.
    for of_scale in corners.keypoints.chunk_by(|a, b| a.scale == b.scale) {
        let Some(scale) = of_scale.first().and_then(|k| corners.scales.get(k.scale)) else {
            all.extend(of_scale.iter().map(|_| Vec::new()));
            continue;
        };
        let map = GradientMap::new(&scale.image);
        all.extend(of_scale.iter().map(|k| {
            let at = scale.local(&k.position).cast::<f32>();
            map.describe(at.x, at.y)
        }));
    }
    all
}

fn by_gradients(first: &Corners, second: &Corners, rule: &PlaceMatching) -> Vec<Pair> {
    let described = |corners: &Corners| {
        let all = gradients_of(corners);
        let each = all.iter().enumerate().flat_map(|(i, own)| own.iter().map(move |d| (i, d.descriptor, d.turn_rad)));
        Described::<GradientDescriptor>::new(corners, each)
    };
    by_places([first, second], [described(first), described(second)], rule)
}

/// Matches by descriptors of places: of what the camera took with each other, and with the other picture's tilted views, either way. The
/// nearest first: a corner, in however many views and scales it was found, keeps its best match.
fn by_places<D: Comparable>(
    corners: [&Corners; 2],
    [first, second]: [Described<D>; 2],
    rule: &PlaceMatching,
) -> Vec<Pair> {
    let tilted = [first.plain < first.of.len(), second.plain < second.of.len()];
    let mut found = match_places(first.slice(true), second.slice(false), rule);
    if tilted[0] {
        found.extend(match_places(first.slice(false), second.slice(true), rule));
        // Stable: of equally near ones the first.
        found.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    }
    let mut used = [vec![false; corners[0].keypoints.len()], vec![false; corners[1].keypoints.len()]];
    let mut kept: Vec<[Place; 2]> = Vec::new();
    let mut pairs = Vec::new();
    for m in found {
        let (p, q) = (m.first as usize, m.second as usize);
        let (i, j) = (first.of[p], second.of[q]);
        if used[0][i] || used[1][j] {
            continue;
        }
        let places = [first.places[p], second.places[q]];
        // One corner of the world is one witness, in however many views it was found.
        let again = |k: &[Place; 2]| (0..2).any(|side| k[side].is_within(&places[side], SAME_CORNER_PX));
        if (tilted[0] || tilted[1]) && kept.iter().any(again) {
            continue;
        }
        (used[0][i], used[1][j]) = (true, true);
        kept.push(places);
        pairs.push(pair_of(corners, [i, j], f64::from(m.distance), [first.turns_rad[p], second.turns_rad[q]]));
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
            pair_of([first, second], [i, j], f64::from(m.distance), [0.0; 2])
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
    let plain = |c: &Corners| c.scales.iter().take_while(|s| s.is_plain()).count();
    for scale in 0..plain(first).min(plain(second)) {
        let ((from_a, a), (from_b, b)) = (of_scale(first, scale), of_scale(second, scale));
        correlator.match_all((&first.scales[scale].image, &a), (&second.scales[scale].image, &b), &mut matches);
        pairs.extend(matches.iter().map(|m| {
            let (i, j) = (from_a[m.first as usize], from_b[m.second as usize]);
            pair_of([first, second], [i, j], f64::from(m.distance), [0.0; 2])
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
                map: Matrix2::identity(),
                polished: false,
            }
        })
        .collect()
}
