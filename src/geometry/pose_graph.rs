//! A graph of cameras whose relative similarities were measured: where they all are, once loops are closed.
//!
//! Nodes are similarities `camera_from_world` (a camera's own unit against the world's is its scale), edges measured `to_from_from`. The residual
//! of an edge is the tangent of `E = to_from_from * from * to⁻¹` (rotation, translation, log scale; decoupled, see [`Sim3::tangent`]), each
//! part over its standard deviation. A chain of one camera's measurements drifts in scale as well; with seven numbers a node a loop gives back what
//! drifted (Strasdat, Montiel, Davison: Scale drift-aware large scale monocular SLAM, RSS 2010).
//!
//! Levenberg-Marquardt ([`least_squares`](super::least_squares)) with sparse normal equations: a Cholesky factor with an approximate minimum
//! degree order (`faer`), analysed once, on one thread. Cost: an iteration is proportional to the edges where the graph is a way with few
//! loops; figures in the bench `places`.
//!
//! Not here: which edges there are, robust losses (a wrong loop must be refused before), covariances.

use faer::Side;
use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::frames::{Camera, World};
use super::least_squares::{Damped, LeastSquares, LmOptions, LmSummary, minimise};
use super::sim3::Sim3;

/// Numbers of a node.
const N: usize = 7;

type Vector7 = SVector<f64, N>;
type Matrix7 = SMatrix<f64, N, N>;

/// A measured relative similarity.
#[derive(Debug, Clone, Copy)]
pub struct Edge {
    /// Numbers of two different nodes.
    pub from: usize,
    pub to: usize,
    pub to_from_from: Sim3<Camera, Camera>,
    pub sigma: EdgeSigma,
}

/// Standard deviations of an edge's parts; all positive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeSigma {
    pub rotation_rad: f64,
    /// In the unit of the node that the edge goes to.
    pub translation: f64,
    pub log_scale: f64,
}

/// Why a graph cannot be solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PoseGraphError {
    #[error("edge {edge} names node {node} of {nodes}")]
    UnknownNode { edge: usize, node: usize, nodes: usize },
    #[error("edge {edge} leads from node {node} to itself")]
    Loop { edge: usize, node: usize },
    #[error("{fixed} marks of held nodes for {nodes} nodes")]
    LengthMismatch { fixed: usize, nodes: usize },
    #[error("the normal equations of {nodes} nodes could not be ordered (out of memory)")]
    Order { nodes: usize },
}

/// The similarities of least cost near `start`; those of `fixed` nodes stay. What no chain of edges connects to a fixed node is held by the
/// damping alone. A cost that is not finite leaves everything as it is.
pub fn solve(
    start: Vec<Sim3<Camera, World>>,
    fixed: &[bool],
    edges: &[Edge],
    options: &LmOptions,
) -> Result<(Vec<Sim3<Camera, World>>, LmSummary), PoseGraphError> {
    let nodes = start.len();
    if fixed.len() != nodes {
        return Err(PoseGraphError::LengthMismatch { fixed: fixed.len(), nodes });
    }
    for (i, edge) in edges.iter().enumerate() {
        if let Some(&node) = [edge.from, edge.to].iter().find(|n| **n >= nodes) {
            return Err(PoseGraphError::UnknownNode { edge: i, node, nodes });
        }
        if edge.from == edge.to {
            return Err(PoseGraphError::Loop { edge: i, node: edge.from });
        }
    }
    let mut free = 0;
    let mut next = |fixed: &bool| {
        free += usize::from(!fixed);
        (!fixed).then(|| free - 1)
    };
    let number: Vec<Option<usize>> = fixed.iter().map(&mut next).collect();
    if free == 0 {
        let summary = LmSummary { initial_cost: 0.0, final_cost: 0.0, iterations: 0, converged: true };
        return Ok((start, summary));
    }
    let pattern = Pattern::new(free, &number, edges).ok_or(PoseGraphError::Order { nodes })?;
    let problem = PoseGraph { edges, number, pattern };
    Ok(minimise(&problem, start, options))
}

/// What the solver works on.
struct PoseGraph<'a> {
    edges: &'a [Edge],
    /// Of the free nodes, which are the unknowns.
    number: Vec<Option<usize>>,
    pattern: Pattern,
}

/// Where what stands in the lower triangle of the normal equations, in compressed columns, and the order of their elimination.
struct Pattern {
    matrix: SymbolicSparseColMat<usize>,
    symbolic: SymbolicLlt<usize>,
    /// Of each unknown node, those after it that it shares an edge with, ascending.
    later: Vec<Vec<usize>>,
}

