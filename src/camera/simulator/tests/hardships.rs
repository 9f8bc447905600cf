//! What makes real sequences hard: jerks, hunting exposure, gloss, people, the long desk.

use std::collections::BTreeSet;

use nalgebra::Vector3;

use super::super::cull::View;
use super::super::gloss::Gloss;
use super::super::people::People;
use super::super::rays::Rays;
use super::super::render::{Renderer, Shot};
use super::super::scene::{Quad, Scene};
use super::super::texture::Texture;
use super::super::{effects, place, room};
use super::*;
use crate::camera::simulator_config::GlossConfig;

fn standing() -> SimulatorConfig {
    quick(SimulatorConfig::ideal(Scenario::Standing))
}

#[test]
fn a_jerk_is_as_quick_as_configured_smooth_and_taken_back() {
    for seed in 1..4 {
        let mut config = standing();
        config.seed = seed;
        let calm = simulator(&config).trajectory().pose_at_seconds(5.0);
        config.jerks.enabled = true;
        let simulator = simulator(&config);
        let pose = |t: f64| simulator.trajectory().pose_at_seconds(t);
        let h = 1e-3;
        let (mut fastest, mut quickest, mut at_rest, mut worst_step) = (0.0f64, 0.0f64, 0, 0.0f64);
        let mut peaks = [0.0f64; 20];
        let mut last = None;
        for i in 0..40_000 {
            let t = f64::from(i) * h;
            let (a, b, c) = (pose(t), pose(t + h), pose(t + 2.0 * h));
            let turn = a.rotation.angle_to(&b.rotation) / h;
            fastest = fastest.max((b.translation - a.translation).norm() / h);
            quickest = quickest.max(turn.to_degrees());
            peaks[i as usize / 2000] = peaks[i as usize / 2000].max(turn.to_degrees());
            at_rest +=
                usize::from(a.rotation.angle_to(&calm.rotation) + (a.translation - calm.translation).norm() < 1e-9);
            let turns =
                [(a.rotation.inverse() * b.rotation), (b.rotation.inverse() * c.rotation)].map(|r| r.scaled_axis());
            let acceleration = (turns[1] - turns[0]) / (h * h);
            worst_step = worst_step.max(last.map_or(0.0, |l: Vector3<f64>| (acceleration - l).norm()));
            last = Some(acceleration);
        }
        // Between two fifths and the whole of 150 degrees/s, and up to a seventh more where yaw and roll add up.
        assert!(
            (100.0..172.0).contains(&quickest) && fastest < 0.505,
            "seed {seed}: {quickest} degrees/s, {fastest} m/s"
        );
        assert!(fastest > 0.3, "seed {seed}: {fastest} m/s");
        let jerks = peaks.iter().filter(|p| **p > 55.0).count();
        assert!(jerks >= 16, "seed {seed}: {jerks} jerks in 20 periods");
        assert!(at_rest > 18_000, "seed {seed}: at rest for {at_rest} ms of 40 s");
        // 60 A / T³ is 520 rad/s³; a profile that is smooth once only would jump by 6 A / T² = 21 rad/s².
        assert!(worst_step < 3.0, "seed {seed}: the angular acceleration jumps by {worst_step} rad/s²");
    }
}

#[test]
fn exposure_hunts_about_what_it_should_be() {
    let mut config = standing();
    let steady = mean(&picture(&mut simulator(&config), 0));
    config.exposure.hunts = true;
    let mut simulator = simulator(&config);
    let ratios: Vec<f64> = (0..240).map(|k| mean(&picture(&mut simulator, k)) / steady).collect();
    let (low, high) = ratios.iter().fold((1.0, 1.0), |(l, h), &r| (f64::min(l, r), f64::max(h, r)));
    // 0.7 exposure values are a factor 2^(0.7 / 2.2) = 1.25; white is clipped.
    assert!(low > 0.79 && low < 0.87 && high < 1.26 && high > 1.12, "{low} .. {high}");
    let swings = ratios.windows(2).filter(|w| (w[0] < 1.0) != (w[1] < 1.0)).count();
    assert!((18..=22).contains(&swings), "{swings} changes of side in ten periods");
}

#[test]
fn exposure_that_sets_the_time_blurs_what_it_brightens() {
    let mut config = SimulatorConfig::default();
    config.motion_blur.exposure_ms = 10.0;
    let exposure_s = |config: &SimulatorConfig, ev| effects::shot(config, 0.0, ev).exposure_s;
    assert_eq!(exposure_s(&config, 1.0), 0.01, "a gain leaves the time alone");
    config.exposure.sets_time = true;
    assert!((exposure_s(&config, 1.0) - 0.02).abs() < 1e-12 && (exposure_s(&config, -1.0) - 0.005).abs() < 1e-12);
    assert!((exposure_s(&config, 3.0) - 1.0 / 30.0).abs() < 1e-12, "no longer than the frame period");
}

