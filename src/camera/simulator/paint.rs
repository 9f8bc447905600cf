//! Painting of flat faces: a grey canvas measured in metres, shapes with soft edges, natural-looking noise.
//!
//! Input: a size in metres and texels per metre. Output: texels, row by row, u to the right and v down as one sees the
//! face from outside. Values are perceptual grey (a photograph's pixel values), 0..255, before light falls on it.
//!
//! Two sources of natural statistics: value noise summed over octaves with amplitudes falling as 1/f, and the dead
//! leaves model (Lee, Mumford and Huang, "Occlusion models for natural images", IJCV 2001): opaque shapes whose sizes
//! follow r^-3 look the same at every distance, so corners exist at every scale and new ones appear when one comes near.
//!
//! Cost: about 5 ns a texel and layer, at start only.

use super::random::Random;

/// Side of the tile of noise, texels.
const NOISE_SIDE: usize = 1024;

/// A square of noise that repeats without a seam.
#[derive(Debug, Clone)]
pub(super) struct Noise {
    /// About -127..127, row by row.
    values: Vec<i8>,
}

impl Noise {
    /// Value noise, octaves from 8 to [`NOISE_SIDE`] lattice points a side, amplitude ~ 1/f^0.8.
    pub(super) fn new(random: &mut Random) -> Self {
        let mut sum = vec![0.0f32; NOISE_SIDE * NOISE_SIDE];
        let mut points = 8;
        while points <= NOISE_SIDE {
            let amplitude = (8.0 / points as f32).powf(0.8);
            let lattice: Vec<f32> = (0..points * points).map(|_| random.range(-1.0, 1.0) as f32).collect();
            let cell = NOISE_SIDE / points;
            for y in 0..NOISE_SIDE {
                let (j, fy) = (y / cell, smooth((y % cell) as f32 / cell as f32));
                let (top, bottom) = (&lattice[j * points..], &lattice[(j + 1) % points * points..]);
                for x in 0..NOISE_SIDE {
                    let (i, fx) = (x / cell, smooth((x % cell) as f32 / cell as f32));
                    let k = (i + 1) % points;
                    let a = top[i] + (top[k] - top[i]) * fx;
                    let b = bottom[i] + (bottom[k] - bottom[i]) * fx;
                    sum[y * NOISE_SIDE + x] += amplitude * (a + (b - a) * fy);
                }
            }
            points *= 2;
        }
        let deviation = (sum.iter().map(|v| v * v).sum::<f32>() / sum.len() as f32).sqrt().max(1e-6);
        Self { values: sum.iter().map(|v| (v / deviation * 45.0).clamp(-127.0, 127.0) as i8).collect() }
    }
}

fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

/// A face being painted.
#[derive(Debug, Clone)]
pub(super) struct Canvas {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Size, m.
    pub(super) size: [f32; 2],
    /// Texels per metre.
    pub(super) density: f32,
    pub(super) texels: Vec<u8>,
}

/// A shape to paint, in metres.
#[derive(Debug, Clone, Copy)]
pub(super) enum Shape {
    /// Centre, half sizes, rotation in rad.
    Rectangle { centre: [f32; 2], half: [f32; 2], angle: f32 },
    /// Centre, radius.
    Disc { centre: [f32; 2], radius: f32 },
    /// Centre, distance of the sides from it, rotation in rad; equilateral.
    Triangle { centre: [f32; 2], inner: f32, angle: f32 },
}

impl Canvas {
    /// A face of `size` metres in one grey.
    pub(super) fn new(size: [f64; 2], density: f64, value: f32) -> Self {
        let side = |m: f64| ((m * density).ceil() as usize).clamp(1, super::texture::MAX_SIDE);
        let (width, height) = (side(size[0]), side(size[1]));
        Self {
            width,
            height,
            size: [size[0] as f32, size[1] as f32],
            density: density as f32,
            texels: vec![value.clamp(0.0, 255.0) as u8; width * height],
        }
    }

    /// Adds noise of the given standard deviation, grey levels. `stretch`: how many texels one sample of the noise
    /// spans in u and v (wood grain: much along, little across).
    pub(super) fn noise(&mut self, noise: &Noise, random: &mut Random, sigma: f32, stretch: [f32; 2]) {
        let offset = [random.index(NOISE_SIDE), random.index(NOISE_SIDE)];
        let step = stretch.map(|s| (65_536.0 / s.max(0.25)) as usize);
        let gain = (sigma / 45.0 * 256.0) as i32;
        for y in 0..self.height {
            let row = ((y * step[1]) >> 16).wrapping_add(offset[1]) % NOISE_SIDE;
            let row = &noise.values[row * NOISE_SIDE..][..NOISE_SIDE];
            for (x, t) in self.texels[y * self.width..][..self.width].iter_mut().enumerate() {
                let n = i32::from(row[(((x * step[0]) >> 16) + offset[0]) % NOISE_SIDE]);
                *t = (i32::from(*t) + ((n * gain) >> 8)).clamp(0, 255) as u8;
            }
        }
    }

