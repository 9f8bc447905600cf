//! What a rotation cannot explain when the lens is not known either.
//!
//! Turning on the spot moves the picture by the homography `K R K⁻¹` whatever the depths are. Seen through a lens that is supposed wrong
//! the same flow has a pattern that no rotation has, and looks like parallax. So before a camera that nobody has calibrated begins a
//! map, the rotation is fitted together with focal length, principal point and first distortion coefficient, each around what is believed
//! of it and as far as that is uncertain; only what is left then speaks for a translation. Where the lens is well known the
//! priors hold it and the test becomes the ordinary one.
//!
//! Input: corresponding points on z = 1 of the lens that is supposed. Output: median of the flow that is left, px. Levenberg-Marquardt
//! with Cauchy's loss (Triggs et al. 2000, section 3), its scale anew in each round, and numeric derivatives; about 1 ms for 200 points.
//! Not here: finding the focal length of a camera that only turns (Hartley 1994), which a few degrees hardly show.

use nalgebra::{Rotation3, SMatrix, SVector, Vector2, Vector3};

use crate::geometry::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use crate::geometry::{CameraModel, median};
use crate::reconstruction::adjust::intrinsics::LensFreedom;

/// Rounds with a loss of their own scale, and steps of each, at the most.
const ROUNDS: usize = 6;
const STEPS: usize = 8;
/// Rotation vector, log of (supposed focal length / true one), principal point on z = 1, first coefficient of undistortion.
const UNKNOWNS: usize = 7;
type Unknowns = SVector<f64, UNKNOWNS>;
/// Standard deviation of a track, px.
const SIGMA_PX: f64 = 1.0;
/// No lens is farther than so many standard deviations from the supposed one.
const LIMIT: f64 = 3.0;
/// Residual of a point that has no place in the other picture, px.
const NOWHERE_PX: f64 = 50.0;

/// The unknown lens of both pictures.
struct Lens {
    scale: f64,
    centre: Vector2<f64>,
    k: f64,
}

impl Lens {
    fn of(unknowns: &Unknowns) -> Self {
        Self { scale: unknowns[3].exp(), centre: Vector2::new(unknowns[4], unknowns[5]), k: unknowns[6] }
    }

    /// From the supposed lens's plane to the true one's.
    fn lift(&self, n: &Vector2<f64>) -> Vector2<f64> {
        let m = (n - self.centre) * self.scale;
        m * (1.0 + self.k * m.norm_squared())
    }

    /// And back; `None` where the distortion folds.
    fn lower(&self, q: &Vector2<f64>) -> Option<Vector2<f64>> {
        let radius = q.norm();
        let mut r = radius;
        for _ in 0..4 {
            let slope = 1.0 + 3.0 * self.k * r * r;
            if slope < 0.1 {
                return None;
            }
            r -= (r * (1.0 + self.k * r * r) - radius) / slope;
        }
        let share = if radius > 1e-9 { r / radius } else { 1.0 };
        Some(q * (share / self.scale) + self.centre)
    }
}

/// Median flow (px) that no rotation and no lens near the supposed one explains; `turn` is the rotation (second from first) to begin with.
pub fn unexplained_flow(
    pairs: &[(Vector2<f64>, Vector2<f64>)],
    turn: &Rotation3<f64>,
    camera: &CameraModel,
    freedom: &LensFreedom,
) -> f64 {
    let focal = camera.focal_px();
    let sigma = Unknowns::from([
        1.0, // a rotation is free
        1.0,
        1.0,
        freedom.focal,
        freedom.centre_px / focal,
        freedom.centre_px / focal,
        freedom.distortion,
    ]);
    let mut problem = TurnProblem { pairs, turn, focal, sigma, loss: Loss::Squared };
    let mut unknowns = Unknowns::zeros();
    let mut least = problem.median(&unknowns);
    let options =
        LmOptions { max_iterations: STEPS, relative_cost: 1e-4, initial_damping: 1e-3, ..LmOptions::default() };
    for _ in 0..ROUNDS {
        problem.loss = Loss::Cauchy((1.5 * least).max(SIGMA_PX));
        let (found, summary) = minimise(&problem, unknowns, &options);
        unknowns = found;
        let now = problem.median(&unknowns);
        let settled = summary.converged && (least - now).abs() < 1e-3 * least;
        least = least.min(now);
        if settled {
            break;
        }
    }
    least
}

/// A rotation seen through an unknown lens, against corresponding points.
struct TurnProblem<'a> {
    pairs: &'a [(Vector2<f64>, Vector2<f64>)],
    turn: &'a Rotation3<f64>,
    focal: f64,
    /// Standard deviations of the unknowns.
    sigma: Unknowns,
    loss: Loss,
}

impl TurnProblem<'_> {
    fn residual(&self, unknowns: &Unknowns, (first, second): &(Vector2<f64>, Vector2<f64>)) -> Option<Vector2<f64>> {
        let lens = Lens::of(unknowns);
        let rotation = Rotation3::new(Vector3::new(unknowns[0], unknowns[1], unknowns[2])) * self.turn;
        let ray = rotation * lens.lift(first).push(1.0);
        let place = (ray.z > 1e-6).then(|| Vector2::new(ray.x / ray.z, ray.y / ray.z))?;
        lens.lower(&place).map(|n| (n - second) * self.focal)
    }

    fn lengths(&self, unknowns: &Unknowns) -> impl Iterator<Item = f64> {
        let length = |pair| self.residual(unknowns, pair).map_or(NOWHERE_PX, |e| e.norm().min(NOWHERE_PX));
        self.pairs.iter().map(length)
    }

    fn median(&self, unknowns: &Unknowns) -> f64 {
        median(&mut self.lengths(unknowns).collect::<Vec<_>>()).unwrap_or(0.0)
    }

    fn prior(&self) -> Unknowns {
        self.sigma.map(|s| (SIGMA_PX * SIGMA_PX) / (s * s).max(1e-12))
    }
}

