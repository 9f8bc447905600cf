//! The simulated world: flat rectangles with textures, lit once and for all.
//!
//! World frame: REP-103 axes, z up, metres, origin on the floor in the middle of the room. Every face is a rectangle
//! seen from one side: `right` and `down` are unit vectors as one looks at it, `right x down` points away from the
//! viewer. Boxes are up to six of them.
//!
//! Light is baked into the textures: lamps under the ceiling (Lambert's cosine, falling off with distance), a constant
//! share from everywhere, darker along the room's inner edges and under furniture. So it costs nothing per frame.
//! Lamps in polished faces are the only mirror images (`gloss`). Deliberately not here: cast shadows of moving things, transparency.

use nalgebra::Vector3;

use super::another_day::{Light, Move};
use super::paint::{Canvas, Noise, Shape};
use super::random::Random;
use super::styles::{Painter, Style};
use super::texture::Texture;
use crate::motion::tag::sheet::{SIDE_CELLS, is_white_cell};

/// A textured rectangle.
#[derive(Debug, Clone)]
pub(super) struct Quad {
    /// Corner at the texture's (0, 0), m.
    pub(super) origin: Vector3<f64>,
    /// Unit vectors: texture u, texture v, and away from the viewer.
    pub(super) right: Vector3<f64>,
    pub(super) down: Vector3<f64>,
    pub(super) away: Vector3<f64>,
    /// Size along right and down, m.
    pub(super) size: [f64; 2],
    /// Index into [`Scene::textures`].
    pub(super) texture: usize,
    /// Texels per metre.
    pub(super) density: f64,
    /// Polished: shows lamps where there is gloss.
    pub(super) polished: bool,
}

impl Quad {
    /// The four corners, m.
    pub(super) fn corners(&self) -> [Vector3<f64>; 4] {
        let (r, d) = (self.right * self.size[0], self.down * self.size[1]);
        [self.origin, self.origin + r, self.origin + d, self.origin + r + d]
    }
}

/// Where the chessboard hangs, exactly: for calibration and for tests.
#[derive(Debug, Clone, PartialEq)]
pub struct Chessboard {
    /// Inner corners a row and a column.
    pub columns: u32,
    pub rows: u32,
    /// Side of a square, m.
    pub square_m: f64,
    /// Inner corner (0, 0), world, m: the upper left one as one looks at the board.
    pub origin: Vector3<f64>,
    /// Unit vectors along a row and down a column, world.
    pub right: Vector3<f64>,
    pub down: Vector3<f64>,
}

impl Chessboard {
    /// Inner corner `column` of row `row`, world coordinates, m.
    pub fn corner(&self, column: u32, row: u32) -> Vector3<f64> {
        let (c, r) = (f64::from(column) * self.square_m, f64::from(row) * self.square_m);
        self.origin + self.right * c + self.down * r
    }
}

/// Where a tag hangs, exactly: for tests.
#[derive(Debug, Clone, PartialEq)]
pub struct WallTag {
    pub id: u16,
    /// Side of its black square, m.
    pub size_m: f64,
    /// Middle of that, world, m.
    pub middle: Vector3<f64>,
    /// Unit vectors, as one looks at it, world.
    pub right: Vector3<f64>,
    pub down: Vector3<f64>,
}

/// Everything that stands still.
#[derive(Debug)]
pub(super) struct Scene {
    pub(super) quads: Vec<Quad>,
    pub(super) textures: Vec<Texture>,
    /// Axis-aligned bounds of solid things (low, high), m: where a camera must not be.
    pub(super) solids: Vec<(Vector3<f64>, Vector3<f64>)>,
    pub(super) chessboard: Option<Chessboard>,
    pub(super) tags: Vec<WallTag>,
    /// World, m: those that are on.
    pub(super) lamps: Vec<Vector3<f64>>,
}

