//! The normal equations of an adjustment, and their Schur complement on cameras and global parameters.
//!
//! Unknowns of the reduced system, in this order: six for each free pose, `W` global parameters. Everything is summed from the two rows
//! of each observation's Jacobian.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SMatrix, SVector, Vector1, Vector2, Vector3, Vector6};

use super::floor::Rows;
use super::globals::focal_scale;
use super::options::LEAST_PIVOT;
use super::problem::{BundleProblem, BundleState};
use crate::geometry::Se3;
use crate::geometry::cholesky::DenseCholesky;
use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::{Damped, LeastSquares, Loss, damped};
use crate::reconstruction::measurement::{BEHIND_CAMERA, CHI2_2D_95, jacobian_rows};

/// In the place of a fixed camera's index among the free ones.
const FIXED: usize = usize::MAX;
type Matrix6x3 = SMatrix<f64, 6, 3>;

/// A bundle adjustment with its first `W` global parameters: one, or all of them.
pub(super) struct Adjustment<'a, const W: usize> {
    problem: &'a BundleProblem,
    /// Index of each camera among the free ones.
    slot: Vec<usize>,
    free: usize,
    loss: Loss,
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

impl<const W: usize> CameraBlock<W> {
    /// A residual and its derivative by this pose.
    #[inline]
    fn add(&mut self, weight: f64, by_pose: &Rows<6>, residual: &Rows<1>) {
        add_product(&mut self.own, weight, by_pose, by_pose);
        add_product(&mut self.gradient, weight, by_pose, residual);
    }
}

/// The same of a point, and where its camera blocks end.
pub(super) struct PointBlock<const W: usize> {
    pub(super) own: Matrix3<f64>,
    gradient: Vector3<f64>,
    global: SMatrix<f64, W, 3>,
    cross_end: usize,
}

/// Normal equations at one state, the prior of the global parameters in them.
pub(super) struct System<const W: usize> {
    cameras: Vec<CameraBlock<W>>,
    pub(super) points: Vec<PointBlock<W>>,
    /// Blocks between two free poses, the later one's rows: cameras between which a length is known, a camera and the target that it sees or the floor
    /// that it drives on.
    pairs: Vec<(usize, usize, Matrix6<f64>)>,
    /// Index of a free camera, or of the floor, and its block with a point, grouped by point.
    cross: Vec<(usize, Matrix6x3)>,
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

/// `matrix[at..] -= a bᵀ`
#[inline]
fn subtract_product<const R: usize, const C: usize>(
    matrix: &mut DMatrix<f64>,
    at: (usize, usize),
    a: &SMatrix<f64, R, 3>,
    b: &SMatrix<f64, C, 3>,
) {
    let rows = matrix.nrows();
    for c in 0..C {
        let begin = (at.1 + c) * rows + at.0;
        let column = &mut matrix.as_mut_slice()[begin..begin + R];
        for (r, value) in column.iter_mut().enumerate() {
            *value -= a[(r, 0)] * b[(c, 0)] + a[(r, 1)] * b[(c, 1)] + a[(r, 2)] * b[(c, 2)];
        }
    }
}

impl<'p, const W: usize> Adjustment<'p, W> {
    pub(super) fn new(problem: &'p BundleProblem, loss: Loss) -> Self {
        let mut free = 0;
        let slot = problem.fixed.iter().map(|fixed| {
            if *fixed {
                return FIXED;
            }
            free += 1;
            free - 1
        });
        Self { problem, slot: slot.collect(), free, loss }
    }

    /// Index of a camera among the free ones.
    pub(super) fn slot_of(&self, camera: usize) -> Option<usize> {
        self.slot.get(camera).copied().filter(|slot| *slot != FIXED)
    }

    fn add_lengths(&self, state: &BundleState, system: &mut System<W>) {
        for known in &self.problem.lengths {
            let Some(term) = known.term(&state.poses) else { continue };
            let slots = known.cameras.map(|camera| self.slot[camera as usize]);
            for (i, &slot) in slots.iter().enumerate() {
                if let Some(block) = system.cameras.get_mut(slot) {
                    block.own += term.own[i];
                    block.gradient += term.gradient[i];
                }
            }
            match slots {
                [FIXED, _] | [_, FIXED] => {}
                [a, b] if a > b => system.pairs.push((a, b, term.cross)),
                [a, b] => system.pairs.push((b, a, term.cross.transpose())),
            }
        }
    }

