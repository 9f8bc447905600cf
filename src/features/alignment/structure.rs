//! Mean, energy and structure tensor of a patch: what says how well it can be localised, before any template is made of it.

use wide::f32x8;

use crate::features::dispatch::simd_kernel;
use crate::features::patch_sampling::OFFSET;

/// Eight pixels of a row.
type Lanes = [f32; 8];

/// What is known of an n x n patch from its sums.
pub struct Structure {
    /// Grey value less [`OFFSET`].
    pub mean: f32,
    /// Gradient, grey/px.
    pub mean_gradient: [f32; 2],
    /// Regression of the gradient on the grey value, x and y, 1/px: what a change of gain could explain of it.
    pub along: [f32; 2],
    /// Sum of squares of the grey values minus their mean, grey².
    pub energy: f32,
    /// H divided by n²: xx, xy, yy, grey²/px².
    pub tensor: [f32; 3],
    /// Of the tensor: the smaller one and the larger one.
    pub eigenvalues: [f32; 2],
}

impl Structure {
    /// Of `n` x `n` pixels (8 or 16) with a border of one, row by row.
    #[inline]
    pub fn of(bordered: &[f32], n: usize) -> Self {
        let area = (n * n) as f32;
        let [t, x, y, tt, tx, ty, xx, xy, yy] = sums(bordered, n).map(|lanes| sum_lanes(lanes.into()));
        let (mean, mean_x, mean_y) = (t / area, x / area, y / area);
        let energy = (tt - t * mean).max(0.0);
        let (along_x, along_y) =
            if energy > 0.0 { ((tx - t * mean_x) / energy, (ty - t * mean_y) / energy) } else { (0.0, 0.0) };
        let tensor @ [xx, xy, yy] = [
            (xx - x * mean_x - along_x * along_x * energy) / area,
            (xy - x * mean_y - along_x * along_y * energy) / area,
            (yy - y * mean_y - along_y * along_y * energy) / area,
        ];
        let smaller = 0.5 * (xx + yy - ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt());
        Self {
            mean,
            mean_gradient: [mean_x, mean_y],
            along: [along_x, along_y],
            energy,
            tensor,
            eigenvalues: [smaller, xx + yy - smaller],
        }
    }
}

simd_kernel! {
    /// Sums, eight columns each, of t, x, y, t², t x, t y, x², x y and y², where t is the grey value and (x, y) its gradient.
    fn sums(bordered: &[f32], n: usize) -> [Lanes; 9] = sums_body
}

#[inline(always)]
fn sums_body(bordered: &[f32], n: usize) -> [Lanes; 9] {
    let side = n + 2;
    let mut sums = [[0.0; 8]; 9];
    for row in 0..n {
        for column in (0..n).step_by(8) {
            let at = |i: usize, j: usize| -> &[f32] { &bordered[(row + j) * side + column + i..][..8] };
            let (middle, left, right, above, below) = (at(1, 1), at(0, 1), at(2, 1), at(1, 0), at(1, 2));
            for k in 0..8 {
                let t = middle[k] - OFFSET;
                let (x, y) = ((right[k] - left[k]) * 0.5, (below[k] - above[k]) * 0.5);
                let products = [t, x, y, t * t, t * x, t * y, x * x, x * y, y * y];
                for m in 0..9 {
                    sums[m][k] += products[m];
                }
            }
        }
    }
    sums
}

/// Sum in a fixed order, whatever the machine's vectors.
#[inline(always)]
pub fn sum_lanes(lanes: f32x8) -> f32 {
    let v = lanes.to_array();
    ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition in f64: the tensor of gradients from which their mean and what a gain explains was taken.
    fn defined(bordered: &[f32], n: usize) -> ([f64; 3], f64) {
        let side = n + 2;
        let at = |x: usize, y: usize| f64::from(bordered[y * side + x]);
        let inner = (0..n * n).map(|k| (k % n + 1, k / n + 1));
        let values: Vec<[f64; 3]> = inner
            .map(|(x, y)| [at(x, y), 0.5 * (at(x + 1, y) - at(x - 1, y)), 0.5 * (at(x, y + 1) - at(x, y - 1))])
            .collect();
        let area = (n * n) as f64;
        let mean: [f64; 3] = std::array::from_fn(|m| values.iter().map(|v| v[m]).sum::<f64>() / area);
        let product = |a: usize, b: usize| values.iter().map(|v| (v[a] - mean[a]) * (v[b] - mean[b])).sum::<f64>();
        let tensor = [(1, 1), (1, 2), (2, 2)]
            .map(|(a, b)| (product(a, b) - product(0, a) * product(0, b) / product(0, 0)) / area);
        (tensor, product(0, 0))
    }

    #[test]
    fn the_tensor_is_that_of_what_neither_gain_nor_bias_explains() {
        let mut random = crate::geometry::random::Random::new(3);
        for n in [8, 16] {
            let bordered: Vec<f32> = (0..(n + 2) * (n + 2)).map(|_| (255.0 * random.unit()) as f32).collect();
            let structure = Structure::of(&bordered, n);
            let ([xx, xy, yy], energy) = defined(&bordered, n);
            assert!((f64::from(structure.energy) / energy - 1.0).abs() < 1e-4);
            for (got, defined) in structure.tensor.iter().zip([xx, xy, yy]) {
                assert!((f64::from(*got) - defined).abs() < 1e-3 * (xx + yy), "{got} {defined}");
            }
            let smaller = 0.5 * (xx + yy - ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt());
            let [small, large] = structure.eigenvalues.map(f64::from);
            assert!((small - smaller).abs() < 1e-3 * (xx + yy));
            assert!((small + large - (xx + yy)).abs() < 1e-3 * (xx + yy));
        }
    }

    #[test]
    fn both_machine_codes_give_the_same_sums() {
        let mut random = crate::geometry::random::Random::new(4);
        let bordered: Vec<f32> = (0..100).map(|_| (255.0 * random.unit()) as f32).collect();
        assert_eq!(sums(&bordered, 8), sums_body(&bordered, 8));
    }
}
