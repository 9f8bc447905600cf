//! The corners of one picture, with what is kept of each.
//!
//! Input: a grey picture and [`Detection`] (detector, number of scales, most corners). Output: [`Corners`]: positions in
//! the picture's pixels, attributes (grey level, salient degree, direction) and a binary descriptor of each.
//! - Detectors: FAST-9; SUSAN with the 37-pixel mask, its default figures or the study's; SUSAN's two passes with 41x41.
//! - A cell of the picture that has no corner at the usual threshold is searched again at half of it (not with the
//!   study's figures, which are kept as they are).
//! - The strongest are kept, spread over the cells, with a share of each scale; then moved to sub-pixel places where the
//!   gradients of the surroundings meet (Förstner & Gülch, 1987).
//!
//! Cost: 10 to 60 ms for 640x480 at eight scales, 41x41 several times that.
//!
//! Deliberately not here: tracking from frame to frame (`features::stage`), matching.

use nalgebra::{Matrix2, Vector2};

use super::scales::{Scale, scales, tilted};
use crate::features::attributes::{Attributes, attributes};
use crate::features::descriptor::{Description, Orientation, describe};
use crate::features::fast::FastDetector;
use crate::features::gradients::BORDER as GRADIENT_BORDER;
use crate::features::susan::{Similarity, SusanConfig, SusanDetector, SusanResponse};
use crate::features::susan_large::{LargeSusanConfig, LargeSusanDetector};
use crate::features::{CellGrid, Corner, CornerDetector};
use crate::image::GreyImage;

/// Side of a cell in which corners compete, pixels of a scale.
const CELL_PX: usize = 32;
/// Half the window that a corner is refined in, pixels of a scale.
const REFINE_RADIUS: i32 = 3;
/// A refined corner farther than this from where it was found is left there, pixels of a scale.
const MAX_REFINE_PX: f64 = 2.5;
/// The window moves along with the corner so often.
const REFINE_ROUNDS: usize = 3;

/// Which corner detector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Detector {
    /// FAST-9: segment test on a ring of 16 pixels
    Fast,
    /// SUSAN, 37-pixel mask, the figures that repeat best
    Susan,
    /// SUSAN, 37-pixel mask, the study's figures: t = 90, g = 0.4, hard step
    SusanStudy,
    /// SUSAN, 41x41 mask where the 37-pixel mask answered: the study's two passes
    #[value(name = "susan-41")]
    #[serde(rename = "susan-41")]
    Susan41,
}

impl Detector {
    pub const ALL: [Self; 4] = [Self::Fast, Self::Susan, Self::SusanStudy, Self::Susan41];

    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Susan => "susan",
            Self::SusanStudy => "susan-study",
            Self::Susan41 => "susan-41",
        }
    }

    /// Brightness threshold, grey levels, and the one for cells that stay empty.
    fn thresholds(self) -> (u8, Option<u8>) {
        match self {
            Self::Fast => (20, Some(7)),
            Self::Susan | Self::Susan41 => (SusanConfig::DEFAULT_T, Some(SusanConfig::DEFAULT_T / 2)),
            Self::SusanStudy => (SusanConfig::STUDY_T, None),
        }
    }

    /// The similarity that a corner's attributes are measured with.
    fn similarity(self) -> Similarity {
        match self {
            Self::SusanStudy => Similarity::new(SusanResponse::Step, SusanConfig::STUDY_T),
            _ => Similarity::new(SusanResponse::Exponential, SusanConfig::DEFAULT_T),
        }
    }

    fn make(self) -> Box<dyn CornerDetector> {
        // The presets are within their ranges (a test makes each).
        let fallback = || Box::new(FastDetector::new()) as Box<dyn CornerDetector>;
        let susan = |config| SusanDetector::new(config).map(|d| Box::new(d) as Box<dyn CornerDetector>).ok();
        match self {
            Self::Fast => fallback(),
            Self::Susan => susan(SusanConfig::default()).unwrap_or_else(fallback),
            Self::SusanStudy => susan(SusanConfig::study()).unwrap_or_else(fallback),
            Self::Susan41 => LargeSusanDetector::new(LargeSusanConfig::default())
                .map(|d| Box::new(d) as Box<dyn CornerDetector>)
                .unwrap_or_else(|_| fallback()),
        }
    }
}

