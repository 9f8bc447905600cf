//! Finds a chessboard in a picture and its inner corners to a fraction of a pixel.
//!
//! Input: a grey picture and a [`Pattern`] (inner corners a row, a column). Output: a [`Sighting`]: the board with its
//! corners in level-0 pixels (pixel (0, 0) is a pixel's centre), a grid of another size, or nothing.
//!
//! # How
//! 1. `saddle`: saddle points of the blurred picture, `S = Ixy² - Ixx Iyy`, on a pyramid level.
//! 2. `profile`: a circle around each must cross from dark to bright to dark to bright, opposite edges in line. That gives the directions
//!    of both edges and which sectors are bright, whatever contrast and light are.
//! 3. `grid`: from a corner to its neighbours, which lie along the edges and have dark and bright exchanged; each next
//!    place is predicted from the ones before, so distortion and perspective need no model.
//! 4. `ordering`: rows and columns of the grid, weak rims cut off, single holes filled where the prediction holds, the
//!    first corner by colour.
//! 5. `refine`: every edge pixel's gradient is perpendicular to the line to the corner (Förstner & Gülch 1987).
//!
//! Half resolution comes first, for half the noise and a quarter of the time; then full resolution for small boards, then
//! a quarter and an eighth for blurred ones. The first level with the whole pattern ends the search. Without one, a larger grid on any
//! level is taken for the board that is shown, which then has another size.
//!
//! Corners that are hidden or washed out may be missing: a plane calibration needs no whole board. A grid that has the
//! pattern's size but for these is the pattern.
//!
//! Cost, 640x480: 2 to 3 ms with a board, 5 ms without. Deterministic. Not here: which of two boards of one size is meant (the one that
//! is found first); markers.

mod board;
mod grid;
mod ordering;
mod profile;
mod refine;
mod saddle;

use crate::image::GreyImage;
use crate::image::pyramid::halve;
pub use board::{Board, BoardCorner, Pattern, SIDE_RANGE};
use ordering::Fit;
use profile::XCorner;
use saddle::SaddleMap;

/// Pyramid levels in the order in which they are searched.
const LEVELS: [usize; 4] = [1, 0, 2, 3];
/// Fewer corners in a grid that is not the pattern say nothing about a board.
const MIN_OTHER: usize = 16;
/// No level smaller than this is searched, pixels.
const MIN_SIDE: usize = 60;

/// What was seen of the pattern.
#[derive(Debug, Clone, PartialEq)]
pub enum Sighting {
    Board(Board),
    /// A grid of another size: (columns, rows) of inner corners, the longer side first.
    OtherSize(u32, u32),
    Nothing,
}

impl Sighting {
    pub fn board(self) -> Option<Board> {
        match self {
            Self::Board(board) => Some(board),
            _ => None,
        }
    }
}

/// Buffers that are kept between pictures.
#[derive(Debug, Default)]
pub struct Detector {
    levels: Vec<GreyImage>,
    map: SaddleMap,
    corners: Vec<XCorner>,
}

impl Detector {
    /// Looks for the pattern.
    pub fn detect(&mut self, picture: &GreyImage, pattern: &Pattern) -> Sighting {
        let mut best: Option<(Fit, usize)> = None;
        let mut larger: Option<Fit> = None;
        self.halve_all(picture);
        for level in LEVELS {
            if level > self.levels.len() {
                continue;
            }
            let image = if level == 0 { picture } else { &self.levels[level - 1] };
            if level > 0 && image.width.min(image.height) < MIN_SIDE {
                continue;
            }
            self.map.build(image);
            profile::find(&self.map, &mut self.corners);
            for grid in grid::grow_all(&self.corners, pattern) {
                let Some(fit) = ordering::fit(grid, &self.map, &self.corners, pattern) else { continue };
                if fit.goes_beyond(pattern) && larger.as_ref().is_none_or(|l| fit.found() > l.found()) {
                    larger = Some(fit.clone());
                }
                if fit.better_than(best.as_ref().map(|(fit, _)| fit), pattern) {
                    best = Some((fit, level));
                }
            }
            // A whole pattern ends the search, unless it may be a part of something else.
            if let Some((fit, level)) = best.as_ref().filter(|(fit, _)| fit.is_whole(pattern) && !fit.cut)
                && let Some(board) = refine::refine(picture, fit, *level, pattern).filter(|board| board.complete)
            {
                return Sighting::Board(board);
            }
        }
        let Some((fit, level)) = best else { return Sighting::Nothing };
        if !fit.is_pattern(pattern) {
            if fit.found() < MIN_OTHER {
                return Sighting::Nothing;
            }
            let (a, b) = fit.size();
            return Sighting::OtherSize(a.max(b), a.min(b));
        }
        // It is not whole, or may go on, and there is a larger board: that is the one that is shown.
        if let Some(whole) = larger.filter(|whole| whole.found() > fit.found()) {
            let (a, b) = whole.size();
            return Sighting::OtherSize(a.max(b), a.min(b));
        }
        match refine::refine(picture, &fit, level, pattern) {
            Some(board) => Sighting::Board(board),
            None => Sighting::Nothing,
        }
    }

    /// Levels 1 to 3 of the picture.
    fn halve_all(&mut self, picture: &GreyImage) {
        let most = LEVELS.into_iter().max().unwrap_or(0);
        self.levels.resize(most, GreyImage::default());
        halve(picture, &mut self.levels[0]);
        for k in 1..most {
            let (below, above) = self.levels.split_at_mut(k);
            halve(&below[k - 1], &mut above[0]);
        }
    }
}

#[cfg(all(test, feature = "tools"))]
mod tests;
