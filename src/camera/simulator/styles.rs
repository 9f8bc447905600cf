//! What faces look like: plaster with posters, bricks, planks, book spines, cartons, screens ...
//!
//! Input: a [`Style`], the face's size in metres, texels per metre, a stream of random numbers. Output: a painted
//! [`Canvas`] in perceptual grey without light. Every style has edges from half a metre down to a few texels, so that a
//! wall shows corners from across the room and new ones from near.
//!
//! In a poor room (`rich` = false) walls are bare but for a poster here and there, floor and ceiling are plain, and
//! everything has half the contrast: corners come from outlines and furniture.

use super::paint::{Area, Canvas, Noise, Shape, Tone};
use super::random::Random;

/// Look of one face.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Style {
    /// Plaster with posters, notes, switches.
    Plaster,
    Brick,
    /// Printed wallpaper with a few pictures.
    Wallpaper,
    /// Plaster with a window and a curtain.
    Window,
    /// Plaster with a door and notices.
    Door,
    /// Wooden floor with a rug.
    Planks,
    /// Stone floor tiles.
    Tiles,
    /// Ceiling panels with lamps and vents.
    Ceiling,
    /// Plain furniture wood.
    Wood,
    /// Doors and drawers with handles and stickers.
    Front,
    /// Book spines on boards.
    Books,
    /// A carton with tape and labels.
    Carton,
    /// Patterned cloth.
    Fabric,
    /// A computer's screen.
    Screen,
    /// Rows of keys.
    Keys,
    /// A table's surface with papers on it.
    Desktop,
    /// Leaves.
    Foliage,
    /// A framed picture or poster.
    Picture,
    /// A radiator's ribs.
    Ribs,
    /// Clothes with a pattern: what walks through the picture.
    Clothes,
    /// A plain desk top: faint grain, a few crumbs and rings.
    Laminate,
    /// A board with holes in rows, 25 mm apart.
    Pegboard,
}

impl Style {
    /// Shows lamps where gloss is on: glass, screens, the tops of tables and desks, stone floors.
    pub(super) fn is_polished(self) -> bool {
        matches!(self, Self::Desktop | Self::Laminate | Self::Screen | Self::Picture | Self::Tiles)
    }
}

/// What painting needs besides the style.
#[derive(Debug)]
pub(super) struct Painter<'a> {
    pub(super) random: Random,
    pub(super) noise: &'a Noise,
    pub(super) rich: bool,
}

