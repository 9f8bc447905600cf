//! Corners chosen so that they are spread over the picture: the strongest of every cell, then the second of every cell, and so on.

use super::Corner;

/// Buffers, kept between pictures.
#[derive(Debug, Default)]
pub struct Spread {
    ranked: Vec<(u32, Corner)>,
    per_cell: Vec<u32>,
}

impl Spread {
    /// `corners` of a picture of `width` x `height` px (they are sorted by strength on the way), in that order over cells of `cell_px`.
    pub fn over_cells(
        &mut self,
        (width, height): (usize, usize),
        cell_px: usize,
        corners: &mut [Corner],
    ) -> impl Iterator<Item = &Corner> {
        let columns = width.div_ceil(cell_px);
        self.per_cell.clear();
        self.per_cell.resize(columns * height.div_ceil(cell_px), 0);
        corners.sort_by(|a, b| b.response.total_cmp(&a.response));
        self.ranked.clear();
        for corner in corners.iter() {
            let cell = corner.y as usize / cell_px * columns + corner.x as usize / cell_px;
            let Some(used) = self.per_cell.get_mut(cell) else { continue };
            self.ranked.push((*used, *corner));
            *used += 1;
        }
        self.ranked.sort_by_key(|r| r.0);
        self.ranked.iter().map(|r| &r.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weak_corner_alone_in_its_cell_comes_before_the_second_of_a_rich_one() {
        let corner = |x, y, response| Corner { x, y, response };
        let mut corners =
            [corner(1.0, 1.0, 9.0), corner(3.0, 2.0, 8.0), corner(25.0, 1.0, 2.0), corner(2.0, 25.0, 5.0)];
        let mut spread = Spread::default();
        let order: Vec<f32> = spread.over_cells((30, 30), 10, &mut corners).map(|c| c.response).collect();
        assert_eq!(order, [9.0, 5.0, 2.0, 8.0]);
    }
}
