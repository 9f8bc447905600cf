//! How long a tag's edge is in map units, from several keyframes that see it.
//!
//! Keyframes' poses (held) and the tag's four corners in each, undistorted on z = 1 -> place, orientation and edge length of the
//! tag, a square: a similarity of seven numbers by least squares on reprojection errors; ln(edge length) and its variance, or why there is none. One
//! view says nothing of the length; the angle between the views does.
//!
//! # Start
//! The view in which the tag is largest gives two poses for an edge of length 1 ([`planar_poses`]); the point nearest to the lines of sight of all
//! views gives the distance, and so the length. Both poses are adjusted and the one of least cost is taken: the views tell them apart.
//!
//! # Errors
//! Each corner has an error of its own (sigma_corner), and all four of a view share one, because the keyframe's pose has an error (sigma_view): in
//! rotation it shifts them together, in translation nearly so. The normal equations are weighed by the covariance of both, which for n = 4
//! corners and each axis is `sigma_corner² I + sigma_view² 1 1ᵀ`: the mean of the four counts less than what is left of them. Both sigmas are estimated
//! from the residuals, around what is usual, and the tag is solved again. What the whole map has wrong (its scale drifts) no residual shows.
//!
//! Cost: 0.2 ms for 10 views, 0.3 ms for 30.

use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector2, Vector3};

use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use crate::geometry::planar_pose::planar_poses;

/// Corners of a tag with edges of length 1, as [`crate::features::tags::Tag`] orders them: x right, y down, z into the tag, origin in its middle.
pub const CORNERS: [[f64; 2]; 4] = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]];

/// Views that say something of a length, at the least: two always agree about a square's distance somehow.
pub const LEAST_VIEWS: usize = 3;
/// Largest angle between two lines of sight at the least, degrees. At 3 degrees a corner's tenth of a pixel is several percent.
pub const LEAST_PARALLAX_DEG: f64 = 3.0;
/// What is usual, px: of a corner on two fitted edges, of a keyframe's pose; and how many residuals' weight that has.
const USUAL_CORNER_PX: f64 = 0.15;
const USUAL_VIEW_PX: f64 = 0.3;
const USUAL_WEIGHT: f64 = 6.0;
/// Smaller ones are not believed, px: the picture's pixels, and a lens that is not exactly known.
const LEAST_CORNER_PX: f64 = 0.03;
const LEAST_VIEW_PX: f64 = 0.05;
/// A keyframe's error along the line of sight changes the size of a tag and not its place, so the means show two thirds of it.
const UNSEEN_SHARE: f64 = 1.2;
/// With larger residuals it is not the same tag in the same place, px.
const MOST_PX: f64 = 3.0;
/// Whitened residuals beyond this count less.
const HUBER: f64 = 3.0;
const STEPS: LmOptions = LmOptions { max_iterations: 25, relative_cost: 1e-7, step_norm: 1e-9, initial_damping: 1e-4 };

/// A keyframe's sight of a tag.
#[derive(Debug, Clone, Copy)]
pub struct View {
    pub camera_from_world: Se3<Camera, World>,
    /// Undistorted, on z = 1.
    pub corners: [Vector2<f64>; 4],
    /// How the camera moved, and how much later than the middle row a rolling shutter read each corner, s.
    pub motion: Option<CameraMotion>,
    pub late_s: [f64; 4],
}

/// Where a tag is and how long its edges are.
#[derive(Debug, Clone, Copy)]
pub struct PlacedTag {
    /// Axes as in [`CORNERS`]; map units.
    pub world_from_tag: Se3<World, Camera>,
    /// ln(edge length in map units).
    pub log_edge: f64,
    /// Its variance by what each corner has wrong, and by what each keyframe has wrong, which all tags that it sees share.
    pub corner_variance: f64,
    pub view_variance: f64,
    /// Standard deviations of place (map units) and orientation (rad) in their worst directions, relative to the keyframes that saw it.
    pub place_sigma: f64,
    pub turn_sigma: f64,
    /// RMS of what is left of the corners, px; and what of that is each corner's own, one sigma.
    pub residual_px: f64,
    pub corner_px: f64,
    pub views: usize,
}