/// A black sheet of 4 m, 1 m before a camera that looks along +x from `at`, and a lamp.
fn lit_sheet(at: Vector3<f64>, lamp: Vector3<f64>, polished: bool) -> (GreyImage, crate::geometry::CameraModel) {
    let simulator = simulator(&standing());
    let camera = simulator.camera_model().clone();
    let quad = Quad {
        origin: Vector3::new(1.0, 2.0, 2.0),
        right: -Vector3::y(),
        down: -Vector3::z(),
        away: Vector3::x(),
        size: [4.0, 4.0],
        texture: 0,
        density: 1.0,
        polished,
    };
    let textures = vec![Texture::new(1, 1, vec![0])];
    let scene = Scene {
        quads: vec![quad],
        textures,
        solids: Vec::new(),
        chessboard: None,
        tags: Vec::new(),
        lamps: vec![lamp],
    };
    let gloss = Gloss::new(&GlossConfig { enabled: true, strength: 0.9, ..GlossConfig::default() }, &scene.lamps);
    let rotation = crate::geometry::ros_from_optical().to_rotation_matrix().into_inner();
    let view = View { rotation, position: at };
    let shot = Shot { time_s: 0.0, exposure_s: 0.0, readout_s: 0.0, max_samples: 1 };
    let mut picture = GreyImage::default();
    picture.resize(camera.width as usize, camera.height as usize);
    Renderer::new(Rays::new(&camera), gloss).render(&scene, None, &shot, &|_| view, &mut |y, row| {
        for (x, value) in row.iter().enumerate() {
            picture.data[y * 320 + x] = *value as u8;
        }
    });
    (picture, camera)
}

#[test]
fn a_highlight_is_where_a_mirror_would_show_the_lamp() {
    // Beside and behind the camera; its image lies as far behind the sheet as it is before it: at x = 2.5.
    let lamp = Vector3::new(-0.5, 0.3, 0.25);
    let image = Vector3::new(2.5, 0.3, 0.25);
    let mut places = Vec::new();
    for at in [Vector3::zeros(), Vector3::new(0.0, 0.2, -0.1), Vector3::new(-0.3, -0.1, 0.1)] {
        let (picture, camera) = lit_sheet(at, lamp, true);
        let optical = crate::geometry::ros_from_optical().inverse() * (image - at);
        let expected = camera.project(&optical).expect("before the camera");
        let weights = picture.data.iter().enumerate().map(|(i, v)| (f64::from(*v), (i % 320) as f64, (i / 320) as f64));
        let (sum, x, y) = weights.fold((0.0, 0.0, 0.0), |s, (v, x, y)| (s.0 + v, s.1 + v * x, s.2 + v * y));
        let found = nalgebra::Vector2::new(x / sum, y / sum);
        assert!((found - expected).norm() < 0.7, "seen at {found}, mirrored to {expected}");
        let peak = picture.data.iter().copied().max();
        assert!(peak.is_some_and(|p| (220..=230).contains(&p)), "peak {peak:?} of 0.9 times white");
        places.push(
            found - camera.project(&(crate::geometry::ros_from_optical().inverse() * (Vector3::x() - at))).unwrap(),
        );
    }
    assert!((places[0] - places[1]).norm() > 10.0, "it stays where it is on the sheet");
    assert!(lit_sheet(Vector3::zeros(), lamp, false).0.data.iter().all(|v| *v == 0), "a matt sheet shows no lamp");
}

