//! What the landmarks of a frame say of its pose, and what of that they share.
//!
//! Input: the matches that agree with a pose. Output: the information of the pose (left perturbation, rad and map units) where each
//! landmark's own covariance `P_l` adds to its place's, `sum Jᵀ (sigma² I + J_l P_l J_lᵀ)⁻¹ J`; how the pose answers to what moves
//! landmarks together (parameters to consider, not to estimate: Bar-Shalom, Li, Kirubarajan 2001, section 5.4 treats biases so): a readout
//! time that is wrong, and what an adjustment has left of disagreement at the templates; and how well the landmarks' distances are known.
//! Cost: 100 ns a match.

use nalgebra::{Matrix6, Vector3, Vector6};

use super::frame::{Frame, measurement_of};
use super::search::Match;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::{accumulate, residual};

/// What the landmarks say of a pose.
#[derive(Debug, Clone, Copy)]
pub struct PoseInformation {
    /// Inverse is the covariance of the left perturbation, were the landmarks' errors independent.
    pub matrix: Matrix6<f64>,
    /// `sum Jᵀ W de/dT` of the readout time T, 1/s: `matrix⁻¹` times it is how far a pose is pushed by a second of it.
    pub readout: Vector6<f64>,
    /// `sum Jᵀ W J_l x`, x from where the map has a landmark to where its template shows it: `matrix⁻¹` times it is how far the pose is
    /// pulled by all of them.
    pub templates: Vector6<f64>,
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
        let (mut matrix, mut readout, mut templates) = (Matrix6::zeros(), Vector6::zeros(), Vector6::zeros());
        let (mut sigmas, mut count) = (0.0, 0usize);
        let world_from_camera = pose.rotation.inverse();
        for m in matches {
            let p = pose.transform(&m.point);
            if p.z < nearest {
                continue;
            }
            let pair = measurement_of(frame, m.landmark, pose, m.pair(frame.camera, frame.shutter.readout_s));
            let Some(seen) = residual(pose, &pair) else { continue };
            let (jx, jy) = seen.rows();
            accumulate(&mut matrix, &jx, &jy, 1.0);
            let moved = seen.scale * m.displacement;
            let (jx, jy) = (Vector6::from(jx), Vector6::from(jy));
            readout += jx * moved.x + jy * moved.y;
            let known = frame.map.landmark(m.landmark).filter(|l| l.assumed.is_none());
            let Some(landmark) = known else { continue };
            if let Some(off) = off_map(frame, m) {
                let off = pose.rotation * off;
                templates += jx * jx.fixed_rows::<3>(3).dot(&off) + jy * jy.fixed_rows::<3>(3).dot(&off);
            }
            let ray: Vector3<f64> = world_from_camera * p.normalize();
            let sigma = ray.dot(&(landmark.covariance * ray)).sqrt() / p.norm();
            if sigma.is_finite() {
                // A distance can be no less known than not at all.
                sigmas += sigma.min(1.0);
                count += 1;
            }
        }
        matrix.fill_lower_triangle_with_upper_triangle();
        Self { matrix, readout, templates, distance_sigma: (count > 0).then(|| sigmas / count as f64) }
    }
}

