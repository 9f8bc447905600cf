//! Half-sampled image pyramid, and the pool that its pictures come from.
//!
//! In: a grey picture of W x H pixels. Out: levels l = 0 .. n-1 of floor(W / 2^l) x floor(H / 2^l) pixels, 8 bit.
//! Every pixel of level l + 1 is the rounded mean of the 2 x 2 pixels of level l that it covers, so pixel centres
//! relate as
//!
//! ```text
//! x_0 = (x_l + 0.5) * 2^l - 0.5        x_l = (x_0 + 0.5) / 2^l - 0.5
//! ```
//!
//! ([`base_from_level`], [`level_from_base`]). An odd last column or row is covered by no pixel of the next level; the
//! relation above stays exact.
//!
//! Filter: the mean is the whole filter. The wider [1 3 3 1] / 8 binomial, the next one that is symmetric about the
//! same centres, was measured against it on recorded sequences and did not track
//! better; it costs three times as much.
//!
//! Cost: W H bytes read, W H / 3 written; no allocation once every level has its size.
//!
//! Does not: blur level 0, keep gradients, or know what the picture shows.

use std::sync::Arc;

use nalgebra::Vector2;

use super::GreyImage;

/// Smallest side of a level, pixels: halving stops before a level would be smaller.
pub const MIN_LEVEL_SIDE: usize = 12;

/// Levels of halved pictures; level 0 is the picture itself.
///
/// A pixel (x, y) of level l covers level-0 pixels around ((x + 0.5) * 2^l - 0.5).
#[derive(Debug, Clone, Default)]
pub struct Pyramid {
    /// At least one level once built; fewer than asked for when the picture is small.
    pub levels: Vec<GreyImage>,
    /// Levels asked for.
    wanted: usize,
}

impl Pyramid {
    /// An empty pyramid of at most `levels` levels (at least 1).
    pub fn new(levels: usize) -> Self {
        Self { levels: Vec::with_capacity(levels.max(1)), wanted: levels.max(1) }
    }

    /// Copies `base` to level 0 and builds the levels above it.
    pub fn build(&mut self, base: &GreyImage) {
        let own = self.base_mut();
        own.resize(base.width, base.height);
        own.data.copy_from_slice(&base.data);
        self.rebuild();
    }

    /// Level 0, for a decoder to write into; call [`rebuild`](Self::rebuild) afterwards.
    pub fn base_mut(&mut self) -> &mut GreyImage {
        if self.levels.is_empty() {
            self.levels.push(GreyImage::default());
        }
        &mut self.levels[0]
    }

    /// Builds the levels above level 0 from it.
    pub fn rebuild(&mut self) {
        let (width, height) = match self.levels.first() {
            Some(base) => (base.width, base.height),
            None => return,
        };
        let mut count = 1;
        while count < self.wanted.max(1) && (width >> count).min(height >> count) >= MIN_LEVEL_SIDE {
            count += 1;
        }
        self.levels.truncate(count);
        while self.levels.len() < count {
            self.levels.push(GreyImage::default());
        }
        for upper in 1..count {
            let (below, above) = self.levels.split_at_mut(upper);
            halve(&below[upper - 1], &mut above[0]);
        }
    }

    /// Becomes a copy of `other`. Allocates only what its levels lack.
    pub fn copy_from(&mut self, other: &Self) {
        self.wanted = other.wanted;
        self.levels.resize_with(other.levels.len(), GreyImage::default);
        for (own, other) in self.levels.iter_mut().zip(&other.levels) {
            own.resize(other.width, other.height);
            own.data.copy_from_slice(&other.data);
        }
    }

    /// A copy whose `count` finest levels are empty.
    pub fn without_finest(&self, count: usize) -> Self {
        let coarser = self.levels.iter().skip(count).cloned();
        let levels = (0..count.min(self.levels.len())).map(|_| GreyImage::default()).chain(coarser).collect();
        Self { levels, wanted: self.wanted }
    }

    /// The pyramid of `levels` levels, or as many as there can be, whose level number `level` is `image` and whose finer ones are empty.
    pub fn from_level(image: GreyImage, level: usize, levels: usize) -> Self {
        let mut coarser = Self::new(levels.saturating_sub(level));
        *coarser.base_mut() = image;
        coarser.rebuild();
        let levels = (0..level).map(|_| GreyImage::default()).chain(coarser.levels).collect();
        Self { levels, wanted: coarser.wanted + level }
    }

    /// Size of level 0, pixels; (0, 0) before the first build.
    pub fn size(&self) -> (usize, usize) {
        self.levels.first().map_or((0, 0), |base| (base.width, base.height))
    }
}

/// Position in pixels of level `level` of a level-0 position.
#[inline]
pub fn level_from_base(level: usize, base: Vector2<f32>) -> Vector2<f32> {
    let scale = 1.0 / (1u32 << level) as f32;
    base.map(|v| (v + 0.5) * scale - 0.5)
}

/// Level-0 position of a position in pixels of level `level`.
#[inline]
pub fn base_from_level(level: usize, position: Vector2<f32>) -> Vector2<f32> {
    let scale = (1u32 << level) as f32;
    position.map(|v| (v + 0.5) * scale - 0.5)
}

