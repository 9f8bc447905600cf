//! Gloss: lamps seen in polished faces.
//!
//! Input: the lamps, a face, the camera's pose. Output: directions, in camera coordinates, in which the face shows a lamp, and the
//! light that is added along a ray.
//!
//! A flat polished face shows each lamp where a mirror would: along the ray to the lamp's mirror image behind the face, wherever the
//! camera is. So a highlight lies deeper than the texture that it lies on and moves against it as the view does. Around that ray it
//! falls off as a Gaussian of the angle, for the lamp's size and the surface's roughness (the specular lobe of Phong, CACM 1975, for
//! narrow lobes). It is added to the light of the face, and white is clipped as a sensor clips.
//!
//! Cost: an exponential a pixel and lamp, only in tiles that show a highlight. Deliberately not here: what stands between lamp and face,
//! mirror images of anything but lamps, Fresnel's rise towards grazing views, the light meter (it does not see highlights).

use nalgebra::Vector3;

use super::cull::View;
use super::scene::Quad;
use crate::camera::simulator_config::GlossConfig;

/// Lamps seen at a time in one tile of the picture.
const MAX_LAMPS: usize = 2;
/// Beyond so many sigmas a highlight adds less than a tenth of a grey level.
const REACH_SIGMAS: f64 = 4.0;

/// The lamps, and how polished things show them.
#[derive(Debug, Clone)]
pub(super) struct Gloss {
    /// World, m.
    lamps: Vec<Vector3<f64>>,
    /// Grey levels added in a highlight's middle.
    peak: f32,
    spread_rad: f64,
}

/// A highlight as a tile sees it: unit direction of the mirror image at the tile's first row, and the change to its last.
#[derive(Debug, Clone, Copy, Default)]
struct Highlight {
    first: [f32; 3],
    change: [f32; 3],
}

/// The highlights of one face in one tile.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Highlights {
    lamps: [Highlight; MAX_LAMPS],
    count: usize,
    peak: f32,
    /// 1 / (2 sigma²), 1/rad².
    sharpness: f32,
}

impl Gloss {
    /// `None` when it is switched off.
    pub(super) fn new(config: &GlossConfig, lamps: &[Vector3<f64>]) -> Option<Self> {
        config.enabled.then(|| Self {
            lamps: lamps.to_vec(),
            peak: (255.0 * config.strength) as f32,
            spread_rad: config.spread_deg.to_radians(),
        })
    }

    /// What `quad` shows near the direction `middle` (camera coordinates) of a tile at its first and last row. The nearest lamps, if
    /// there are more than [`MAX_LAMPS`].
    pub(super) fn seen_in(&self, quad: &Quad, views: &[View; 2], middle: &Vector3<f64>) -> Highlights {
        let mut seen = Highlights { peak: self.peak, ..Highlights::default() };
        seen.sharpness = (0.5 / self.spread_rad.powi(2)) as f32;
        let mut angles = [f64::MAX; MAX_LAMPS];
        for lamp in &self.lamps {
            // Before the face, or it is not lit at all.
            let before = quad.away.dot(&(quad.origin - lamp));
            if before <= 0.0 {
                continue;
            }
            let image = lamp + quad.away * (2.0 * before);
            let towards = |view: &View| view.rotation.tr_mul(&(image - view.position)).normalize();
            let [start, end] = [towards(&views[0]), towards(&views[1])];
            // A tile and what it turns by while it is exposed are small beside the reach's last sigma.
            let angle = middle.angle(&start).min(middle.angle(&end));
            if angle > (REACH_SIGMAS + 1.0) * self.spread_rad {
                continue;
            }
            let Some(slot) = angles.iter().position(|a| angle < *a) else { continue };
            for k in (slot + 1..MAX_LAMPS).rev() {
                angles[k] = angles[k - 1];
                seen.lamps[k] = seen.lamps[k - 1];
            }
            angles[slot] = angle;
            let change = (end - start).map(|v| v as f32);
            seen.lamps[slot] = Highlight { first: start.map(|v| v as f32).into(), change: change.into() };
            seen.count = (seen.count + 1).min(MAX_LAMPS);
        }
        seen
    }
}

impl Highlights {
    /// Adds what is seen along the rays (x, y, 1) of a row, `row` tile rows of `rows` below the tile's first.
    #[inline]
    pub(super) fn add<const N: usize>(&self, x: &[f32; N], y: &[f32; N], row: f32, rows: f32, values: &mut [f32; N]) {
        for lamp in &self.lamps[..self.count] {
            let t = row / rows;
            let [a, b, c] = std::array::from_fn(|k| lamp.first[k] + t * lamp.change[k]);
            for i in 0..N {
                let cosine = (a * x[i] + b * y[i] + c) / (x[i] * x[i] + y[i] * y[i] + 1.0).sqrt();
                // angle² = 2 (1 - cos) to 1 % at 20 degrees; single precision leaves 0.03 degrees.
                let angle2 = 2.0 * (1.0 - cosine).max(0.0);
                values[i] += self.peak * (-angle2 * self.sharpness).exp();
            }
        }
    }
}
