//! Optical flow as a matcher of two single pictures.
//!
//! Input: the pyramids of both pictures and the corners of the first. Output: [`PointMatch`]es: places in the second
//! picture, sub-pixel, that need not be corners there; ascending in the first index.
//! Each corner is followed by [`follow`](crate::features::optical_flow::follow): coarse to fine, and the way back must end
//! at the corner. It starts from the motion between blurred thumbnails of the two pictures, where these are alike. What is
//! lost there tries again from the motion of the nearest corners that were found, for a few rounds: so the matching grows
//! from where it is easy into where the motion differs from the whole picture's.
//! Measured (strongest 600 FAST corners): inliers of a robust F 98 % on frames 5 and 15 apart, 98 % on a rectified stereo pair
//! (92 % within 2 px of the truth); of graffiti's views 148 corners, 74 % right, against 11 and 27 % without thumbnail levels
//! and neighbours (coarsest level 2, no rounds).
//! Cost: about 3 us a corner and round. Two pictures of different sizes have no flow: nothing is matched.
//! It deliberately does not do: turns of more than about 20 degrees, changes of scale (the patches are not warped).

use nalgebra::Vector2;

use super::{PointGrid, PointMatch};
use crate::features::Corner;
use crate::features::alignment::Template;
use crate::features::optical_flow::{FlowOptions, Point, follow};
use crate::features::thumbnail::{ImageMotion, Thumbnail, ThumbnailAligner};
use crate::image::Pyramid;

/// Corners whose median motion a lost one tries.
const NEIGHBOURS: usize = 5;

/// They are looked for within this share of the picture's longer side.
const NEIGHBOURHOOD: f32 = 0.1;

/// When a followed corner counts, and how hard it is tried.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct FlowMatching {
    /// Pyramid level that the descent starts at; fewer where the pyramid ends before.
    pub coarsest_level: usize,
    /// Distance between the corner and where the way back ends, px.
    pub max_return_px: f32,
    /// Correlation of the two patches.
    pub min_ncc: f32,
    /// The thumbnails' motion is used when they are at least this much alike (NCC); above 1: never.
    pub min_thumbnail_ncc: f32,
    /// How often lost corners try the motion of their neighbours.
    pub rounds: usize,
}

impl Default for FlowMatching {
    fn default() -> Self {
        Self { coarsest_level: 5, max_return_px: 0.5, min_ncc: 0.8, min_thumbnail_ncc: 0.5, rounds: 3 }
    }
}

/// Follows `corners` of `first` into `second`. Clears `out`.
pub fn match_flow(
    first: &Pyramid,
    second: &Pyramid,
    corners: &[Corner],
    rule: &FlowMatching,
    out: &mut Vec<PointMatch>,
) {
    out.clear();
    if first.size() != second.size() || first.size().0 == 0 {
        return;
    }
    let motion = picture_motion(first, second).filter(|m| m.ncc >= rule.min_thumbnail_ncc);
    let options =
        FlowOptions { coarsest_level: rule.coarsest_level, max_return_px: rule.max_return_px, min_ncc: rule.min_ncc };
    let points: Vec<Vector2<f32>> = corners.iter().map(|c| Vector2::new(c.x, c.y)).collect();
    let mut found: Vec<Option<Vector2<f32>>> =
        points.iter().map(|&p| place_of(first, second, p, motion.map_or(p, |m| m.apply(p)), &options)).collect();
    for _ in 0..rule.rounds {
        if !try_neighbours(first, second, &points, &mut found, &options) {
            break;
        }
    }
    for (i, (point, place)) in points.iter().zip(&found).enumerate() {
        let Some(position) = *place else { continue };
        let ncc = Template::from_image(&first.levels[0], *point).and_then(|t| t.ncc(&second.levels[0], position));
        if let Some(ncc) = ncc {
            out.push(PointMatch { first: i as u32, position, distance: 1.0 - ncc });
        }
    }
}

/// Motion of the whole picture; `None` where the thumbnails are nothing alike.
fn picture_motion(first: &Pyramid, second: &Pyramid) -> Option<ImageMotion> {
    let (mut a, mut b) = (Thumbnail::default(), Thumbnail::default());
    (a.build(first) && b.build(second)).then(|| ThumbnailAligner::default().align(&a, &b))?
}

/// One round for the lost corners, from what the rounds before found. Whether it found any.
fn try_neighbours(
    first: &Pyramid,
    second: &Pyramid,
    points: &[Vector2<f32>],
    found: &mut [Option<Vector2<f32>>],
    options: &FlowOptions,
) -> bool {
    let (width, height) = first.size();
    let radius_px = NEIGHBOURHOOD * width.max(height) as f32;
    // Only found corners are neighbours: the others' positions are not numbers, which a grid never finds.
    let known: Vec<[f32; 2]> =
        points.iter().zip(&*found).map(|(p, f)| if f.is_some() { [p.x, p.y] } else { [f32::NAN; 2] }).collect();
    let before = found.to_vec();
    let (mut grid, mut near) = (PointGrid::default(), Vec::new());
    grid.fill(&known, radius_px);
    // The last descent starts one level finer: neighbours tell the place well.
    let options = FlowOptions { coarsest_level: options.coarsest_level.saturating_sub(2), ..*options };
    let mut any = false;
    for (i, &point) in points.iter().enumerate().filter(|(i, _)| before[*i].is_none()) {
        grid.within([point.x, point.y], radius_px, &mut near);
        near.sort_by(|&a, &b| {
            let distance = |k: u32| (points[k as usize] - point).norm_squared();
            distance(a).total_cmp(&distance(b))
        });
        near.truncate(NEIGHBOURS);
        let motions = near.iter().filter_map(|&k| Some(before[k as usize]? - points[k as usize]));
        if let Some(motion) = median(motions) {
            found[i] = place_of(first, second, point, point + motion, &options);
            any |= found[i].is_some();
        }
    }
    any
}

/// Where a pixel of the first picture is in the second.
fn place_of(
    first: &Pyramid,
    second: &Pyramid,
    pixel: Vector2<f32>,
    guess: Vector2<f32>,
    options: &FlowOptions,
) -> Option<Vector2<f32>> {
    Some(follow(first, second, &Point::at(first, pixel)?, guess, options)?.place)
}

/// Median of each component; `None` of nothing.
fn median(motions: impl Iterator<Item = Vector2<f32>>) -> Option<Vector2<f32>> {
    let (mut x, mut y): (Vec<f32>, Vec<f32>) = motions.map(|m| (m.x, m.y)).unzip();
    x.sort_by(f32::total_cmp);
    y.sort_by(f32::total_cmp);
    Some(Vector2::new(*x.get(x.len() / 2)?, *y.get(y.len() / 2)?))
}

#[cfg(test)]
mod tests;
