//! A furnished room and a corridor; the simulator knows two places more, `desk` and `building`.
//!
//! Input: seed, richness, texel size, chessboard. Output: a [`Scene`]. The seed changes all pictures and patterns, moves
//! furniture by some centimetres and degrees and decides what lies on it; the plan stays the same, so that every
//! trajectory keeps clear of everything (a test drives them all).
//!
//! ```text
//! room 6.0 x 5.0 x 2.8 m, seen from above; x to the right, y up
//!   sideboard   window, radiator   plant
//!   shelf                           desk (hand_held, calibration_sweep)
//!   shelf        table in the       desk
//!   door           middle           desk
//!   cupboard        sofa           cartons
//! ```

use nalgebra::Vector3;

use super::another_day::{Changes, Light};
use super::random::Random;
use super::scene::{BoxPlan, Builder, Faces, Scene, WallTag};
use super::styles::Style;
use crate::camera::simulator_config::{AnotherDayConfig, ChessboardConfig, DeskConfig, TagsConfig};

use std::f64::consts::{FRAC_PI_2, PI};

/// Size of the room, m.
pub(super) const ROOM: [f64; 3] = [6.0, 5.0, 2.8];
/// Size of the corridor, m.
const CORRIDOR: [f64; 3] = [14.0, 2.4, 2.6];
/// Middle of the chessboard: on the wall above the desk, m.
pub(super) const CHESSBOARD_MIDDLE: [f64; 3] = [0.5 * ROOM[0] - 0.01, 0.0, 1.60];

/// What both places are built from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plan<'a> {
    pub(super) seed: u64,
    /// Side of a texel of furniture, m.
    pub(super) texel_m: f64,
    /// False: bare walls, pale furniture, nothing lying about.
    pub(super) rich: bool,
    pub(super) chessboard: &'a ChessboardConfig,
    pub(super) tags: &'a TagsConfig,
    /// Of the long desk.
    pub(super) desk: &'a DeskConfig,
    pub(super) another_day: &'a AnotherDayConfig,
}

/// Furniture that stands in [`Builder`]'s room, with small seeded variations.
pub(super) struct Furnisher {
    pub(super) builder: Builder,
    pub(super) random: Random,
    rich: bool,
    changes: Option<Changes>,
}

impl Furnisher {
    pub(super) fn new(plan: &Plan, size: [f64; 3]) -> Self {
        let light = Light::new(plan.another_day, plan.seed);
        let builder = Builder::new(plan.seed, size, plan.rich, plan.texel_m, light);
        let changes = Changes::new(plan.another_day, plan.seed);
        Self { builder, random: Random::new(plan.seed, 0xf0a1), rich: plan.rich, changes }
    }

    /// What is placed from now on stands on another day as it does in the place's own time.
    pub(super) fn fixed(&mut self) {
        (self.builder.moves, self.builder.other_pattern) = ([None; 2], 0);
    }

    /// What is placed from now on is one piece of furniture around `about`, which may stand elsewhere on another day: up to `room` along x
    /// and y from there, m, and turned by up to `turn`, rad.
    fn piece(&mut self, about: [f64; 2], room: [f64; 2], turn: f64) {
        self.fixed();
        self.builder.moves[1] = self.changes.as_mut().and_then(|c| c.moved(about, room, turn));
    }

    fn no_thing(&mut self) {
        (self.builder.moves[0], self.builder.other_pattern) = (None, 0);
    }

    /// The same of a thing on the last piece, which is another thing if it was moved.
    fn thing(&mut self, about: [f64; 2], room: [f64; 2], turn: f64) {
        let Some(changes) = &mut self.changes else { return };
        let moved = changes.moved(about, room, turn);
        let other = changes.other_pattern();
        self.builder.moves[0] = moved;
        self.builder.other_pattern = if moved.is_some() { other } else { 0 };
    }

    pub(super) fn place(&mut self, base: [f64; 3], size: [f64; 3], yaw: f64, faces: Faces, coarseness: f64) {
        self.builder.cuboid(BoxPlan { base, size, yaw, faces, coarseness });
    }