    /// Paints `shape` in grey `value` with opacity `alpha`; its edge is one texel soft.
    pub(super) fn shape(&mut self, shape: Shape, value: f32, alpha: f32) {
        self.soft_shape(shape, value, alpha, 1.0 / self.density);
    }

    /// As [`shape`](Self::shape) with an edge `softness` metres wide: shadows, stains.
    pub(super) fn soft_shape(&mut self, shape: Shape, value: f32, alpha: f32, softness: f32) {
        let (centre, reach) = match shape {
            Shape::Rectangle { centre, half, angle } => {
                let (s, c) = (angle.sin().abs(), angle.cos().abs());
                (centre, [half[0] * c + half[1] * s, half[0] * s + half[1] * c])
            }
            Shape::Disc { centre, radius } => (centre, [radius; 2]),
            Shape::Triangle { centre, inner, .. } => (centre, [2.0 * inner; 2]),
        };
        let reach = reach.map(|r| r + 0.5 * softness);
        let bound = |centre: f32, reach: f32, n: usize| {
            let low = ((centre - reach) * self.density).floor().max(0.0) as usize;
            let high = (((centre + reach) * self.density).ceil().max(0.0) as usize).min(n);
            low.min(high)..high
        };
        let (columns, rows) = (bound(centre[0], reach[0], self.width), bound(centre[1], reach[1], self.height));
        let (sin, cos) = match shape {
            Shape::Rectangle { angle, .. } | Shape::Triangle { angle, .. } => angle.sin_cos(),
            Shape::Disc { .. } => (0.0, 1.0),
        };
        let texel = 1.0 / self.density;
        let hardness = 1.0 / softness.max(1e-6);
        for y in rows {
            let dy = (y as f32 + 0.5) * texel - centre[1];
            let row = &mut self.texels[y * self.width..][..self.width];
            for x in columns.clone() {
                let dx = (x as f32 + 0.5) * texel - centre[0];
                let (a, b) = (dx * cos + dy * sin, dy * cos - dx * sin);
                // Signed distance from the edge, m; negative inside.
                let distance = match shape {
                    Shape::Rectangle { half, .. } => (a.abs() - half[0]).max(b.abs() - half[1]),
                    Shape::Disc { radius, .. } => (a * a + b * b).sqrt() - radius,
                    Shape::Triangle { inner, .. } => (b.max(-0.5 * b + 0.866 * a.abs())) - inner,
                };
                let cover = (0.5 - distance * hardness).clamp(0.0, 1.0) * alpha;
                let t = &mut row[x];
                *t = (f32::from(*t) + (value - f32::from(*t)) * cover + 0.5).clamp(0.0, 255.0) as u8;
            }
        }
    }

    /// Axis-aligned rectangle from its corner (x, y) and size, m.
    pub(super) fn rectangle(&mut self, x: f32, y: f32, w: f32, h: f32, value: f32) {
        let shape = Shape::Rectangle { centre: [x + 0.5 * w, y + 0.5 * h], half: [0.5 * w, 0.5 * h], angle: 0.0 };
        self.shape(shape, value, 1.0);
    }

    /// A rectangle's outline, `line` metres wide, inside its border.
    pub(super) fn frame(&mut self, x: f32, y: f32, w: f32, h: f32, line: f32, value: f32) {
        self.rectangle(x, y, w, line, value);
        self.rectangle(x, y + h - line, w, line, value);
        self.rectangle(x, y, line, h, value);
        self.rectangle(x + w - line, y, line, h, value);
    }