impl Painter<'_> {
    /// Paints one face of `size` metres at `density` texels per metre.
    pub(super) fn paint(&mut self, style: Style, size: [f64; 2], density: f64) -> Canvas {
        let mut c = Canvas::new(size, density, 128.0);
        let whole = Area::new(0.0, 0.0, size[0] as f32, size[1] as f32);
        if self.rich {
            self.paint_rich(style, &mut c, whole);
        } else if !self.paint_bare(style, &mut c, whole) {
            self.paint_rich(style, &mut c, whole);
            pale(&mut c);
        }
        c
    }

    fn paint_rich(&mut self, style: Style, c: &mut Canvas, whole: Area) {
        match style {
            Style::Plaster => self.plaster(c, whole),
            Style::Brick => self.brick(c, whole),
            Style::Wallpaper => self.wallpaper(c, whole),
            Style::Window => self.window(c, whole),
            Style::Door => self.door(c, whole),
            Style::Planks => self.planks(c, whole),
            Style::Tiles => self.tiles(c, whole),
            Style::Ceiling => self.ceiling(c, whole),
            Style::Wood => self.wood(c, whole),
            Style::Front => self.front(c, whole),
            Style::Books => self.books(c, whole),
            Style::Carton => self.carton(c, whole),
            Style::Fabric => self.fabric(c, whole, 105.0, 35.0),
            Style::Screen => self.screen(c, whole),
            Style::Keys => self.keys(c, whole),
            Style::Desktop => self.desktop(c, whole),
            Style::Foliage => self.foliage(c, whole),
            Style::Picture => self.picture(c, whole),
            Style::Ribs => self.ribs(c, whole),
            Style::Clothes => self.fabric(c, whole, 90.0, 70.0),
            Style::Laminate => self.laminate(c, whole),
            Style::Pegboard => self.pegboard(c, whole),
        }
    }

    /// Walls, floors and ceilings of a poor room; false for everything else.
    fn paint_bare(&mut self, style: Style, c: &mut Canvas, whole: Area) -> bool {
        let (value, wall) = match style {
            Style::Plaster | Style::Wallpaper | Style::Window | Style::Door | Style::Brick => {
                (self.between(168.0, 186.0), true)
            }
            Style::Planks | Style::Tiles => (118.0, false),
            Style::Ceiling => (195.0, false),
            _ => return false,
        };
        self.fill(c, value, 3.2, [2.0, 2.0]);
        if wall {
            self.skirting(c, whole, value - 70.0);
            self.sheets(c, whole, 6.0, [0.2, 0.5]);
        }
        pale(c);
        true
    }

    fn between(&mut self, low: f64, high: f64) -> f32 {
        self.random.range(low, high) as f32
    }

    fn fill(&mut self, c: &mut Canvas, value: f32, sigma: f32, stretch: [f32; 2]) {
        c.texels.fill(value.clamp(0.0, 255.0) as u8);
        c.noise(self.noise, &mut self.random, sigma, stretch);
    }

    fn skirting(&mut self, c: &mut Canvas, a: Area, value: f32) {
        c.rectangle(0.0, a.h - 0.08, a.w, 0.08, value);
    }

    /// Posters and pages of `sizes` metres, one for every `area` square metres.
    fn sheets(&mut self, c: &mut Canvas, a: Area, area: f32, sizes: [f64; 2]) {
        for _ in 0..((a.w * a.h / area).round() as usize).max(2) {
            let mut side = || self.random.log_range(sizes[0], sizes[1]) as f32;
            let (w, h) = (side(), side());
            let (x, y) = (self.between(0.02, 0.98) * (a.w - w), self.between(0.1, 0.88) * (a.h - h));
            self.sheet(c, Area::new(x.max(0.0), y.max(0.0), w, h));
        }
    }

    fn plaster(&mut self, c: &mut Canvas, a: Area) {
        let base = self.between(150.0, 185.0);
        self.fill(c, base, 6.0, [2.0, 2.0]);
        c.noise(self.noise, &mut self.random, 3.0, [0.5, 0.5]);
        self.skirting(c, a, base - 70.0);
        // Scuffs and nail holes.
        for _ in 0..(a.w * a.h * 16.0) as usize {
            let centre = [self.between(0.0, f64::from(a.w)), self.between(0.0, f64::from(a.h))];
            let r = self.random.log_range(0.004, 0.03) as f32;
            let value = base + self.between(-80.0, 25.0);
            let angle = self.between(0.0, 3.1);
            c.shape(Shape::Rectangle { centre, half: [r, r * 0.5], angle }, value, 0.8);
        }
        self.sheets(c, a, 1.0, [0.15, 0.75]);
    }

    /// A poster, page, chart or photograph on something.
    fn sheet(&mut self, c: &mut Canvas, a: Area) {
        let tilt = self.random.chance(0.5);
        let paper = self.between(190.0, 235.0);
        let shadow = Shape::Rectangle {
            centre: [a.x + 0.5 * a.w + 0.004, a.y + 0.5 * a.h + 0.006],
            half: [0.5 * a.w, 0.5 * a.h],
            angle: 0.0,
        };
        c.soft_shape(shadow, 60.0, 0.6, 0.012);
        c.rectangle(a.x, a.y, a.w, a.h, paper);
        let inner = a.shrunk(0.06 * a.w.min(a.h));
        match self.random.index(4) {
            0 => {
                let line = (inner.h / 14.0).clamp(0.008, 0.04);
                c.rectangle(inner.x, inner.y, inner.w * 0.8, 1.6 * line, 45.0);
                let body = Area::new(inner.x, inner.y + 3.0 * line, inner.w, inner.h - 3.0 * line);
                c.text(&mut self.random, body, line, 60.0);
            }
            1 => {
                let value = self.between(40.0, 120.0);
                c.rectangle(inner.x, inner.y, inner.w, inner.h * 0.6, value);
                let photo = Area::new(inner.x, inner.y, inner.w, inner.h * 0.6);
                let tone = Tone { mean: value + 30.0, contrast: 85.0 };
                c.leaves(&mut self.random, photo, [0.006, 0.4 * inner.w.min(inner.h)], tone, 2.0);
                let body = Area::new(inner.x, inner.y + 0.66 * inner.h, inner.w, 0.34 * inner.h);
                c.text(&mut self.random, body, (inner.h / 20.0).clamp(0.008, 0.03), 50.0);
            }
            2 => {
                // A chart: bars and grid.
                let n = 4 + self.random.index(6);
                for i in 0..n {
                    let h = inner.h * self.between(0.15, 0.95);
                    let w = inner.w / n as f32;
                    let value = self.between(30.0, 150.0);
                    c.rectangle(inner.x + i as f32 * w, inner.y + inner.h - h, 0.7 * w, h, value);
                }
                c.frame(inner.x, inner.y, inner.w, inner.h, 0.006, 30.0);
            }
            _ => {
                let tone = Tone { mean: 125.0, contrast: 105.0 };
                c.leaves(&mut self.random, inner, [0.006, 0.4 * inner.w.min(inner.h)], tone, 2.5);
            }
        }
        if tilt {
            // A note stuck over a corner.
            let angle = self.between(-0.4, 0.4);
            let half = [0.18 * a.w.min(a.h); 2];
            let centre = [a.x + 0.85 * a.w, a.y + 0.8 * a.h];
            c.shape(Shape::Rectangle { centre, half, angle }, self.between(140.0, 230.0), 1.0);
        }
    }

    fn brick(&mut self, c: &mut Canvas, a: Area) {
        self.fill(c, 150.0, 10.0, [1.0, 1.0]);
        let (w, h, joint) = (0.24, 0.085, 0.012);
        let mut row = 0;
        let mut y = 0.0;
        while y < a.h {
            let mut x = if row % 2 == 0 { 0.0 } else { -0.5 * w };
            while x < a.w {
                let value = 92.0 + 24.0 * self.random.normal() as f32;
                c.rectangle(x, y, w - joint, h - joint, value.clamp(30.0, 175.0));
                if self.random.chance(0.35) {
                    let centre = [x + w * self.between(0.1, 0.9), y + h * self.between(0.2, 0.8)];
                    let half = [self.between(0.005, 0.05), self.between(0.004, 0.02)];
                    let angle = self.between(0.0, 3.0);
                    c.shape(Shape::Rectangle { centre, half, angle }, value + self.between(-45.0, 45.0), 0.7);
                }
                x += w;
            }
            y += h;
            row += 1;
        }
        c.noise(self.noise, &mut self.random, 9.0, [1.0, 1.0]);
        self.sheets(c, a, 3.0, [0.25, 0.7]);
    }

    fn wallpaper(&mut self, c: &mut Canvas, a: Area) {
        let base = self.between(125.0, 165.0);
        self.fill(c, base, 5.0, [2.0, 2.0]);
        c.leaves(&mut self.random, a, [0.01, 0.22], Tone { mean: base, contrast: 38.0 }, 1.2);
        c.rectangle(0.0, a.h - 0.1, a.w, 0.1, 70.0);
        c.rectangle(0.0, 0.38 * a.h, a.w, 0.02, base - 60.0);
        self.sheets(c, a, 2.4, [0.2, 0.8]);
        c.noise(self.noise, &mut self.random, 4.0, [0.5, 0.5]);
    }

    fn window(&mut self, c: &mut Canvas, a: Area) {
        self.plaster(c, a);
        for k in 0..((a.w / 3.0) as usize).max(1) {
            let (w, h) = (1.3f32.min(a.w * 0.6), 1.25f32.min(a.h * 0.5));
            let (x, y) = (a.w * (0.55 - 0.4 * k as f32).max(0.03), 0.18 * a.h);
            c.rectangle(x - 0.06, y - 0.06, w + 0.12, h + 0.12, 215.0);
            c.rectangle(x, y, w, h, 160.0);
            let view = Area::new(x, y, w, h);
            c.leaves(&mut self.random, view, [0.01, 0.3], Tone { mean: 150.0, contrast: 90.0 }, 2.5);
            c.rectangle(x, y, w, 0.3 * h, 225.0);
            c.rectangle(x + 0.48 * w, y, 0.05, h, 205.0);
            c.rectangle(x, y + 0.3 * h, w, 0.04, 205.0);
            // Curtain with folds.
            let mut fold = x - 0.35;
            while fold < x + 0.02 {
                let value = self.between(60.0, 130.0);
                c.rectangle(fold, y - 0.1, 0.05, h + 0.35, value);
                fold += 0.05;
            }
        }
    }

    fn door(&mut self, c: &mut Canvas, a: Area) {
        self.plaster(c, a);
        let mut x = 0.12 * a.w;
        for _ in 0..6 {
            if x + 0.95 > a.w {
                break;
            }
            let top = (a.h - 2.05).max(0.0);
            c.rectangle(x - 0.08, top - 0.08, 1.06, 2.1, 90.0);
            c.rectangle(x, top, 0.9, 2.03, 140.0);
            let leaf = Area::new(x, top, 0.9, 2.0);
            for (fy, fh) in [(0.08, 0.36), (0.52, 0.4)] {
                c.frame(x + 0.12, top + fy * leaf.h, 0.66, fh * leaf.h, 0.025, 95.0);
            }
            c.rectangle(x + 0.8, top + 1.0, 0.07, 0.16, 220.0);
            c.rectangle(x + 0.74, top + 1.05, 0.12, 0.025, 40.0);
            self.sheet(c, Area::new(x + 0.28, top + 0.55, 0.3, 0.22));
            x += self.between(2.2, 3.4);
        }
    }

    fn planks(&mut self, c: &mut Canvas, a: Area) {
        self.fill(c, 120.0, 9.0, [12.0, 0.7]);
        let width = 0.14;
        let mut y = 0.0;
        while y < a.h {
            let mut x = -self.between(0.0, 1.2);
            while x < a.w {
                let length = self.between(0.7, 1.5);
                let value = self.between(85.0, 150.0);
                let centre = [x + 0.5 * length, y + 0.5 * width];
                c.shape(Shape::Rectangle { centre, half: [0.5 * length, 0.5 * width], angle: 0.0 }, value, 0.55);
                c.rectangle(x, y, 0.004, width, 45.0);
                for _ in 0..2 {
                    let centre = [x + length * self.between(0.1, 0.9), y + width * self.between(0.2, 0.8)];
                    let radius = self.between(0.006, 0.02);
                    c.shape(Shape::Disc { centre, radius }, value - 50.0, 0.8);
                }
                x += length;
            }
            c.rectangle(0.0, y, a.w, 0.004, 45.0);
            y += width;
        }
        // A rug, and things dropped on the floor.
        let rug = Area::new(0.27 * a.w, 0.28 * a.h, 0.46 * a.w, 0.42 * a.h);
        c.rectangle(rug.x, rug.y, rug.w, rug.h, 70.0);
        c.leaves(&mut self.random, rug.shrunk(0.05), [0.015, 0.25], Tone { mean: 110.0, contrast: 75.0 }, 2.5);
        c.frame(rug.x, rug.y, rug.w, rug.h, 0.06, 160.0);
        for _ in 0..10 {
            let (w, h) = (self.between(0.1, 0.3), self.between(0.1, 0.3));
            let (x, y) = (self.between(0.0, 1.0) * (a.w - w), self.between(0.0, 1.0) * (a.h - h));
            self.sheet(c, Area::new(x, y, w, h));
        }
        c.noise(self.noise, &mut self.random, 5.0, [0.7, 0.7]);
    }

    fn tiles(&mut self, c: &mut Canvas, a: Area) {
        self.fill(c, 95.0, 5.0, [1.0, 1.0]);
        let side = 0.3;
        for j in 0..(a.h / side).ceil() as usize {
            for i in 0..(a.w / side).ceil() as usize {
                let tone = if (i + j) % 2 == 0 { 135.0 } else { 165.0 };
                let value = tone + 9.0 * self.random.normal() as f32;
                c.rectangle(i as f32 * side + 0.004, j as f32 * side + 0.004, side - 0.008, side - 0.008, value);
                for _ in 0..4 {
                    let at = |r: f64| r as f32 * side;
                    let centre = [i as f32 * side + at(self.random.unit()), j as f32 * side + at(self.random.unit())];
                    let radius = self.random.log_range(0.003, 0.025) as f32;
                    c.shape(Shape::Disc { centre, radius }, value + self.between(-60.0, 40.0), 0.7);
                }
            }
        }
        c.noise(self.noise, &mut self.random, 6.0, [1.0, 1.0]);
    }

    fn ceiling(&mut self, c: &mut Canvas, a: Area) {
        self.fill(c, 190.0, 4.0, [1.0, 1.0]);
        let side = 0.6;
        for j in 0..(a.h / side).ceil() as usize {
            for i in 0..(a.w / side).ceil() as usize {
                let (x, y) = (i as f32 * side, j as f32 * side);
                c.frame(x, y, side, side, 0.02, 140.0);
                match self.random.index(9) {
                    0 => c.rectangle(x + 0.05, y + 0.05, side - 0.1, side - 0.1, 250.0),
                    1 => {
                        for k in 0..6 {
                            c.rectangle(x + 0.08, y + 0.1 + 0.07 * k as f32, side - 0.16, 0.03, 60.0);
                        }
                    }
                    _ => {
                        let panel = Area::new(x, y, side, side).shrunk(0.03);
                        c.leaves(&mut self.random, panel, [0.006, 0.03], Tone { mean: 150.0, contrast: 40.0 }, 0.15);
                    }
                }
            }
        }
    }
}

/// Halves the contrast.
fn pale(c: &mut Canvas) {
    let mean = c.texels.iter().map(|&t| u64::from(t)).sum::<u64>() as f32 / c.texels.len().max(1) as f32;
    for t in &mut c.texels {
        *t = (mean + 0.5 * (f32::from(*t) - mean)) as u8;
    }
}