/// How corners are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Detection {
    pub detector: Detector,
    /// Scales searched, 1 to 16: 1 is the picture alone.
    pub scales: usize,
    /// Most corners that are kept.
    pub max_corners: usize,
}

/// A corner and what is kept of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Keypoint {
    /// Pixels of the picture.
    pub position: Vector2<f64>,
    /// Scale or tilted view that it was found in, 0 = the picture itself.
    pub scale: usize,
    /// Pixels of the picture a pixel of that scale: what its position is uncertain by.
    pub size_px: f64,
    /// The detector's strength.
    pub response: f32,
    /// `None` where the mask leaves the picture.
    pub attributes: Option<Attributes>,
    /// `None` near the edge.
    pub descriptor: Option<Description>,
}

/// The corners of one picture.
#[derive(Debug, Clone, Default)]
pub struct Corners {
    pub keypoints: Vec<Keypoint>,
    /// Corners found in the picture's own scales, before the strongest were taken.
    pub found: usize,
    /// The picture's own first, then those of tilted views.
    pub scales: Vec<Scale>,
}

impl Corners {
    /// How many of the keypoints are of the picture as the camera took it: the first ones.
    pub fn plain_count(&self) -> usize {
        self.keypoints.partition_point(|k| self.scales.get(k.scale).is_none_or(Scale::is_plain))
    }

    /// The picture's own scale whose pixels are nearest to this size, pixels of the picture.
    pub fn nearest_scale(&self, size_px: f64) -> Option<&Scale> {
        let far = |s: &Scale| (s.size_px() / size_px).ln().abs();
        self.scales.iter().filter(|s| s.is_plain()).min_by(|a, b| far(a).total_cmp(&far(b)))
    }
}

/// Finds and describes the corners of a picture.
pub fn detect(picture: &GreyImage, options: &Detection) -> Corners {
    let mut corners = Corners::default();
    add(&mut corners, scales(picture, options.scales.max(1)), options.max_corners, options);
    corners
}

/// Adds those of the picture as it were seen at slants ([`tilted`]): of each view fewer the more it is squeezed.
pub fn add_tilted(corners: &mut Corners, picture: &GreyImage, options: &Detection) {
    for view in tilted(picture, options.scales.max(1)) {
        let tilt = view.first().map_or(1.0, |scale| scale.tilt);
        add(corners, view, (options.max_corners as f64 / tilt).round() as usize, options);
    }
}

/// Finds and describes the corners of a picture's or a view's scales, at most `count` of them.
fn add(corners: &mut Corners, scales: Vec<Scale>, count: usize, options: &Detection) {
    let similarity = options.detector.similarity();
    let mut detector = options.detector.make();
    // A share of the corners by the side of the scale, as their number goes.
    let weights: Vec<f64> = scales.iter().map(|s| 1.0 / s.size_px()).collect();
    let total: f64 = weights.iter().sum();
    let size = corners.scales.first().or(scales.first()).map(|s| (s.image.width, s.image.height));
    let Some(size) = size else { return };
    for (scale, weight) in scales.into_iter().zip(weights) {
        let mut found = search(detector.as_mut(), &scale.image, options.detector.thresholds());
        found.retain(|c| scale.is_plain() || shows_the_picture(&scale, c, size));
        if scale.is_plain() {
            corners.found += found.len();
        }
        let share = (count as f64 * weight / total).round() as usize;
        for corner in strongest(found, &scale.image, share) {
            let at = Vector2::new(f64::from(corner.x), f64::from(corner.y));
            let at = refine(&scale.image, at).unwrap_or(at);
            corners.keypoints.push(Keypoint {
                position: scale.base(&at),
                scale: corners.scales.len(),
                size_px: scale.size_px(),
                response: corner.response,
                attributes: attributes(&scale.image, &corner, &similarity),
                descriptor: describe(&scale.image, corner.x, corner.y, Orientation::IntensityCentroid),
            });
        }
        corners.scales.push(scale);
    }
}

