//! Which pixels are dark beside what is around them.
//!
//! Grey picture -> mask of the same size with a rim of one pixel. Tiles of 4 x 4 pixels know their darkest and brightest pixel; a pixel is
//! dark below the middle of the extremes of its tile and the eight around it. Where these are too close nothing is dark: there is no edge.

use crate::image::GreyImage;

/// Side of a tile, px. Three of them must reach across the white cell beside a tag's border and be filled by no dark cell of a small tag.
const TILE_PX: usize = 4;
/// Difference of brightest and darkest below which there is no edge, grey levels.
const LEAST_CONTRAST: u8 = 24;

/// Set in [`Mask::pixels`]: the pixel is dark.
pub const DARK: u8 = 1;

/// Dark pixels; the rim is not dark, so that followers of contours need no bounds.
#[derive(Debug, Default)]
pub struct Mask {
    /// Pixels a row, the rim included.
    pub stride: usize,
    pub rows: usize,
    pub pixels: Vec<u8>,
    /// (darkest, brightest) of each tile, and of each with its neighbours.
    tiles: Vec<(u8, u8)>,
    around: Vec<(u8, u8)>,
}

impl Mask {
    /// Becomes that of this picture. Allocates only when it grows.
    pub fn fill(&mut self, image: &GreyImage) {
        let (width, height) = (image.width, image.height);
        (self.stride, self.rows) = (width + 2, height + 2);
        self.pixels.clear();
        self.pixels.resize(self.stride * self.rows, 0);
        if width < TILE_PX || height < TILE_PX {
            return;
        }
        let (columns, rows) = (width.div_ceil(TILE_PX), height.div_ceil(TILE_PX));
        self.fill_tiles(image, columns, rows);
        for y in 0..height {
            let tiles = &self.around[y / TILE_PX * columns..][..columns];
            let out = &mut self.pixels[(y + 1) * self.stride + 1..][..width];
            for ((pixels, out), &(low, high)) in
                image.row(y).chunks(TILE_PX).zip(out.chunks_mut(TILE_PX)).zip(tiles.iter())
            {
                if high - low < LEAST_CONTRAST {
                    continue;
                }
                let middle = low + (high - low) / 2;
                for (v, out) in pixels.iter().zip(out) {
                    *out = u8::from(*v < middle);
                }
            }
        }
    }

    fn fill_tiles(&mut self, image: &GreyImage, columns: usize, rows: usize) {
        let merged = |a: (u8, u8), b: (u8, u8)| (a.0.min(b.0), a.1.max(b.1));
        self.tiles.clear();
        self.tiles.resize(columns * rows, (u8::MAX, u8::MIN));
        for y in 0..image.height {
            let tiles = &mut self.tiles[y / TILE_PX * columns..][..columns];
            for (pixels, tile) in image.row(y).chunks(TILE_PX).zip(tiles) {
                *tile = pixels.iter().fold(*tile, |tile, &v| merged(tile, (v, v)));
            }
        }
        self.around.clear();
        for row in 0..rows {
            for column in 0..columns {
                let mut all = self.tiles[row * columns + column];
                for r in row.saturating_sub(1)..(row + 2).min(rows) {
                    for c in column.saturating_sub(1)..(column + 2).min(columns) {
                        all = merged(all, self.tiles[r * columns + c]);
                    }
                }
                self.around.push(all);
            }
        }
    }
}
