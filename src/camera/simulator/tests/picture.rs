//! The picture: reproducible, complete, and spoilt exactly as configured.

use super::super::cull::View;
use super::super::rays::Rays;
use super::super::render::{Renderer, Shot};
use super::super::scene::Quad;
use super::super::texture::Texture;
use super::super::{effects, place, room};
use super::*;
use nalgebra::Vector3;

#[test]
fn same_configuration_gives_the_same_bytes_in_any_order() {
    let config = quick(SimulatorConfig::everything(Scenario::RoomTour));
    let (mut a, mut b) = (simulator(&config), simulator(&config));
    let forward: Vec<GreyImage> = [3, 170, 171, 400].iter().map(|&k| picture(&mut a, k)).collect();
    let backward: Vec<GreyImage> = [400, 171, 170, 3].iter().map(|&k| picture(&mut b, k)).collect();
    assert!(forward.iter().eq(backward.iter().rev()));
}

#[test]
fn another_seed_gives_another_room() {
    let mut config = quick(SimulatorConfig::ideal(Scenario::Standing));
    let a = picture(&mut simulator(&config), 0);
    config.seed += 1;
    let b = picture(&mut simulator(&config), 0);
    let different = a.data.iter().zip(&b.data).filter(|(a, b)| a.abs_diff(**b) > 5).count();
    assert!(different > a.data.len() / 4, "{different} pixels differ");
}

/// Every face in one grey of its own: then the picture names the face.
fn painted_by_number(config: &SimulatorConfig) -> super::super::scene::Scene {
    let plan = room::Plan {
        seed: config.seed,
        texel_m: 0.02,
        rich: true,
        chessboard: &config.chessboard,
        tags: &config.tags,
        desk: &config.desk,
        another_day: &config.another_day,
    };
    let mut scene = place(config.scenario, &plan);
    for (i, texture) in scene.textures.iter_mut().enumerate() {
        *texture = Texture::new(1, 1, vec![grey(i)]);
    }
    scene
}

fn grey(face: usize) -> u8 {
    (face * 37 % 251) as u8
}

#[test]
fn culling_never_loses_a_face() {
    for (scenario, readout_s, exposure_s) in
        [(Scenario::RoomTour, 0.0, 0.0), (Scenario::DeskOrbit, 0.02, 0.0), (Scenario::FastRotation, 0.02, 0.01)]
    {
        let config = quick(SimulatorConfig { scenario, seed: 4, ..SimulatorConfig::default() });
        let scene = painted_by_number(&config);
        let simulator = simulator(&config);
        let trajectory = simulator.trajectory();
        let rays = Rays::new(simulator.camera_model());
        let mut renderer = Renderer::new(rays.clone(), None);
        let view_at = |t: f64| {
            let pose = trajectory.pose_at_seconds(t);
            View { rotation: pose.rotation.to_rotation_matrix().into_inner(), position: pose.translation }
        };
        for time_s in [1.0, 4.7, 9.3] {
            // One moment even where the exposure is long: the culling must allow for it, the picture stays sharp.
            let shot = Shot { time_s, exposure_s, readout_s, max_samples: 1 };
            let mut wrong = 0;
            renderer.render(&scene, None, &shot, &view_at, &mut |y, row| {
                let time = time_s + readout_s * ((y as f64 - 119.5) / 240.0);
                let pose = trajectory.pose_at_seconds(time);
                for (x, value) in row.iter().enumerate().step_by(3) {
                    let face = |grid: &super::super::rays::Grid, x: usize, y: usize| {
                        let at = y * grid.stride + x;
                        let ray = Vector3::new(f64::from(grid.x[at]), f64::from(grid.y[at]), 1.0);
                        scene.trace(&pose.translation, &(pose.rotation * ray)).map(|h| scene.quads[h.face].texture)
                    };
                    let middle = face(&rays.centres, x, y);
                    let alike = [(0, 0), (1, 0), (0, 1), (1, 1)]
                        .iter()
                        .all(|(dx, dy)| face(&rays.corners, x + dx, y + dy) == middle);
                    let expected = middle.map_or(f32::NAN, |i| f32::from(grey(i)));
                    if alike && !((value - expected).abs() < 0.6) {
                        wrong += 1;
                    }
                }
            });
            // A hair's breadth beside an outline the two may disagree.
            assert!(wrong <= 5, "{} at {time_s} s: {wrong} pixels show another face", scenario.name());
        }
    }
}

