//! Rolling shutter: rows are exposed one after another, so a moving camera has a pose of its own for each row.
//!
//! Poses here are those of the middle row. To first order a point that moves over the picture with `flow` (per second, on
//! z = 1) is seen displaced by `g T`, `g = flow (row / height - 1/2)`, T the readout time. Observations are kept as they were
//! seen and corrected by `- g T` wherever they are compared with a projection.
//!
//! T is a property of the camera that nobody writes on the box, so it is estimated from the residuals: with e the residuals
//! of a frame at its best pose, J the pose's Jacobian and H = JᵀJ, the step `dT = eᵀg / (gᵀg - gᵀJ H⁻¹ Jᵀg)` is the joint
//! least-squares step of pose and T. Frames are added up as in a Kalman filter of one constant. A global shutter comes out as
//! zero. Not here: acceleration within a frame, exposure time.

use nalgebra::{Matrix2, Matrix6, Vector2, Vector3, Vector6};

use super::pose_optimisation::jacobian_rows;
use crate::geometry::camera_motion::CameraMotion;

/// Readout time and how surely it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shutter {
    /// Time from the first row's exposure to the last one's, s; negative when the last row comes first.
    pub readout_s: f64,
    /// One over the variance of `readout_s`, 1/s^2.
    information: f64,
    height_px: f64,
    estimate: bool,
}

/// Longest readout that a camera has, s.
const MAX_READOUT_S: f64 = 0.04;
/// Standard deviation of the readout time before anything is known, s.
const PRIOR_SIGMA_S: f64 = 0.01;
/// What the past counts after one more frame: half after 23. Short, because frames that were tracked against a map made with
/// another readout time agree with that one.
const MEMORY: f64 = 0.97;

impl Shutter {
    /// `estimate`: start at `readout_s` and learn; else it stays.
    pub fn new(readout_s: f64, height_px: u32, estimate: bool) -> Self {
        let information = 1.0 / (PRIOR_SIGMA_S * PRIOR_SIGMA_S);
        Self { readout_s, information, height_px: f64::from(height_px.max(1)), estimate }
    }

    /// Nothing to correct and nothing to learn.
    pub fn is_off(&self) -> bool {
        !self.estimate && self.readout_s == 0.0
    }

    /// Share of the readout that a row is late by, against the middle one: -1/2 to 1/2.
    fn delay(&self, row_px: f32) -> f64 {
        (f64::from(row_px) + 0.5) / self.height_px - 0.5
    }

    /// g: displacement on z = 1 per second of readout, of a point (camera coordinates) that was seen in row `row_px`.
    pub fn displacement(&self, motion: &CameraMotion, point: &Vector3<f64>, row_px: f32) -> Vector2<f64> {
        motion.flow(point) * self.delay(row_px)
    }

    /// Where the middle row's pose would have seen it.
    pub fn corrected(
        &self,
        seen: &Vector2<f64>,
        motion: Option<&CameraMotion>,
        point: &Vector3<f64>,
        row_px: f32,
    ) -> Vector2<f64> {
        match motion {
            Some(motion) if self.readout_s != 0.0 && point.z > 1e-6 => {
                seen - self.displacement(motion, point, row_px) * self.readout_s
            }
            _ => *seen,
        }
    }

    /// Learns from one frame. Each item: the point in camera coordinates at the frame's pose, the corrected observation, the
    /// displacement g, and pixels that steps on z = 1 count as there, over sigma.
    pub fn learn(&mut self, items: impl Iterator<Item = (Vector3<f64>, Vector2<f64>, Vector2<f64>, Matrix2<f64>)>) {
        if !self.estimate {
            return;
        }
        let (mut h, mut jg) = (Matrix6::zeros(), Vector6::zeros());
        let (mut gg, mut eg) = (0.0, 0.0);
        for (p, seen, g, scale) in items {
            let e = scale * (seen - Vector2::new(p.x / p.z, p.y / p.z));
            let g = scale * g;
            // Large residuals count less, as everywhere.
            let w = 1.0 / (1.0 + e.norm_squared());
            let (jx, jy) = jacobian_rows(&p, &scale);
            let (jx, jy) = (Vector6::from(jx), Vector6::from(jy));
            h += (jx * jx.transpose() + jy * jy.transpose()) * w;
            jg += (jx * g.x + jy * g.y) * w;
            gg += g.norm_squared() * w;
            eg += e.dot(&g) * w;
        }
        let Some(factor) = h.cholesky() else { return };
        let den = gg - jg.dot(&factor.solve(&jg));
        if !(den.is_finite() && eg.is_finite()) || den <= 0.0 {
            return;
        }
        self.information = self.information * MEMORY + den;
        self.readout_s = (self.readout_s + eg / self.information).clamp(-MAX_READOUT_S, MAX_READOUT_S);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readout_time_is_learnt_from_what_it_does_to_the_picture() {
        for truth in [0.0, 0.02, -0.015] {
            let mut shutter = Shutter::new(0.0, 480, true);
            let scale = Matrix2::identity() * 500.0;
            let mut state = 7u64;
            let mut random = || {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
            };
            for _ in 0..60 {
                let camera = CameraMotion {
                    turn: Vector3::new(random(), random(), random()),
                    shift: Vector3::new(random(), random(), random()),
                };
                let items: Vec<_> = (0..120)
                    .map(|_| {
                        let p = Vector3::new(random(), random() * 0.8, 2.0 + random());
                        let row = (240.0 + 250.0 * p.y / p.z) as f32;
                        let g = shutter.displacement(&camera, &p, row);
                        let seen = Vector2::new(p.x / p.z, p.y / p.z) + g * (truth - shutter.readout_s);
                        (p, seen + Vector2::new(random(), random()) * 0.001, g, scale)
                    })
                    .collect();
                shutter.learn(items.into_iter());
            }
            assert!((shutter.readout_s - truth).abs() < 1e-3, "{} instead of {truth}", shutter.readout_s);
        }
    }
}