/// A tilted view is a parallelogram in a rectangle: is what a corner is described by of the picture, of this `size`, and not of the rest?
fn shows_the_picture(view: &Scale, corner: &Corner, (width, height): (usize, usize)) -> bool {
    let at = Vector2::new(f64::from(corner.x), f64::from(corner.y));
    let reach = GRADIENT_BORDER as f64;
    [(-reach, 0.0), (reach, 0.0), (0.0, -reach), (0.0, reach)].into_iter().all(|(dx, dy)| {
        let p = view.base(&(at + Vector2::new(dx, dy)));
        p.x >= 0.0 && p.y >= 0.0 && p.x <= width as f64 - 1.0 && p.y <= height as f64 - 1.0
    })
}

/// All corners at the usual threshold, and those of empty cells at the lower one; raster order in each part.
fn search(detector: &mut dyn CornerDetector, image: &GreyImage, (usual, lower): (u8, Option<u8>)) -> Vec<Corner> {
    let mut cells = CellGrid::new(image.width, image.height, CELL_PX, f32::from(usual));
    let mut found = Vec::new();
    detector.detect(image, &cells, &mut found);
    let Some(lower) = lower else { return found };
    for cell in &mut cells.cells {
        cell.threshold = f32::from(lower);
    }
    for corner in &found {
        if let Some(index) = cells.index(corner.x, corner.y) {
            cells.cells[index].wanted = false;
        }
    }
    let mut more = Vec::new();
    detector.detect(image, &cells, &mut more);
    found.append(&mut more);
    found
}

/// At most `count` corners: the strongest of each cell, then the second strongest of each, and so on.
fn strongest(corners: Vec<Corner>, image: &GreyImage, count: usize) -> Vec<Corner> {
    if corners.len() <= count {
        return corners;
    }
    let grid = CellGrid::new(image.width, image.height, CELL_PX, 0.0);
    let mut cells: Vec<Vec<Corner>> = vec![Vec::new(); grid.cells.len()];
    for corner in corners {
        if let Some(cell) = grid.index(corner.x, corner.y).and_then(|i| cells.get_mut(i)) {
            cell.push(corner);
        }
    }
    let mut ranked: Vec<(usize, Corner)> = Vec::new();
    for cell in &mut cells {
        // Stable: of equals the first in raster order stays first.
        cell.sort_by(|a, b| b.response.total_cmp(&a.response));
        ranked.extend(cell.iter().copied().enumerate());
    }
    ranked.sort_by(|(i, a), (j, b)| i.cmp(j).then(b.response.total_cmp(&a.response)));
    ranked.truncate(count);
    let mut kept: Vec<Corner> = ranked.into_iter().map(|(_, corner)| corner).collect();
    kept.sort_by(|a, b| a.y.total_cmp(&b.y).then(a.x.total_cmp(&b.x)));
    kept
}

/// Moves a corner to where the gradients' lines around it meet; `None` where they do not, or too far away.
fn refine(image: &GreyImage, start: Vector2<f64>) -> Option<Vector2<f64>> {
    let mut at = start;
    for _ in 0..REFINE_ROUNDS {
        let next = meeting_point(image, at)?;
        if !((next - start).norm() <= MAX_REFINE_PX) {
            return None;
        }
        let moved = next.map(f64::round) != at.map(f64::round);
        at = next;
        if !moved {
            break;
        }
    }
    Some(at)
}

