//! Which of several minima a pose belongs to, while most distances are assumed.
//!
//! A camera that has just begun to move after a turn on the spot knows the rays of what it sees, and next to no distance. What it sees then fits two and
//! more motions: near ahead of a wall, a step towards it and one aside with a turn look alike for some frames, and each is a minimum of its own. A descent
//! from where the last frame was stays in the one that noise has chosen; later that one fits worse (0.5 px where the true one fits to 0.2), but there is a
//! hill in between. So a descent is begun in every direction, as far from where the rays were seen as the camera has come, and the lowest end is taken.
//!
//! Kept by ablation: of the quarter metres in 16 drives around a square (45 s each) 3.1 % lead 10 degrees up or down without it and with distances
//! eliminated once a solution, 0.6 % so. Cost: seven short descents, some 2 ms, a solution (of which a search takes one to three) after a turn on the spot.

use nalgebra::Vector3;

use super::descent::{PoseOptions, descend};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::Correspondence;

/// A way shorter than this share of the distance assumed (mean of the inverses) says next to nothing of where it leads.
const SHORTEST_WAY: f64 = 0.01;

/// The cheapest end of short descents from `start` and from six places that are as far from where the rays were seen, ahead, aside and so on as the camera looks;
/// `start` itself where that is near. Its rotation has to be right to some pixels: distances are eliminated to first order. `inlier` is overwritten.
pub fn lowest_minimum(
    start: &Se3<Camera, World>,
    pairs: &[Correspondence],
    options: &PoseOptions,
    inlier: &mut Vec<bool>,
) -> Se3<Camera, World> {
    let rays = || pairs.iter().filter_map(|pair| pair.ray.as_ref());
    let n = rays().count() as f64;
    let from = rays().map(|ray| ray.centre).sum::<Vector3<f64>>() / n;
    let inverse = rays().map(|ray| ray.assumed.inverse).sum::<f64>() / n;
    let way = (start.inverse().translation - from).norm();
    if !(way * inverse > SHORTEST_WAY) {
        return *start;
    }
    inlier.clear();
    inlier.resize(pairs.len(), true);
    let mut best = descend(start, pairs, inlier, options, false);
    for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
        for step in [axis * way, -axis * way] {
            let moved = Se3::new(start.rotation, -(start.rotation * from + step));
            let other = descend(&moved, pairs, inlier, options, false);
            if other.1 < best.1 {
                best = other;
            }
        }
    }
    best.0
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, UnitQuaternion, Vector2};

    use super::*;
    use crate::geometry::random::Random;
    use crate::map::AssumedDistance;
    use crate::reconstruction::measurement::inverse_distance::{Ray, SIGMA_SHARE};
    use crate::reconstruction::track::pose::optimise_pose;

    /// Rays to a wall 4 m ahead, assumed to be at 1.6 m, as a camera sees them that went 0.2 m towards it, its turn known to a pixel.
    fn towards_a_wall(seed: u64) -> (Se3<Camera, World>, Vec<Correspondence>) {
        let mut random = Random::new(seed);
        let mut within = |a: f64| random.uniform(-a, a);
        let truth = Se3::new(
            UnitQuaternion::from_scaled_axis(Vector3::new(within(0.002), within(0.002), within(0.002))),
            Vector3::new(within(0.01), within(0.01), -0.2),
        );
        let assumed = AssumedDistance { inverse: 1.0 / 1.6, sigma: SIGMA_SHARE / 1.6 };
        let pairs = (0..100)
            .map(|_| {
                let point = Vector3::new(within(2.4), within(1.8), 4.0 + within(0.3));
                let p = truth.transform(&point);
                let normalised = p.xy() / p.z + Vector2::new(within(0.3), within(0.3)) / 500.0;
                let ray = Ray { centre: Vector3::zeros(), direction: point.normalize(), assumed };
                let pair = Correspondence::new(ray.point(), normalised, Matrix2::identity() * 500.0, 1.25);
                Correspondence { ray: Some(ray), ..pair }
            })
            .collect();
        (truth, pairs)
    }

    #[test]
    fn a_camera_that_went_ahead_is_not_taken_for_one_that_went_aside() {
        let (mut worst, mut astray) = (0.0_f64, 0);
        let options = PoseOptions::default();
        for seed in 1..40 {
            let (truth, pairs) = towards_a_wall(seed);
            let aside = Random::new(seed).uniform(0.0, std::f64::consts::TAU);
            let start = Se3::new(UnitQuaternion::identity(), Vector3::new(aside.cos(), aside.sin(), 0.0) * 0.06);
            let mut inlier = Vec::new();
            let off = |start: &Se3<Camera, World>, inlier: &mut Vec<bool>| {
                let pose = optimise_pose(start, &pairs, &options, inlier).expect("a pose").camera_from_world;
                pose.inverse().translation.angle(&truth.inverse().translation).to_degrees()
            };
            let best = lowest_minimum(&start, &pairs, &options, &mut inlier);
            worst = worst.max(off(&best, &mut inlier));
            astray += usize::from(off(&start, &mut inlier) > 5.0);
        }
        assert!(worst < 5.0 && astray > 20, "{worst} degrees at the worst; {astray} astray from their start alone");
    }

    #[test]
    fn a_camera_that_stands_stays() {
        let (_, pairs) = towards_a_wall(1);
        let start = Se3::new(UnitQuaternion::identity(), Vector3::new(0.01, 0.0, 0.0));
        let found = lowest_minimum(&start, &pairs, &PoseOptions::default(), &mut Vec::new());
        assert!(found == start);
    }
}
