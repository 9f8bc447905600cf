//! What of a place has changed at another time: where furniture stands, and the light.
//!
//! Input: [`AnotherDayConfig`], the place's seed. Output: a [`Move`] for each piece of furniture that has one, the strengths of lamps and window.
//! Drawn from streams of its own: what has not changed looks as it did, to the texel but for the light on it.
//! Deliberately not here: shadows that furniture casts on furniture or walls, reflections, colours of light.

use nalgebra::Vector3;

use super::random::{Random, mix};
use crate::camera::simulator_config::AnotherDayConfig;

/// How something came to stand elsewhere: turned about a vertical axis, then shifted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Move {
    /// Place of the axis, m.
    about: [f64; 2],
    /// rad.
    pub(super) turn: f64,
    /// m.
    shift: [f64; 2],
}

impl Move {
    pub(super) fn direction(&self, d: &Vector3<f64>) -> Vector3<f64> {
        let (sin, cos) = self.turn.sin_cos();
        Vector3::new(d.x * cos - d.y * sin, d.x * sin + d.y * cos, d.z)
    }

    pub(super) fn point(&self, p: &Vector3<f64>) -> Vector3<f64> {
        let about = Vector3::new(self.about[0], self.about[1], 0.0);
        about + self.direction(&(p - about)) + Vector3::new(self.shift[0], self.shift[1], 0.0)
    }
}

/// What is drawn for a place; `None` in the place's own time.
#[derive(Debug, Clone)]
pub(super) struct Changes {
    random: Random,
    moved_share: f64,
}

impl Changes {
    pub(super) fn new(config: &AnotherDayConfig, seed: u64) -> Option<Self> {
        let random = || Random::new(mix(seed) ^ config.seed, 0xda1);
        config.enabled.then(|| Self { random: random(), moved_share: config.moved_share })
    }

    /// Whether something around `about` has been moved, and where to: by half of `room` to all of it along x and y, m, to either side,
    /// and likewise turned by up to `turn`, rad.
    pub(super) fn moved(&mut self, about: [f64; 2], room: [f64; 2], turn: f64) -> Option<Move> {
        let is_moved = self.random.chance(self.moved_share);
        let mut some = |most: f64| self.random.range(0.5, 1.0) * if self.random.chance(0.5) { most } else { -most };
        let found = Move { about, turn: some(turn), shift: room.map(&mut some) };
        is_moved.then_some(found)
    }

    /// Patterns of a thing that is another one now: what its own are mixed with.
    pub(super) fn other_pattern(&mut self) -> u64 {
        self.random.next()
    }
}

/// Light of a place.
#[derive(Debug, Clone)]
pub(super) struct Light {
    /// From everywhere, as a share of white paper's.
    pub(super) everywhere: f64,
    /// From a window in the wall +y.
    pub(super) window: f64,
    random: Option<Random>,
}

impl Light {
    pub(super) fn new(config: &AnotherDayConfig, seed: u64) -> Self {
        if !(config.enabled && config.other_light) {
            return Self { everywhere: 0.36, window: 0.0, random: None };
        }
        let mut random = Random::new(mix(seed) ^ config.seed, 0x119);
        Self { everywhere: random.range(0.18, 0.4), window: random.range(0.0, 1.6), random: Some(random) }
    }

    /// Strength of the next lamp: 1 in the place's own time; at another one in three is off, the others are weaker or stronger.
    pub(super) fn next_lamp(&mut self) -> f64 {
        match &mut self.random {
            None => 1.0,
            Some(random) => {
                let strength = random.range(0.4, 1.5);
                if random.chance(1.0 / 3.0) { 0.0 } else { strength }
            }
        }
    }
}