/// Why a tag gives no length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoLength {
    /// Too few views, or from one direction: more will do.
    Waits,
    /// The views do not fit together: it was moved, or it is not one tag.
    Moved {
        /// The view that fits least.
        worst: usize,
    },
}

/// Standard deviations, normalised units.
#[derive(Debug, Clone, Copy)]
struct Noise {
    corner: f64,
    view: f64,
}

/// A square: rotation, middle, ln(edge length).
#[derive(Debug, Clone, Copy)]
struct Square {
    rotation: UnitQuaternion<f64>,
    centre: Vector3<f64>,
    log_edge: f64,
}

impl Square {
    /// From the middle to a corner, in world axes.
    fn arm(&self, corner: usize) -> Vector3<f64> {
        self.rotation * Vector2::from(CORNERS[corner]).push(0.0) * self.log_edge.exp()
    }
}

struct Problem<'a> {
    views: &'a [View],
    noise: Noise,
}

/// Residuals of a view and their Jacobian by (turn of the tag in world axes, its middle, ln edge), axis by axis.
type Rows = [[(f64, SVector<f64, 7>); 4]; 2];

impl Problem<'_> {
    /// `None` where a corner is behind the camera.
    fn rows(view: &View, square: &Square) -> Option<Rows> {
        let mut rows = [[(0.0, SVector::zeros()); 4]; 2];
        let turn = view.camera_from_world.rotation.to_rotation_matrix();
        for corner in 0..4 {
            let arm = square.arm(corner);
            let p = view.camera_from_world.transform(&(square.centre + arm));
            // Written so that NaN fails.
            if !(p.z > 1e-9) {
                return None;
            }
            let iz = 1.0 / p.z;
            let n = p.xy() * iz;
            let moved = view.motion.map_or(Vector2::zeros(), |m| m.flow(&p) * view.late_s[corner]);
            let residual = n + moved - view.corners[corner];
            for (axis, gradient) in
                [Vector3::new(iz, 0.0, -n.x * iz), Vector3::new(0.0, iz, -n.y * iz)].into_iter().enumerate()
            {
                let by_point = turn.matrix().tr_mul(&gradient);
                // d(w x arm) = (arm x g) . w
                let by_turn = arm.cross(&by_point);
                let mut row = SVector::<f64, 7>::zeros();
                row.fixed_rows_mut::<3>(0).copy_from(&by_turn);
                row.fixed_rows_mut::<3>(3).copy_from(&by_point);
                row[6] = by_point.dot(&arm);
                rows[axis][corner] = (residual[axis], row);
            }
        }
        Some(rows)
    }

    /// The same with independent residuals of variance 1.
    fn whitened(&self, view: &View, square: &Square) -> Option<Rows> {
        let mut rows = Self::rows(view, square)?;
        let Noise { corner, view } = self.noise;
        let kept = corner / (corner * corner + 4.0 * view * view).sqrt();
        for axis in &mut rows {
            let mean = axis.iter().map(|r| r.0).sum::<f64>() / 4.0;
            let mean_row = axis.iter().map(|r| r.1).sum::<SVector<f64, 7>>() / 4.0;
            for (residual, row) in axis {
                *residual = (*residual - (1.0 - kept) * mean) / corner;
                *row = (*row - mean_row * (1.0 - kept)) / corner;
            }
        }
        Some(rows)
    }
}