#[test]
fn outlines_are_shaded_by_the_share_that_each_face_has() {
    // A wall's edge crossing the picture: the mean over many pixels along it is unbiased.
    let config = quick(SimulatorConfig::ideal(Scenario::Standing));
    let mut scene = painted_by_number(&config);
    let simulator = simulator(&config);
    let (dark, bright) = (0, 200);
    for (i, texture) in scene.textures.iter_mut().enumerate() {
        *texture = Texture::new(1, 1, vec![if i == 0 { bright } else { dark }]);
    }
    // One bright face in front of dark ones, 1.0 m before the camera, upright, its left edge through the middle.
    let away = Vector3::x();
    let (right, down) = (-Vector3::y(), -Vector3::z());
    let face = |x: f64, y: f64, texture: usize| Quad {
        origin: Vector3::new(x, y, 2.0),
        right,
        down,
        away,
        size: [9.0, 4.0],
        texture,
        density: 1.0,
        polished: false,
    };
    scene.quads = vec![face(3.0, 4.5, 1), face(1.0, 0.013, 0)];
    let camera = simulator.camera_model().clone();
    let mut renderer = Renderer::new(Rays::new(&camera), None);
    let view = View {
        rotation: crate::geometry::ros_from_optical().to_rotation_matrix().into_inner(),
        position: Vector3::zeros(),
    };
    let shot = Shot { time_s: 0.0, exposure_s: 0.0, readout_s: 0.0, max_samples: 1 };
    let expected = camera.cx - 0.013 * camera.fx;
    renderer.render(&scene, None, &shot, &|_| view, &mut |y, row| {
        if (60..180).contains(&y) {
            let from = expected as usize - 3;
            let lit: f32 = row[from..from + 8].iter().sum::<f32>() / f32::from(bright);
            let edge = from as f64 - 0.5 + 8.0 - f64::from(lit);
            assert!((edge - expected).abs() < 0.07, "row {y}: edge at {edge:.3}, expected {expected:.3}");
        }
    });
}

#[test]
fn the_occluder_covers_its_share() {
    for share in [0.15, 0.3, 0.5] {
        let mut config = quick(SimulatorConfig::ideal(Scenario::Standing));
        let free = picture(&mut simulator(&config), 0);
        config.occluder.enabled = true;
        config.occluder.share = share;
        let mut simulator = simulator(&config);
        // The middle of the first pass; before it nothing is there.
        let frame = ((config.occluder.start_s + 0.5 * config.occluder.pass_s) * config.rate_hz) as u64;
        assert_eq!(picture(&mut simulator, 10), free);
        let covered = picture(&mut simulator, frame);
        let changed = free.data.iter().zip(&covered.data).filter(|(a, b)| a != b).count();
        let got = changed as f64 / free.data.len() as f64;
        assert!((got - share).abs() < 0.03, "share {share}: {got} of the picture changed");
    }
}

#[test]
fn the_lens_is_covered_for_exactly_the_configured_frames() {
    let mut config = quick(SimulatorConfig::default());
    config.blackout.enabled = true;
    config.blackout.start_s = 1.0;
    config.blackout.period_s = 2.0;
    let dark: Vec<u64> = (0..130).filter(|&k| effects::covered(&config.blackout, k, 30.0)).collect();
    assert_eq!(dark, (30..50).chain(90..110).collect::<Vec<_>>());
    let mut simulator = simulator(&config);
    assert!(mean(&picture(&mut simulator, 29)) > 40.0);
    assert!(mean(&picture(&mut simulator, 30)) < 10.0);
}

#[test]
fn exposure_jumps_change_all_grey_values_by_one_factor() {
    let mut config = quick(SimulatorConfig::ideal(Scenario::Standing));
    let free = mean(&picture(&mut simulator(&config), 0));
    config.exposure.jumps = true;
    config.exposure.jump_ev = 1.0;
    let mut simulator = simulator(&config);
    let ratios: Vec<f64> = (0..600).step_by(5).map(|k| mean(&picture(&mut simulator, k)) / free).collect();
    let (low, high) = ratios.iter().fold((1.0, 1.0), |(l, h), &r| (f64::min(l, r), f64::max(h, r)));
    // One exposure value is a factor 2^(1 / 2.2) = 1.37; white is clipped, so less is possible, more is not.
    assert!(low < 0.85 && low > 0.72 && high > 1.1 && high < 1.38, "{low} .. {high}");
}

#[test]
fn automatic_exposure_reacts_slowly_and_brings_the_mean_to_middle_grey() {
    let mut config = quick(SimulatorConfig::ideal(Scenario::PureRotation));
    config.exposure.automatic = true;
    let mut simulator = simulator(&config);
    let means: Vec<f64> = (60..360).step_by(6).map(|k| mean(&picture(&mut simulator, k))).collect();
    let overall = means.iter().sum::<f64>() / means.len() as f64;
    assert!((95.0..140.0).contains(&overall), "mean grey {overall}");
}

#[test]
fn noise_has_the_configured_strength() {
    let mut config = quick(SimulatorConfig::ideal(Scenario::Standing));
    config.noise.enabled = true;
    config.noise.read_sigma = 2.0;
    config.noise.shot_sigma = 0.0;
    let mut simulator = simulator(&config);
    let (a, b) = (picture(&mut simulator, 1), picture(&mut simulator, 2));
    let squares = a.data.iter().zip(&b.data).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>();
    // The difference of two frames has twice the variance; rounding adds a twelfth to each.
    let sigma = (squares / a.data.len() as f64 / 2.0 - 1.0 / 12.0).sqrt();
    assert!((sigma - 2.0).abs() < 0.1, "sigma {sigma}");
}

#[test]
fn a_poor_room_has_far_fewer_edges() {
    let edges = |low_texture: bool| {
        let mut config = quick(SimulatorConfig::ideal(Scenario::RoomTour));
        config.low_texture = low_texture;
        let mut simulator = simulator(&config);
        (0..5)
            .map(|k| picture(&mut simulator, k * 100).data.windows(2).filter(|w| w[0].abs_diff(w[1]) > 12).count())
            .sum::<usize>()
    };
    let (rich, poor) = (edges(false), edges(true));
    assert!(poor * 3 < rich, "{poor} edges in the poor room, {rich} in the rich one");
}