    /// A box whose patterns are drawn from `pattern`: equal calls give boxes that look alike.
    pub(super) fn alike(&mut self, pattern: u64, base: [f64; 3], size: [f64; 3], yaw: f64, faces: Faces) {
        self.builder.alike(pattern, |b| b.cuboid(BoxPlan { base, size, yaw, faces, coarseness: 0.5 }));
    }

    /// A few things on a surface: `middle` of it (x, y, z), half sizes of the part to use along world x and y.
    pub(super) fn clutter(&mut self, middle: [f64; 3], half: [f64; 2], count: usize) {
        let count = if self.rich { count } else { count.div_ceil(3) };
        for i in 0..count {
            // One cell each along the longer side, so that nothing stands inside another thing.
            let cell = ((i as f64 + 0.5) / count as f64) * 2.0 - 1.0;
            let other = self.random.range(-1.0, 1.0);
            let (fx, fy) = if half[0] > half[1] { (cell, other) } else { (other, cell) };
            let room = (half[0].max(half[1]) / count as f64).min(0.16);
            let at = [middle[0] + fx * half[0], middle[1] + fy * half[1], middle[2]];
            let yaw = self.random.range(-0.7, 0.7) + FRAC_PI_2 * self.random.index(4) as f64;
            let (size, faces, coarseness) = match self.random.index(5) {
                0 => {
                    ([0.16, 0.11, 0.05], Faces { front: Style::Books, sides: Style::Carton, top: Style::Picture }, 0.6)
                }
                1 => ([0.08, 0.08, 0.11], Faces::all(Style::Fabric), 0.5),
                2 => ([0.2, 0.14, 0.16], Faces::all(Style::Carton), 0.6),
                3 => ([0.2, 0.03, 0.26], Faces::all(Style::Picture), 0.6),
                _ => ([0.1, 0.1, 0.22], Faces::all(Style::Clothes), 0.6),
            };
            let scale = self.random.range(0.8, 1.2) * (room / 0.13).min(1.0);
            self.thing([at[0], at[1]], [0.05; 2], 1.0);
            self.place(at, size.map(|s| s * scale), yaw, faces, coarseness);
        }
        self.no_thing();
    }

    /// A plate on four legs; `size` is the plate's (width, depth, height above the floor), m.
    pub(super) fn table(&mut self, middle: [f64; 2], size: [f64; 3], yaw: f64, top: Style) {
        let [w, d, h] = size;
        let faces = Faces { front: Style::Wood, sides: Style::Wood, top };
        self.place([middle[0], middle[1], h - 0.04], [w, d, 0.04], yaw, faces, 0.8);
        let (sin, cos) = yaw.sin_cos();
        for (fx, fy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let (x, y) = (fx * (0.5 * w - 0.06), fy * (0.5 * d - 0.06));
            let at = [middle[0] + x * cos - y * sin, middle[1] + x * sin + y * cos, 0.0];
            self.place(at, [0.055, 0.055, h - 0.04], yaw, Faces::all(Style::Wood), 1.0);
        }
    }

    pub(super) fn chair(&mut self, middle: [f64; 2], yaw: f64) {
        self.table(middle, [0.42, 0.42, 0.45], yaw, Style::Fabric);
        let (sin, cos) = yaw.sin_cos();
        let back = [middle[0] - 0.2 * sin, middle[1] + 0.2 * cos, 0.5];
        self.place(back, [0.42, 0.03, 0.42], yaw, Faces::all(Style::Fabric), 0.8);
    }

    /// Framed pictures on the wall whose inward normal is (nx, ny), at offsets along it, m.
    pub(super) fn pictures(&mut self, normal: [f64; 2], half_room: f64, offsets: &[f64]) {
        if !self.rich {
            return;
        }
        let yaw = f64::atan2(normal[0], -normal[1]);
        self.fixed();
        for &offset in offsets {
            let size = [self.random.range(0.3, 0.7), 0.03, self.random.range(0.3, 0.6)];
            let (along, z) = (offset + self.random.range(-0.08, 0.08), self.random.range(1.25, 1.7));
            let at = half_room - 0.015;
            let base = [-normal[0] * at - normal[1] * along, -normal[1] * at + normal[0] * along, z];
            self.thing([base[0], base[1]], [0.12 * normal[1].abs(), 0.12 * normal[0].abs()], 0.0);
            self.place(base, size, yaw, Faces { front: Style::Picture, sides: Style::Wood, top: Style::Wood }, 0.75);
        }
        self.no_thing();
    }