impl LeastSquares for Problem<'_> {
    type State = Square;
    type Normal = NormalEquations<7>;

    fn linearise(&self, square: &Square) -> NormalEquations<7> {
        let mut normal = NormalEquations::default();
        for view in self.views {
            for (residual, row) in self.whitened(view, square).iter().flatten().flatten() {
                let (_, weight) = Loss::Huber(HUBER).evaluate(residual * residual);
                normal.add(row, *residual, weight);
            }
        }
        normal
    }

    fn cost(&self, square: &Square) -> f64 {
        let mut sum = 0.0;
        for view in self.views {
            let Some(rows) = self.whitened(view, square) else { return f64::INFINITY };
            sum += rows.iter().flatten().map(|(r, _)| Loss::Huber(HUBER).evaluate(r * r).0).sum::<f64>();
        }
        if sum.is_nan() { f64::INFINITY } else { sum }
    }

    fn step(&self, square: &Square, delta: &SVector<f64, 7>) -> Square {
        Square {
            rotation: UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned()) * square.rotation,
            centre: square.centre + delta.fixed_rows::<3>(3),
            log_edge: square.log_edge + delta[6].clamp(-1.0, 1.0),
        }
    }
}

/// Middle of a tag as a view sees it: where its diagonals meet.
fn middle(corners: &[Vector2<f64>; 4]) -> Option<Vector2<f64>> {
    let [a, b, c, d] = corners;
    let (ac, bd) = (c - a, d - b);
    let determinant = ac.perp(&bd);
    (determinant.abs() > 1e-12).then(|| a + ac * ((b - a).perp(&bd) / determinant))
}

