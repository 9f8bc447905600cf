//! Mean, energy and structure tensor of a patch: what says how well it can be localised, before any template is made of it.

use super::super::dispatch::simd_kernel;
use super::{OFFSET, sum_lanes};

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
    pub min_eigenvalue: f32,
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
        let min_eigenvalue = 0.5 * (xx + yy - ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt());
        Self { mean, mean_gradient: [mean_x, mean_y], along: [along_x, along_y], energy, tensor, min_eigenvalue }
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