/// `half` becomes `full` at half its size (rounded down), each pixel the rounded mean of the four that it covers.
pub fn halve(full: &GreyImage, half: &mut GreyImage) {
    let (width, height) = (full.width / 2, full.height / 2);
    half.resize(width, height);
    if width == 0 || height == 0 {
        return;
    }
    let pairs = full.data.chunks_exact(2 * full.width);
    for (rows, out) in pairs.zip(half.data.chunks_exact_mut(width)) {
        let (upper, lower) = rows.split_at(full.width);
        halve_row(&upper[..2 * width], &lower[..2 * width], out);
    }
}

/// A picture of twice the size: bilinear between the centres, which [`halve`] would give back but for rounding and the contrast of
/// details below two pixels; its edge is repeated outwards.
pub fn double(half: &GreyImage) -> GreyImage {
    let (width, height) = (half.width, half.height);
    let mut full = GreyImage::new(2 * width, 2 * height);
    if width == 0 || height == 0 {
        return full;
    }
    // Of two neighbours the nearer one weighs three quarters.
    let beside =
        |i: usize, size: usize| if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(size - 1) };
    for (y, out) in full.data.chunks_exact_mut(2 * width).enumerate() {
        let (near, far) = (half.row(y / 2), half.row(beside(y, height)));
        for (x, out) in out.iter_mut().enumerate() {
            let down = |x: usize| 3 * u16::from(near[x]) + u16::from(far[x]);
            *out = ((3 * down(x / 2) + down(beside(x, width)) + 8) >> 4) as u8;
        }
    }
    full
}

/// One row of [`halve`]. Plain stride-2 loop: the compiler turns it into mask, shift, add and pack on SSE2 and NEON.
#[inline]
fn halve_row(upper: &[u8], lower: &[u8], out: &mut [u8]) {
    for ((out, u), l) in out.iter_mut().zip(upper.chunks_exact(2)).zip(lower.chunks_exact(2)) {
        let sum = u16::from(u[0]) + u16::from(u[1]) + u16::from(l[0]) + u16::from(l[1]);
        *out = ((sum + 2) >> 2) as u8;
    }
}

/// Pyramids that are used again once their last holder has dropped them.
///
/// Bounded: the pool remembers at most `capacity` pyramids. When all of them are still held elsewhere (keyframes keep
/// theirs), the one handed out longest ago is left to its holders, which free it when they drop it, and a new one takes its place;
/// [`replaced`](Self::replaced) counts these.
#[derive(Debug)]
pub struct PyramidPool {
    /// Oldest hand-out first.
    slots: Vec<Arc<Pyramid>>,
    capacity: usize,
    levels: usize,
    replaced: u64,
}

impl PyramidPool {
    /// A pool of at most `capacity` (at least 1) pyramids of at most `levels` levels.
    pub fn new(capacity: usize, levels: usize) -> Self {
        let capacity = capacity.max(1);
        Self { slots: Vec::with_capacity(capacity), capacity, levels, replaced: 0 }
    }

    /// Lets `fill` write a pyramid that nobody else holds, and hands it out. Its old contents are unspecified.
    /// When `fill` fails the pyramid goes back to the pool.
    pub fn fill<E>(&mut self, fill: impl FnOnce(&mut Pyramid) -> Result<(), E>) -> Result<Arc<Pyramid>, E> {
        let mut arc = match self.slots.iter_mut().position(|slot| Arc::get_mut(slot).is_some()) {
            Some(free) => self.slots.remove(free),
            None => {
                if self.slots.len() == self.capacity {
                    self.slots.remove(0);
                    self.replaced += 1;
                }
                Arc::new(Pyramid::new(self.levels))
            }
        };
        let outcome = match Arc::get_mut(&mut arc) {
            Some(pyramid) => fill(pyramid),
            // Nobody but the pool held it a moment ago and the pool gives out no weak references.
            None => unreachable!("a free pyramid became shared"),
        };
        self.slots.push(arc.clone());
        outcome.map(|()| arc)
    }