impl LeastSquares for TurnProblem<'_> {
    type State = Unknowns;
    type Normal = NormalEquations<UNKNOWNS>;

    fn linearise(&self, unknowns: &Unknowns) -> NormalEquations<UNKNOWNS> {
        let prior = self.prior();
        let mut normal =
            NormalEquations { hessian: SMatrix::from_diagonal(&prior), gradient: unknowns.component_mul(&prior) };
        for pair in self.pairs {
            let Some(e) = self.residual(unknowns, pair) else { continue };
            let (_, weight) = self.loss.evaluate(e.norm_squared());
            let mut rows = [Unknowns::zeros(); 2];
            for i in 0..UNKNOWNS {
                let mut moved = *unknowns;
                moved[i] += 1e-5;
                if let Some(there) = self.residual(&moved, pair) {
                    let slope = (there - e) * 1e5;
                    (rows[0][i], rows[1][i]) = (slope.x, slope.y);
                }
            }
            normal.add(&rows[0], e.x, weight);
            normal.add(&rows[1], e.y, weight);
        }
        normal
    }

    fn cost(&self, unknowns: &Unknowns) -> f64 {
        let data: f64 = self.lengths(unknowns).map(|e| self.loss.evaluate(e * e).0).sum();
        data + unknowns.component_mul(unknowns).dot(&self.prior())
    }

    fn step(&self, unknowns: &Unknowns, delta: &Unknowns) -> Unknowns {
        // A rotation is free.
        let bound = |u: f64, s: f64| if s < 1.0 { u.clamp(-LIMIT * s, LIMIT * s) } else { u };
        (unknowns + delta).zip_map(&self.sigma, bound)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(focal: f64, k1: f64) -> CameraModel {
        CameraModel::new(640, 480, focal, focal, 325.0, 236.0, [k1, 0.0, 0.0, 0.0, 0.0]).expect("a camera")
    }

    /// Points of a room seen before and after a motion through `real`, undistorted with `supposed`.
    fn pairs(
        real: &CameraModel,
        supposed: &CameraModel,
        turn: &Rotation3<f64>,
        step: Vector3<f64>,
    ) -> Vec<(Vector2<f64>, Vector2<f64>)> {
        let mut pairs = Vec::new();
        for i in 0..16 {
            for j in 0..12 {
                let pixel = Vector2::new(20.0 + 40.0 * f64::from(i), 20.0 + 40.0 * f64::from(j));
                let depth = 2.0 + f64::from((i * 7 + j * 5) % 11) * 0.3;
                let Some(n) = real.undistort(&pixel) else { continue };
                let there = turn * (n.push(1.0) * depth) + step;
                let Some(seen) = real.project(&there) else { continue };
                if real.contains(&seen, 0.0) {
                    let places = supposed.undistort(&pixel).zip(supposed.undistort(&seen));
                    pairs.extend(places);
                }
            }
        }
        pairs
    }

    const UNKNOWN: LensFreedom = LensFreedom { focal: 0.25, centre_px: 16.0, distortion: 0.1 };

    #[test]
    fn a_turn_seen_through_a_wrong_lens_is_explained_and_a_translation_is_not() {
        let supposed = CameraModel::new(640, 480, 554.0, 554.0, 319.5, 239.5, [0.0; 5]).expect("a camera");
        for view in [37f64, 60.0, 75.0, 90.0] {
            let real = camera(320.0 / (0.5 * view).to_radians().tan(), -0.12);
            let turn = Rotation3::from_euler_angles(0.05, 0.22, 0.03);
            let turned = pairs(&real, &supposed, &turn, Vector3::zeros());
            let left = unexplained_flow(&turned, &turn, &supposed, &UNKNOWN);
            assert!(turned.len() > 60 && left < 1.0, "{view} degrees, {} points: {left}", turned.len());
            let moved = pairs(&real, &supposed, &turn, Vector3::new(0.25, 0.05, 0.1));
            let left = unexplained_flow(&moved, &turn, &supposed, &UNKNOWN);
            assert!(left > 5.0, "{view} degrees, moved: {left}");
        }
    }

    #[test]
    fn a_lens_that_is_known_is_held() {
        let (real, supposed) = (camera(330.0, 0.0), camera(554.0, 0.0));
        let turn = Rotation3::from_euler_angles(0.05, 0.22, 0.03);
        let turned = pairs(&real, &supposed, &turn, Vector3::zeros());
        let held = LensFreedom { focal: 0.002, centre_px: 0.1, distortion: 0.001 };
        let (free, held) =
            (unexplained_flow(&turned, &turn, &supposed, &UNKNOWN), unexplained_flow(&turned, &turn, &supposed, &held));
        assert!(free < 1.0 && held > 4.0, "free {free}, held {held}");
    }
}