    pub(super) fn jitter(&mut self, metres: f64) -> f64 {
        self.random.range(-metres, metres)
    }
}

/// The furnished room.
pub(super) fn furnished_room(plan: &Plan) -> Scene {
    let mut f = furnished(plan);
    f.builder.shell([Style::Plaster, Style::Door, Style::Window, Style::Wallpaper], Style::Planks, Style::Ceiling);
    f.builder.finish()
}

/// The same without walls, floor and ceiling.
pub(super) fn furnished(plan: &Plan) -> Furnisher {
    let mut f = Furnisher::new(plan, ROOM);
    let wood_front = Faces { front: Style::Front, sides: Style::Wood, top: Style::Wood };
    let carton = Faces::all(Style::Carton);
    let cloth = Faces::all(Style::Fabric);

    // The middle: a table with things on it and two chairs.
    let yaw = f.jitter(0.15);
    f.piece([0.0; 2], [0.08, 0.06], 0.15);
    f.table([0.0, 0.0], [1.25, 0.72, 0.74], yaw, Style::Desktop);
    f.clutter([0.0, 0.0, 0.74], [0.45, 0.2], 6);
    let (a, b) = (f.jitter(0.2), f.jitter(0.2));
    f.piece([-0.25, 0.52], [0.15, 0.08], 0.5);
    f.chair([-0.25, 0.52], a);
    f.piece([0.25, -0.52], [0.15, 0.08], 0.5);
    f.chair([0.25, -0.52], PI + b);

    // Wall +x: the desk, with the free part of the wall above it for the chessboard.
    f.piece([2.62, 0.0], [0.0, 0.25], 0.0);
    f.place([2.62, 0.0, 0.69], [1.7, 0.72, 0.04], -FRAC_PI_2, Faces { top: Style::Desktop, ..wood_front }, 0.6);
    f.place([2.68, 0.62, 0.0], [0.42, 0.55, 0.69], -FRAC_PI_2, wood_front, 0.8);
    f.place([2.68, -0.80, 0.0], [0.04, 0.6, 0.69], -FRAC_PI_2, Faces::all(Style::Wood), 1.0);
    let turn = f.jitter(0.25);
    f.thing([2.76, -0.25], [0.04, 0.15], 0.3);
    let screen = Faces { front: Style::Screen, sides: Style::Wood, top: Style::Wood };
    f.place([2.74, -0.25, 0.73], [0.22, 0.16, 0.02], -FRAC_PI_2 + turn, Faces::all(Style::Wood), 0.8);
    f.place([2.76, -0.25, 0.82], [0.54, 0.04, 0.34], -FRAC_PI_2 + turn, screen, 0.5);
    f.place([2.77, -0.25, 0.75], [0.05, 0.04, 0.07], -FRAC_PI_2 + turn, Faces::all(Style::Wood), 0.8);
    f.thing([2.47, -0.22], [0.03, 0.1], 0.3);
    f.place([2.47, -0.22, 0.73], [0.44, 0.14, 0.02], -FRAC_PI_2 + 0.5 * turn, Faces::all(Style::Keys), 0.4);
    f.thing([2.80, 0.45], [0.0, 0.1], 0.0);
    f.place([2.80, 0.45, 0.73], [0.5, 0.22, 0.28], -FRAC_PI_2, Faces { front: Style::Books, ..carton }, 0.5);
    f.clutter([2.55, 0.36, 0.73], [0.1, 0.32], 4);
    f.clutter([2.80, 0.45, 1.01], [0.06, 0.18], 2);
    f.clutter([2.60, -0.70, 0.73], [0.14, 0.1], 1);
    f.pictures([-1.0, 0.0], 0.5 * ROOM[0], &[-1.5, -0.85, 0.85, 1.55]);

    // Corner +x -y: cartons; corner +x +y: a plant.
    let (a, b, c) = (f.jitter(0.3), f.jitter(0.3), f.jitter(0.4));
    f.piece([2.55, -1.85], [0.05, 0.15], 0.3);
    f.place([2.55, -1.85, 0.0], [0.6, 0.5, 0.45], a, carton, 1.0);
    f.thing([2.52, -1.87], [0.06; 2], 0.6);
    f.place([2.52, -1.87, 0.45], [0.45, 0.4, 0.35], b, carton, 0.9);
    f.thing([2.56, -1.85], [0.06; 2], 0.6);
    f.place([2.56, -1.85, 0.80], [0.3, 0.3, 0.25], c, carton, 0.8);
    f.piece([2.5, 2.0], [0.15, 0.15], 1.5);
    f.place([2.5, 2.0, 0.0], [0.36, 0.36, 0.4], a, cloth, 1.0);
    f.place([2.5, 2.0, 0.4], [0.5, 0.3, 0.75], 0.4 + a, Faces::all(Style::Foliage), 1.0);
    f.place([2.5, 2.0, 0.45], [0.28, 0.54, 0.6], 0.5 + a, Faces::all(Style::Foliage), 1.0);

    // Wall +y: sideboard, radiator under the window.
    f.piece([-1.5, 2.25], [0.3, 0.0], 0.0);
    f.place([-1.5, 2.25, 0.0], [1.6, 0.46, 0.8], 0.0, wood_front, 1.0);
    f.clutter([-1.5, 2.27, 0.8], [0.7, 0.1], 5);
    f.fixed();
    f.place([0.6, 2.44, 0.1], [1.3, 0.1, 0.6], 0.0, Faces::all(Style::Ribs), 1.0);
    f.pictures([0.0, -1.0], 0.5 * ROOM[1], &[1.9, 1.0]);

    // Wall -x: two shelves, the door painted on the wall beside them.
    f.piece([-2.82, -1.0], [0.0, 0.15], 0.0);
    f.place([-2.82, -1.0, 0.0], [1.15, 0.34, 2.0], FRAC_PI_2, Faces { front: Style::Books, ..wood_front }, 0.8);
    f.piece([-2.80, 0.35], [0.0, 0.15], 0.0);
    f.place([-2.80, 0.35, 0.0], [0.95, 0.38, 1.1], FRAC_PI_2, Faces { front: Style::Books, ..wood_front }, 0.8);
    f.clutter([-2.80, 0.35, 1.1], [0.08, 0.38], 4);
    f.pictures([1.0, 0.0], 0.5 * ROOM[0], &[0.4]);

    // Wall -y: cupboard, sofa, pictures.
    f.piece([-2.2, -2.22], [0.25, 0.0], 0.0);
    f.place([-2.2, -2.22, 0.0], [1.0, 0.54, 1.8], PI, wood_front, 1.0);
    f.piece([0.4, -2.12], [0.3, 0.0], 0.0);
    f.place([0.4, -2.12, 0.0], [1.8, 0.74, 0.42], PI, cloth, 1.0);
    f.place([0.4, -2.40, 0.42], [1.8, 0.18, 0.42], PI, cloth, 1.0);
    f.place([-0.45, -2.12, 0.42], [0.16, 0.7, 0.2], PI, cloth, 1.0);
    f.place([1.25, -2.12, 0.42], [0.16, 0.7, 0.2], PI, cloth, 1.0);
    let tilt = f.jitter(0.4);
    f.thing([0.1, -2.2], [0.3, 0.03], 0.3);
    f.place([0.1, -2.2, 0.42], [0.4, 0.14, 0.36], PI + tilt, Faces::all(Style::Clothes), 0.8);
    f.pictures([0.0, 1.0], 0.5 * ROOM[1], &[-1.3, -0.3, 0.7, 1.5]);

    // A hanging lamp.
    f.fixed();
    f.place([0.0, 0.0, 2.15], [0.5, 0.5, 0.22], 0.3, Faces::all(Style::Fabric), 1.0);
    f.place([0.0, 0.0, 2.37], [0.03, 0.03, 0.43], 0.3, Faces::all(Style::Wood), 1.0);

    if plan.chessboard.enabled {
        let board = plan.chessboard;
        // On the wall +x: as one looks at it, right is -y and down is -z.
        let [x, y, z] = CHESSBOARD_MIDDLE;
        let (right, down) = (-Vector3::y(), -Vector3::z());
        f.builder.chessboard(Vector3::new(x, y, z), right, down, board.columns, board.rows, board.square_m);
    }
    if plan.tags.enabled {
        let (x, y, [lx, ly, _]) = (Vector3::x(), Vector3::y(), ROOM);
        let [by, bx] = [0.5 * ly - 0.01, 0.5 * lx - 0.01];
        // On the free parts of the walls: above the desk, above the sideboard, on the door, right of the pictures.
        let places = [
            (Vector3::new(CHESSBOARD_MIDDLE[0], 0.05, 1.35), -y),
            (Vector3::new(-1.5, by, 1.35), x),
            (Vector3::new(-bx, 1.6, 1.2), y),
            (Vector3::new(1.95, -by, 1.1), -x),
        ];
        for (id, (middle, right)) in (1..).zip(places) {
            if id != 1 || !plan.chessboard.enabled {
                f.builder.tag(WallTag { id, size_m: plan.tags.size_m, middle, right, down: -Vector3::z() });
            }
        }
    }
    f
}

