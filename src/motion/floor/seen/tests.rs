//! Pictures of a painted floor with a box on it, by rays.

use nalgebra::{Unit, UnitQuaternion};

use super::*;
use crate::geometry::random::Random;
use crate::geometry::ros_from_optical;
use crate::motion::floor::plane::Scatter;

/// The front of the box, m ahead of the origin; it reaches to both sides of the line y = 0 to its left.
const BOX_M: f64 = 2.0;
const HEIGHT_M: f64 = 0.5;

fn lens() -> CameraModel {
    CameraModel::new(320, 240, 262.0, 262.0, 159.5, 119.5, [0.0; 5]).expect("a lens")
}

fn camera(x: f64) -> Se3<Camera, World> {
    let mount = UnitQuaternion::from_euler_angles(0.0, 0.15, 0.0) * ros_from_optical();
    Se3::<World, Camera>::new(mount, Vector3::new(x, 0.0, HEIGHT_M)).inverse()
}

fn floor() -> Plane {
    Plane {
        normal: Vector3::z(),
        offset: 0.0,
        height: HEIGHT_M,
        sigma: 0.01,
        up_camera: Unit::new_normalize(-Vector3::y()),
        landmarks: 100,
        scatter: Scatter::default(),
    }
}

/// Smooth random paint, of 3 cm and coarser.
fn paint(noise: &[f64], u: f64, v: f64) -> f64 {
    let at = |u: f64, v: f64| {
        let value = |i: i64, j: i64| noise[(i.rem_euclid(64) * 64 + j.rem_euclid(64)) as usize];
        let (i, j) = (u.floor() as i64, v.floor() as i64);
        let (a, b) = (u - u.floor(), v - v.floor());
        let along = |j: i64| value(i, j) * (1.0 - a) + value(i + 1, j) * a;
        along(j) * (1.0 - b) + along(j + 1) * b
    };
    at(u / 0.03, v / 0.03) + at(u / 0.12 + 7.0, v / 0.12 + 3.0)
}

/// What the camera looks at: a painted floor with the box on it, or one that lies `drop` m lower from `EDGE_M` on.
#[derive(Clone, Copy)]
struct Scene {
    contrast: f64,
    drop: f64,
}

const EDGE_M: f64 = 1.5;
const FLAT: Scene = Scene { contrast: 40.0, drop: 0.0 };

fn picture(pose: &Se3<Camera, World>, noise: &[f64], scene: Scene) -> GreyImage {
    let Scene { contrast, drop } = scene;
    let (camera, world_from_camera) = (lens(), pose.inverse());
    let origin = world_from_camera.translation;
    let mut image = GreyImage::new(320, 240);
    for y in 0..240 {
        for x in 0..320 {
            let ray = camera.undistort(&Vector2::new(x as f64, y as f64)).expect("inside").push(1.0);
            let ray = world_from_camera.rotation * ray;
            let front = (BOX_M - origin.x) / ray.x;
            let at = origin + ray * front;
            let value = if drop == 0.0 && at.y > 0.0 && at.z > 0.0 && at.z < 0.4 {
                paint(noise, at.y + 11.0, at.z + 5.0)
            } else if ray.z < 0.0 {
                let level = |z: f64| origin - ray * ((origin.z - z) / ray.z);
                let at = if level(0.0).x < EDGE_M { level(0.0) } else { level(-drop) };
                paint(noise, at.x, at.y)
            } else {
                0.0
            };
            image.data[y * 320 + x] = (128.0 + contrast * value).clamp(0.0, 255.0) as u8;
        }
    }
    image
}

fn seen(scene: Scene) -> Seen {
    let mut random = Random::new(5);
    let noise: Vec<f64> = (0..64 * 64).map(|_| random.normal()).collect();
    let (now, earlier) = (camera(0.0), [camera(-0.25), camera(-0.45)]);
    let images: Vec<_> = earlier.iter().map(|pose| picture(pose, &noise, scene)).collect();
    let before: Vec<_> =
        earlier.iter().zip(&images).map(|(camera_from_world, image)| Picture { camera_from_world, image }).collect();
    let image = picture(&now, &noise, scene);
    let mut out = Seen::default();
    floor_seen(&floor(), HEIGHT_M, &lens(), &Picture { camera_from_world: &now, image: &image }, &before, &mut out);
    out
}