/// What a ray meets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hit {
    /// Index of the face.
    pub(super) face: usize,
    /// Multiples of the ray's direction.
    pub(super) distance: f64,
    /// Grey value there, averaged over about 10 cm, 0..255.
    pub(super) value: f64,
}

impl Scene {
    /// The first face that a ray meets: the plain reference for the fast renderer, and the light meter of the auto
    /// exposure. About 1 us a ray.
    pub(super) fn trace(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<Hit> {
        let mut best: Option<(f64, usize, f64, f64)> = None;
        for (face, quad) in self.quads.iter().enumerate() {
            let approach = quad.away.dot(direction);
            if approach <= 1e-9 {
                continue;
            }
            let relative = quad.origin - origin;
            let distance = quad.away.dot(&relative) / approach;
            if distance <= 0.0 || best.as_ref().is_some_and(|b| b.0 <= distance) {
                continue;
            }
            let point = direction * distance - relative;
            let (u, v) = (quad.right.dot(&point), quad.down.dot(&point));
            if u >= 0.0 && v >= 0.0 && u <= quad.size[0] && v <= quad.size[1] {
                best = Some((distance, face, u, v));
            }
        }
        best.map(|(distance, face, u, v)| {
            let quad = &self.quads[face];
            let texture = &self.textures[quad.texture];
            let wide = (0.1 * quad.density) as f32;
            let footprint = texture.footprint(wide, 0.0, 0.0, wide);
            let value = texture.sample(&[(u * quad.density) as f32], &[(v * quad.density) as f32], &footprint)[0];
            Hit { face, distance, value: f64::from(value) }
        })
    }

    /// The same elsewhere; a chessboard goes with it.
    pub(super) fn moved(mut self, shift: &Vector3<f64>) -> Self {
        self.quads.iter_mut().for_each(|quad| quad.origin += shift);
        self.solids.iter_mut().for_each(|(low, high)| (*low, *high) = (*low + shift, *high + shift));
        self.lamps.iter_mut().for_each(|lamp| *lamp += shift);
        if let Some(board) = &mut self.chessboard {
            board.origin += shift;
        }
        self.tags.iter_mut().for_each(|tag| tag.middle += shift);
        self
    }

    /// Takes over another scene that lies so far from here, but for its chessboard.
    pub(super) fn absorb(&mut self, other: Self, shift: &Vector3<f64>) {
        let other = other.moved(shift);
        let first = self.textures.len();
        self.quads.extend(other.quads.into_iter().map(|quad| Quad { texture: quad.texture + first, ..quad }));
        self.textures.extend(other.textures);
        self.solids.extend(other.solids);
        self.lamps.extend(other.lamps);
    }

    /// Memory of all textures, bytes.
    pub(super) fn texture_bytes(&self) -> usize {
        self.textures.iter().map(Texture::bytes).sum()
    }
}

/// Looks of a box's faces.
#[derive(Debug, Clone, Copy)]
pub(super) struct Faces {
    pub(super) front: Style,
    pub(super) sides: Style,
    pub(super) top: Style,
}

impl Faces {
    /// The same all round.
    pub(super) fn all(style: Style) -> Self {
        Self { front: style, sides: style, top: style }
    }
}

/// A box to place: yawed about the vertical, its front looking along its own -y.
#[derive(Debug, Clone, Copy)]
pub(super) struct BoxPlan {
    /// Middle of its base, m.
    pub(super) base: [f64; 3],
    /// Width (along its x), depth (y), height (z), m.
    pub(super) size: [f64; 3],
    /// About z, rad; 0 puts the front towards world -y.
    pub(super) yaw: f64,
    pub(super) faces: Faces,
    /// Side of its texels relative to the configured one.
    pub(super) coarseness: f64,
}

/// Puts a scene together.
pub(super) struct Builder {
    scene: Scene,
    noise: Noise,
    random: Random,
    /// Size of the room (x, y, z), m.
    pub(super) room: [f64; 3],
    rich: bool,
    texel_m: f64,
    /// Footprints on the floor: centre, half sizes, yaw; they darken it.
    shadows: Vec<([f64; 2], [f64; 2], f64)>,
    /// Where patterns are drawn from, if not from `random`.
    alike: Option<Random>,
    light: Light,
    /// Strength of each of the scene's lamps.
    strengths: Vec<f64>,
    /// Where what is placed stands on another day: a thing on its piece of furniture, then that piece.
    pub(super) moves: [Option<Move>; 2],
    /// What its patterns are mixed with where it is another thing now; else 0.
    pub(super) other_pattern: u64,
}

impl Builder {
    /// An empty room. `texel_m` is the side of a texel of furniture, m.
    pub(super) fn new(seed: u64, room: [f64; 3], rich: bool, texel_m: f64, light: Light) -> Self {
        let mut random = Random::new(seed, 0x5ce7e);
        let noise = Noise::new(&mut random);
        let mut places = Vec::new();
        let (nx, ny) = ((room[0] / 2.6).ceil() as usize, (room[1] / 2.6).ceil() as usize);
        for i in 0..nx {
            for j in 0..ny {
                let x = ((i as f64 + 0.5) / nx as f64 - 0.5) * room[0] + random.range(-0.3, 0.3);
                let y = ((j as f64 + 0.5) / ny as f64 - 0.5) * room[1] + random.range(-0.3, 0.3);
                places.push(Vector3::new(x, y, room[2] - 0.15));
            }
        }
        let (quads, textures, solids) = (Vec::new(), Vec::new(), Vec::new());
        let scene = Scene { quads, textures, solids, chessboard: None, tags: Vec::new(), lamps: Vec::new() };
        let (shadows, strengths) = (Vec::new(), Vec::new());
        let (alike, moves, other_pattern) = (None, [None; 2], 0);
        let mut builder =
            Self { scene, noise, random, room, rich, texel_m, shadows, alike, light, strengths, moves, other_pattern };
        places.into_iter().for_each(|at| builder.lamp(at));
        builder
    }

