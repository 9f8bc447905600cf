//! The pictures of `cairn twoview`: corners, matches, epipolar lines, and the scene.
//!
//! `corners_a.png`, `corners_b.png`: corners in red with their directions. `attributes.png`: what is kept of each. `matches.png`: matches in
//! green, those that are no inliers thin. `epipolar.png`: some inliers and the lines of their partners. `motions.png`: the four motions of
//! E with the points of each. `distances.png`: the points in the first picture, by how far they are. `scene.png`: points blue, cameras red.

use std::path::Path;

use nalgebra::{Matrix3x4, Vector2, Vector3};

use crate::features::attributes::Direction;
use crate::geometry::CameraModel;
use crate::geometry::triangulation::{euclidean, triangulate};
use crate::plot::{
    AttributeMark, CornerMark, EpipolarMark, Link, MarkDirection, MotionPanel, PlotError, SpaceCamera, points_along,
    write_attributes, write_corners, write_distances, write_epipolar_lines, write_links, write_motions, write_space,
};
use crate::workbench::detect::{Corners, Keypoint};
use crate::workbench::pose::{CANDIDATES, FourMotions};
use crate::workbench::{Cameras, Picture, TwoView};

/// Matches whose epipolar lines are drawn.
const LINES: usize = 21;
/// Points of a line, which a lens bends.
const POINTS_OF_A_LINE: usize = 80;

/// Draws everything that there is to draw.
pub fn write(
    folder: &Path,
    result: &TwoView,
    pictures: [&Picture; 2],
    cameras: Option<&Cameras>,
) -> Result<(), PlotError> {
    for (k, file) in ["corners_a.png", "corners_b.png"].into_iter().enumerate() {
        let marks = corner_marks(&result.corners[k]);
        let heading = format!("{}: {} corners", pictures[k].name(), marks.len());
        write_corners(&folder.join(file), &pictures[k].grey, &marks, &heading)?;
    }
    let kept = [0, 1].map(|k| attribute_marks(&result.corners[k]));
    if kept.iter().any(|marks| !marks.is_empty()) {
        let both = pictures.map(|p| &p.grey);
        write_attributes(&folder.join("attributes.png"), both, [&kept[0], &kept[1]], "salient degree and direction")?;
    }
    let inliers = result.inliers();
    let both = pictures.map(|p| &p.grey);
    let links: Vec<Link> =
        result.pairs.iter().zip(&inliers).map(|(p, i)| Link { a: p.a, b: p.b, inlier: *i }).collect();
    let count = inliers.iter().filter(|i| **i).count();
    let heading = format!("{} matches, {count} inliers (green)", links.len());
    write_links(&folder.join("matches.png"), both, &links, &heading)?;
    if let Some(f) = result.fundamental() {
        let marks: Vec<EpipolarMark> = spread(result, &inliers)
            .into_iter()
            .map(|i| {
                let [a, b] = &result.ideal[i];
                EpipolarMark {
                    a: result.pairs[i].a,
                    b: result.pairs[i].b,
                    line_in_a: line(&f.tr_mul(&b.push(1.0)), pictures[0], cameras.map(|c| &c.a)),
                    line_in_b: line(&(f * a.push(1.0)), pictures[1], cameras.map(|c| &c.b)),
                }
            })
            .collect();
        let heading =
            format!("epipolar lines of {} inliers, median distance {:.2} px", marks.len(), result.median_px());
        write_epipolar_lines(&folder.join("epipolar.png"), both, &marks, &heading)?;
    }
    if let (Some(four), Some(cameras)) = (result.pose.as_ref().and_then(|p| p.four_motions()), cameras) {
        let heading = "the four motions of E, from above: points before both cameras are blue";
        write_motions(&folder.join("motions.png"), &motion_panels(result, four, cameras, &inliers), heading)?;
    }
    if let (Some(solution), Some(cameras)) = (result.pose.as_ref().and_then(|p| p.solution.as_ref()), cameras) {
        let points: Vec<Vector3<f64>> = solution.points.iter().flatten().copied().collect();
        let first_from_second = solution.second_from_first.inverse();
        let views = [
            space_camera("A", &cameras.a, Vector3::zeros(), |d| d),
            space_camera("B", &cameras.b, first_from_second.translation, |d| first_from_second.rotation * d),
        ];
        let facts = format!(
            "cameras A and B 1 baseline apart, turned by {:.2}°; adjusted to {:.2} px",
            solution.second_from_first.rotation.angle().to_degrees(),
            solution.adjusted.rms_after_px
        );
        let far: Vec<_> =
            result.pairs.iter().zip(&solution.points).filter_map(|(pair, p)| Some((pair.a, (*p)?.norm()))).collect();
        let heading = format!("{}: {} points by their distance", pictures[0].name(), far.len());
        write_distances(&folder.join("distances.png"), &pictures[0].grey, &far, "baselines", &heading)?;
        let heading = format!("{} and {}", pictures[0].name(), pictures[1].name());
        write_space(&folder.join("scene.png"), &points, &views, "baselines", &heading, &facts)?;
    }
    Ok(())
}

