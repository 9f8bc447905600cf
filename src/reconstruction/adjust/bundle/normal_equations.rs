//! The normal equations of an adjustment, and their Schur complement on the cameras.
//!
//! Unknowns of the reduced system, in this order: six for each free camera, the readout time, the shared numbers (the last two if they are
//! asked for).

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SMatrix, Vector3, Vector6};

use super::problem::{BundleProblem, FIXED, huber};
use super::shared::{SHARED, SharedMatrix, SharedVector};
use crate::reconstruction::measurement::{accumulate, is_diagonal, jacobian_rows};

type Matrix6xS = SMatrix<f64, 6, SHARED>;
type MatrixSx3 = SMatrix<f64, SHARED, 3>;
type Matrix6x3 = SMatrix<f64, 6, 3>;

/// Normal equations at one linearisation point.
#[derive(Default)]
pub(super) struct System {
    /// Free cameras: own 6x6 block (upper triangle) and gradient.
    pub(super) camera_h: Vec<Matrix6<f64>>,
    pub(super) camera_g: Vec<Vector6<f64>>,
    pub(super) point_h: Vec<Matrix3<f64>>,
    pub(super) point_g: Vec<Vector3<f64>>,
    /// Camera-point block of each observation (zero for fixed cameras and outliers).
    pub(super) cross: Vec<Matrix6x3>,
    /// The same between cameras and the readout time, it and the points, it and the shared numbers, and its own.
    pub(super) camera_readout: Vec<Vector6<f64>>,
    pub(super) readout_point: Vec<Vector3<f64>>,
    pub(super) readout_shared: SharedVector,
    pub(super) readout_h: f64,
    pub(super) readout_g: f64,
    /// The same between cameras and shared numbers, shared numbers and points, and among the shared numbers.
    pub(super) camera_shared: Vec<Matrix6xS>,
    pub(super) shared_point: Vec<MatrixSx3>,
    pub(super) shared_h: SharedMatrix,
    pub(super) shared_g: SharedVector,
    pub(super) cost: f64,
}
impl BundleProblem {
    pub(super) fn linearise(&self, slot: &[u32], free: usize, delta2: f64, system: &mut System) {
        system.camera_h.clear();
        system.camera_h.resize(free, Matrix6::zeros());
        system.camera_g.clear();
        system.camera_g.resize(free, Vector6::zeros());
        system.point_h.clear();
        system.point_g.clear();
        system.cross.clear();
        system.cross.resize(self.observations.len(), Matrix6x3::zeros());
        system.camera_shared.clear();
        system.shared_point.clear();
        system.shared_h = SharedMatrix::zeros();
        system.shared_g = SharedVector::zeros();
        system.cost = self.prior_cost();
        system.camera_readout.clear();
        system.camera_readout.resize(free, Vector6::zeros());
        system.readout_point.clear();
        system.readout_shared = SharedVector::zeros();
        (system.readout_h, system.readout_g) = (0.0, 0.0);
        let find_readout = self.readout.unknowns() > 0;
        if self.shared.is_some() {
            system.camera_shared.resize(free, Matrix6xS::zeros());
        }
        // Pixels that a step on the plane z = 1 is.
        let scale = self.focal_scale();
        let rotations: Vec<Matrix3<f64>> =
            self.cameras.iter().map(|c| *c.camera_from_world.rotation.to_rotation_matrix().matrix()).collect();
        for (i, point) in self.points.iter().enumerate() {
            let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
            let mut with_readout = Vector3::zeros();
            let mut with_shared = MatrixSx3::zeros();
            for k in self.range(i) {
                if !self.inlier[k] {
                    continue;
                }
                let o = &self.observations[k];
                let Some((e, p)) = self.residual(point, k) else {
                    system.cost += 100.0 * delta2;
                    continue;
                };
                let (rho, w) = huber(e.norm_squared(), delta2);
                system.cost += rho;
                let pixels = o.pixel_scale * o.inv_sigma_px;
                let (jx, jy) = jacobian_rows(&p, &(pixels * scale));
                // d e / d point = d e / d translation * R.
                let r = &rotations[o.camera as usize];
                let px = r.row(0) * jx[3] + r.row(1) * jx[4] + r.row(2) * jx[5];
                let py = r.row(0) * jy[3] + r.row(1) * jy[4] + r.row(2) * jy[5];
                for c in 0..3 {
                    for d in 0..=c {
                        h[(d, c)] += w * (px[d] * px[c] + py[d] * py[c]);
                    }
                    g[c] += w * (px[c] * e.x + py[c] * e.y);
                }
                let s = slot[o.camera as usize];
                // d e / d readout: as the shared numbers, the observation moves against it.
                let moved = pixels * o.displacement * scale;
                if find_readout {
                    system.readout_h += moved.norm_squared() * w;
                    system.readout_g += moved.dot(&e) * w;
                    with_readout += (px * moved.x + py * moved.y).transpose() * w;
                    if s != FIXED {
                        system.camera_readout[s as usize] +=
                            (Vector6::from(jx) * moved.x + Vector6::from(jy) * moved.y) * w;
                    }
                }
                if let Some(shared) = &self.shared {
                    // d e / d shared: the observation moves, so the residual moves against it.
                    let d = shared.jacobian(k, &self.off(k, &p));
                    let (x, y) = (d.row(0).transpose(), d.row(1).transpose());
                    let (mut dx, mut dy) = (x * -pixels.m11, y * -pixels.m22);
                    if !is_diagonal(&pixels) {
                        dx -= y * pixels.m12;
                        dy -= x * pixels.m21;
                    }
                    system.readout_shared += (dx * moved.x + dy * moved.y) * w;
                    system.shared_h += (dx * dx.transpose() + dy * dy.transpose()) * w;
                    system.shared_g += (dx * e.x + dy * e.y) * w;
                    with_shared += (dx * px + dy * py) * w;
                    if s != FIXED {
                        let (jx, jy) = (Vector6::from(jx), Vector6::from(jy));
                        system.camera_shared[s as usize] += (jx * dx.transpose() + jy * dy.transpose()) * w;
                    }
                }
                if s != FIXED {
                    let s = s as usize;
                    accumulate(&mut system.camera_h[s], &jx, &jy, w);
                    let cross = &mut system.cross[k];
                    for row in 0..6 {
                        system.camera_g[s][row] += w * (jx[row] * e.x + jy[row] * e.y);
                        let (a, b) = (w * jx[row], w * jy[row]);
                        for c in 0..3 {
                            cross[(row, c)] = a * px[c] + b * py[c];
                        }
                    }
                }
            }
            h[(1, 0)] = h[(0, 1)];
            h[(2, 0)] = h[(0, 2)];
            h[(2, 1)] = h[(1, 2)];
            system.point_h.push(h);
            system.point_g.push(g);
            system.readout_point.push(with_readout);
            if self.shared.is_some() {
                system.shared_point.push(with_shared);
            }
        }
    }