    /// A lamp beside those under the ceiling, if it is on; lights what is painted after it.
    pub(super) fn lamp(&mut self, at: Vector3<f64>) {
        let strength = self.light.next_lamp();
        if strength > 0.0 {
            self.scene.lamps.push(at);
            self.strengths.push(strength);
        }
    }

    /// The moves of what is placed, the first one first.
    fn moved(&self) -> impl Iterator<Item = &Move> {
        self.moves.iter().flatten()
    }

    /// Runs `place` with patterns drawn from `pattern` in place of new ones: what is placed by equal calls looks alike.
    pub(super) fn alike(&mut self, pattern: u64, place: impl FnOnce(&mut Self)) {
        self.alike = Some(Random::new(pattern, 0xa11c));
        place(self);
        self.alike = None;
    }

    /// A rectangle with its top left corner at `origin` as one looks at it.
    pub(super) fn quad(
        &mut self,
        origin: Vector3<f64>,
        right: Vector3<f64>,
        down: Vector3<f64>,
        size: [f64; 2],
        style: Style,
        coarseness: f64,
    ) {
        let density = 1.0 / (self.texel_m * coarseness);
        let stream = self.alike.as_mut().unwrap_or(&mut self.random).next() ^ self.other_pattern;
        let origin = self.moved().fold(origin, |p, m| m.point(&p));
        let [right, down] = [right, down].map(|d| self.moved().fold(d, |d, m| m.direction(&d)));
        let canvas =
            Painter { random: Random::new(stream, 0), noise: &self.noise, rich: self.rich }.paint(style, size, density);
        self.painted(origin, right, down, size, density, canvas);
        if let Some(quad) = self.scene.quads.last_mut() {
            quad.polished = style.is_polished();
        }
    }