fn corner_marks(corners: &Corners) -> Vec<CornerMark> {
    corners.keypoints[..corners.plain_count()]
        .iter()
        .map(|k| CornerMark { at: k.position, radius_px: 3.0 * k.size_px, direction: direction(k) })
        .collect()
}

fn attribute_marks(corners: &Corners) -> Vec<AttributeMark> {
    corners.keypoints[..corners.plain_count()]
        .iter()
        .filter_map(|k| {
            let salient_degree = f64::from(k.attributes?.salient_degree);
            Some(AttributeMark { at: k.position, salient_degree, direction: direction(k) })
        })
        .collect()
}

fn direction(keypoint: &Keypoint) -> Option<MarkDirection> {
    match keypoint.attributes?.direction {
        Direction::Towards(angle) => Some(MarkDirection::Towards(f64::from(angle))),
        Direction::Axis(angle) => Some(MarkDirection::Axis(f64::from(angle))),
        Direction::Undefined => None,
    }
}

/// The inliers' points by each of the four motions.
fn motion_panels(result: &TwoView, four: &FourMotions, cameras: &Cameras, inliers: &[bool]) -> [MotionPanel; 4] {
    let normalised = |camera: &CameraModel, p: &Vector2<f64>| {
        Vector2::new((p.x - camera.cx) / camera.fx, (p.y - camera.cy) / camera.fy)
    };
    [0, 1, 2, 3].map(|k| {
        let motion = &four.candidates[k];
        let views = [Matrix3x4::identity(), motion.matrix()];
        let points = result.ideal.iter().zip(inliers).filter(|(_, inlier)| **inlier).filter_map(|([a, b], _)| {
            let seen = [normalised(&cameras.a, a), normalised(&cameras.b, b)];
            let point = euclidean(&triangulate(&views, &seen)?)?;
            let there = motion.rotation * point + motion.translation;
            Some((point, point.z > 0.0 && there.z > 0.0))
        });
        let first_from_second = motion.inverse();
        MotionPanel {
            name: CANDIDATES[k].into(),
            facts: format!("{} of {} votes", four.votes[k], four.inliers),
            is_chosen: k == four.winner(),
            points: points.collect(),
            cameras: [
                space_camera("A", &cameras.a, Vector3::zeros(), |d| d),
                space_camera("B", &cameras.b, first_from_second.translation, |d| first_from_second.rotation * d),
            ],
        }
    })
}

/// Inliers far from each other in the first picture: each the farthest from those before it.
fn spread(result: &TwoView, inliers: &[bool]) -> Vec<usize> {
    let candidates: Vec<usize> = (0..inliers.len()).filter(|i| inliers[*i]).collect();
    let at = |i: usize| result.pairs[i].a;
    let Some(first) = candidates.first() else { return Vec::new() };
    let mut chosen = vec![*first];
    let mut distance: Vec<f64> = candidates.iter().map(|i| (at(*i) - at(*first)).norm()).collect();
    while chosen.len() < LINES.min(candidates.len()) {
        let Some(k) = (0..candidates.len()).max_by(|a, b| distance[*a].total_cmp(&distance[*b])) else { break };
        chosen.push(candidates[k]);
        for (d, i) in distance.iter_mut().zip(&candidates) {
            *d = d.min((at(*i) - at(candidates[k])).norm());
        }
    }
    chosen
}

/// A line of undistorted pixels as it appears in the picture.
fn line(line: &Vector3<f64>, picture: &Picture, camera: Option<&CameraModel>) -> Vec<Vector2<f64>> {
    let size = Vector2::new(picture.grey.width as f64, picture.grey.height as f64);
    let half = Vector2::new(0.5, 0.5);
    let Some(camera) = camera else { return points_along(line, -half, size - half, 2) };
    // A lens may pull in what lies beyond the border without it.
    let straight = points_along(line, -size, size * 2.0, 3 * POINTS_OF_A_LINE);
    let bent =
        |p: &Vector2<f64>| camera.distort(&Vector2::new((p.x - camera.cx) / camera.fx, (p.y - camera.cy) / camera.fy));
    straight.iter().filter_map(bent).collect()
}

/// A camera's centre and the directions of its picture's corners, turned into the scene's axes.
fn space_camera(
    name: &str,
    camera: &CameraModel,
    centre: Vector3<f64>,
    turn: impl Fn(Vector3<f64>) -> Vector3<f64>,
) -> SpaceCamera {
    let (w, h) = (f64::from(camera.width) - 1.0, f64::from(camera.height) - 1.0);
    let wide = |x: f64, y: f64| camera.undistort(&Vector2::new(x, y)).filter(|_| camera.lens.is_wide_angle());
    let corners = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)].map(|(x, y)| {
        let pinhole = Vector2::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy);
        turn(wide(x, y).unwrap_or(pinhole).push(1.0))
    });
    SpaceCamera { name: name.into(), centre, corners }
}