    /// What was seen of targets of known size: ties a target to a camera, as no point that is eliminated does.
    fn add_corners(&self, state: &BundleState, rotations: &[Matrix3<f64>], system: &mut System<W>) {
        for (k, corner) in self.problem.seen_corners().filter(|(k, _)| self.problem.inlier[*k]) {
            let (camera, target) = (self.problem.observations[k].camera as usize, corner.target as usize);
            let point = self.problem.corner(state, corner);
            let Some(o) = self.observation(state, &point, k, &rotations[camera]) else { continue };
            let by_target = o.point.map(|by_point| corner.by_pose(&by_point, &rotations[target]));
            add_product(&mut system.global, o.weight, &o.global, &o.global);
            add_product(&mut system.global_gradient, o.weight, &o.global, &o.residual);
            let slots = [camera, target].map(|pose| self.slot[pose]);
            for (slot, by_pose) in slots.into_iter().zip([&o.camera, &by_target]) {
                if let Some(block) = system.cameras.get_mut(slot) {
                    block.add(o.weight, by_pose, &o.residual);
                    add_product(&mut block.global, o.weight, &o.global, by_pose);
                }
            }
            let [camera, target] = slots;
            if camera != FIXED {
                let mut between = Matrix6::zeros();
                add_product(&mut between, o.weight, &by_target, &o.camera);
                system.pairs.push((target, camera, between));
            }
        }
    }

    /// A point that lies on the floor.
    fn add_floor_point(
        &self,
        state: &BundleState,
        rotations: &[Matrix3<f64>],
        point: usize,
        block: &mut PointBlock<W>,
        system: &mut System<W>,
    ) {
        let Some(held) = self.problem.floor.as_ref().filter(|held| held.on_floor[point]) else { return };
        let pose = held.pose as usize;
        let term = held.point_term(&state.poses[pose], &rotations[pose], &state.points[point]);
        add_product(&mut block.own, term.weight, &term.by_other, &term.by_other);
        add_product(&mut block.gradient, term.weight, &term.by_other, &term.residual);
        system.cameras[self.slot[pose]].add(term.weight, &term.by_floor, &term.residual);
        let mut cross = Matrix6x3::zeros();
        add_product(&mut cross, term.weight, &term.by_floor, &term.by_other);
        system.cross.push((self.slot[pose], cross));
    }

    /// The floor under landmarks that stay, and cameras that keep height and tilt above it.
    fn add_heights(&self, state: &BundleState, rotations: &[Matrix3<f64>], system: &mut System<W>) {
        let Some(held) = &self.problem.floor else { return };
        let pose = held.pose as usize;
        for point in &held.around {
            let term = held.point_term(&state.poses[pose], &rotations[pose], point);
            system.cameras[self.slot[pose]].add(term.weight, &term.by_floor, &term.residual);
        }
        for camera in held.cameras.iter().map(|camera| *camera as usize) {
            let (floor, camera_pose) =
                ((&state.poses[pose], &rotations[pose]), (&state.poses[camera], &rotations[camera]));
            let slots = [pose, camera].map(|pose| self.slot[pose]);
            for term in [held.camera_term(floor, camera_pose), held.tilt_term(floor, camera_pose)] {
                for (slot, by_pose) in slots.into_iter().zip([&term.by_floor, &term.by_other]) {
                    if let Some(block) = system.cameras.get_mut(slot) {
                        block.add(term.weight, by_pose, &term.residual);
                    }
                }
                let [floor, camera] = slots;
                if camera != FIXED {
                    let mut between = Matrix6::zeros();
                    add_product(&mut between, term.weight, &term.by_floor, &term.by_other);
                    system.pairs.push((floor, camera, between));
                }
            }
        }
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
        let (_, weight) = self.loss.evaluate(e.norm_squared());
        let (jx, jy) = jacobian_rows(&p, &(o.sqrt_information * focal_scale(&state.globals)));
        // d e / d point = d e / d translation * R.
        let by_point = |j: &[f64; 6]| rotation.tr_mul(&Vector3::new(j[3], j[4], j[5]));
        let off = self.problem.off(state, k, &p);
        let global = o.sqrt_information * self.problem.globals.jacobian::<W>(k, &off, &o.displacement, &state.globals);
        Some(Linearised {
            residual: [Vector1::new(e.x), Vector1::new(e.y)],
            weight,
            camera: [jx.into(), jy.into()],
            point: [by_point(&jx), by_point(&jy)],
            global: [global.row(0).transpose(), global.row(1).transpose()],
        })
    }
}

impl<const W: usize> LeastSquares for Adjustment<'_, W> {
    type State = BundleState;
    type Normal = System<W>;