/// A corridor with lockers, cartons, benches and notice boards along its walls.
pub(super) fn corridor(plan: &Plan) -> Scene {
    let mut f = Furnisher::new(plan, CORRIDOR);
    let wood_front = Faces { front: Style::Front, sides: Style::Wood, top: Style::Wood };
    let half = 0.5 * CORRIDOR[1];
    for (i, x) in [-5.4, -3.2, -1.1, 1.2, 3.3, 5.3].into_iter().enumerate() {
        let x = x + f.jitter(0.25);
        let left = i % 2 == 0;
        let (side, yaw) = if left { (1.0, 0.0) } else { (-1.0, PI) };
        f.piece([x, side * half], [0.3, 0.0], 0.0);
        match f.random.index(4) {
            0 => f.place([x, side * (half - 0.2), 0.0], [0.9, 0.4, 1.75], yaw, wood_front, 1.0),
            1 => {
                f.place([x, side * (half - 0.2), 0.0], [1.2, 0.4, 0.45], yaw, Faces::all(Style::Fabric), 1.0);
                f.clutter([x, side * (half - 0.2), 0.45], [0.45, 0.08], 2);
            }
            2 => {
                f.place([x, side * (half - 0.24), 0.0], [0.5, 0.42, 0.45], yaw, Faces::all(Style::Carton), 1.0);
                f.place([x, side * (half - 0.22), 0.45], [0.4, 0.35, 0.35], yaw, Faces::all(Style::Carton), 1.0);
            }
            _ => f.place(
                [x, side * (half - 0.17), 0.0],
                [0.8, 0.34, 1.5],
                yaw,
                Faces { front: Style::Books, ..wood_front },
                1.0,
            ),
        }
        f.piece([x, -side * half], [0.3, 0.0], 0.0);
        // A box on the other wall: fire extinguisher, cabinet, notice board.
        let z = f.random.range(0.3, 0.8);
        let style = if f.random.chance(0.5) { Style::Picture } else { Style::Front };
        let faces = Faces { front: style, sides: Style::Wood, top: Style::Wood };
        f.place([x, -side * (half - 0.06), z], [0.6, 0.12, 0.6], PI - yaw, faces, 0.8);
    }
    // The far ends differ.
    f.fixed();
    f.place([0.5 * CORRIDOR[0] - 0.22, 0.4, 0.0], [0.7, 0.4, 1.2], -FRAC_PI_2, wood_front, 1.0);
    f.place([-0.5 * CORRIDOR[0] + 0.2, -0.4, 0.0], [0.6, 0.36, 0.5], FRAC_PI_2, Faces::all(Style::Foliage), 1.0);
    f.pictures([-1.0, 0.0], 0.5 * CORRIDOR[0], &[-0.6, 0.4]);
    f.pictures([1.0, 0.0], 0.5 * CORRIDOR[0], &[0.3]);
    f.fixed();
    f.builder.shell([Style::Plaster, Style::Wallpaper, Style::Door, Style::Brick], Style::Tiles, Style::Ceiling);
    f.builder.finish()
}