#[test]
fn people_walk_at_their_pace_and_keep_to_their_lanes() {
    for scenario in [Scenario::HandHeld, Scenario::Corridor] {
        let mut config = SimulatorConfig { scenario, ..standing() };
        config.people.start_s = 0.0;
        let people = People::new(&config);
        let middles = |t: f64| {
            let mut quads = Vec::new();
            people.add_quads(t, 0, &mut quads);
            let box_middle = |faces: &[Quad]| {
                faces.iter().map(|q| q.origin + q.right * (0.5 * q.size[0])).sum::<Vector3<f64>>() / 4.0
            };
            quads.chunks(8).map(|figure| box_middle(&figure[..4])).collect::<Vec<_>>()
        };
        let scene = place(
            scenario,
            &room::Plan {
                seed: config.seed,
                texel_m: 0.1,
                rich: true,
                chessboard: &config.chessboard,
                tags: &config.tags,
                desk: &config.desk,
                another_day: &config.another_day,
            },
        );
        let (step, steps) = (0.1, 600);
        let mut way = vec![0.0; middles(0.0).len()];
        for i in 0..steps {
            let (a, b) = (middles(f64::from(i) * step), middles(f64::from(i + 1) * step));
            for (k, (a, b)) in a.iter().zip(&b).enumerate() {
                way[k] += (b.xy() - a.xy()).norm();
                for (low, high) in &scene.solids {
                    // The tops of things at hip height are no obstacle to a test of lanes; what reaches the middle of a body is.
                    let inside = (0..2).all(|d| a[d] > low[d] && a[d] < high[d]) && low.z < 1.0;
                    assert!(!inside, "{} figure {k}: in a box at {low:?} .. {high:?}", scenario.name());
                }
            }
        }
        for way in way {
            // It may have waited for 1.5 of the 60 s.
            let speed = way / (f64::from(steps) * step);
            // Swaying adds a little to the way, turning at the ends takes some of it.
            assert!((0.93..1.15).contains(&(speed / config.people.walk_m_s)), "{}: {speed} m/s", scenario.name());
        }
    }
}

#[test]
fn people_hide_what_is_behind_them_only() {
    let mut config = quick(SimulatorConfig::ideal(Scenario::Sideways));
    let mut empty = simulator(&config);
    config.people.enabled = true;
    let mut walked = simulator(&config);
    let mut shares = Vec::new();
    for frame in (0..300).step_by(10) {
        let (a, b) = (picture(&mut empty, frame), picture(&mut walked, frame));
        let pose = empty.trajectory().pose_at(empty.timestamp_ns(frame));
        let mut hidden = 0;
        for (i, _) in a.data.iter().zip(&b.data).enumerate().filter(|(_, (a, b))| a.abs_diff(**b) > 3) {
            let pixel = nalgebra::Vector2::new((i % 320) as f64, (i / 320) as f64);
            let ray = pose.rotation * empty.camera_model().undistort(&pixel).expect("a ray").push(1.0);
            let hit = empty.scene.trace(&pose.translation, &ray).expect("a closed room");
            hidden += 1;
            // Lanes are at y = 1.62, the other one at x = 1.94; a hair's breadth beside an outline the nearer thing is hit.
            let at = pose.translation + ray * hit.distance;
            let nearer = at.y < 1.3 && at.x < 1.6;
            assert!(
                !nearer || beside_an_outline(&empty, &pose, pixel, hit.face),
                "frame {frame}: {at:?} is hidden at {pixel}"
            );
        }
        shares.push(f64::from(hidden) / a.data.len() as f64);
    }
    let most = shares.iter().fold(0.0, |m, s| f64::max(m, *s));
    assert!((0.02..0.5).contains(&most), "at the most {most} of the picture is hidden");
}

/// Whether a ray one pixel beside it meets another face.
fn beside_an_outline(
    simulator: &Simulator,
    pose: &crate::geometry::Se3<crate::geometry::frames::World, crate::geometry::frames::Camera>,
    pixel: nalgebra::Vector2<f64>,
    face: usize,
) -> bool {
    [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)].into_iter().any(|(dx, dy)| {
        let beside = simulator.camera_model().undistort(&(pixel + nalgebra::Vector2::new(dx, dy)));
        let ray = beside.map(|n| pose.rotation * n.push(1.0));
        ray.and_then(|r| simulator.scene.trace(&pose.translation, &r)).is_none_or(|hit| hit.face != face)
    })
}

fn long_desk(edit: impl Fn(&mut SimulatorConfig)) -> Scene {
    let mut config = quick(SimulatorConfig::ideal(Scenario::DeskSweep));
    edit(&mut config);
    let plan = room::Plan {
        seed: 2,
        texel_m: 0.01,
        rich: true,
        chessboard: &config.chessboard,
        tags: &config.tags,
        desk: &config.desk,
        another_day: &config.another_day,
    };
    place(config.scenario, &plan)
}

/// Grey values of a face on a coarse grid.
fn look(scene: &Scene, quad: &Quad) -> Vec<f32> {
    let texture = &scene.textures[quad.texture];
    let sharp = texture.footprint(1.0, 0.0, 0.0, 1.0);
    let at = |i: usize, k: usize| ((i as f64 + 0.5) / 12.0 * quad.size[k] * quad.density) as f32;
    (0..144).map(|i| texture.sample(&[at(i % 12, 0)], &[at(i / 12, 1)], &sharp)[0]).collect()
}