impl Pattern {
    fn new(free: usize, number: &[Option<usize>], edges: &[Edge]) -> Option<Self> {
        let mut later = vec![Vec::new(); free];
        for edge in edges {
            if let (Some(a), Some(b)) = (number[edge.from], number[edge.to]) {
                later[a.min(b)].push(a.max(b));
            }
        }
        let (mut columns, mut rows) = (vec![0], Vec::new());
        for (node, later) in later.iter_mut().enumerate() {
            later.sort_unstable();
            later.dedup();
            for k in 0..N {
                rows.extend(node * N + k..(node + 1) * N);
                rows.extend(later.iter().flat_map(|&other| other * N..(other + 1) * N));
                columns.push(rows.len());
            }
        }
        let size = free * N;
        let matrix = SymbolicSparseColMat::new_checked(size, size, columns, None, rows);
        let symbolic = SymbolicLlt::try_new(matrix.as_ref(), Side::Lower).ok()?;
        Some(Self { matrix, symbolic, later })
    }

    /// Where column `k` of an unknown node begins: its diagonal element.
    fn diagonal(&self, node: usize, k: usize) -> usize {
        self.matrix.col_ptr()[node * N + k]
    }

    /// Adds to the block of a node with itself; its lower triangle counts.
    fn add_own(&self, values: &mut [f64], node: usize, block: &Matrix7) {
        for k in 0..N {
            let begin = self.diagonal(node, k);
            for a in k..N {
                values[begin + a - k] += block[(a, k)];
            }
        }
    }

    /// Adds to the block in the row of one node and the column of another.
    fn add_between(&self, values: &mut [f64], (row, column): (usize, usize), block: &Matrix7) {
        let Ok(place) = self.later[column].binary_search(&row) else { return };
        for k in 0..N {
            let begin = self.diagonal(column, k) + (N - k) + place * N;
            for a in 0..N {
                values[begin + a] += block[(a, k)];
            }
        }
    }
}

/// Normal equations at one state: the lower triangle in compressed columns, and what solves them.
struct SparseEquations {
    matrix: SymbolicSparseColMat<usize>,
    symbolic: SymbolicLlt<usize>,
    values: Vec<f64>,
    gradient: Vec<f64>,
}

impl Damped for SparseEquations {
    /// Of each unknown node.
    type Step = Vec<Vector7>;

    fn solve(&self, damping: f64) -> Option<(Self::Step, f64)> {
        let size = self.gradient.len();
        let place = |i: usize| self.matrix.col_ptr()[i];
        let largest = (0..size).map(|i| self.values[place(i)]).fold(0.0, f64::max);
        // A parameter that nothing depends on still gets a pivot.
        let floor = 1e-12 * largest + f64::MIN_POSITIVE;
        let damped_by = |i: usize| damping * self.values[place(i)].max(floor);
        let mut damped = self.values.clone();
        (0..size).for_each(|i| damped[place(i)] += damped_by(i) + floor);
        let matrix = SparseColMatRef::new(self.matrix.as_ref(), &damped);
        let factor = Llt::try_new_with_symbolic(self.symbolic.clone(), matrix, Side::Lower).ok()?;
        let mut delta = faer::Col::from_fn(size, |i| -self.gradient[i]);
        factor.solve_in_place(delta.as_mut());
        let predicted = (0..size).map(|i| delta[i] * (damped_by(i) * delta[i] - self.gradient[i])).sum();
        let step = (0..size / N).map(|node| Vector7::from_fn(|k, _| delta[node * N + k])).collect();
        Some((step, predicted))
    }

    fn length(step: &Self::Step) -> f64 {
        step.iter().map(Vector7::norm_squared).sum::<f64>().sqrt()
    }
}

