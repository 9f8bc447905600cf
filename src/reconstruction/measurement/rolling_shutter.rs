//! Rolling shutter: rows are exposed one after another, so a moving camera has a pose of its own for each row.
//!
//! Poses here are those of the middle row. To first order a point that moves over the picture with `flow` (per second, on
//! z = 1) is seen displaced by `g T`, `g = flow (row / height - 1/2)`, T the readout time. Observations are kept as they were
//! seen and corrected by `- g T` wherever they are compared with a projection.
//!
//! T is a property of the camera that nobody writes on the box. It is one more unknown of every adjustment, which solves for it together
//! with poses and landmarks: against a map taken as true, what young landmarks' depths are wrong by looks like a shutter. From one
//! adjustment to the next it is carried as in a Kalman filter of one constant. A global shutter comes out as zero. Not here: acceleration
//! within a frame, exposure time.

use nalgebra::{Vector2, Vector3};

use super::NEAREST;
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
/// What the past counts after one more adjustment. Adjustments before had fewer landmarks, placed with another readout time.
const MEMORY: f64 = 0.9;
/// Share of an adjustment's information on what all observations share (readout, lens) that is believed: an observation is in some ten of them, and
/// neighbouring keyframes share the errors of their templates.
pub const BELIEVED: f64 = 0.05;
/// Never surer than this, s: what the motion between two frames says of the motion within one is not exact.
const FLOOR_SIGMA_S: f64 = 0.001;

impl Shutter {
    /// `estimate`: start at `readout_s` and learn; else it stays.
    pub fn new(readout_s: f64, height_px: u32, estimate: bool) -> Self {
        let information = PRIOR_SIGMA_S.powi(-2);
        Self { readout_s, information, height_px: f64::from(height_px.max(1)), estimate }
    }

    /// Readout time (s) and one over its variance (1/s^2), for another run.
    pub fn saved(&self) -> (f64, f64) {
        (self.readout_s, self.information)
    }

    /// Goes on from what another run knew; a readout time that is to be held stays as it is.
    pub fn resume(&mut self, readout_s: f64, information: f64) {
        if self.estimate && readout_s.is_finite() && information > 0.0 {
            (self.readout_s, self.information) = (readout_s.clamp(-MAX_READOUT_S, MAX_READOUT_S), information);
        }
    }

    /// Nothing to correct and nothing to learn.
    pub fn is_off(&self) -> bool {
        !self.estimate && self.readout_s == 0.0
    }

    /// As this camera may be: with the readout time that is believed, and one and two standard deviations more and less.
    pub fn possible(&self) -> [Self; 5] {
        let sigma_s = self.variance().sqrt();
        [0.0, -2.0, -1.0, 1.0, 2.0].map(|n| Self { readout_s: self.readout_s + n * sigma_s, ..*self })
    }

    /// For pictures that are looked at in the reverse of their order, in which everything moves the other way: held, as far as it is known.
    pub fn backwards(&self) -> Self {
        Self { readout_s: -self.readout_s, estimate: false, ..*self }
    }

    /// Variance of the readout time, s^2; zero where it is held.
    pub fn variance(&self) -> f64 {
        if self.estimate { self.information.recip() } else { 0.0 }
    }

    /// Share of the readout that a row is late by, against the middle one: -1/2 to 1/2.
    fn delay(&self, row_px: f32) -> f64 {
        (f64::from(row_px) + 0.5) / self.height_px - 0.5
    }

    /// g: displacement on z = 1 per second of readout, of a point (camera coordinates) that was seen in row `row_px`; zero where the motion is
    /// not known, and of what is not in front of the camera.
    pub fn displacement(&self, motion: Option<&CameraMotion>, point: &Vector3<f64>, row_px: f32) -> Vector2<f64> {
        let flow = motion.filter(|_| point.z > NEAREST).map(|motion| motion.flow(point));
        flow.map_or_else(Vector2::zeros, |flow| flow * self.delay(row_px))
    }

    /// As an adjustment takes it: readout time (s), and one over its variance (1/s^2; infinite: held).
    pub fn prior(&self) -> (f64, f64) {
        // Believing a part of the data is weighing the prior the more.
        (self.readout_s, if self.estimate { self.information / BELIEVED } else { f64::INFINITY })
    }

