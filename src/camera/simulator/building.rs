//! Three furnished rooms in a row with doors between them, and the way of a robot through all of them.
//!
//! Each room has the plan of the furnished one (`room`). In `three_rooms` no two have a pattern in common. In `look_alike` they are the same to
//! the texel, as the floors of a hotel are, but for a few cartons and a picture of each room's own: what a loop must not be closed on.
//!
//! ```text
//! seen from above; each room 6 x 5 m          path, some 60 m: a lap and a half in the first room, one in the second,
//!   +-----------+-----------+-----------+     most of one in the third, and back along the doors to where it began
//!   |           |           |           |
//!   |   first  door second door  third  |
//!   +-----------+-----------+-----------+
//! ```

use nalgebra::Vector3;

use super::room::{self, Furnisher, Plan, ROOM};
use super::scene::{Faces, Scene};
use super::styles::Style;

/// Rooms in a row.
const ROOMS: usize = 3;
/// Middle of a door along y, its width and height, m.
pub(super) const DOOR: [f64; 3] = [1.32, 0.95, 2.05];

/// Middle of a room along x, m.
fn middle(number: usize) -> f64 {
    (number as f64 - 0.5 * (ROOMS - 1) as f64) * ROOM[0]
}

/// `alike`: the rooms look the same.
pub(super) fn building(plan: &Plan, alike: bool) -> Scene {
    let mut scene: Option<Scene> = None;
    for number in 0..ROOMS {
        // Streams of other rooms of the same seed, far from those of other seeds.
        let own = if alike { 0 } else { number as u64 };
        let mut f = room::furnished(&Plan { seed: plan.seed.wrapping_add(own << 32), ..*plan });
        if alike {
            of_its_own(&mut f, number);
        }
        walls(&mut f, [number + 1 < ROOMS, number > 0]);
        let part = f.builder.finish();
        let shift = Vector3::new(middle(number), 0.0, 0.0);
        match &mut scene {
            Some(scene) => scene.absorb(part, &shift),
            None => scene = Some(part.moved(&shift)),
        }
    }
    scene.unwrap_or_else(|| room::furnished_room(plan))
}

/// The few things by which a room differs from those that look like it.
fn of_its_own(f: &mut Furnisher, number: usize) {
    let pattern = 0x0b0 + number as u64;
    let carton = Faces::all(Style::Carton);
    let x = -2.45 + 0.25 * number as f64;
    f.alike(pattern, [x, -2.25, 1.8], [0.3, 0.25, 0.22], 0.2 * number as f64, carton);
    f.alike(pattern, [-1.9 + 0.3 * number as f64, 2.3, 0.8], [0.22, 0.2, 0.3], 0.1, carton);
    let picture = Faces { front: Style::Picture, sides: Style::Wood, top: Style::Wood };
    f.alike(pattern, [-0.55, 2.485, 1.4], [0.4, 0.03, 0.4], 0.0, picture);
}

/// Walls, floor and ceiling; a passage in the walls +x and -x where `open` says, and a door painted there where not.
fn walls(f: &mut Furnisher, open: [bool; 2]) {
    let [lx, ly, lz] = ROOM;
    let [door_y, width, height] = DOOR;
    let (y, z) = (Vector3::y(), Vector3::z());
    for (side, style, open) in [(1.0, Style::Plaster, open[0]), (-1.0, Style::Brick, open[1])] {
        let normal = -Vector3::x() * side;
        let right = (-normal).cross(&z);
        // From `from` to `to` along y, and up to `top` from `bottom`.
        let mut piece = |from: f64, to: f64, bottom: f64, top: f64, style: Style| {
            let left = if right.y > 0.0 { from } else { to };
            let origin = -normal * (0.5 * lx) + y * left + z * top;
            f.builder.quad(origin, right, -z, [to - from, top - bottom], style, 1.5);
        };
        let (low, high) = (door_y - 0.5 * width, door_y + 0.5 * width);
        piece(-0.5 * ly, low, 0.0, lz, style);
        piece(high, 0.5 * ly, 0.0, lz, style);
        piece(low, high, height, lz, style);
        if !open {
            piece(low, high, 0.0, height, Style::Front);
        }
    }
    f.builder.shell_but_ends([Style::Window, Style::Wallpaper], Style::Planks, Style::Ceiling);
}

/// Corners of the robot's way, x and y, m; closed.
pub(super) fn way() -> Vec<[f64; 2]> {
    const LAP: [[f64; 2]; 8] = [
        [-1.0, -1.25],
        [1.0, -1.25],
        [1.6, -0.65],
        [1.6, 0.65],
        [1.0, 1.25],
        [-1.0, 1.25],
        [-1.6, 0.65],
        [-1.6, -0.65],
    ];
    let mut corners = Vec::new();
    let mut at = |number: usize, corner: [f64; 2]| corners.push([corner[0] + middle(number), corner[1]]);
    let door = DOOR[0];
    // Counter-clockwise in the first room, and out by its door.
    LAP.iter().for_each(|&c| at(0, c));
    LAP[..3].iter().for_each(|&c| at(0, c));
    [[1.65, 0.45], [2.1, 1.15], [3.0, door]].iter().for_each(|&c| at(0, c));
    // Clockwise in the second.
    let clockwise = [5, 4, 3, 2, 1, 0, 7, 6];
    [[-2.2, 1.3]].iter().for_each(|&c| at(1, c));
    clockwise.iter().for_each(|&i| at(1, LAP[i]));
    [[-1.0, 1.25], [1.0, 1.25], [2.2, 1.3], [3.0, door]].iter().for_each(|&c| at(1, c));
    // The third, and back.
    [[-2.2, 1.3]].iter().for_each(|&c| at(2, c));
    clockwise[..7].iter().for_each(|&i| at(2, LAP[i]));
    [[-1.65, 0.45], [-2.1, 1.15], [-3.0, door]].iter().for_each(|&c| at(2, c));
    [[2.2, 1.3], [-2.2, 1.3], [-3.0, door]].iter().for_each(|&c| at(1, c));
    [[2.2, 1.3], [1.0, 1.25], [-1.0, 1.25], [-1.6, 0.65], [-1.6, -0.65]].iter().for_each(|&c| at(0, c));
    corners
}