    fn linearise(&self, state: &BundleState) -> System<W> {
        let none = CameraBlock { own: Matrix6::zeros(), gradient: Vector6::zeros(), global: SMatrix::zeros() };
        let prior: [(f64, f64); W] = std::array::from_fn(|i| self.problem.globals.prior(i, state.globals[i]));
        let on_floor = self.problem.floor.as_ref().map_or(0, |held| held.on_floor.iter().filter(|on| **on).count());
        let mut system = System {
            cameras: vec![none; self.free],
            points: Vec::with_capacity(state.points.len()),
            pairs: Vec::new(),
            cross: Vec::with_capacity(self.problem.observations.len() + on_floor),
            global: SMatrix::from_diagonal(&prior.map(|p| p.1).into()),
            global_gradient: prior.map(|p| p.0).into(),
        };
        let rotations: Vec<Matrix3<f64>> =
            state.poses.iter().map(|pose| *pose.rotation.to_rotation_matrix().matrix()).collect();
        for (i, point) in state.points.iter().enumerate() {
            let (own, gradient, global) = (Matrix3::zeros(), Vector3::zeros(), SMatrix::zeros());
            let mut block = PointBlock { own, gradient, global, cross_end: 0 };
            for k in self.problem.inliers(i) {
                let camera = self.problem.observations[k].camera as usize;
                let Some(o) = self.observation(state, point, k, &rotations[camera]) else { continue };
                add_product(&mut block.own, o.weight, &o.point, &o.point);
                add_product(&mut block.gradient, o.weight, &o.point, &o.residual);
                add_product(&mut block.global, o.weight, &o.global, &o.point);
                add_product(&mut system.global, o.weight, &o.global, &o.global);
                add_product(&mut system.global_gradient, o.weight, &o.global, &o.residual);
                if let Some(block) = system.cameras.get_mut(self.slot[camera]) {
                    block.add(o.weight, &o.camera, &o.residual);
                    add_product(&mut block.global, o.weight, &o.global, &o.camera);
                    let mut cross = Matrix6x3::zeros();
                    add_product(&mut cross, o.weight, &o.camera, &o.point);
                    system.cross.push((self.slot[camera], cross));
                }
            }
            self.add_floor_point(state, &rotations, i, &mut block, &mut system);
            block.cross_end = system.cross.len();
            system.points.push(block);
        }
        self.add_lengths(state, &mut system);
        self.add_corners(state, &rotations, &mut system);
        self.add_heights(state, &rotations, &mut system);
        system
    }

    /// Sum of the robust costs, sigma-scaled squares, and of the priors'.
    fn cost(&self, state: &BundleState) -> f64 {
        let price = |(e, _): (Vector2<f64>, Vector3<f64>)| self.loss.evaluate(e.norm_squared()).0;
        let behind = BEHIND_CAMERA * CHI2_2D_95;
        let mut cost = self.problem.globals.prior_cost(&state.globals);
        cost += self.problem.lengths.iter().map(|length| length.cost(&state.poses)).sum::<f64>();
        cost += self.problem.floor.as_ref().map_or(0.0, |held| held.cost(&state.poses, &state.points));
        for (i, point) in state.points.iter().enumerate() {
            for k in self.problem.inliers(i) {
                let residual = self.problem.residual(state, point, k);
                cost += residual.map_or(behind, price);
            }
        }
        for (k, corner) in self.problem.seen_corners().filter(|(k, _)| self.problem.inlier[*k]) {
            let residual = self.problem.residual(state, &self.problem.corner(state, corner), k);
            cost += residual.map_or(behind, price);
        }
        cost
    }

