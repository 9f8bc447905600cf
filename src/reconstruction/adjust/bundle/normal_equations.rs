//! The normal equations of an adjustment, and their Schur complement on cameras and global parameters.
//!
//! Unknowns of the reduced system, in this order: six for each free camera, `W` global parameters. Everything is summed from the two rows
//! of each observation's Jacobian.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SMatrix, SVector, Vector1, Vector3, Vector6};

use super::globals::focal_scale;
use super::problem::{BundleProblem, BundleState};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::Loss;
use crate::reconstruction::measurement::jacobian_rows;

/// In the place of a fixed camera's index among the free ones.
const FIXED: usize = usize::MAX;
/// Added to every pivot: what no observation holds stays where it is. The information of one pixel on one unit of the map is some 1e5.
const LEAST_PIVOT: f64 = 1e-9;
/// Price of an observation behind its camera in squared outlier limits: a step that does this is no gain.
const BEHIND_CAMERA: f64 = 100.0;

type Matrix6x3 = SMatrix<f64, 6, 3>;
/// Derivatives of a residual's x and y by N unknowns.
type Rows<const N: usize> = [SVector<f64, N>; 2];

/// A bundle adjustment with its first `W` global parameters: one, or all of them.
pub(super) struct Adjustment<'a, const W: usize> {
    problem: &'a BundleProblem,
    /// Index of each camera among the free ones.
    slot: Vec<usize>,
    free: usize,
    /// Huber's limit, standard deviations.
    limit: f64,
}

/// An observation at one state.
struct Linearised<const W: usize> {
    residual: Rows<1>,
    weight: f64,
    camera: Rows<6>,
    point: Rows<3>,
    global: Rows<W>,
}

/// A free camera's own block, its gradient, and what it has in common with the global parameters.
#[derive(Clone)]
struct CameraBlock<const W: usize> {
    own: Matrix6<f64>,
    gradient: Vector6<f64>,
    global: SMatrix<f64, W, 6>,
}

/// The same of a point.
pub(super) struct PointBlock<const W: usize> {
    pub(super) own: Matrix3<f64>,
    gradient: Vector3<f64>,
    global: SMatrix<f64, W, 3>,
}

/// Normal equations at one state, the prior of the global parameters in them.
pub(super) struct System<'a, 'p, const W: usize> {
    adjustment: &'a Adjustment<'p, W>,
    cameras: Vec<CameraBlock<W>>,
    pub(super) points: Vec<PointBlock<W>>,
    /// Camera-point block of each observation (zero for fixed cameras and outliers).
    cross: Vec<Matrix6x3>,
    global: SMatrix<f64, W, W>,
    global_gradient: SVector<f64, W>,
}

/// The system that is left once the points are eliminated.
pub(super) struct Reduced {
    /// Lower triangle.
    pub(super) matrix: DMatrix<f64>,
    right: DVector<f64>,
    /// The inverted blocks of the points.
    inverses: Vec<Matrix3<f64>>,
}

/// One step of everything.
pub(super) struct Step {
    /// Stacked over the free cameras, then the global parameters.
    pub(super) reduced: DVector<f64>,
    pub(super) points: Vec<Vector3<f64>>,
}

/// `block += weight aᵀ b`
#[inline]
fn add_product<const R: usize, const C: usize>(block: &mut SMatrix<f64, R, C>, weight: f64, a: &Rows<R>, b: &Rows<C>) {
    for c in 0..C {
        let (x, y) = (weight * b[0][c], weight * b[1][c]);
        for r in 0..R {
            block[(r, c)] += a[0][r] * x + a[1][r] * y;
        }
    }
}

/// Marquardt's damping.
fn damped<const N: usize>(block: &SMatrix<f64, N, N>, damping: f64) -> SMatrix<f64, N, N> {
    let mut block = *block;
    for i in 0..N {
        block[(i, i)] += damping * block[(i, i)] + LEAST_PIVOT;
    }
    block
}

impl<'p, const W: usize> Adjustment<'p, W> {
    pub(super) fn new(problem: &'p BundleProblem, outlier_chi2: f64) -> Self {
        let mut free = 0;
        let slot = problem.fixed.iter().map(|fixed| {
            if *fixed {
                return FIXED;
            }
            free += 1;
            free - 1
        });
        Self { problem, slot: slot.collect(), free, limit: outlier_chi2.sqrt() }
    }