/// The point that the gradients' lines around a pixel pass nearest to: `sum w g gᵀ (x - p) = 0`. `None` where they do not
/// meet (an edge), or too near the picture's border.
fn meeting_point(image: &GreyImage, start: Vector2<f64>) -> Option<Vector2<f64>> {
    let (cx, cy) = (start.x.round() as i32, start.y.round() as i32);
    let reach = REFINE_RADIUS + 1;
    if cx < reach || cy < reach || cx + reach >= image.width as i32 || cy + reach >= image.height as i32 {
        return None;
    }
    let grey = |x: i32, y: i32| f64::from(image.at(x as usize, y as usize));
    let (mut tensor, mut moment) = (Matrix2::zeros(), Vector2::zeros());
    for dy in -REFINE_RADIUS..=REFINE_RADIUS {
        for dx in -REFINE_RADIUS..=REFINE_RADIUS {
            let (x, y) = (cx + dx, cy + dy);
            let g = Vector2::new(grey(x + 1, y) - grey(x - 1, y), grey(x, y + 1) - grey(x, y - 1)) * 0.5;
            let weight = (-f64::from(dx * dx + dy * dy) / f64::from(REFINE_RADIUS * REFINE_RADIUS)).exp();
            let outer = g * g.transpose() * weight;
            tensor += outer;
            moment += outer * Vector2::new(f64::from(dx), f64::from(dy));
        }
    }
    let (determinant, trace) = (tensor.determinant(), tensor.trace());
    // The smaller eigenvalue at least a twentieth of the larger one.
    if !(determinant > 0.045 * trace * trace) {
        return None;
    }
    Some(Vector2::new(f64::from(cx), f64::from(cy)) + tensor.try_inverse()? * moment)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Dark squares with known sub-pixel corners on a light ground.
    fn squares(width: usize, height: usize) -> (GreyImage, Vec<Vector2<f64>>) {
        let mut image = GreyImage::new(width, height);
        image.data.fill(200);
        let mut corners = Vec::new();
        for (left, top) in [(40.3, 50.7), (150.6, 60.2), (80.9, 150.4), (220.5, 140.1)] {
            let side = 40.0;
            for dy in [0.0, side] {
                for dx in [0.0, side] {
                    // The square's edge is between pixel centres.
                    corners.push(Vector2::new(left + dx, top + dy));
                }
            }
            let cover = |i: usize, low: f64| {
                let i = i as f64;
                ((i + 0.5).min(low + side) - (i - 0.5).max(low)).clamp(0.0, 1.0)
            };
            for y in 0..height {
                for x in 0..width {
                    let share = cover(x, left) * cover(y, top);
                    let pixel = &mut image.data[y * width + x];
                    *pixel = (f64::from(*pixel) * (1.0 - share) + 40.0 * share).round() as u8;
                }
            }
        }
        (image, corners)
    }

    #[test]
    fn every_detector_finds_the_corners_of_squares_once_and_to_sub_pixels() {
        let (image, truth) = squares(320, 240);
        for detector in Detector::ALL {
            let found = detect(&image, &Detection { detector, scales: 1, max_corners: 200 });
            let nearest = |corner: &Vector2<f64>| {
                let distances = found.keypoints.iter().map(|k| (k.position - corner).norm());
                distances.fold(f64::INFINITY, f64::min)
            };
            let hits = truth.iter().filter(|c| nearest(c) < 0.7).count();
            // The study's hard step at t = 90 does not answer where half covered pixels round a corner off.
            let least = if detector == Detector::SusanStudy { 10 } else { truth.len() };
            assert!(hits >= least, "{}: {hits} of {}", detector.name(), truth.len());
        }
    }

    #[test]
    fn a_black_picture_has_no_corners_and_a_tiny_one_is_no_panic() {
        for detector in Detector::ALL {
            for (width, height) in [(320, 240), (1, 1), (7, 3), (30, 300)] {
                let found =
                    detect(&GreyImage::new(width, height), &Detection { detector, scales: 8, max_corners: 100 });
                assert!(found.keypoints.is_empty());
            }
        }
    }

    #[test]
    fn the_strongest_are_spread_over_the_picture() {
        let image = GreyImage::new(320, 320);
        let corners: Vec<Corner> = (0..1000)
            .map(|i| Corner { x: (i % 100) as f32 * 3.0, y: (i / 100) as f32 * 30.0, response: (i % 7) as f32 })
            .collect();
        let kept = strongest(corners, &image, 100);
        assert_eq!(kept.len(), 100);
        assert!(kept.iter().any(|c| c.x < 32.0 && c.y < 32.0) && kept.iter().any(|c| c.x > 280.0 && c.y > 250.0));
    }
}
