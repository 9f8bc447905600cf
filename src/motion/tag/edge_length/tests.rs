use super::*;
use crate::geometry::random::Random;

const FOCAL_PX: f64 = 520.0;

/// What is wrong with the views.
#[derive(Clone, Copy)]
struct Wrong {
    /// Of a corner, px.
    corner_px: f64,
    /// Of a keyframe's rotation and of its place, as what they move in the picture, px.
    pose_px: f64,
}

const USUAL: Wrong = Wrong { corner_px: 0.15, pose_px: 0.25 };

/// Views of a tag with this edge (map units) from an arc of 25 degrees at 8 to 16 edges' distance.
fn views(random: &mut Random, edge: f64, count: usize, wrong: Wrong) -> Vec<View> {
    let tilt = Vector3::new(random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6), random.uniform(-3.0, 3.0));
    let truth = Square {
        rotation: UnitQuaternion::from_scaled_axis(tilt),
        centre: Vector3::new(random.normal(), random.normal(), random.normal()) * edge,
        log_edge: edge.ln(),
    };
    let distance = random.uniform(8.0, 16.0) * edge;
    let mut normal = |scale: f64| Vector3::new(random.normal(), random.normal(), random.normal()) * scale;
    let mut found = Vec::new();
    for i in 0..count {
        let angle = 0.44 * (i as f64 / (count.max(2) - 1) as f64 - 0.5);
        let eye = truth.centre + Vector3::new(angle.sin(), 0.1 * (7.0 * angle).sin(), -angle.cos()) * distance;
        let look = UnitQuaternion::face_towards(&(truth.centre - eye + normal(0.1 * distance)), &Vector3::y());
        let pose: Se3<Camera, World> = Se3::new(look.inverse(), -(look.inverse() * eye));
        let corners = std::array::from_fn(|k| {
            let p = pose.transform(&(truth.centre + truth.arm(k)));
            p.xy() / p.z + normal(wrong.corner_px / FOCAL_PX).xy()
        });
        let believed = Se3::new(
            UnitQuaternion::from_scaled_axis(normal(wrong.pose_px / FOCAL_PX)) * pose.rotation,
            pose.translation + normal(wrong.pose_px / FOCAL_PX * distance),
        );
        found.push(View { camera_from_world: believed, corners, motion: None, late_s: [0.0; 4] });
    }
    found
}

fn sigma(tag: &PlacedTag) -> f64 {
    (tag.corner_variance + tag.view_variance).sqrt()
}

#[test]
fn exact_views_give_the_exact_length_however_few() {
    for seed in 0..50 {
        let views = views(&mut Random::new(seed), 0.37, 3, Wrong { corner_px: 0.0, pose_px: 0.0 });
        let tag = edge_length(&views, FOCAL_PX).expect("regular");
        assert!((tag.log_edge - 0.37f64.ln()).abs() < 1e-6, "seed {seed}: {}", tag.log_edge.exp());
        assert!(tag.residual_px < 1e-4);
    }
}

#[test]
fn the_truth_is_in_the_95_percent_interval_as_often_as_it_should_be() {
    for (count, wrong) in [
        (4, USUAL),
        (10, USUAL),
        (30, USUAL),
        (10, Wrong { corner_px: 0.4, pose_px: 0.1 }),
        (10, Wrong { corner_px: 0.05, pose_px: 0.6 }),
    ] {
        let (mut inside, mut squares, mut worst) = (0, 0.0, 0.0f64);
        for seed in 0..200 {
            let edge = 0.37;
            let views = views(&mut Random::new(seed), edge, count, wrong);
            let tag = edge_length(&views, FOCAL_PX).unwrap_or_else(|e| panic!("seed {seed}: {e:?}"));
            let error = tag.log_edge - edge.ln();
            inside += usize::from(error.abs() <= 1.96 * sigma(&tag));
            squares += error * error;
            worst = worst.max(error.abs());
        }
        let rms = (squares / 200.0f64).sqrt();
        eprintln!(
            "{count} views, {} px a corner, {} px a pose: {} % inside, RMS {:.3} %, worst {:.3} %",
            wrong.corner_px,
            wrong.pose_px,
            inside / 2,
            100.0 * rms,
            100.0 * worst
        );
        assert!((180..=196).contains(&inside), "{count} views: {inside} of 200 inside");
        if count == 10 && wrong.corner_px == USUAL.corner_px {
            assert!(rms < 0.005, "{rms}");
        }
    }
}