    /// Index of a camera among the free ones.
    pub(super) fn slot_of(&self, camera: usize) -> Option<usize> {
        self.slot.get(camera).copied().filter(|slot| *slot != FIXED)
    }

    /// Sum of the robust costs, sigma-scaled squares, and of the priors'.
    pub(super) fn cost(&self, state: &BundleState) -> f64 {
        let loss = Loss::Huber(self.limit);
        let behind = BEHIND_CAMERA * self.limit * self.limit;
        let mut cost = self.problem.globals.prior_cost(&state.globals);
        for (i, point) in state.points.iter().enumerate() {
            for k in self.problem.inliers(i) {
                let residual = self.problem.residual(state, point, k);
                cost += residual.map_or(behind, |(e, _)| loss.evaluate(e.norm_squared()).0);
            }
        }
        cost
    }

    /// `rotation`: of the camera. `None` for a point behind it.
    #[inline]
    fn observation(
        &self,
        state: &BundleState,
        point: &Vector3<f64>,
        k: usize,
        rotation: &Matrix3<f64>,
    ) -> Option<Linearised<W>> {
        let o = &self.problem.observations[k];
        let (e, p) = self.problem.residual(state, point, k)?;
        let (_, weight) = Loss::Huber(self.limit).evaluate(e.norm_squared());
        let pixels = o.pixel_scale * o.inv_sigma_px;
        let (jx, jy) = jacobian_rows(&p, &(pixels * focal_scale(&state.globals)));
        // d e / d point = d e / d translation * R.
        let by_point = |j: &[f64; 6]| rotation.tr_mul(&Vector3::new(j[3], j[4], j[5]));
        let off = self.problem.off(state, k, &p);
        let global = pixels * self.problem.globals.jacobian::<W>(k, &off, &o.displacement, &state.globals);
        Some(Linearised {
            residual: [Vector1::new(e.x), Vector1::new(e.y)],
            weight,
            camera: [jx.into(), jy.into()],
            point: [by_point(&jx), by_point(&jy)],
            global: [global.row(0).transpose(), global.row(1).transpose()],
        })
    }

    pub(super) fn linearise(&self, state: &BundleState) -> System<'_, 'p, W> {
        let none = CameraBlock { own: Matrix6::zeros(), gradient: Vector6::zeros(), global: SMatrix::zeros() };
        let prior: [(f64, f64); W] = std::array::from_fn(|i| self.problem.globals.prior(i, state.globals[i]));
        let mut system = System {
            adjustment: self,
            cameras: vec![none; self.free],
            points: Vec::with_capacity(state.points.len()),
            cross: vec![Matrix6x3::zeros(); self.problem.observations.len()],
            global: SMatrix::from_diagonal(&prior.map(|p| p.1).into()),
            global_gradient: prior.map(|p| p.0).into(),
        };
        let rotations: Vec<Matrix3<f64>> =
            state.poses.iter().map(|pose| *pose.rotation.to_rotation_matrix().matrix()).collect();
        for (i, point) in state.points.iter().enumerate() {
            let mut block = PointBlock { own: Matrix3::zeros(), gradient: Vector3::zeros(), global: SMatrix::zeros() };
            for k in self.problem.inliers(i) {
                let camera = self.problem.observations[k].camera as usize;
                let Some(o) = self.observation(state, point, k, &rotations[camera]) else { continue };
                add_product(&mut block.own, o.weight, &o.point, &o.point);
                add_product(&mut block.gradient, o.weight, &o.point, &o.residual);
                add_product(&mut block.global, o.weight, &o.global, &o.point);
                add_product(&mut system.global, o.weight, &o.global, &o.global);
                add_product(&mut system.global_gradient, o.weight, &o.global, &o.residual);
                if let Some(block) = system.cameras.get_mut(self.slot[camera]) {
                    add_product(&mut block.own, o.weight, &o.camera, &o.camera);
                    add_product(&mut block.gradient, o.weight, &o.camera, &o.residual);
                    add_product(&mut block.global, o.weight, &o.global, &o.camera);
                    add_product(&mut system.cross[k], o.weight, &o.camera, &o.point);
                }
            }
            system.points.push(block);
        }
        system
    }