#[test]
fn a_painted_floor_is_seen_up_to_a_box_on_it_and_no_farther() {
    let Seen { floor, ends, things } = seen(FLAT);
    assert!(floor.len() > 15, "{} bearings", floor.len());
    let (mut before_box, mut beside) = (0, 0);
    for stretch in &floor {
        let to = f64::from(stretch.to) * HEIGHT_M;
        // The box covers everything to the left.
        let (sin, cos) = f64::from(stretch.bearing).sin_cos();
        if sin > 0.03 {
            assert!(to * cos < BOX_M + 0.02, "{to} m at {} rad is in the box", stretch.bearing);
            before_box += usize::from(to * cos > BOX_M - 0.4);
        } else if sin < -0.03 {
            beside += usize::from(to > BOX_M + 0.2);
        }
    }
    assert!(before_box > 5 && beside > 5, "{before_box} bearings reach the box, {beside} pass it");
    let of_box = ends.iter().filter(|end| {
        let (from, to) = (f64::from(end.from) * HEIGHT_M, f64::from(end.to) * HEIGHT_M);
        let cos = f64::from(end.bearing).cos();
        from * cos < BOX_M + 0.02 && to * cos > BOX_M
    });
    let of_box = of_box.count();
    let at = |thing: &Stretch| f64::from(thing.from + thing.to) / 2.0 * HEIGHT_M * f64::from(thing.bearing).cos();
    let right = things.iter().filter(|(thing, _)| (at(thing) - BOX_M).abs() < 0.1).count();
    assert!(right > 5 && 10 * right >= 9 * things.len(), "{right} of {} things are the box", things.len());
    assert!(of_box > 3 && 3 * of_box > 2 * ends.len(), "{of_box} of {} ends are the box", ends.len());
}

#[test]
fn a_bare_floor_tells_nothing() {
    let Seen { floor, ends, things } = seen(Scene { contrast: 0.5, ..FLAT });
    assert!(floor.is_empty() && ends.is_empty() && things.is_empty());
}

#[test]
fn a_step_down_is_never_floor() {
    for drop in [0.05, 0.08, 0.15, 0.3, 0.5] {
        let Seen { floor, .. } = seen(Scene { drop, ..FLAT });
        let reach = |stretch: &Stretch| f64::from(stretch.to) * HEIGHT_M * f64::from(stretch.bearing).cos();
        let farthest = floor.iter().map(reach).fold(0.0, f64::max);
        // Half a patch across the edge is the floor's.
        assert!(farthest > EDGE_M - 0.4 && farthest < EDGE_M + 0.05, "{drop} m: {farthest} m");
    }
}

#[test]
fn of_a_tall_camera_no_more_hides_than_of_a_low_one() {
    let longest = |camera_height_m: f64| {
        let (now, earlier) = (camera(0.0), [camera(-0.25), camera(-0.45)]);
        let mut random = Random::new(5);
        let noise: Vec<f64> = (0..64 * 64).map(|_| random.normal()).collect();
        let images: Vec<_> = earlier.iter().map(|pose| picture(pose, &noise, FLAT)).collect();
        let pictures = earlier.iter().zip(&images);
        let before: Vec<_> = pictures.map(|(camera_from_world, image)| Picture { camera_from_world, image }).collect();
        let image = picture(&now, &noise, FLAT);
        let mut out = Seen::default();
        let now = Picture { camera_from_world: &now, image: &image };
        floor_seen(&floor(), camera_height_m, &lens(), &now, &before, &mut out);
        out.floor.iter().map(|stretch| f64::from(stretch.to - stretch.from)).sum::<f64>()
    };
    let (low, tall) = (longest(HEIGHT_M), longest(4.0 * HEIGHT_M));
    assert!(tall < 0.5 * low, "{tall} of {low}: between its rings 10 cm could hide");
}