fn correlation(a: &[f32], b: &[f32]) -> f32 {
    let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
    let (ma, mb) = (mean(a), mean(b));
    let dot = |a: &[f32], ma, b: &[f32], mb| a.iter().zip(b).map(|(x, y)| (x - ma) * (y - mb)).sum::<f32>();
    dot(a, ma, b, mb) / (dot(a, ma, a, ma) * dot(b, mb, b, mb)).sqrt()
}

#[test]
fn the_long_desk_is_what_its_switches_say() {
    let thin = |scene: &Scene| {
        let slender =
            |q: &&Quad| q.size.iter().any(|s| (0.0035..0.0125).contains(s)) && q.size.iter().any(|s| *s > 0.1);
        scene.quads.iter().filter(slender).count()
    };
    let (with, without) = (long_desk(|_| {}), long_desk(|c| c.desk.thin = false));
    assert!(
        thin(&with) > thin(&without) + 100,
        "{} slender faces, {} without thin things",
        thin(&with),
        thin(&without)
    );

    // Fronts of bottles: the same print on all, and none when nothing is repeated.
    let fronts = |scene: &Scene| {
        let front = |q: &&Quad| (q.size[0] - 0.05).abs() < 1e-9 && (q.size[1] - 0.16).abs() < 1e-9 && q.away.x > 0.9;
        scene.quads.iter().filter(front).map(|q| look(scene, q)).collect::<Vec<_>>()
    };
    let bottles = fronts(&with);
    assert_eq!(bottles.len(), 8);
    for bottle in &bottles[1..] {
        assert!(correlation(&bottles[0], bottle) > 0.98, "{}", correlation(&bottles[0], bottle));
    }
    assert_eq!(fronts(&long_desk(|c| c.desk.repeated = false)).len(), 0);

    // The top itself, 4.4 x 0.8 m: at how many of 576 places it differs from 3 cm beside (light alone changes more slowly).
    let marked = |scene: &Scene| {
        let top = scene.quads.iter().find(|q| q.size == [4.4, 0.8] && q.away.z < -0.9).expect("a top");
        let texture = &scene.textures[top.texture];
        let sharp = texture.footprint(1.0, 0.0, 0.0, 1.0);
        let at = |x: f64, y: f64| texture.sample(&[(x * top.density) as f32], &[(y * top.density) as f32], &sharp)[0];
        let place = |i: usize| (4.3 * (i % 24) as f64 / 24.0, 0.8 * (i / 24) as f64 / 24.0);
        (0..576).map(place).filter(|(x, y)| (at(*x, *y) - at(x + 0.03, *y)).abs() > 25.0).count()
    };
    let (bare, covered) = (marked(&with), marked(&long_desk(|c| c.desk.bare = false)));
    assert!(bare < 12 && covered > 60, "{bare} of 576 places of a bare top stand out, {covered} of one with papers");
}

#[test]
fn the_sweep_sees_near_things_again_from_elsewhere() {
    let config = quick(SimulatorConfig::ideal(Scenario::DeskSweep));
    let simulator = simulator(&config);
    let seen = |t: f64| {
        let pose = simulator.trajectory().pose_at_seconds(t);
        let hit = simulator.scene.trace(&pose.translation, &(pose.rotation * Vector3::z())).expect("a closed room");
        (pose, hit)
    };
    let distances: Vec<f64> = (20..280).map(|i| seen(0.1 * f64::from(i)).1.distance).collect();
    let near = distances.iter().filter(|d| (0.35..1.25).contains(*d)).count();
    assert!(near * 10 > distances.len() * 8, "{near} of {} views end within 0.4 to 1.2 m", distances.len());
    // There and back: the same middle of the desk, from another height and from the other side.
    let (there, back) = (seen(4.0).0, seen(11.0).0);
    assert!((there.translation.y - back.translation.y).abs() < 0.4, "{:?} {:?}", there.translation, back.translation);
    assert!((there.translation - back.translation).norm() > 0.15, "the same place");
    let angle = there.rotation.angle_to(&back.rotation).to_degrees();
    assert!((15.0..70.0).contains(&angle), "{angle} degrees between the views");
    let faces: BTreeSet<usize> = (0..140).map(|i| seen(0.1 * f64::from(i)).1.face).collect();
    assert!(faces.len() > 15, "only {} things are looked at", faces.len());
}