    fn painted(
        &mut self,
        origin: Vector3<f64>,
        right: Vector3<f64>,
        down: Vector3<f64>,
        size: [f64; 2],
        density: f64,
        mut canvas: Canvas,
    ) {
        let away = right.cross(&down);
        if away.z < -0.5 && origin.z < 1e-6 {
            self.cast_shadows(&origin, &right, &down, &mut canvas);
        }
        self.bake_light(&origin, &right, &down, &-away, &mut canvas);
        self.scene.textures.push(Texture::new(canvas.width, canvas.height, canvas.texels));
        let texture = self.scene.textures.len() - 1;
        self.scene.quads.push(Quad { origin, right, down, away, size, texture, density, polished: false });
    }

    /// The floor is darker under furniture. Floors are painted last, when all furniture stands.
    fn cast_shadows(&self, origin: &Vector3<f64>, right: &Vector3<f64>, down: &Vector3<f64>, canvas: &mut Canvas) {
        for &(centre, half, yaw) in &self.shadows {
            let p = Vector3::new(centre[0], centre[1], 0.0) - origin;
            let centre = [p.dot(right) as f32, p.dot(down) as f32];
            let half = half.map(|h| h as f32);
            // Texture v runs against world y on a floor, so angles change sign.
            let angle = -yaw as f32;
            canvas.soft_shape(Shape::Rectangle { centre, half, angle }, 20.0, 0.45, 0.25);
        }
    }

    /// Multiplies the texels by the light that falls on them, interpolated over cells of about 12 cm.
    fn bake_light(
        &self,
        origin: &Vector3<f64>,
        right: &Vector3<f64>,
        down: &Vector3<f64>,
        normal: &Vector3<f64>,
        canvas: &mut Canvas,
    ) {
        let cells = canvas.size.map(|s| ((f64::from(s) / 0.12).ceil() as usize).max(1));
        let step = [f64::from(canvas.size[0]) / cells[0] as f64, f64::from(canvas.size[1]) / cells[1] as f64];
        let mut grid = Vec::with_capacity((cells[0] + 1) * (cells[1] + 1));
        for j in 0..=cells[1] {
            for i in 0..=cells[0] {
                let point = origin + right * (i as f64 * step[0]) + down * (j as f64 * step[1]);
                grid.push(self.light(&point, normal) as f32);
            }
        }
        let per_cell = [1.0 / (step[0] as f32 * canvas.density), 1.0 / (step[1] as f32 * canvas.density)];
        let columns = cells[0] + 1;
        for y in 0..canvas.height {
            let gv = ((y as f32 + 0.5) * per_cell[1]).min(cells[1] as f32 - 1e-3);
            let (j, fv) = (gv as usize, gv.fract());
            let (top, bottom) = (&grid[j * columns..][..columns], &grid[(j + 1) * columns..][..columns]);
            for (x, t) in canvas.texels[y * canvas.width..][..canvas.width].iter_mut().enumerate() {
                let gu = ((x as f32 + 0.5) * per_cell[0]).min(cells[0] as f32 - 1e-3);
                let (i, fu) = (gu as usize, gu.fract());
                let a = top[i] + (top[i + 1] - top[i]) * fu;
                let b = bottom[i] + (bottom[i + 1] - bottom[i]) * fu;
                *t = (f32::from(*t) * (a + (b - a) * fv)).clamp(0.0, 255.0) as u8;
            }
        }
    }