    /// The state moved by a step.
    pub(super) fn step(&self, state: &BundleState, step: &Step) -> BundleState {
        let moved = |(pose, &slot): (&Se3<Camera, World>, &usize)| match slot {
            FIXED => *pose,
            slot => pose.perturb_left(&step.reduced.fixed_rows::<6>(6 * slot).into_owned()),
        };
        let mut globals = state.globals;
        let mut changed = globals.fixed_rows_mut::<W>(0);
        changed += step.reduced.fixed_rows::<W>(6 * self.free);
        BundleState {
            poses: state.poses.iter().zip(&self.slot).map(moved).collect(),
            points: state.points.iter().zip(&step.points).map(|(point, step)| point + step).collect(),
            globals,
        }
    }
}

impl<const W: usize> System<'_, '_, W> {
    /// Inlier observations of a point by free cameras, with the cameras' indices among these.
    fn seen(&self, point: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        let Adjustment { problem, slot, .. } = self.adjustment;
        problem.inliers(point).map(|k| (k, slot[problem.observations[k].camera as usize])).filter(|(_, s)| *s != FIXED)
    }

    /// Where the global parameters begin in the reduced system.
    pub(super) fn globals_at(&self) -> usize {
        6 * self.cameras.len()
    }

    /// The reduced system at this damping. The global parameters are held by their priors and not damped.
    pub(super) fn reduce(&self, damping: f64) -> Reduced {
        let at = self.globals_at();
        let mut s = DMatrix::<f64>::zeros(at + W, at + W);
        let mut g = DVector::<f64>::zeros(at + W);
        for (i, camera) in self.cameras.iter().enumerate() {
            s.fixed_view_mut::<6, 6>(6 * i, 6 * i).copy_from(&damped(&camera.own, damping));
            s.fixed_view_mut::<W, 6>(at, 6 * i).copy_from(&camera.global);
            g.fixed_rows_mut::<6>(6 * i).copy_from(&-camera.gradient);
        }
        let (mut own, mut right) = (self.global, -self.global_gradient);
        let mut inverses = Vec::with_capacity(self.points.len());
        for (i, point) in self.points.iter().enumerate() {
            let inverse = damped(&point.own, damping).try_inverse().unwrap_or_else(Matrix3::zeros);
            let rest = inverse * point.gradient;
            for (a, slot_a) in self.seen(i) {
                let y = self.cross[a] * inverse;
                let mut part = g.fixed_rows_mut::<6>(6 * slot_a);
                part += self.cross[a] * rest;
                for (b, slot_b) in self.seen(i).filter(|(_, slot_b)| *slot_b <= slot_a) {
                    let mut block = s.fixed_view_mut::<6, 6>(6 * slot_a, 6 * slot_b);
                    block -= y * self.cross[b].transpose();
                }
                let mut block = s.fixed_view_mut::<W, 6>(at, 6 * slot_a);
                block -= point.global * y.transpose();
            }
            own -= point.global * inverse * point.global.transpose();
            right += point.global * rest;
            inverses.push(inverse);
        }
        s.fixed_view_mut::<W, W>(at, at).copy_from(&own);
        g.fixed_rows_mut::<W>(at).copy_from(&right);
        Reduced { matrix: s, right: g, inverses }
    }

    /// The step at this damping; `None` if the reduced system is not positive definite.
    pub(super) fn solve(&self, damping: f64) -> Option<Step> {
        let Reduced { matrix, right, inverses } = self.reduce(damping);
        let reduced = matrix.cholesky()?.solve(&right);
        let global = reduced.fixed_rows::<W>(self.globals_at());
        let point = |(i, (point, inverse)): (usize, (&PointBlock<W>, &Matrix3<f64>))| {
            let mut rest = -point.gradient - point.global.tr_mul(&global);
            for (k, slot) in self.seen(i) {
                rest -= self.cross[k].tr_mul(&reduced.fixed_rows::<6>(6 * slot));
            }
            inverse * rest
        };
        let points = self.points.iter().zip(&inverses).enumerate().map(point).collect();
        Some(Step { reduced, points })
    }
}
