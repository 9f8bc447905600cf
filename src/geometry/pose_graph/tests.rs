use nalgebra::UnitQuaternion;

use super::*;
use crate::geometry::random::Random;
use crate::geometry::synthetic::random_rotation;

const SIGMA: EdgeSigma = EdgeSigma { rotation_rad: 0.01, translation: 0.02, log_scale: 0.01 };

fn random<A, B>(random: &mut Random, angle: f64) -> Sim3<A, B> {
    let t = Vector3::new(random.normal(), random.normal(), random.normal());
    Sim3::new(random.uniform(0.5, 2.0), random_rotation(random, angle), t)
}

/// A ring of `nodes` cameras, 0.1 apart, that look outward; edges to the next three along the way, each wrong by the same small turn and scale, and
/// one that closes it. Truth, what the edges tell without the loop, edges, how far the last camera has drifted.
struct Ring {
    truth: Vec<Sim3<Camera, World>>,
    start: Vec<Sim3<Camera, World>>,
    edges: Vec<Edge>,
    drift: f64,
}

fn centre(node: &Sim3<Camera, World>) -> Vector3<f64> {
    node.inverse().translation
}

fn ring(nodes: usize) -> Ring {
    let radius = 0.1 * nodes as f64 / std::f64::consts::TAU;
    let camera = |i: usize| {
        let angle = std::f64::consts::TAU * i as f64 / nodes as f64;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * angle);
        Sim3::<World, Camera>::new(1.0, turn, turn * Vector3::z() * radius).inverse()
    };
    let truth: Vec<_> = (0..nodes).map(camera).collect();
    // In all a tenth of the scale and some degrees.
    let n = nodes as f64;
    let wrong = |steps: f64| {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.02, 0.08, -0.03) * (steps / n));
        Sim3::<Camera, Camera>::new((-0.1 * steps / n).exp(), turn, Vector3::zeros())
    };
    let told = |from: usize, to: usize| wrong((to - from) as f64) * truth[to] * truth[from].inverse();
    let mut edges = Vec::new();
    for from in 0..nodes {
        for to in from + 1..(from + 4).min(nodes) {
            edges.push(Edge { from, to, to_from_from: told(from, to), sigma: SIGMA });
        }
    }
    let mut start = vec![truth[0]];
    (1..nodes).for_each(|i| start.push(told(i - 1, i) * start[i - 1]));
    let drift = (centre(&start[nodes - 1]) - centre(&truth[nodes - 1])).norm();
    let closing = truth[nodes - 1] * truth[0].inverse();
    edges.push(Edge { from: 0, to: nodes - 1, to_from_from: closing, sigma: SIGMA });
    Ring { truth, start, edges, drift }
}

fn held_first(nodes: usize) -> Vec<bool> {
    (0..nodes).map(|i| i == 0).collect()
}

#[test]
fn jacobians_agree_with_numeric_differences() {
    let mut r = Random::new(1);
    for case in 0..20 {
        let (from, to) = (random::<Camera, World>(&mut r, 2.0), random::<Camera, World>(&mut r, 2.0));
        let angle = [0.0, 0.3, 2.0][case % 3];
        let error = random::<Camera, Camera>(&mut r, angle);
        let edge = Edge { from: 0, to: 1, to_from_from: error * to * from.inverse(), sigma: SIGMA };
        let (residual, by_from, by_to) = linearised(&edge, &from, &to);
        let at = |from: &Sim3<Camera, World>, to: &Sim3<Camera, World>| whitened(&edge, &super::error(&edge, from, to));
        assert!((residual - at(&from, &to)).norm() < 1e-9);
        for k in 0..N {
            let step = |h: f64| Vector7::from_fn(|i, _| if i == k { h } else { 0.0 });
            let h = 1e-6;
            let numeric = (at(&from.perturb_left(&step(h)), &to) - at(&from.perturb_left(&step(-h)), &to)) / (2.0 * h);
            assert!((numeric - by_from.column(k)).norm() < 1e-4, "case {case}, {k}: {numeric} {}", by_from.column(k));
            let numeric = (at(&from, &to.perturb_left(&step(h))) - at(&from, &to.perturb_left(&step(-h)))) / (2.0 * h);
            assert!((numeric - by_to.column(k)).norm() < 1e-4, "case {case}, {k}: {numeric} {}", by_to.column(k));
        }
    }
}