    /// Light on a point of a face, 1 = as painted.
    fn light(&self, point: &Vector3<f64>, normal: &Vector3<f64>) -> f64 {
        // A share from everywhere, a little more from a window towards +y, so that faces of one box differ.
        let mut sum = self.light.everywhere + 0.06 * normal.y + 0.04 * normal.x;
        let from = |source: &Vector3<f64>, reach2: f64| {
            let to = source - point;
            let d2 = to.norm_squared();
            let cosine = normal.dot(&to) / d2.sqrt().max(0.05);
            // The half that is wrapped around stands for light scattered by the walls.
            (0.75 * cosine.max(0.0) + 0.25 * (0.5 + 0.5 * cosine)) / (1.0 + d2 / reach2)
        };
        for (lamp, strength) in self.scene.lamps.iter().zip(&self.strengths) {
            sum += 0.95 * strength * from(lamp, 2.6);
        }
        if self.light.window > 0.0 {
            let window = Vector3::new(0.1 * self.room[0], 0.5 * self.room[1], 0.55 * self.room[2]);
            sum += self.light.window * from(&window, 6.0);
        }
        let wall = (0.5 * self.room[0] - point.x.abs()).min(0.5 * self.room[1] - point.y.abs());
        let level = point.z.min(self.room[2] - point.z);
        let near_edge = if normal.z.abs() > 0.5 { wall } else { level };
        sum * (1.0 - 0.22 * (-near_edge.max(0.0) / 0.18).exp())
    }

    /// A box. Faces on the floor or against a wall are left out.
    pub(super) fn cuboid(&mut self, plan: BoxPlan) {
        let [w, d, h] = plan.size;
        let (sin, cos) = plan.yaw.sin_cos();
        let (ex, ey, ez) = (Vector3::new(cos, sin, 0.0), Vector3::new(-sin, cos, 0.0), Vector3::z());
        let base = Vector3::new(plan.base[0], plan.base[1], plan.base[2]);
        let top = base + ez * h;
        let room = self.room;
        let against = |normal: &Vector3<f64>, half: f64| {
            let p = base + normal * (half + 0.02);
            p.x.abs() > 0.5 * room[0] || p.y.abs() > 0.5 * room[1]
        };
        for (normal, half, width, style) in [
            (-ey, 0.5 * d, w, plan.faces.front),
            (ey, 0.5 * d, w, plan.faces.sides),
            (ex, 0.5 * w, d, plan.faces.sides),
            (-ex, 0.5 * w, d, plan.faces.sides),
        ] {
            if against(&normal, half) {
                continue;
            }
            let right = (-normal).cross(&ez);
            let origin = top + normal * half - right * (0.5 * width);
            self.quad(origin, right, -ez, [width, h], style, plan.coarseness);
        }
        let half = ex * (0.5 * w);
        if top.z < self.room[2] - 0.01 {
            self.quad(top - half + ey * (0.5 * d), ex, -ey, [w, d], plan.faces.top, plan.coarseness);
        }
        if base.z > 0.05 {
            self.quad(base - half - ey * (0.5 * d), ex, ey, [w, d], plan.faces.sides, plan.coarseness);
        }
        let (base, top) = self.moved().fold((base, top), |(base, top), m| (m.point(&base), m.point(&top)));
        let yaw = plan.yaw + self.moved().map(|m| m.turn).sum::<f64>();
        let (sin, cos) = yaw.sin_cos();
        if base.z < 0.3 && w.min(d) > 0.02 {
            self.shadows.push(([base.x, base.y], [0.5 * w, 0.5 * d], yaw));
        }
        let reach = Vector3::new(0.5 * (w * cos.abs() + d * sin.abs()), 0.5 * (w * sin.abs() + d * cos.abs()), 0.0);
        self.scene.solids.push((base - reach, top + reach));
    }

    /// The six inner sides of the room; `styles` of the walls at +x, -x, +y, -y.
    pub(super) fn shell(&mut self, walls: [Style; 4], floor: Style, ceiling: Style) {
        let [lx, ly, _] = self.room;
        let x = Vector3::x();
        self.wall(-x, 0.5 * lx, ly, walls[0]);
        self.wall(x, 0.5 * lx, ly, walls[1]);
        self.shell_but_ends([walls[2], walls[3]], floor, ceiling);
    }

    fn wall(&mut self, normal: Vector3<f64>, half: f64, width: f64, style: Style) {
        let z = Vector3::z();
        let right = (-normal).cross(&z);
        let origin = -normal * half - right * (0.5 * width) + z * self.room[2];
        self.quad(origin, right, -z, [width, self.room[2]], style, 1.5);
    }