    /// Takes over what an adjustment with this [`prior`](Self::prior) found: readout time (s), and its variance (s^2), the prior in it.
    pub fn learn(&mut self, seconds: f64, variance: f64) {
        if !(self.estimate && seconds.is_finite() && variance > 0.0) {
            return;
        }
        // The prior is in the variance in full; the past counts less. What was learnt while the adjustment was under way was not in its prior.
        let information = BELIEVED / variance - (1.0 - MEMORY) * self.information;
        self.information = information.max(MEMORY * self.information).min(1.0 / (FLOOR_SIGMA_S * FLOOR_SIGMA_S));
        self.readout_s = seconds.clamp(-MAX_READOUT_S, MAX_READOUT_S);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::frames::Camera;

    #[test]
    fn the_displacement_is_the_derivative_of_what_a_row_sees_by_the_readout_time() {
        // A camera that turned and moved like this in 0.1 s; what row 60 of 240 sees is a quarter of the readout early.
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.05, 0.03));
        let step = Se3::<Camera, Camera>::new(turn, Vector3::new(0.03, -0.01, 0.04));
        let motion = CameraMotion::over(&step, 0.1);
        let point = Vector3::new(0.3, -0.4, 1.7);
        for (row_px, delay) in [(59.5, -0.25), (119.5, 0.0), (239.5, 0.5)] {
            let told = Shutter::new(0.0, 240, true).displacement(Some(&motion), &point, row_px);
            // The same motion for as long as the row is late, at a readout of h seconds, to both sides.
            let h = 1e-4;
            let seen = |readout_s: f64| {
                let moved = Se3::<Camera, Camera>::exp(&(step.log() * (delay * readout_s / 0.1))).transform(&point);
                moved.xy() / moved.z
            };
            let measured = (seen(h) - seen(-h)) / (2.0 * h);
            assert!((told - measured).norm() < 1e-6, "row {row_px}: {told} told, {measured} measured");
        }
    }

    #[test]
    fn a_readout_time_that_is_held_or_nonsense_is_not_learnt() {
        let held = Shutter::new(0.02, 240, false);
        assert_eq!((held.variance(), held.prior()), (0.0, (0.02, f64::INFINITY)));
        let mut shutter = held;
        shutter.learn(0.01, 1e-9);
        assert_eq!(shutter, held);
        let mut learning = Shutter::new(0.0, 240, true);
        let before = learning;
        learning.learn(f64::NAN, 1e-6);
        learning.learn(0.001, 0.0);
        learning.learn(0.001, f64::NAN);
        assert_eq!(learning, before);
    }

    #[test]
    fn an_adjustment_that_began_before_something_was_learnt_takes_little_of_it_away() {
        let mut shutter = Shutter::new(0.0, 240, true);
        let told_nothing = 1.0 / shutter.prior().1;
        shutter.learn(0.01, told_nothing / 100.0);
        let sure = shutter.variance();
        shutter.learn(0.01, told_nothing);
        assert!((sure..sure / 0.89).contains(&shutter.variance()), "{} after {sure}", shutter.variance());
    }

    #[test]
    fn what_is_learnt_is_bounded_in_size_and_in_how_surely_it_is_known() {
        let mut shutter = Shutter::new(0.0, 240, true);
        assert!((shutter.variance().sqrt() - PRIOR_SIGMA_S).abs() < 1e-12);
        // Nothing seen but the prior: a little is forgotten.
        shutter.learn(0.001, 1.0 / shutter.prior().1);
        assert!(shutter.variance().sqrt() > PRIOR_SIGMA_S);
        for _ in 0..20 {
            shutter.learn(0.2, 1e-12);
        }
        assert_eq!(shutter.readout_s, MAX_READOUT_S);
        assert!((shutter.variance().sqrt() - FLOOR_SIGMA_S).abs() < 1e-12);
        // What the adjustment takes as its prior weighs the more, as it believes a part of its own data only.
        let (_, information) = shutter.prior();
        assert!((information * FLOOR_SIGMA_S.powi(2) * BELIEVED - 1.0).abs() < 1e-9);
    }
}