#[test]
fn a_drifting_ring_closes_to_a_twentieth_and_its_scale_too() {
    let Ring { truth, start, edges, drift } = ring(200);
    let (solved, summary) = solve(start.clone(), &held_first(200), &edges, &LmOptions::default()).expect("a graph");
    let worst = |nodes: &[Sim3<Camera, World>]| {
        nodes.iter().zip(&truth).map(|(a, b)| (centre(a) - centre(b)).norm()).fold(0.0, f64::max)
    };
    let end = (centre(&solved[199]) - centre(&truth[199])).norm();
    assert!(drift > 0.4 && end < drift / 20.0, "{drift} {end}, {summary:?}");
    assert!(worst(&solved) < worst(&start) / 3.0, "{} {}", worst(&solved), worst(&start));
    let scale = solved.iter().map(|s| s.scale.ln().abs()).fold(0.0, f64::max);
    assert!(start[199].scale.ln().abs() > 0.09 && scale < 0.05, "{scale}");
    assert!(summary.converged, "{summary:?}");
}

#[test]
fn the_sparse_step_is_that_of_the_dense_equations() {
    let Ring { start, edges, .. } = ring(8);
    let number: Vec<_> = (0..8).map(|i: usize| i.checked_sub(1)).collect();
    let pattern = Pattern::new(7, &number, &edges).expect("an order");
    let problem = PoseGraph { edges: &edges, number, pattern };
    let equations = problem.linearise(&start);
    let mut dense = nalgebra::DMatrix::<f64>::zeros(49, 49);
    for column in 0..49 {
        for place in equations.matrix.col_ptr()[column]..equations.matrix.col_ptr()[column + 1] {
            let row = equations.matrix.row_idx()[place];
            (dense[(row, column)], dense[(column, row)]) = (equations.values[place], equations.values[place]);
        }
    }
    let mut jacobian = nalgebra::DMatrix::<f64>::zeros(7 * edges.len(), 49);
    let mut residuals = nalgebra::DVector::<f64>::zeros(7 * edges.len());
    for (i, edge) in edges.iter().enumerate() {
        let (residual, by_from, by_to) = linearised(edge, &start[edge.from], &start[edge.to]);
        residuals.rows_mut(7 * i, 7).copy_from(&residual);
        for (node, by) in [(edge.from, by_from), (edge.to, by_to)] {
            if node > 0 {
                jacobian.view_mut((7 * i, 7 * (node - 1)), (7, 7)).copy_from(&by);
            }
        }
    }
    let expected = jacobian.transpose() * &jacobian;
    assert!((&dense - &expected).norm() < 1e-9 * expected.norm());
    let damping = 0.1;
    let damped = &expected + nalgebra::DMatrix::from_diagonal(&(expected.diagonal() * damping));
    let dense_step = -damped.cholesky().expect("positive").solve(&(jacobian.transpose() * residuals));
    let (step, predicted) = equations.solve(damping).expect("a step");
    let step: Vec<f64> = step.iter().flat_map(|s| s.iter().copied()).collect();
    assert!((nalgebra::DVector::from_vec(step) - &dense_step).norm() < 1e-8 * dense_step.norm());
    assert!(predicted > 0.0);
}

#[test]
fn wrong_graphs_are_told_and_what_nothing_holds_stays() {
    let Ring { start, mut edges, .. } = ring(8);
    let options = LmOptions::default();
    let run = |fixed: &[bool], edges: &[Edge]| solve(start.clone(), fixed, edges, &options).map(|r| r.0);
    assert_eq!(run(&[true], &edges), Err(PoseGraphError::LengthMismatch { fixed: 1, nodes: 8 }));
    assert_eq!(run(&[true; 8], &edges).as_deref(), Ok(&start[..]), "all are held");
    // Nobody is held, and the last camera has no edges.
    edges.retain(|e| e.to != 7);
    let free = run(&[false; 8], &edges).expect("a graph");
    assert!(free.iter().all(Sim3::is_valid) && free[7] == start[7]);
    edges[2].to = 8;
    assert_eq!(run(&held_first(8), &edges), Err(PoseGraphError::UnknownNode { edge: 2, node: 8, nodes: 8 }));
    edges[2].to = edges[2].from;
    assert!(matches!(run(&held_first(8), &edges), Err(PoseGraphError::Loop { edge: 2, .. })));
    edges.truncate(2);
    edges[0].to_from_from.translation.x = f64::NAN;
    assert_eq!(run(&held_first(8), &edges).as_deref(), Ok(&start[..]), "no cost");
}

#[test]
fn the_same_graph_gives_the_same_bytes() {
    let run = || {
        let Ring { start, edges, .. } = ring(60);
        solve(start, &held_first(60), &edges, &LmOptions::default()).expect("a graph").0
    };
    assert_eq!(run(), run());
}