/// The point nearest to all lines of sight, and the largest angle between two of them, rad.
fn meeting(views: &[View]) -> Option<(Vector3<f64>, f64)> {
    let (mut hessian, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
    let mut rays = Vec::with_capacity(views.len());
    for view in views {
        let world_from_camera = view.camera_from_world.inverse();
        let ray = (world_from_camera.rotation * middle(&view.corners)?.push(1.0)).normalize();
        let across = Matrix3::identity() - ray * ray.transpose();
        hessian += across;
        gradient += across * world_from_camera.translation;
        rays.push(ray);
    }
    let mut angle = 0.0f64;
    for (i, a) in rays.iter().enumerate() {
        angle = rays[..i].iter().fold(angle, |most, b| most.max(a.cross(b).norm().atan2(a.dot(b))));
    }
    Some((nalgebra::Cholesky::new(hessian)?.solve(&gradient), angle))
}

/// The squares that the view with the largest picture of the tag says, at the distance that all views say.
fn starts(views: &[View], centre: &Vector3<f64>) -> Vec<Square> {
    let size = |v: &&View| (v.corners[2] - v.corners[0]).perp(&(v.corners[3] - v.corners[1])).abs();
    let Some(view) = views.iter().max_by(|a, b| size(a).total_cmp(&size(b))) else { return Vec::new() };
    let poses = planar_poses::<Camera, Camera>(&CORNERS.map(Vector2::from), &view.corners);
    let depth = view.camera_from_world.transform(centre).z;
    let square = |camera_from_tag: &Se3<Camera, Camera>| Square {
        rotation: view.camera_from_world.rotation.inverse() * camera_from_tag.rotation,
        centre: *centre,
        log_edge: (depth / camera_from_tag.translation.z).ln(),
    };
    poses.iter().flatten().map(|p| square(&p.camera_from_plane)).filter(|s| s.log_edge.is_finite()).collect()
}

/// Of the corners' residuals: sums of squares within views and of views' means (both axes), normalised units.
fn squares(views: &[View], square: &Square) -> Option<(f64, f64)> {
    let (mut within, mut means) = (0.0, 0.0);
    for view in views {
        for axis in Problem::rows(view, square)? {
            let mean = axis.iter().map(|r| r.0).sum::<f64>() / 4.0;
            within += axis.iter().map(|r| (r.0 - mean).powi(2)).sum::<f64>();
            means += mean * mean;
        }
    }
    Some((within, means))
}

/// The view whose residuals are the largest.
fn worst(views: &[View], square: &Square) -> usize {
    let off = |view: &View| squares(std::slice::from_ref(view), square).map_or(f64::INFINITY, |(w, m)| w + 4.0 * m);
    let largest = views.iter().map(off).enumerate().max_by(|a, b| a.1.total_cmp(&b.1));
    largest.map_or(0, |(i, _)| i)
}

impl Noise {
    fn usual(focal_px: f64) -> Self {
        Self { corner: USUAL_CORNER_PX / focal_px, view: USUAL_VIEW_PX / focal_px }
    }

    /// From the residuals, around what is usual. The three of the middle are taken from the views' means, the other four parameters from the rest.
    fn of(views: &[View], square: &Square, focal_px: f64) -> Option<Self> {
        let (within, means) = squares(views, square)?;
        let (usual, n) = (Self::usual(focal_px), views.len() as f64);
        let corner = (USUAL_WEIGHT * usual.corner.powi(2) + within) / (USUAL_WEIGHT + 6.0 * n - 4.0);
        let mean = (USUAL_WEIGHT * usual.view.powi(2) + means) / (USUAL_WEIGHT + 2.0 * n - 3.0);
        let view = (mean - corner / 4.0).max((LEAST_VIEW_PX / focal_px).powi(2)).sqrt() * UNSEEN_SHARE;
        Some(Self { corner: corner.sqrt().max(LEAST_CORNER_PX / focal_px), view })
    }
}

/// The length of a tag's edge from its views. `focal_px` turns normalised residuals into pixels.
pub fn edge_length(views: &[View], focal_px: f64) -> Result<PlacedTag, NoLength> {
    if views.len() < LEAST_VIEWS {
        return Err(NoLength::Waits);
    }
    let (centre, angle) = meeting(views).ok_or(NoLength::Waits)?;
    if !(angle >= LEAST_PARALLAX_DEG.to_radians()) {
        return Err(NoLength::Waits);
    }
    let problem = Problem { views, noise: Noise::usual(focal_px) };
    let solved = starts(views, &centre).into_iter().map(|start| minimise(&problem, start, &STEPS));
    let best = solved.min_by(|a, b| a.1.final_cost.total_cmp(&b.1.final_cost));
    let (square, _) = best.filter(|(_, summary)| summary.final_cost.is_finite()).ok_or(NoLength::Moved { worst: 0 })?;
    let moved = || NoLength::Moved { worst: worst(views, &square) };
    let noise = Noise::of(views, &square, focal_px).ok_or_else(moved)?;
    let problem = Problem { views, noise };
    let (square, _) = minimise(&problem, square, &STEPS);
    let moved = || NoLength::Moved { worst: worst(views, &square) };
    let (within, means) = squares(views, &square).ok_or_else(moved)?;
    let residual_px = focal_px * ((within + 4.0 * means) / (8.0 * views.len() as f64)).sqrt();
    if !(residual_px <= MOST_PX) {
        return Err(moved());
    }
    let covariance = |noise: Noise| {
        let mut hessian = Problem { views, noise }.linearise(&square).hessian;
        hessian.fill_upper_triangle_with_lower_triangle();
        Some(nalgebra::Cholesky::new(hessian)?.inverse())
    };
    let of_all = covariance(noise).ok_or(NoLength::Waits)?;
    let all = of_all[(6, 6)];
    // What would be left if the keyframes' poses were exact.
    let corner_variance = covariance(Noise { view: 0.0, ..noise }).ok_or(NoLength::Waits)?[(6, 6)].min(all);
    let worst_sigma = |first| of_all.fixed_view::<3, 3>(first, first).symmetric_eigenvalues().max().sqrt();
    Ok(PlacedTag {
        world_from_tag: Se3::new(square.rotation, square.centre),
        log_edge: square.log_edge,
        corner_variance,
        view_variance: all - corner_variance,
        place_sigma: worst_sigma(3),
        turn_sigma: worst_sigma(0),
        residual_px,
        corner_px: noise.corner * focal_px,
        views: views.len(),
    })
}

#[cfg(test)]
mod tests;