#[test]
fn one_direction_or_two_views_say_nothing_yet() {
    let random = &mut Random::new(1);
    let many = views(random, 0.3, 10, USUAL);
    assert_eq!(edge_length(&many[..2], FOCAL_PX).map(|_| ()), Err(NoLength::Waits));
    let same = [many[0]; 5];
    assert_eq!(edge_length(&same, FOCAL_PX).map(|_| ()), Err(NoLength::Waits));
}

#[test]
fn a_tag_that_was_moved_is_told() {
    let random = &mut Random::new(2);
    let mut seen = views(random, 0.3, 10, USUAL);
    for corners in seen[5..].iter_mut().map(|v| &mut v.corners) {
        // 40 px to the side.
        corners.iter_mut().for_each(|c| c.x += 40.0 / FOCAL_PX);
    }
    assert!(matches!(edge_length(&seen, FOCAL_PX), Err(NoLength::Moved { .. })));
}

#[test]
fn rows_equal_numeric_differences() {
    for seed in 0..20 {
        let random = &mut Random::new(seed);
        let view = views(random, 0.5, 2, USUAL)[1];
        let square = Square {
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.2, -0.1, 0.4)),
            centre: Vector3::new(0.1, 0.2, -0.1),
            log_edge: -0.4,
        };
        let problem = Problem { views: &[view], noise: Noise { corner: 1.0, view: 0.7 } };
        let (Some(rows), h) = (problem.whitened(&view, &square), 1e-6) else { continue };
        for parameter in 0..7 {
            let at = |by: f64| {
                let mut delta = SVector::<f64, 7>::zeros();
                delta[parameter] = by;
                problem.whitened(&view, &problem.step(&square, &delta)).expect("in front")
            };
            let (low, high) = (at(-h), at(h));
            for axis in 0..2 {
                for corner in 0..4 {
                    let numeric = (high[axis][corner].0 - low[axis][corner].0) / (2.0 * h);
                    let row = rows[axis][corner].1[parameter];
                    assert!((numeric - row).abs() < 1e-5, "seed {seed}: {parameter}: {numeric} {row}");
                }
            }
        }
    }
}

#[test]
fn a_rolling_shutter_is_allowed_for() {
    let random = &mut Random::new(3);
    let exact = Wrong { corner_px: 0.0, pose_px: 0.0 };
    let mut seen = views(random, 0.4, 10, exact);
    let centre = meeting(&seen).expect("they meet").0;
    for view in &mut seen {
        let motion = CameraMotion { turn: Vector3::new(0.3, -0.4, 0.1), shift: Vector3::new(1.0, 0.3, -0.8) };
        (view.motion, view.late_s) = (Some(motion), [-0.004, -0.003, 0.005, 0.004]);
        let depth = view.camera_from_world.transform(&centre).z;
        for (corner, late_s) in view.corners.iter_mut().zip(view.late_s) {
            *corner += motion.flow(&(corner.push(1.0) * depth)) * late_s;
        }
    }
    let with = edge_length(&seen, FOCAL_PX).expect("regular").log_edge - 0.4f64.ln();
    seen.iter_mut().for_each(|v| v.motion = None);
    let without = edge_length(&seen, FOCAL_PX).expect("regular").log_edge - 0.4f64.ln();
    assert!(with.abs() < 0.002 && without.abs() > 4.0 * with.abs(), "{with} {without}");
}