    /// All but the walls at +x and -x; `walls` at +y, -y.
    pub(super) fn shell_but_ends(&mut self, walls: [Style; 2], floor: Style, ceiling: Style) {
        let [lx, ly, lz] = self.room;
        let (x, y) = (Vector3::x(), Vector3::y());
        self.wall(-y, 0.5 * ly, lx, walls[0]);
        self.wall(y, 0.5 * ly, lx, walls[1]);
        self.quad(Vector3::new(-0.5 * lx, 0.5 * ly, 0.0), x, -y, [lx, ly], floor, 1.5);
        self.quad(Vector3::new(-0.5 * lx, -0.5 * ly, lz), x, y, [lx, ly], ceiling, 2.5);
    }

    /// A chessboard of `columns` x `rows` inner corners as a sheet whose middle is at `middle`, facing `-away`, with a
    /// white border one square wide. The squares' edges lie exactly on texel edges.
    pub(super) fn chessboard(
        &mut self,
        middle: Vector3<f64>,
        right: Vector3<f64>,
        down: Vector3<f64>,
        columns: u32,
        rows: u32,
        square_m: f64,
    ) {
        /// Texels a square: a power of two keeps the edges on texel edges in the finer mip levels too.
        const SQUARE: usize = 32;
        let (squares_u, squares_v) = (columns as usize + 3, rows as usize + 3);
        let size = [squares_u as f64 * square_m, squares_v as f64 * square_m];
        let mut canvas = Canvas::new([1.0, 1.0], 1.0, 0.0);
        (canvas.width, canvas.height) = (squares_u * SQUARE, squares_v * SQUARE);
        canvas.size = size.map(|s| s as f32);
        let density = SQUARE as f64 / square_m;
        canvas.density = density as f32;
        canvas.texels = (0..canvas.width * canvas.height)
            .map(|i| {
                let (u, v) = ((i % canvas.width) / SQUARE, (i / canvas.width) / SQUARE);
                let border = u == 0 || v == 0 || u == squares_u - 1 || v == squares_v - 1;
                if border || (u + v) % 2 == 1 { 205 } else { 28 }
            })
            .collect();
        let origin = middle - right * (0.5 * size[0]) - down * (0.5 * size[1]);
        self.painted(origin, right, down, size, density, canvas);
        let first = origin + (right + down) * (2.0 * square_m);
        self.scene.chessboard = Some(Chessboard { columns, rows, square_m, origin: first, right, down });
    }

    /// A tag on white paper, whose rim is one cell wide. The cells' edges lie exactly on texel edges.
    pub(super) fn tag(&mut self, tag: WallTag) {
        /// Texels a cell, as of the chessboard's squares; cells of the paper's side.
        const CELL: usize = 32;
        const PAPER: usize = SIDE_CELLS + 2;
        let side_m = tag.size_m * PAPER as f64 / SIDE_CELLS as f64;
        let mut canvas = Canvas::new([1.0, 1.0], 1.0, 0.0);
        (canvas.width, canvas.height) = (PAPER * CELL, PAPER * CELL);
        canvas.size = [side_m as f32; 2];
        let density = canvas.width as f64 / side_m;
        canvas.density = density as f32;
        canvas.texels = (0..canvas.width * canvas.height)
            .map(|i| {
                let (u, v) = ((i % canvas.width) / CELL, (i / canvas.width) / CELL);
                let inside = (1..=SIDE_CELLS).contains(&u) && (1..=SIDE_CELLS).contains(&v);
                if !inside || is_white_cell(tag.id, u - 1, v - 1) { 205 } else { 28 }
            })
            .collect();
        let origin = tag.middle - (tag.right + tag.down) * (0.5 * side_m);
        self.painted(origin, tag.right, tag.down, [side_m; 2], density, canvas);
        self.scene.tags.push(tag);
    }

    pub(super) fn finish(self) -> Scene {
        self.scene
    }
}