    /// The reduced system of cameras (readout time, and shared numbers) at this damping, right-hand side, and the inverted point
    /// blocks. The prior of the shared numbers is left out, that of the readout time is in it.
    pub(super) fn reduce(
        &self,
        slot: &[u32],
        free: usize,
        system: &System,
        lambda: f64,
    ) -> (DMatrix<f64>, DVector<f64>, Vec<Matrix3<f64>>) {
        let shared = self.shared.as_ref().map_or(0, |s| s.active);
        let readout = self.readout.unknowns();
        let at = 6 * free + readout;
        let size = at + shared;
        let mut s = DMatrix::<f64>::zeros(size, size);
        let mut g = DVector::<f64>::zeros(size);
        for (i, (h, gradient)) in system.camera_h.iter().zip(&system.camera_g).enumerate() {
            for c in 0..6 {
                for r in 0..=c {
                    s[(6 * i + r, 6 * i + c)] = h[(r, c)];
                }
                s[(6 * i + c, 6 * i + c)] += lambda * h[(c, c)] + 1e-9;
                g[6 * i + c] = -gradient[c];
            }
        }
        if readout > 0 {
            for (i, block) in system.camera_readout.iter().enumerate() {
                s.fixed_view_mut::<6, 1>(6 * i, 6 * free).copy_from(block);
            }
            let (information, pull) = self.readout.prior();
            s[(6 * free, 6 * free)] = system.readout_h + information;
            s.view_mut((6 * free, at), (1, shared)).copy_from(&system.readout_shared.rows(0, shared).transpose());
            g[6 * free] = pull - system.readout_g;
        }
        if shared > 0 {
            for (i, block) in system.camera_shared.iter().enumerate() {
                s.view_mut((6 * i, at), (6, shared)).copy_from(&block.columns(0, shared));
            }
            let own = system.shared_h.view((0, 0), (shared, shared));
            s.view_mut((at, at), (shared, shared)).copy_from(&own);
            g.rows_mut(at, shared).copy_from(&-system.shared_g.rows(0, shared));
        }
        let mut inverses = Vec::with_capacity(self.points.len());
        for i in 0..self.points.len() {
            let mut c = system.point_h[i];
            for d in 0..3 {
                c[(d, d)] += lambda * c[(d, d)] + 1e-9;
            }
            let inverse = c.try_inverse().unwrap_or_else(Matrix3::zeros);
            let rest = inverse * system.point_g[i];
            let range = self.range(i);
            for a in range.clone() {
                let sa = slot[self.observations[a].camera as usize];
                if sa == FIXED || !self.inlier[a] {
                    continue;
                }
                let y = system.cross[a] * inverse;
                let mut part = g.fixed_rows_mut::<6>(6 * sa as usize);
                part += system.cross[a] * rest;
                for b in range.clone() {
                    let sb = slot[self.observations[b].camera as usize];
                    // Upper triangle of blocks only.
                    if sb == FIXED || sb < sa || !self.inlier[b] {
                        continue;
                    }
                    let mut block = s.fixed_view_mut::<6, 6>(6 * sa as usize, 6 * sb as usize);
                    block -= y * system.cross[b].transpose();
                }
                if readout > 0 {
                    let mut border = s.fixed_view_mut::<6, 1>(6 * sa as usize, 6 * free);
                    border -= y * system.readout_point[i];
                }
                if shared > 0 {
                    let border = y * system.shared_point[i].transpose();
                    let mut block = s.view_mut((6 * sa as usize, at), (6, shared));
                    block -= border.columns(0, shared);
                }
            }
            if readout > 0 {
                let w = &system.readout_point[i];
                s[(6 * free, 6 * free)] -= w.dot(&(inverse * w));
                g[6 * free] += w.dot(&rest);
                if shared > 0 {
                    let border = (system.shared_point[i] * (inverse * w)).transpose();
                    let mut block = s.view_mut((6 * free, at), (1, shared));
                    block -= border.columns(0, shared);
                }
            }
            if shared > 0 {
                let w = &system.shared_point[i];
                let own = w * inverse * w.transpose();
                let mut block = s.view_mut((at, at), (shared, shared));
                block -= own.view((0, 0), (shared, shared));
                let mut part = g.rows_mut(at, shared);
                part += (w * rest).rows(0, shared);
            }
            inverses.push(inverse);
        }
        for c in 0..size {
            for r in 0..c {
                s[(c, r)] = s[(r, c)];
            }
        }
        (s, g, inverses)
    }
}
