//! What furniture and the things on it look like; second half of [`Painter`], same contract as in `styles`.

use super::paint::{Area, Canvas, Shape, Tone};
use super::styles::Painter;

impl Painter<'_> {
    fn value(&mut self, low: f64, high: f64) -> f32 {
        self.random.range(low, high) as f32
    }

    fn ground(&mut self, c: &mut Canvas, value: f32, sigma: f32, stretch: [f32; 2]) {
        c.texels.fill(value.clamp(0.0, 255.0) as u8);
        c.noise(self.noise, &mut self.random, sigma, stretch);
    }

    pub(super) fn wood(&mut self, c: &mut Canvas, a: Area) {
        let base = self.value(75.0, 165.0);
        let stretch = if a.w > a.h { [10.0, 0.6] } else { [0.6, 10.0] };
        self.ground(c, base, 12.0, stretch);
        for _ in 0..((a.w * a.h * 25.0) as usize).clamp(1, 60) {
            let centre = [a.w * self.value(0.0, 1.0), a.h * self.value(0.0, 1.0)];
            let radius = self.random.log_range(0.004, 0.02) as f32;
            c.shape(Shape::Disc { centre, radius }, base - self.value(20.0, 60.0), 0.8);
        }
        if a.w.min(a.h) > 0.03 {
            c.frame(0.0, 0.0, a.w, a.h, 0.004, base - 45.0);
        }
    }

    pub(super) fn front(&mut self, c: &mut Canvas, a: Area) {
        self.wood(c, a);
        let base = self.value(95.0, 185.0);
        let columns = ((a.w / 0.5).round() as usize).max(1);
        let rows = ((a.h / 0.35).round() as usize).max(1);
        let (w, h) = (a.w / columns as f32, a.h / rows as f32);
        for j in 0..rows {
            for i in 0..columns {
                let door = Area::new(i as f32 * w, j as f32 * h, w, h).shrunk(0.012);
                let tone = base + self.value(-14.0, 14.0);
                c.shape(
                    Shape::Rectangle {
                        centre: [door.x + 0.5 * door.w, door.y + 0.5 * door.h],
                        half: [0.5 * door.w, 0.5 * door.h],
                        angle: 0.0,
                    },
                    tone,
                    0.8,
                );
                c.frame(door.x, door.y, door.w, door.h, 0.008, base - 55.0);
                c.rectangle(door.x + 0.4 * door.w, door.y + 0.18 * door.h, 0.2 * door.w, 0.018, 35.0);
                if self.random.chance(0.55) {
                    let sticker = [0.05 + 0.1 * self.value(0.0, 1.0), 0.04 + 0.08 * self.value(0.0, 1.0)];
                    let x = door.x + self.value(0.1, 0.7) * door.w;
                    let y = door.y + self.value(0.35, 0.75) * door.h;
                    c.rectangle(x, y, sticker[0], sticker[1], self.value(180.0, 235.0));
                    let inner = Area::new(x, y, sticker[0], sticker[1]).shrunk(0.008);
                    c.text(&mut self.random, inner, 0.014, 40.0);
                }
            }
        }
    }

    pub(super) fn books(&mut self, c: &mut Canvas, a: Area) {
        self.ground(c, 40.0, 6.0, [1.0, 1.0]);
        let shelves = ((a.h / 0.33).round() as usize).max(1);
        let pitch = a.h / shelves as f32;
        for s in 0..shelves {
            let base = (s + 1) as f32 * pitch - 0.03;
            let mut x = 0.025;
            while x < a.w - 0.03 {
                if self.random.chance(0.06) {
                    // A gap, or a box lying there.
                    let w = self.value(0.06, 0.2).min(a.w - 0.03 - x);
                    if self.random.chance(0.6) {
                        c.rectangle(x, base - 0.12, w, 0.12, self.value(90.0, 200.0));
                    }
                    x += w;
                    continue;
                }
                let w = self.value(0.015, 0.055).min(a.w - 0.02 - x);
                let h = (pitch - 0.04) * self.value(0.6, 0.97);
                let tone = self.value(45.0, 225.0);
                c.rectangle(x, base - h, w, h, tone);
                c.rectangle(x + w - 0.003, base - h, 0.003, h, tone * 0.45);
                let mark = if tone > 130.0 { tone - 90.0 } else { tone + 90.0 };
                c.rectangle(x + 0.15 * w, base - 0.9 * h, 0.6 * w, h * self.value(0.1, 0.4), mark);
                c.rectangle(x, base - h * self.value(0.12, 0.3), w, 0.012, mark);
                x += w;
            }
            c.rectangle(0.0, base, a.w, 0.03, 150.0);
        }
        c.rectangle(0.0, 0.0, 0.025, a.h, 145.0);
        c.rectangle(a.w - 0.025, 0.0, 0.025, a.h, 145.0);
        c.noise(self.noise, &mut self.random, 5.0, [1.0, 1.0]);
    }

    pub(super) fn carton(&mut self, c: &mut Canvas, a: Area) {
        let base = self.value(115.0, 160.0);
        self.ground(c, base, 7.0, [6.0, 0.8]);
        c.rectangle(0.0, 0.46 * a.h, a.w, 0.08 * a.h, base + 40.0);
        let label = Area::new(0.1 * a.w, 0.1 * a.h, 0.42 * a.w, 0.3 * a.h);
        c.rectangle(label.x, label.y, label.w, label.h, 225.0);
        c.text(&mut self.random, label.shrunk(0.08 * label.h), (label.h / 6.0).max(0.008), 40.0);
        let mark = Area::new(0.58 * a.w, 0.6 * a.h, 0.32 * a.w, 0.3 * a.h);
        c.leaves(&mut self.random, mark, [0.006, 0.3 * mark.w.min(mark.h)], Tone { mean: 80.0, contrast: 60.0 }, 1.5);
        c.frame(0.0, 0.0, a.w, a.h, 0.006, base - 40.0);
        for _ in 0..6 {
            let centre = [a.w * self.value(0.0, 1.0), a.h * self.value(0.0, 1.0)];
            let half = [self.value(0.004, 0.03), self.value(0.002, 0.01)];
            let angle = self.value(0.0, 3.1);
            c.shape(Shape::Rectangle { centre, half, angle }, base - self.value(20.0, 60.0), 0.7);
        }
    }

    pub(super) fn fabric(&mut self, c: &mut Canvas, a: Area, mean: f32, contrast: f32) {
        self.ground(c, mean, 6.0, [1.0, 1.0]);
        let large = (0.25 * a.w.min(a.h)).clamp(0.02, 0.12);
        c.leaves(&mut self.random, a, [0.008, large], Tone { mean, contrast }, 1.6);
        c.noise(self.noise, &mut self.random, 7.0, [0.5, 0.5]);
    }

    pub(super) fn screen(&mut self, c: &mut Canvas, a: Area) {
        self.ground(c, 25.0, 2.0, [1.0, 1.0]);
        let glass = a.shrunk(0.018);
        c.rectangle(glass.x, glass.y, glass.w, glass.h, 70.0);
        c.leaves(&mut self.random, glass, [0.01, 0.12], Tone { mean: 80.0, contrast: 35.0 }, 1.0);
        for _ in 0..3 {
            let (w, h) = (glass.w * self.value(0.3, 0.6), glass.h * self.value(0.35, 0.7));
            let x = glass.x + (glass.w - w) * self.value(0.0, 1.0);
            let y = glass.y + (glass.h - h) * self.value(0.0, 1.0);
            c.rectangle(x, y, w, h, self.value(200.0, 245.0));
            c.rectangle(x, y, w, 0.014, 100.0);
            let body = Area::new(x, y + 0.014, w, h - 0.014).shrunk(0.012);
            c.text(&mut self.random, body, 0.012, 50.0);
        }
    }

    pub(super) fn keys(&mut self, c: &mut Canvas, a: Area) {
        self.ground(c, 45.0, 3.0, [1.0, 1.0]);
        let pitch = 0.019f32.min(0.3 * a.w.min(a.h)).max(0.004);
        for j in 0..(a.h / pitch) as usize {
            for i in 0..(a.w / pitch) as usize {
                let value = self.value(75.0, 120.0);
                c.rectangle(i as f32 * pitch + 0.002, j as f32 * pitch + 0.002, 0.78 * pitch, 0.78 * pitch, value);
            }
        }
    }

    pub(super) fn desktop(&mut self, c: &mut Canvas, a: Area) {
        self.wood(c, a);
        for _ in 0..((a.w * a.h * 9.0) as usize).max(2) {
            let angle = self.value(0.0, 3.1);
            let half = [self.value(0.05, 0.11), self.value(0.07, 0.15)];
            let centre = [a.w * self.value(0.0, 1.0), a.h * self.value(0.0, 1.0)];
            let paper = self.value(170.0, 240.0);
            c.shape(Shape::Rectangle { centre, half, angle }, paper, 1.0);
            // Lines of print, turned with the page.
            let (sin, cos) = angle.sin_cos();
            for k in -4i32..=4 {
                let along = half[1] * 0.2 * k as f32;
                let middle = [centre[0] - sin * along, centre[1] + cos * along];
                let line = Shape::Rectangle { centre: middle, half: [half[0] * self.value(0.3, 0.8), 0.004], angle };
                c.shape(line, paper - 120.0, 1.0);
            }
        }
        for _ in 0..8 {
            let centre = [a.w * self.value(0.0, 1.0), a.h * self.value(0.0, 1.0)];
            let radius = self.random.log_range(0.008, 0.04) as f32;
            c.shape(Shape::Disc { centre, radius }, self.value(30.0, 220.0), 1.0);
        }
    }

    pub(super) fn laminate(&mut self, c: &mut Canvas, a: Area) {
        let base = self.value(135.0, 165.0);
        self.ground(c, base, 2.0, [10.0, 1.0]);
        // Crumbs and the rings of cups: what a bare top has for corners.
        for _ in 0..((a.w * a.h * 6.0) as usize).max(1) {
            let centre = [a.w * self.value(0.0, 1.0), a.h * self.value(0.0, 1.0)];
            let radius = self.random.log_range(0.001, 0.003) as f32;
            c.shape(Shape::Disc { centre, radius }, base - self.value(20.0, 70.0), 0.9);
        }
        for _ in 0..((a.w * a.h) as usize).max(1) {
            let centre = [a.w * self.value(0.0, 1.0), a.h * self.value(0.0, 1.0)];
            c.soft_shape(Shape::Disc { centre, radius: 0.038 }, base - 14.0, 0.7, 0.006);
            c.soft_shape(Shape::Disc { centre, radius: 0.034 }, base, 0.7, 0.006);
        }
    }

    pub(super) fn pegboard(&mut self, c: &mut Canvas, a: Area) {
        let (pitch, radius) = (0.025, 0.003);
        self.ground(c, 178.0, 2.0, [2.0, 2.0]);
        for j in 0..(a.h / pitch) as usize {
            for i in 0..(a.w / pitch) as usize {
                let centre = [(i as f32 + 0.5) * pitch, (j as f32 + 0.5) * pitch];
                c.shape(Shape::Disc { centre, radius }, 45.0, 1.0);
            }
        }
    }

    pub(super) fn foliage(&mut self, c: &mut Canvas, a: Area) {
        self.ground(c, 60.0, 12.0, [1.0, 1.0]);
        c.leaves(&mut self.random, a, [0.01, 0.08], Tone { mean: 95.0, contrast: 65.0 }, 3.0);
    }

    pub(super) fn picture(&mut self, c: &mut Canvas, a: Area) {
        self.ground(c, 60.0, 4.0, [1.0, 1.0]);
        let mount = a.shrunk(0.025);
        c.rectangle(mount.x, mount.y, mount.w, mount.h, self.value(200.0, 235.0));
        let inner = mount.shrunk(0.1 * a.w.min(a.h));
        let large = 0.45 * inner.w.min(inner.h).max(0.03);
        let mean = self.value(85.0, 150.0);
        c.rectangle(inner.x, inner.y, inner.w, inner.h, mean);
        c.leaves(&mut self.random, inner, [0.006, large], Tone { mean, contrast: 95.0 }, 2.5);
        c.noise(self.noise, &mut self.random, 4.0, [1.0, 1.0]);
    }

    pub(super) fn ribs(&mut self, c: &mut Canvas, a: Area) {
        self.ground(c, 195.0, 2.0, [1.0, 1.0]);
        let mut x = 0.02;
        while x + 0.04 < a.w {
            c.rectangle(x, 0.04, 0.018, a.h - 0.08, 110.0);
            x += 0.06;
        }
        c.rectangle(0.0, 0.1 * a.h, a.w, 0.015, 140.0);
        c.rectangle(0.0, 0.85 * a.h, a.w, 0.015, 140.0);
        c.noise(self.noise, &mut self.random, 3.0, [1.0, 1.0]);
    }
}
