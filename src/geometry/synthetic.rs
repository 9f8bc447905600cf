//! Synthetic two-view scenes with known answers, for the tests of this room.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use super::Se3;
use super::frames::{First, Second};
use super::random::Random;

/// Focal length that turns pixels into normalised coordinates, pixels.
pub const FOCAL: f64 = 500.0;

/// Points seen by two cameras, undistorted normalised coordinates.
pub struct Scene {
    pub second_from_first: Se3<Second, First>,
    /// In the first camera's coordinates.
    pub points: Vec<Vector3<f64>>,
    pub x1: Vec<Vector2<f64>>,
    pub x2: Vec<Vector2<f64>>,
    /// `true` where the match is not an outlier.
    pub truth: Vec<bool>,
}

/// What the scene looks like.
#[derive(Clone, Copy)]
pub enum Shape {
    /// Depths 2 to 8.
    Volume,
    /// A tilted plane about 4 away.
    Plane,
}

/// A random rotation of at most `max_angle` radians.
pub fn random_rotation(random: &mut Random, max_angle: f64) -> UnitQuaternion<f64> {
    let axis = Vector3::new(random.normal(), random.normal(), random.normal()).normalize();
    UnitQuaternion::from_scaled_axis(axis * random.uniform(0.2, 1.0) * max_angle)
}

impl Scene {
    /// `count` points seen by both cameras of a 640 x 480 picture, after a rotation up to 0.2 rad and a translation of
    /// length `baseline` in a random direction.
    pub fn new(random: &mut Random, shape: Shape, count: usize, baseline: f64) -> Self {
        let rotation = random_rotation(random, 0.2);
        let direction = Vector3::new(random.normal(), random.normal(), 0.5 * random.normal()).normalize();
        Self::with_motion(random, shape, count, Se3::new(rotation, direction * baseline))
    }

    /// The same with a given motion.
    pub fn with_motion(random: &mut Random, shape: Shape, count: usize, motion: Se3<Second, First>) -> Self {
        let normal = Vector3::new(random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5), 1.0).normalize();
        let inside = |x: &Vector2<f64>| x.x.abs() * FOCAL < 320.0 && x.y.abs() * FOCAL < 240.0;
        let mut scene =
            Self { second_from_first: motion, points: vec![], x1: vec![], x2: vec![], truth: vec![true; count] };
        for _ in 0..count * 1000 {
            if scene.points.len() == count {
                break;
            }
            let x = Vector2::new(random.uniform(-320.0, 320.0), random.uniform(-240.0, 240.0)) / FOCAL;
            let depth = match shape {
                Shape::Volume => random.uniform(2.0, 8.0),
                Shape::Plane => 4.0 / normal.dot(&x.push(1.0)),
            };
            let point = x.push(1.0) * depth;
            let moved = motion.transform(&point);
            let y = Vector2::new(moved.x / moved.z, moved.y / moved.z);
            if depth > 0.0 && moved.z > 0.1 && inside(&y) {
                scene.points.push(point);
                scene.x1.push(x);
                scene.x2.push(y);
            }
        }
        assert_eq!(scene.points.len(), count, "the cameras share a view");
        scene
    }

    /// Adds Gaussian noise to both pictures, pixels.
    pub fn noise(mut self, random: &mut Random, sigma_px: f64) -> Self {
        for x in self.x1.iter_mut().chain(self.x2.iter_mut()) {
            *x += Vector2::new(random.normal(), random.normal()) * (sigma_px / FOCAL);
        }
        self
    }

    /// Replaces a share of the matches by random ones.
    pub fn outliers(mut self, random: &mut Random, share: f64) -> Self {
        let count = self.x1.len();
        for i in 0..(count as f64 * share).round() as usize {
            let i = i * count / ((count as f64 * share).round() as usize).max(1);
            self.x2[i] = Vector2::new(random.uniform(-320.0, 320.0), random.uniform(-240.0, 240.0)) / FOCAL;
            self.truth[i] = false;
        }
        self
    }

    /// Share of the true matches that the mask has, and share of the mask that is true.
    pub fn recall_precision(&self, mask: &[bool]) -> (f64, f64) {
        let both = mask.iter().zip(&self.truth).filter(|(m, t)| **m && **t).count() as f64;
        let truth = self.truth.iter().filter(|t| **t).count() as f64;
        (both / truth, both / (mask.iter().filter(|m| **m).count() as f64).max(1.0))
    }

    /// Errors of a motion, radians: of the rotation, and of the translation's direction.
    pub fn motion_error(&self, estimate: &Se3<Second, First>) -> (f64, f64) {
        let rotation = (estimate.rotation.inverse() * self.second_from_first.rotation).angle();
        (rotation, estimate.translation.angle(&self.second_from_first.translation))
    }
}

/// Distance of two 3 x 3 matrices that are known up to scale, each brought to unit norm.
pub fn projective_distance(m: &Matrix3<f64>, reference: &Matrix3<f64>) -> f64 {
    let (a, b) = (m / m.norm(), reference / reference.norm());
    (a - b).norm().min((a + b).norm())
}
