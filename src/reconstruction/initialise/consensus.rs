//! Does a new map explain most of the picture? Something large that moves past has the most corners where it is, and two views of
//! it are as good a start as two views of the world; but the world fills more of the picture.
//!
//! In: the views of a start with their poses, and where each saw its tracks. Out: the share of the picture's cells (those with
//! tracks that can tell) in which most tracks agree with the views' motion.
//!
//! A track agrees when it lies within 3 px of the epipolar line of the earliest view that saw it, and meets its ray in
//! front of both cameras. One that a rotation alone explains says nothing. Cost: some 0.05 ms, once a start; in
//! the second after it, with more views, what [`probation`](super::probation) says. Not here: what moves slower than that, or fills more of the picture
//! than the world; a lens that is a guess, whose own error bends the picture.

use std::f64::consts::SQRT_2;

use nalgebra::Vector2;

use super::views::PendingFrame;
use crate::geometry::epipolar::sampson_squared;
use crate::geometry::essential::essential_of;
use crate::geometry::frames::{Camera, World};
use crate::geometry::triangulation::intersect;
use crate::geometry::{CameraModel, Se3};

/// Share of the picture that must agree with a map's motion; not more, as something may cover a part of it for good.
pub const AGREEING_SHARE: f64 = 0.7;
/// How often more the picture must disagree than agree to be believed, at the most.
pub const MAX_DISAGREEMENTS: u32 = 5;
/// Cells across the picture; as many rows as make them about square.
const COLUMNS: usize = 10;
/// Sampson distance of a track that agrees, px. Tracks drift over a start's frames, and a rolling shutter bends.
const AGREEING_PX: f64 = 3.0;

/// A view: its tracks and its pose.
pub type PosedView = (PendingFrame, Se3<Camera, World>);

/// What the picture says, by its cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Agreement {
    /// Of the cells with telling tracks, those in which most agree (0 to 1).
    pub share: f64,
    /// Of the cells with tracks that an earlier view saw, those with telling ones.
    pub telling: f64,
}

/// Whether the picture of the last view agrees with the motion of all, which are in order of time. `None` when no track can tell.
pub fn agreement(views: &[PosedView], camera: &CameraModel) -> Option<Agreement> {
    let (newest, earlier) = views.split_last()?;
    let rows = (COLUMNS * camera.height as usize).div_ceil((camera.width as usize).max(1)).max(1);
    let cell = |p: &Vector2<f32>| {
        let (x, y) = (p.x / camera.width as f32 * COLUMNS as f32, p.y / camera.height as f32 * rows as f32);
        (y as usize).min(rows - 1) * COLUMNS + (x as usize).min(COLUMNS - 1)
    };
    // Agreeing less dissenting tracks, how many there are, and with those that do not tell.
    let mut cells = vec![(0i32, 0u32, 0u32); rows * COLUMNS];
    for (track, pixel) in &newest.0.tracks {
        let first = earlier.iter().find_map(|(frame, pose)| Some((frame.track(*track)?, pose)));
        let Some((first_pixel, first_pose)) = first else { continue };
        let (balance, count, all) = &mut cells[cell(pixel)];
        *all += 1;
        let Some(agrees) = agrees(&(first_pixel, first_pose), &(*pixel, &newest.1), camera) else {
            continue;
        };
        *balance += if agrees { 1 } else { -1 };
        *count += 1;
    }
    let telling = cells.iter().filter(|c| c.1 > 0).count();
    let agreeing = cells.iter().filter(|c| c.1 > 0 && c.0 > 0).count() as f64;
    let even = cells.iter().filter(|c| c.1 > 0 && c.0 == 0).count() as f64;
    let seen = cells.iter().filter(|c| c.2 > 0).count() as f64;
    (telling > 0).then(|| Agreement { share: (agreeing + 0.5 * even) / telling as f64, telling: telling as f64 / seen })
}

/// Does a track that was seen at two places agree with the cameras' motion? `None` when it cannot tell.
fn agrees(
    (first_pixel, first_pose): &(Vector2<f32>, &Se3<Camera, World>),
    (second_pixel, second_pose): &(Vector2<f32>, &Se3<Camera, World>),
    camera: &CameraModel,
) -> Option<bool> {
    let (x1, x2) = (camera.undistort(&first_pixel.cast())?, camera.undistort(&second_pixel.cast())?);
    let motion = **second_pose * first_pose.inverse();
    let turned = motion.rotation * x1.push(1.0);
    if !(turned.z > 1e-3) {
        return None;
    }
    // A step across the epipolar line counts in both pictures: shorter than this it agrees in any direction.
    if camera.pixels(&x2, &(x2 - turned.xy() / turned.z)) < SQRT_2 * AGREEING_PX {
        return None;
    }
    let distance = sampson_squared(&essential_of(&motion), &x1, &x2).sqrt() * camera.focal_px();
    let in_front = intersect(&motion, &x1, &x2).is_some_and(|met| met.depth1 > 0.0 && met.depth2 > 0.0);
    Some(distance <= AGREEING_PX && in_front)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use nalgebra::Vector3;

    pub fn camera() -> CameraModel {
        CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).unwrap()
    }

    /// A camera that goes to the right before a wall of depth, whose left `share` moves down at the same time; 30 pictures a second.
    pub fn views(count: usize, step: f64, share: f64) -> Vec<PosedView> {
        let camera = camera();
        let view = |n: usize| {
            let (go, fall) = (step * n as f64, 1.5 * step * n as f64);
            let pose = Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::new(-go, 0.0, 0.0));
            let mut tracks = Vec::new();
            for i in 0..30 {
                for j in 0..24 {
                    let depth = 2.0 + f64::from((i * 5 + j * 3) % 7) * 0.3;
                    let ray = Vector3::new((f64::from(i) - 14.5) * 0.04, (f64::from(j) - 11.5) * 0.035, 1.0);
                    let falls = if f64::from(i) < 30.0 * share { fall } else { 0.0 };
                    let p = pose.transform(&(ray * depth + Vector3::y() * falls));
                    tracks.extend(camera.project(&p).map(|pixel| ((i * 24 + j) as u64, pixel.cast())));
                }
            }
            (PendingFrame { sequence: n as u64, timestamp_ns: n as i64 * 33_333_333, tracks }, pose)
        };
        (0..count).map(view).collect()
    }

    fn share(step: f64, moving: f64) -> Option<f64> {
        let views = views(2, step, moving);
        agreement(&views, &camera()).map(|told| told.share)
    }

    #[test]
    fn the_world_agrees_and_what_moves_alone_does_not() {
        assert_eq!(share(0.1, 0.0), Some(1.0));
        assert_eq!(agreement(&views(2, 0.1, 0.0), &camera()).map(|told| told.telling), Some(1.0));
        let third = share(0.1, 0.3).unwrap();
        assert!((third - 0.7).abs() < 0.08, "{third}");
        let half = share(0.1, 0.5).unwrap();
        assert!(half < AGREEING_SHARE, "{half}: no start");
    }

    #[test]
    fn a_camera_that_stands_is_told_nothing() {
        assert_eq!(share(0.0, 0.0), None);
        assert_eq!(agreement(&[], &camera()), None);
    }
}
