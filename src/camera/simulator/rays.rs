//! Viewing rays of all pixels, computed once.
//!
//! Input: a [`CameraModel`]. Output: undistorted normalised points (x/z, y/z) of every pixel's centre and of every
//! corner between pixels, as `f32`: an error of 1e-7, less than 1e-4 px. Rows are padded to whole tiles. 5 MB for
//! 640x480, about 0.1 us a pixel at start.

use nalgebra::Vector2;

use crate::geometry::CameraModel;

/// Side of a tile of the renderer, px.
pub(super) const TILE: usize = 16;

/// Rays on a regular grid over the picture.
#[derive(Debug, Clone)]
pub(super) struct Grid {
    pub(super) stride: usize,
    pub(super) x: Vec<f32>,
    pub(super) y: Vec<f32>,
}

/// Bounds of a tile's rays in normalised coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CullRect {
    pub(super) low: [f64; 2],
    pub(super) high: [f64; 2],
}

impl CullRect {
    /// Contains no point yet.
    pub(super) fn empty() -> Self {
        Self { low: [f64::MAX; 2], high: [f64::MIN; 2] }
    }

    /// Grows to contain a point.
    pub(super) fn include(&mut self, p: [f64; 2]) {
        for k in 0..2 {
            self.low[k] = self.low[k].min(p[k]);
            self.high[k] = self.high[k].max(p[k]);
        }
    }
}

/// All rays of a camera.
#[derive(Debug, Clone)]
pub(super) struct Rays {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Tiles a row and a column.
    pub(super) tiles: [usize; 2],
    /// Rays through the pixels' centres.
    pub(super) centres: Grid,
    /// Rays through the pixels' upper left corners; one row and one column more.
    pub(super) corners: Grid,
    /// Per tile, row by row.
    pub(super) bounds: Vec<CullRect>,
    /// Per tile: d normalised / d pixel, `[dx/du, dx/dv, dy/du, dy/dv]`.
    pub(super) jacobians: Vec<[f32; 4]>,
}

impl Rays {
    pub(super) fn new(camera: &CameraModel) -> Self {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let tiles = [width.div_ceil(TILE), height.div_ceil(TILE)];
        let padded = [tiles[0] * TILE, tiles[1] * TILE];
        let centres = Grid::new(camera, padded[0], padded[1], 0.0);
        let corners = Grid::new(camera, padded[0] + 1, padded[1] + 1, -0.5);
        let mut bounds = Vec::with_capacity(tiles[0] * tiles[1]);
        let mut jacobians = Vec::with_capacity(tiles[0] * tiles[1]);
        for ty in 0..tiles[1] {
            for tx in 0..tiles[0] {
                let mut rect = CullRect::empty();
                // The map is continuous and one to one: a tile's extremes lie on its border.
                for i in 0..=TILE {
                    for (x, y) in [(i, 0), (i, TILE), (0, i), (TILE, i)] {
                        let at = (ty * TILE + y) * corners.stride + tx * TILE + x;
                        let p = [f64::from(corners.x[at]), f64::from(corners.y[at])];
                        rect.include(p);
                    }
                }
                bounds.push(rect);
                let at = (ty * TILE + TILE / 2) * corners.stride + tx * TILE + TILE / 2;
                jacobians.push([
                    corners.x[at] - corners.x[at - 1],
                    corners.x[at] - corners.x[at - corners.stride],
                    corners.y[at] - corners.y[at - 1],
                    corners.y[at] - corners.y[at - corners.stride],
                ]);
            }
        }
        Self { width, height, tiles, centres, corners, bounds, jacobians }
    }
}

impl Grid {
    fn new(camera: &CameraModel, columns: usize, rows: usize, offset: f64) -> Self {
        let mut grid =
            Self { stride: columns, x: Vec::with_capacity(columns * rows), y: Vec::with_capacity(columns * rows) };
        // Padding beyond the picture repeats its last ray but one pixel: nobody looks there, the lens may fold there.
        let limit = [f64::from(camera.width) - 0.5, f64::from(camera.height) - 0.5];
        for row in 0..rows {
            for column in 0..columns {
                let pixel = Vector2::new((column as f64 + offset).min(limit[0]), (row as f64 + offset).min(limit[1]));
                let n = camera.undistort(&pixel).unwrap_or_default();
                grid.x.push(n.x as f32);
                grid.y.push(n.y as f32);
            }
        }
        grid
    }
}
