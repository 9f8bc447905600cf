//! What the landmarks of a frame say of its pose, and what of that they share.
//!
//! Input: the matches that agree with a pose. Output: the information of the pose (left perturbation, rad and map units) where each
//! landmark's own covariance `P_l` adds to its place's, `sum Jᵀ (sigma² I + J_l P_l J_lᵀ)⁻¹ J`; how the pose would answer to a readout
//! time that is wrong, which moves all of them at once (a parameter to consider, not to estimate: Bar-Shalom, Li, Kirubarajan 2001,
//! section 5.4 treats biases so); and how well the landmarks' distances are known. Cost: 60 ns a match.

use nalgebra::{Matrix6, Vector3, Vector6};

use super::frame::{Frame, measurement_of};
use super::search::Match;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::{accumulate, jacobian_rows};

/// What the landmarks say of a pose.
#[derive(Debug, Clone, Copy)]
pub struct PoseInformation {
    /// Inverse is the covariance of the left perturbation, were the landmarks' errors independent.
    pub matrix: Matrix6<f64>,
    /// `sum Jᵀ W de/dT` of the readout time T, 1/s: `matrix⁻¹` times it is how far a pose is pushed by a second of it.
    pub readout: Vector6<f64>,
    /// Standard deviation of a landmark's distance as a share of it, mean over the landmarks whose distance is not assumed; `None`
    /// where there are none, or nothing is known of any.
    pub distance_sigma: Option<f64>,
}

/// Landmarks nearer than this many mean depths say nothing here: a pose would be as sure as if nothing were wrong with the one nearest
/// thing, and what comes that near is as a rule something that moves.
const NEAREST: f64 = 0.1;

impl PoseInformation {
    pub fn of<'a>(
        frame: &Frame<'_>,
        matches: impl Iterator<Item = &'a Match> + Clone,
        pose: &Se3<Camera, World>,
    ) -> Self {
        let depths = || matches.clone().map(|m| pose.transform(&m.point).z);
        let nearest = (NEAREST * depths().sum::<f64>() / depths().count() as f64).max(1e-6);
        let (mut matrix, mut readout) = (Matrix6::zeros(), Vector6::zeros());
        let (mut sigmas, mut count) = (0.0, 0usize);
        let world_from_camera = pose.rotation.inverse();
        for m in matches {
            let p = pose.transform(&m.point);
            if p.z < nearest {
                continue;
            }
            let pair = measurement_of(frame, m.landmark, pose, m.pair(frame.camera, frame.shutter.readout_s));
            let (jx, jy) = jacobian_rows(&pose.transform(&pair.point), &pair.sqrt_information);
            accumulate(&mut matrix, &jx, &jy, 1.0);
            let moved = pair.sqrt_information * m.displacement;
            readout += Vector6::from(jx) * moved.x + Vector6::from(jy) * moved.y;
            let known = frame.map.landmark(m.landmark).filter(|l| l.assumed.is_none());
            let Some(landmark) = known else { continue };
            let ray: Vector3<f64> = world_from_camera * p.normalize();
            let sigma = ray.dot(&(landmark.covariance * ray)).sqrt() / p.norm();
            if sigma.is_finite() {
                // A distance can be no less known than not at all.
                sigmas += sigma.min(1.0);
                count += 1;
            }
        }
        matrix.fill_lower_triangle_with_upper_triangle();
        Self { matrix, readout, distance_sigma: (count > 0).then(|| sigmas / count as f64) }
    }
}