    fn step(&self, state: &BundleState, step: &Step) -> BundleState {
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

impl<const W: usize> System<W> {
    /// Blocks between a point and the free cameras that see it, with the cameras' indices.
    fn seen(&self, point: usize) -> &[(usize, Matrix6x3)] {
        let begin = point.checked_sub(1).map_or(0, |before| self.points[before].cross_end);
        &self.cross[begin..self.points[point].cross_end]
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
            s.fixed_view_mut::<6, 6>(6 * i, 6 * i).copy_from(&damped(&camera.own, damping, LEAST_PIVOT));
            s.fixed_view_mut::<W, 6>(at, 6 * i).copy_from(&camera.global);
            g.fixed_rows_mut::<6>(6 * i).copy_from(&-camera.gradient);
        }
        for (later, earlier, block) in &self.pairs {
            let mut between = s.fixed_view_mut::<6, 6>(6 * later, 6 * earlier);
            between += block;
        }
        s.fixed_view_mut::<W, W>(at, at).copy_from(&self.global);
        g.fixed_rows_mut::<W>(at).copy_from(&-self.global_gradient);
        let mut inverses = Vec::with_capacity(self.points.len());
        for (i, point) in self.points.iter().enumerate() {
            let inverse = damped(&point.own, damping, LEAST_PIVOT).try_inverse();
            let inverse = inverse.filter(|m| m.iter().all(|v| v.is_finite())).unwrap_or_else(Matrix3::zeros);
            let rest = inverse * point.gradient;
            let seen = self.seen(i);
            for (a, cross_a) in seen {
                let y = cross_a * inverse;
                let mut part = g.fixed_rows_mut::<6>(6 * a);
                part += cross_a * rest;
                for (b, cross_b) in seen.iter().filter(|(b, _)| b <= a) {
                    subtract_product(&mut s, (6 * a, 6 * b), &y, cross_b);
                }
                subtract_product(&mut s, (at, 6 * a), &point.global, &y);
            }
            subtract_product(&mut s, (at, at), &(point.global * inverse), &point.global);
            let mut part = g.fixed_rows_mut::<W>(at);
            part += point.global * rest;
            inverses.push(inverse);
        }
        Reduced { matrix: s, right: g, inverses }
    }

    /// By how much the linearised cost falls with a step: `-δᵀg + δᵀDδ`, D what the damping added.
    fn predicted_gain(&self, step: &Step, damping: f64) -> f64 {
        fn of<const N: usize>(
            step: &SVector<f64, N>,
            own: &SMatrix<f64, N, N>,
            gradient: &SVector<f64, N>,
            damping: f64,
        ) -> f64 {
            let added = |i: usize| step[i] * step[i] * (damping * own[(i, i)] + LEAST_PIVOT);
            (0..N).map(added).sum::<f64>() - step.dot(gradient)
        }
        let pose = |i: usize| step.reduced.fixed_rows::<6>(6 * i).into_owned();
        let cameras = self.cameras.iter().enumerate();
        cameras.map(|(i, camera)| of(&pose(i), &camera.own, &camera.gradient, damping)).sum::<f64>()
            + self.points.iter().zip(&step.points).map(|(p, step)| of(step, &p.own, &p.gradient, damping)).sum::<f64>()
            - step.reduced.fixed_rows::<W>(self.globals_at()).dot(&self.global_gradient)
    }
}

impl<const W: usize> Damped for System<W> {
    type Step = Step;

    fn solve(&self, damping: f64) -> Option<(Step, f64)> {
        let Reduced { matrix, right, inverses } = self.reduce(damping);
        let reduced = DenseCholesky::of(matrix)?.solve(right);
        let global = reduced.fixed_rows::<W>(self.globals_at());
        let point = |(i, (point, inverse)): (usize, (&PointBlock<W>, &Matrix3<f64>))| {
            let mut rest = -point.gradient - point.global.tr_mul(&global);
            for (camera, cross) in self.seen(i) {
                rest -= cross.tr_mul(&reduced.fixed_rows::<6>(6 * camera));
            }
            inverse * rest
        };
        let points = self.points.iter().zip(&inverses).enumerate().map(point).collect();
        let step = Step { reduced, points };
        let predicted = self.predicted_gain(&step, damping);
        Some((step, predicted))
    }

    fn length(step: &Step) -> f64 {
        (step.reduced.norm_squared() + step.points.iter().map(Vector3::norm_squared).sum::<f64>()).sqrt()
    }
}
