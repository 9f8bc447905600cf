//! The place of `desk_sweep`: a long desk along the wall +x, as an office has it.
//!
//! Input: seed, richness, texel size, what the desk is like. Output: a [`Scene`] in the frame of `room`.
//!
//! Four work places of 0.7 m with things close together, and bare top between and before them. What makes such a desk hard: things of
//! 0.4 to 1 m distance before a wall (large parallax), thin things that have no face to hold a patch, structure that repeats by 15 to
//! 80 mm, a top without texture, lamps low over it that polished things reflect.
//!
//! ```text
//! seen from above, x to the right, y up; the camera is at x = 1.6 to 1.9
//!   2.2  desk's edge ... 3.0 wall with pegboard and pictures
//!   y = 1.65 books, cartons | 0.55 screen, keys | -0.55 bottles, basket, papers | -1.65 screen, keys, books
//! ```

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::Vector3;

use super::room::{Furnisher, Plan, ROOM};
use super::scene::{Faces, Scene};
use super::styles::Style;
use crate::camera::simulator_config::DeskConfig;

/// Yaw of what stands with its back to the wall.
const FRONT: f64 = -FRAC_PI_2;
/// Height of the desk's top, m.
const TOP: f64 = 0.73;
/// Middles of the work places along the desk, m.
const PLACES: [f64; 4] = [1.65, 0.55, -0.55, -1.65];
/// Lamps over the desk: distance from the wall and height, m.
const LAMP: [f64; 2] = [0.28, 1.25];

/// The room with the long desk.
pub(super) fn office(plan: &Plan) -> Scene {
    let mut f = Furnisher::new(plan, ROOM);
    let wood_front = Faces { front: Style::Front, sides: Style::Wood, top: Style::Wood };
    for y in [1.1, -1.1] {
        let [x, z] = [0.5 * ROOM[0] - LAMP[0], LAMP[1]];
        f.builder.lamp(Vector3::new(x, y, z));
        f.place([x, y, z + 0.03], [0.5, 0.08, 0.04], FRONT, Faces::all(Style::Wood), 0.8);
    }
    let top = if plan.desk.bare { Style::Laminate } else { Style::Desktop };
    let plate = Faces { front: Style::Wood, sides: Style::Wood, top };
    f.place([2.6, 0.0, TOP - 0.04], [4.4, 0.8, 0.04], FRONT, plate, 0.6);
    for y in [2.0, 0.0, -2.0] {
        f.place([2.7, y, 0.0], [0.42, 0.55, TOP - 0.04], FRONT, wood_front, 0.8);
    }
    for (k, y) in PLACES.into_iter().enumerate() {
        work_place(&mut f, k, y, plan.desk);
    }
    if plan.desk.repeated {
        f.place([2.985, 0.0, 0.95], [1.6, 0.02, 0.55], FRONT, Faces::all(Style::Pegboard), 0.6);
    }
    f.pictures([-1.0, 0.0], 0.5 * ROOM[0], &[-1.7, 1.7]);
    // At the desk's ends and behind the camera: seen in passing.
    f.place([2.2, 2.3, 0.0], [0.9, 0.36, 2.0], 0.0, Faces { front: Style::Books, ..wood_front }, 0.8);
    f.place([2.3, -2.32, 0.0], [0.8, 0.34, 1.3], PI, wood_front, 1.0);
    f.place([0.2, -2.12, 0.0], [1.8, 0.74, 0.42], PI, Faces::all(Style::Fabric), 1.0);
    f.builder.shell([Style::Plaster, Style::Door, Style::Window, Style::Wallpaper], Style::Planks, Style::Ceiling);
    f.builder.finish()
}

/// What stands around (x, `y`) on the desk; every second one has a screen.
fn work_place(f: &mut Furnisher, k: usize, y: f64, desk: &DeskConfig) {
    let shift = f.jitter(0.06);
    let y = y + shift;
    if k % 2 == 1 {
        screen(f, y, desk);
    } else {
        shelf(f, y);
    }
    if desk.repeated && k == 2 {
        bottles(f, y);
    }
    if desk.thin {
        pens(f, y);
        rods(f, y);
        cable(f, y);
        if k == 2 {
            basket(f, y + 0.18);
        }
    }
    // Loose sheets and magazines, each a little higher than the one below it.
    for i in 0..3 {
        let (x, along, yaw) = (f.random.range(2.32, 2.6), y + f.jitter(0.36), f.jitter(PI));
        let top = if i % 2 == 0 { Style::Desktop } else { Style::Clothes };
        let size = [0.21, 0.297, 0.001 + 0.001 * f64::from(i)];
        f.place([x, along, TOP], size, yaw, Faces { top, ..Faces::all(Style::Wood) }, 0.5);
    }
    f.clutter([2.46, y, TOP], [0.1, 0.3], 4);
    f.clutter([2.8, y, TOP], [0.06, 0.3], 3);
}