    /// Dead leaves over a part of the face: opaque shapes of radius `small`..`large` metres whose number falls with the
    /// third power of the size, greys `mean` +- `contrast`, until they could cover the part `cover` times.
    pub(super) fn leaves(&mut self, random: &mut Random, area: Area, sizes: [f32; 2], tone: Tone, cover: f32) {
        let [small, large] = sizes;
        let total = (area.w * area.h).max(0.0) * cover;
        let mut painted = 0.0;
        // Bounded: a leaf is at least pi small² large, and the cap holds whatever the sizes.
        for _ in 0..60_000 {
            if painted >= total {
                break;
            }
            // Inverse of the distribution r^-3 between the two sizes.
            let t = random.unit() as f32;
            let (i, j) = (small.powi(-2), large.powi(-2));
            let r = (i - t * (i - j)).powf(-0.5);
            let centre = [area.x + area.w * random.unit() as f32, area.y + area.h * random.unit() as f32];
            let value = tone.mean + tone.contrast * random.range(-1.0, 1.0) as f32;
            let angle = random.range(0.0, std::f64::consts::TAU) as f32;
            let shape = match random.index(5) {
                0 => Shape::Disc { centre, radius: r },
                1 => Shape::Triangle { centre, inner: 0.7 * r, angle },
                2 => Shape::Rectangle { centre, half: [r, r * random.range(0.15, 0.5) as f32], angle },
                _ => Shape::Rectangle { centre, half: [r, r * random.range(0.4, 1.0) as f32], angle: 0.0 },
            };
            self.clipped(shape, value, area);
            painted += 2.0 * r * r;
        }
    }

    /// Paints a shape, but nothing outside `area`.
    fn clipped(&mut self, shape: Shape, value: f32, area: Area) {
        let shape = match shape {
            Shape::Rectangle { centre, half, angle } if angle == 0.0 => {
                let clip = |c: f32, h: f32, low: f32, size: f32| {
                    let (a, b) = ((c - h).max(low), (c + h).min(low + size));
                    (0.5 * (a + b), (0.5 * (b - a)).max(0.0))
                };
                let (x, w) = clip(centre[0], half[0], area.x, area.w);
                let (y, h) = clip(centre[1], half[1], area.y, area.h);
                Shape::Rectangle { centre: [x, y], half: [w, h], angle }
            }
            Shape::Rectangle { centre, half, angle } => {
                let room = area.inside(centre);
                let shrink = (room / (half[0].hypot(half[1])).max(1e-6)).min(1.0);
                Shape::Rectangle { centre, half: half.map(|h| h * shrink), angle }
            }
            Shape::Disc { centre, radius } => Shape::Disc { centre, radius: radius.min(area.inside(centre)) },
            Shape::Triangle { centre, inner, angle } => {
                Shape::Triangle { centre, inner: inner.min(0.5 * area.inside(centre)), angle }
            }
        };
        self.shape(shape, value, 1.0);
    }

    /// Rows of word-like dashes: what print looks like from afar.
    pub(super) fn text(&mut self, random: &mut Random, area: Area, line: f32, value: f32) {
        let mut y = area.y;
        for _ in 0..400 {
            if y + line > area.y + area.h {
                break;
            }
            let end = area.x + area.w * if random.chance(0.25) { random.range(0.3, 0.9) as f32 } else { 1.0 };
            let mut x = area.x;
            while x < end {
                let word = line * random.range(0.6, 4.0) as f32;
                let word = word.min(end - x);
                self.rectangle(x, y, word, 0.5 * line, value);
                // Ascenders: corners that show only from near.
                if random.chance(0.6) {
                    self.rectangle(x + word * 0.5, y - 0.22 * line, 0.18 * line, 0.3 * line, value);
                }
                x += word + 0.4 * line;
            }
            y += line * 1.25;
        }
    }
}

/// A rectangle on a face: corner and size, m.
#[derive(Debug, Clone, Copy)]
pub(super) struct Area {
    pub(super) x: f32,
    pub(super) y: f32,
    pub(super) w: f32,
    pub(super) h: f32,
}

impl Area {
    pub(super) fn new(x: f32, y: f32, w: f32, h: f32) -> Self {
        Self { x, y, w, h }
    }

    /// Without a border of `margin` metres.
    pub(super) fn shrunk(&self, margin: f32) -> Self {
        let m = margin.min(0.5 * self.w).min(0.5 * self.h);
        Self::new(self.x + m, self.y + m, self.w - 2.0 * m, self.h - 2.0 * m)
    }

    /// Distance of a point from the border, m; 0 outside.
    fn inside(&self, p: [f32; 2]) -> f32 {
        let x = (p[0] - self.x).min(self.x + self.w - p[0]);
        let y = (p[1] - self.y).min(self.y + self.h - p[1]);
        x.min(y).max(0.0)
    }
}

/// Greys of a pattern: mean and largest deviation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tone {
    pub(super) mean: f32,
    pub(super) contrast: f32,
}
