//! What it costs to know a place again: `cargo bench --bench places`.
//!
//! The index over keyframes at 1,000 and 10,000 of them (a query, entering a keyframe, memory), and the pose graph of a way that ends where
//! it began, of as many (seconds to the solution, on one thread). Descriptors are drawn, not described: corners along a way, seen again with a twelfth of their bits turned over
//! and a third of them elsewhere. Printed as Markdown.

use std::time::Instant;

use cairn::features::descriptor::Descriptor;
use cairn::geometry::frames::{Camera, World};
use cairn::geometry::least_squares::LmOptions;
use cairn::geometry::pose_graph::{Edge, EdgeSigma, solve};
use cairn::geometry::random::Random;
use cairn::geometry::sim3::Sim3;
use cairn::map::KeyframeId;
use cairn::places::index::{DESCRIPTORS, PlaceIndex};
use nalgebra::{UnitQuaternion, Vector3};

const SIZES: [usize; 2] = [1_000, 10_000];
const QUERIES: usize = 400;

fn main() {
    println!("| keyframes | query p50 ms | query p99 ms | found % | entering one ms | memory MB | kB a keyframe |");
    println!("|---:|---:|---:|---:|---:|---:|---:|");
    SIZES.iter().for_each(|&n| index(n));
    println!("\n| keyframes | edges | pose graph s | iterations | drift before | after |");
    println!("|---:|---:|---:|---:|---:|---:|");
    SIZES.iter().for_each(|&n| pose_graph(n));
}

/// What a keyframe sees at a place of the way.
fn seen(corners: &[Descriptor], random: &mut Random, place: usize) -> Vec<Descriptor> {
    let corner = |i: usize, random: &mut Random| {
        if random.below(3) == 0 {
            return Descriptor(std::array::from_fn(|_| random.bits()));
        }
        let noise = Descriptor(std::array::from_fn(|_| random.bits() & random.bits() & random.bits() & random.bits()));
        let doubtful = noise.0.map(|w| w | (w << 1));
        Descriptor(std::array::from_fn(|k| corners[(20 * place + i) % corners.len()].0[k] ^ doubtful[k]))
    };
    (0..DESCRIPTORS).map(|i| corner(i, random)).collect()
}

fn index(keyframes: usize) {
    let mut random = Random::new(1);
    let corners: Vec<Descriptor> =
        (0..20 * keyframes).map(|_| Descriptor(std::array::from_fn(|_| random.bits()))).collect();
    let mut index = PlaceIndex::default();
    let all: Vec<_> = (0..keyframes).map(|place| seen(&corners, &mut random, place)).collect();
    let begin = Instant::now();
    for (place, seen) in all.iter().enumerate() {
        index.add(KeyframeId(place as u32), seen);
    }
    let entering = begin.elapsed().as_secs_f64() * 1e3 / keyframes as f64;
    let (mut times, mut found, mut out) = (Vec::new(), 0, Vec::new());
    for _ in 0..QUERIES {
        let place = random.below(keyframes);
        let asked = seen(&corners, &mut random, place);
        let begin = Instant::now();
        index.query(&asked, 5, |_| true, &mut out);
        times.push(begin.elapsed().as_secs_f64() * 1e3);
        found += usize::from(out.iter().any(|c| (c.keyframe.0 as usize).abs_diff(place) <= 3));
    }
    times.sort_by(f64::total_cmp);
    let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize];
    let (bytes, percent) = (index.bytes() as f64, 100.0 * found as f64 / QUERIES as f64);
    println!(
        "| {keyframes} | {:.2} | {:.2} | {percent:.1} | {entering:.2} | {:.1} | {:.1} |",
        at(0.5),
        at(0.99),
        bytes / 1e6,
        bytes / 1e3 / keyframes as f64
    );
}

/// A ring of cameras, 0.1 apart, with edges to the next four, which drift in scale and direction, closed at its end by one in twenty of the cameras.
fn pose_graph(nodes: usize) {
    let radius = 0.1 * nodes as f64 / std::f64::consts::TAU;
    let camera = |i: usize| {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * (std::f64::consts::TAU * i as f64 / nodes as f64));
        Sim3::<World, Camera>::new(1.0, turn, turn * Vector3::z() * radius).inverse()
    };
    let truth: Vec<Sim3<Camera, World>> = (0..nodes).map(camera).collect();
    let wrong = |steps: usize| {
        let share = steps as f64 / nodes as f64;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.02, 0.08, -0.03) * share);
        Sim3::<Camera, Camera>::new((-0.1 * share).exp(), turn, Vector3::zeros())
    };
    let told = |from: usize, to: usize| wrong(to - from) * truth[to] * truth[from].inverse();
    let sigma = EdgeSigma { rotation_rad: 0.01, translation: 0.02, log_scale: 0.01 };
    let mut edges = Vec::new();
    for from in 0..nodes {
        for to in from + 1..(from + 5).min(nodes) {
            edges.push(Edge { from, to, to_from_from: told(from, to), sigma });
        }
    }
    for from in 0..nodes / 20 {
        let to = nodes - nodes / 20 + from;
        edges.push(Edge { from, to, to_from_from: truth[to] * truth[from].inverse(), sigma });
    }
    let mut start = vec![truth[0]];
    (1..nodes).for_each(|i| start.push(told(i - 1, i) * start[i - 1]));
    let off = |nodes: &[Sim3<Camera, World>]| {
        let last = nodes.len() - 1;
        (nodes[last].inverse().translation - truth[last].inverse().translation).norm()
    };
    let before = off(&start);
    let fixed: Vec<bool> = (0..nodes).map(|i| i == 0).collect();
    let begin = Instant::now();
    let (solved, summary) = solve(start, &fixed, &edges, &LmOptions::default()).expect("a graph");
    let took = begin.elapsed().as_secs_f64();
    let (count, after) = (edges.len(), off(&solved));
    println!("| {nodes} | {count} | {took:.2} | {} | {before:.3} | {after:.4} |", summary.iterations);
}