impl LeastSquares for PoseGraph<'_> {
    type State = Vec<Sim3<Camera, World>>;
    type Normal = SparseEquations;

    fn linearise(&self, state: &Self::State) -> SparseEquations {
        let pattern = &self.pattern;
        let mut values = vec![0.0; pattern.matrix.row_idx().len()];
        let mut gradient = vec![0.0; self.pattern.later.len() * N];
        for edge in self.edges {
            let (residual, by_from, by_to) = linearised(edge, &state[edge.from], &state[edge.to]);
            let (from, to) = (self.number[edge.from], self.number[edge.to]);
            for (node, jacobian) in [(from, &by_from), (to, &by_to)] {
                let Some(node) = node else { continue };
                pattern.add_own(&mut values, node, &(jacobian.transpose() * jacobian));
                let g = jacobian.transpose() * residual;
                (0..N).for_each(|k| gradient[node * N + k] += g[k]);
            }
            if let (Some(from), Some(to)) = (from, to) {
                let between = by_from.transpose() * by_to;
                match from > to {
                    true => pattern.add_between(&mut values, (from, to), &between),
                    false => pattern.add_between(&mut values, (to, from), &between.transpose()),
                }
            }
        }
        SparseEquations { matrix: pattern.matrix.clone(), symbolic: pattern.symbolic.clone(), values, gradient }
    }

    fn cost(&self, state: &Self::State) -> f64 {
        let cost = |edge: &Edge| whitened(edge, &error(edge, &state[edge.from], &state[edge.to])).norm_squared();
        let cost: f64 = self.edges.iter().map(cost).sum();
        if cost.is_finite() { cost } else { f64::INFINITY }
    }

    fn step(&self, state: &Self::State, delta: &Vec<Vector7>) -> Self::State {
        let moved = |(node, number): (&Sim3<Camera, World>, &Option<usize>)| match number {
            Some(i) => node.perturb_left(&delta[*i]),
            None => *node,
        };
        state.iter().zip(&self.number).map(moved).collect()
    }
}

/// What the measurement and the nodes leave between them; the identity where they agree.
fn error(edge: &Edge, from: &Sim3<Camera, World>, to: &Sim3<Camera, World>) -> Sim3<Camera, Camera> {
    edge.to_from_from * *from * to.inverse()
}

fn inverse_sigma(edge: &Edge) -> Vector7 {
    let EdgeSigma { rotation_rad: r, translation: t, log_scale: s } = edge.sigma;
    Vector7::from_column_slice(&[1.0 / r, 1.0 / r, 1.0 / r, 1.0 / t, 1.0 / t, 1.0 / t, 1.0 / s])
}

fn whitened(edge: &Edge, error: &Sim3<Camera, Camera>) -> Vector7 {
    error.tangent().component_mul(&inverse_sigma(edge))
}

/// The whitened residual and how it answers to left perturbations of both nodes.
///
/// `from` moves E by its own perturbation seen through the measurement M: `M d M⁻¹ E`, so with `w' = R_M w` its rotation by `w'`, its
/// translation by `s_M R_M v + (w' x + l)(t_E - t_M)`. `to` moves it by `E d⁻¹`: its rotation by `-w` on the right, its translation by `-s_E R_E v`.
fn linearised(edge: &Edge, from: &Sim3<Camera, World>, to: &Sim3<Camera, World>) -> (Vector7, Matrix7, Matrix7) {
    let (m, e) = (&edge.to_from_from, error(edge, from, to));
    let turn = e.rotation.scaled_axis();
    let (m_turn, e_turn) = (m.rotation.to_rotation_matrix(), e.rotation.to_rotation_matrix());
    let left = left_jacobian_inverse(&turn);
    let (mut by_from, mut by_to) = (Matrix7::zeros(), Matrix7::zeros());
    by_from.fixed_view_mut::<3, 3>(0, 0).copy_from(&(left * m_turn.matrix()));
    let arm: Vector3<f64> = e.translation - m.translation;
    by_from.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-arm.cross_matrix() * m_turn.matrix()));
    by_from.fixed_view_mut::<3, 3>(3, 3).copy_from(&(m_turn.matrix() * m.scale));
    by_from.fixed_view_mut::<3, 1>(3, 6).copy_from(&arm);
    by_from[(6, 6)] = 1.0;
    // The right Jacobian is the left one's transpose.
    by_to.fixed_view_mut::<3, 3>(0, 0).copy_from(&-left.transpose());
    by_to.fixed_view_mut::<3, 3>(3, 3).copy_from(&(e_turn.matrix() * -e.scale));
    by_to[(6, 6)] = -1.0;
    let weights = Matrix7::from_diagonal(&inverse_sigma(edge));
    (whitened(edge, &e), weights * by_from, weights * by_to)
}

/// How the logarithm of a rotation `exp(turn)` answers to a small rotation on its left.
fn left_jacobian_inverse(turn: &Vector3<f64>) -> Matrix3<f64> {
    let (angle, cross) = (turn.norm(), turn.cross_matrix());
    // (1 - (angle / 2) cot(angle / 2)) / angle², whose limit is 1 / 12.
    let second = if angle < 1e-4 { 1.0 / 12.0 } else { (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle) };
    Matrix3::identity() - cross * 0.5 + cross * cross * second
}

#[cfg(test)]
mod tests;