fn screen(f: &mut Furnisher, y: f64, desk: &DeskConfig) {
    let turn = f.jitter(0.25);
    let screen = Faces { front: Style::Screen, sides: Style::Wood, top: Style::Wood };
    f.place([2.78, y, TOP], [0.22, 0.16, 0.02], FRONT + turn, Faces::all(Style::Wood), 0.8);
    f.place([2.81, y, TOP + 0.02], [0.05, 0.04, 0.09], FRONT + turn, Faces::all(Style::Wood), 0.8);
    f.place([2.80, y, TOP + 0.09], [0.5, 0.04, 0.32], FRONT + turn, screen, 0.5);
    let keys = if desk.repeated { Style::Keys } else { Style::Wood };
    f.place([2.50, y, TOP], [0.44, 0.14, 0.02], FRONT + 0.5 * turn, Faces::all(keys), 0.4);
}

fn shelf(f: &mut Furnisher, y: f64) {
    let books = Faces { front: Style::Books, ..Faces::all(Style::Carton) };
    f.place([2.84, y, TOP], [0.5, 0.2, 0.28], FRONT, books, 0.5);
    let turn = f.jitter(0.2);
    f.place([2.84, y + 0.05, TOP + 0.28], [0.3, 0.18, 0.14], FRONT + turn, Faces::all(Style::Carton), 0.6);
}

/// Eight equal bottles in a row, 80 mm apart.
fn bottles(f: &mut Furnisher, y: f64) {
    let pattern = f.random.next();
    for i in 0..8 {
        let base = [2.66, y + 0.08 * (f64::from(i) - 3.5), TOP];
        f.alike(pattern, base, [0.05, 0.05, 0.16], FRONT, Faces::all(Style::Carton));
    }
}

/// Pens that lie about: 8 mm thick.
fn pens(f: &mut Furnisher, y: f64) {
    for _ in 0..4 {
        let (x, along, yaw) = (f.random.range(2.28, 2.6), y + f.jitter(0.33), f.jitter(PI));
        f.place([x, along, TOP], [0.14, 0.008, 0.008], yaw, Faces::all(Style::Wood), 0.5);
    }
}

/// The upright rods of a lamp and a stand: 10 mm thick, 0.3 to 0.5 m tall.
fn rods(f: &mut Furnisher, y: f64) {
    for side in [-1.0, 1.0] {
        let (x, along, height) =
            (f.random.range(2.62, 2.72), y + side * 0.33 + f.jitter(0.04), f.random.range(0.3, 0.5));
        f.place([x, along, TOP], [0.01, 0.01, height], FRONT, Faces::all(Style::Wood), 0.5);
        f.place([x, along, TOP], [0.1, 0.1, 0.012], FRONT, Faces::all(Style::Wood), 0.5);
    }
}

/// A cable in four straight pieces across the desk, 6 mm thick.
fn cable(f: &mut Furnisher, y: f64) {
    let (mut x, mut along, mut yaw) = (2.9, y + f.jitter(0.2), PI + f.jitter(0.5));
    for _ in 0..4 {
        let length = 0.15;
        let middle = [x + 0.5 * length * yaw.cos(), along + 0.5 * length * yaw.sin(), TOP];
        f.place(middle, [length, 0.006, 0.006], yaw, Faces::all(Style::Screen), 0.5);
        (x, along) = (x + length * yaw.cos(), along + length * yaw.sin());
        yaw += f.jitter(0.8);
    }
}

/// A wire basket: rods of 4 mm, 15 mm apart, between two rails.
fn basket(f: &mut Furnisher, y: f64) {
    let pattern = f.random.next();
    let rods = 18;
    let across = 0.015 * f64::from(rods - 1);
    for i in 0..rods {
        let base = [2.40, y + 0.015 * f64::from(i) - 0.5 * across, TOP];
        f.alike(pattern, base, [0.004, 0.004, 0.12], FRONT, Faces::all(Style::Ribs));
    }
    for z in [TOP + 0.004, TOP + 0.116] {
        f.place([2.40, y, z], [across + 0.004, 0.005, 0.004], FRONT, Faces::all(Style::Ribs), 0.5);
    }
}