    /// Pyramids that the pool had to give up because all were held, since the start.
    pub fn replaced(&self) -> u64 {
        self.replaced
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(width: usize, height: usize, mut seed: u32) -> GreyImage {
        let mut image = GreyImage::new(width, height);
        for v in &mut image.data {
            seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
            *v = (seed >> 24) as u8;
        }
        image
    }

    #[test]
    fn each_pixel_is_the_rounded_mean_of_the_four_below_at_any_size() {
        for (width, height) in [(320, 240), (641, 479), (333, 241), (64, 51), (1920, 1080)] {
            let base = noise(width, height, 7);
            let mut pyramid = Pyramid::new(4);
            pyramid.build(&base);
            assert_eq!(pyramid.levels[0], base);
            for l in 1..pyramid.levels.len() {
                let (below, above) = (&pyramid.levels[l - 1], &pyramid.levels[l]);
                assert_eq!((above.width, above.height), (width >> l, height >> l));
                for y in 0..above.height {
                    for x in 0..above.width {
                        let sum: f64 = [(0, 0), (1, 0), (0, 1), (1, 1)]
                            .iter()
                            .map(|&(i, j)| f64::from(below.at(2 * x + i, 2 * y + j)))
                            .sum();
                        assert_eq!(
                            above.at(x, y),
                            (sum / 4.0 + 0.5).floor() as u8,
                            "{width}x{height} level {l} at {x},{y}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn a_doubled_picture_shows_the_same_at_the_same_place() {
        // A slope survives doubling and halving; a level-1 position is where `base_from_level` says.
        let mut half = GreyImage::new(40, 30);
        for (i, v) in half.data.iter_mut().enumerate() {
            *v = (4 * (i % 40) + 2 * (i / 40)) as u8;
        }
        let full = double(&half);
        assert_eq!((full.width, full.height), (80, 60));
        for (x, y) in [(3, 5), (20, 14), (37, 27)] {
            let at = base_from_level(1, Vector2::new(x as f32, y as f32));
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| full.at(at.x as usize + i, at.y as usize + j));
            let mean = four.iter().map(|v| f64::from(*v)).sum::<f64>() / 4.0;
            assert!((mean - f64::from(half.at(x, y))).abs() <= 0.5);
            assert!(four[0] < four[1] && four[0] < four[2]);
        }
    }

    #[test]
    fn level_pixel_lies_at_the_centre_of_what_it_covers() {
        // A ramp is kept by averaging, so its value tells where a pixel of any level lies.
        let mut base = GreyImage::new(200, 160);
        for y in 0..160 {
            for x in 0..200 {
                base.data[y * 200 + x] = x as u8;
            }
        }
        let mut pyramid = Pyramid::new(4);
        pyramid.build(&base);
        for (l, level) in pyramid.levels.iter().enumerate() {
            for x in 0..level.width {
                let lies = base_from_level(l, Vector2::new(x as f32, 3.0));
                assert!((f32::from(level.at(x, 3)) - lies.x).abs() <= 0.51 * l as f32 + 1e-3);
                assert!((level_from_base(l, lies) - Vector2::new(x as f32, 3.0)).norm() < 1e-4);
            }
        }
    }

    #[test]
    fn small_pictures_get_fewer_levels_and_none_panics() {
        for (width, height) in [(0, 0), (1, 1), (1, 500), (13, 9), (24, 24), (47, 200)] {
            let mut pyramid = Pyramid::new(6);
            pyramid.build(&noise(width, height, 1));
            for level in &pyramid.levels[1..] {
                assert!(level.width >= MIN_LEVEL_SIDE && level.height >= MIN_LEVEL_SIDE);
            }
        }
    }

    #[test]
    fn a_copy_is_the_same_whatever_was_there() {
        let mut pyramids = [(64, 51, 4), (320, 240, 3), (30, 24, 4)].map(|(width, height, levels)| {
            let mut pyramid = Pyramid::new(levels);
            pyramid.build(&noise(width, height, 9));
            pyramid
        });
        let mut copy = Pyramid::new(1);
        for pyramid in &mut pyramids {
            copy.copy_from(pyramid);
            assert_eq!(copy.levels, pyramid.levels);
            copy.rebuild();
            assert_eq!(copy.levels.len(), pyramid.levels.len(), "as many levels are wanted");
        }
        let coarser = copy.without_finest(1);
        assert!(coarser.levels[0].data.is_empty() && coarser.levels[1..] == copy.levels[1..]);
        let again = Pyramid::from_level(coarser.levels[1].clone(), 1, coarser.levels.len());
        assert_eq!(again.levels, coarser.levels, "coarser levels follow from level 1");
    }

    #[test]
    fn pool_reuses_what_was_dropped_and_stays_bounded() {
        let base = noise(64, 48, 3);
        let fill = |p: &mut Pyramid| -> Result<(), ()> {
            p.build(&base);
            Ok(())
        };
        let mut pool = PyramidPool::new(3, 2);
        let mut held = std::collections::VecDeque::new();
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..20 {
            let pyramid = pool.fill(fill).unwrap();
            seen.insert(Arc::as_ptr(&pyramid) as usize);
            held.push_back(pyramid);
            if held.len() > 2 {
                held.pop_front();
            }
        }
        assert_eq!((seen.len(), pool.replaced()), (3, 0));
        // Everything is kept: each further one replaces a slot, and what is held stays untouched.
        let kept: Vec<_> = (0..10).map(|_| pool.fill(fill).unwrap()).collect();
        assert_eq!(pool.slots.len(), 3);
        assert!(pool.replaced() > 0);
        assert!(kept.iter().all(|p| p.levels[0] == base));
    }

    #[test]
    fn failed_fill_returns_the_pyramid_to_the_pool() {
        let mut pool = PyramidPool::new(1, 2);
        assert_eq!(pool.fill(|_| Err("corrupt")).unwrap_err(), "corrupt");
        let _held = pool.fill(|_| Ok::<(), ()>(())).unwrap();
        assert_eq!(pool.replaced(), 0);
    }
}