/// From where the map has a landmark to where the keyframe that its template was cut from saw it: the residual that an adjustment left
/// there, at the landmark's depth (world axes, map units). Every frame that the template is aligned to finds the patch off by this.
fn off_map(frame: &Frame<'_>, m: &Match) -> Option<Vector3<f64>> {
    let keyframe = frame.map.keyframe(m.template)?;
    let seen = keyframe.observation(m.landmark)?.at_middle_row(frame.shutter.readout_s);
    let p = keyframe.camera_from_world.transform(&m.point);
    let off = seen * p.z - p.xy();
    (p.z > 0.0).then(|| keyframe.camera_from_world.rotation.inverse() * Vector3::new(off.x, off.y, 0.0))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Matrix3, UnitQuaternion, Vector2};

    use super::*;
    use crate::features::FrameFeatures;
    use crate::geometry::CameraModel;
    use crate::geometry::random::Random;
    use crate::image::Pyramid;
    use crate::map::{Landmark, Map, examples};
    use crate::reconstruction::config::ReconstructionConfig;
    use crate::reconstruction::measurement::CHI2_2D_95;
    use crate::reconstruction::measurement::rolling_shutter::Shutter;
    use crate::reconstruction::track::association::Bindings;
    use crate::reconstruction::track::pose::{PoseOptions, optimise_pose};
    use crate::reconstruction::track::template::observe;

    #[test]
    fn a_pose_is_pulled_as_far_as_the_residuals_at_its_templates_say() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).expect("a camera");
        for seed in 1..10 {
            let mut random = Random::new(seed);
            let mut map = Map::default();
            let place = |x: f64, turn: f64| {
                Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.0, turn, 0.1)), Vector3::new(-x, 0.1, 0.05))
            };
            let [a, b, truth]: [Se3<Camera, World>; 3] = [place(0.0, 0.0), place(0.5, 0.05), place(0.3, -0.04)];
            let mut add = |pose| map.add_keyframe(examples::keyframe(Arc::new(Pyramid::default()), pose));
            let ids = [add(a), add(b)];
            let mut matches = Vec::new();
            while matches.len() < 60 {
                let mut within = |from: f64, to: f64| random.uniform(from, to);
                let point = Vector3::new(within(-2.0, 2.0), within(-1.5, 1.5), within(3.0, 6.0));
                let off_px = Vector2::new(within(-0.4, 0.6), within(-0.5, 0.5));
                let template = matches.len() % 2;
                // Where the template's keyframe saw it, and what stands there, as deep as the landmark.
                let mut seen = Vec::new();
                let mut there = point;
                for (i, pose) in [a, b].iter().enumerate() {
                    let p = pose.transform(&point);
                    let pixel =
                        camera.project(&p).expect("in front") + if i == template { off_px } else { off_px * 0.0 };
                    let o = observe(&camera, crate::map::LandmarkId(0), pixel.cast(), 1.25).expect("in the picture");
                    if i == template {
                        there = pose.inverse().transform(&(o.normalised.push(1.0) * p.z));
                    }
                    seen.push((ids[i], o));
                }
                let landmark = examples::landmark(point, ids[0]);
                let covariance = Matrix3::identity() * within(1e-6, 1e-4);
                let landmark = map.add_landmark(Landmark { covariance, ..landmark }, &seen);
                let p = truth.transform(&there);
                matches.push(Match {
                    landmark,
                    template: ids[template],
                    point,
                    pixel: camera.project(&p).expect("in front").cast(),
                    normalised: p.xy() / p.z,
                    displacement: Vector2::zeros(),
                    inv_sigma_px: 1.25,
                    inlier: true,
                    is_alike: true,
                });
            }
            let frame = Frame {
                features: &FrameFeatures::default(),
                map: &map,
                bindings: &Bindings::default(),
                camera: &camera,
                config: &ReconstructionConfig::default(),
                before: None,
                was_here: true,
                motion: None,
                shutter: &Shutter::new(0.0, 480, false),
                outlier_chi2: CHI2_2D_95,
            };
            let pairs: Vec<_> =
                matches.iter().map(|m| measurement_of(&frame, m.landmark, &truth, m.pair(&camera, 0.0))).collect();
            let options = PoseOptions { leverage: false, ..PoseOptions::default() };
            let found = optimise_pose(&truth, &pairs, &options, &mut Vec::new()).expect("a pose");
            assert_eq!(found.inliers, matches.len(), "seed {seed}: all weigh in full");
            let step = found.camera_from_world * truth.inverse();
            let w = step.rotation.scaled_axis();
            let v = found.camera_from_world.translation - step.rotation * truth.translation;
            let moved = Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z);
            let information = PoseInformation::of(&frame, matches.iter(), &truth);
            let expected = information.matrix.cholesky().expect("enough landmarks").solve(&information.templates);
            let off = (moved - expected).norm() / moved.norm();
            assert!(off < 0.03 && moved.norm() > 1e-4, "seed {seed}: {moved} instead of {expected}");
        }
    }
}
