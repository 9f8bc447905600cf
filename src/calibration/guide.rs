//! Calibration with somebody who moves a board before the camera (or a camera before a board).
//!
//! Input: frame after frame with its time. Output: what each frame came to ([`Seen`]), what is missing, and the camera once it is known well
//! enough. A view is taken by itself when the board is
//! - still: its corners move slower than 1.2 % of the picture's width a second against the frame before; the longer no view comes,
//!   the more is let pass, up to 5 %;
//! - sharp: its edges are narrower than a sixth of a square and than three pixels in 640;
//! - new: its corners are 6 % of the width away from those of every view that was taken.
//!
//! A view like one that was taken, but held much stiller, takes its place. A rolling shutter of 20 ms shears by 0.15 to 0.6 px what moves so, and
//! no residual shows it: so how fast each corner moved, from the frames before and after, is a part of the view, and the solution
//! estimates the shutter with the camera.
//!
//! After each view from the fourth on, and the frame after it, everything is solved anew. It is done when [`ENOUGH_VIEWS`] were taken and the verdict has nothing to ask for, or when
//! [`MAX_VIEWS`] were taken; the caller bounds the time.
//!
//! Cost: a detection a frame, 2 to 15 ms; a millisecond or two a view. Not here: cameras, terminals, clocks.

use nalgebra::{SMatrix, SVector, Vector2};

use super::boards::{BoardView, Calibrated, solve};
use super::chessboard::{Board, BoardCorner, Detector, Pattern, Sighting};
use crate::geometry::plane_calibration::{Distortion, MIN_VIEWS};
use crate::image::GreyImage;

/// Views that are kept.
pub const MAX_VIEWS: usize = 60;
/// Views before it ends by itself.
pub const ENOUGH_VIEWS: usize = 15;
/// Speed of a board that counts as still, picture widths a second: at once, and after waiting for [`PATIENCE_S`].
const STILL_WIDTHS_S: (f64, f64) = (0.012, 0.05);
/// So long nothing but still boards is waited for, s.
const PATIENCE_S: f64 = 10.0;
/// A view takes another's place if it moved less by this factor.
const STILLER: f64 = 0.6;
/// Frames further apart say nothing about movement, s.
const MAX_GAP_S: f64 = 0.5;
/// A board moves if that shows so many times more than its corners' noise does.
const MOVES: f64 = 4.0;
/// Distance of a new view from every other, picture widths.
const NEW_WIDTHS: f64 = 0.06;
/// Blur of a sharp board, one sigma, px at 640 px of width.
const SHARP_PX: f64 = 3.0;

/// What a frame came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    NoBoard,
    /// A board of so many columns and rows of inner corners.
    OtherSize(u32, u32),
    /// Some of its corners are hidden.
    Incomplete,
    Moving,
    Blurred,
    /// Like a view that was taken before.
    Known,
    /// The same, and better than that one, whose place it takes.
    Better(usize),
    Taken,
}

/// A view that was taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Taken {
    pub board: Board,
    /// How fast it moved, picture widths a second.
    pub speed: f64,
    /// How fast each corner moved, px/s.
    pub velocity: Vec<Vector2<f64>>,
    /// Empty if pictures are not kept.
    pub picture: GreyImage,
}

/// The state of a guided calibration.
#[derive(Debug)]
pub struct Guide {
    pattern: Pattern,
    distortion: Distortion,
    keeps_pictures: bool,
    detector: Detector,
    size: (u32, u32),
    previous: Option<(i64, Board)>,
    /// When the last view was taken, or the first frame came.
    waiting_since_ns: Option<i64>,
    views: Vec<Taken>,
    /// The view of the frame before, and the time and the board before that: how it moved is known when the next frame comes.
    unsettled: Option<(usize, i64, Board)>,
    solution: Option<Calibrated>,
}

/// Each corner of `a` in `b`, where that has it.
fn same_corners(a: &Board, b: &Board) -> Vec<Option<Vector2<f64>>> {
    let mut at = 0;
    // Both are in reading order.
    let other = |corner: &BoardCorner| {
        let key = (corner.row, corner.column);
        while b.corners.get(at).is_some_and(|c| (c.row, c.column) < key) {
            at += 1;
        }
        b.corners.get(at).filter(|c| (c.row, c.column) == key).map(|c| c.pixel)
    };
    a.corners.iter().map(other).collect()
}

/// Mean distance of the corners that both boards have, pixels.
fn distance(a: &Board, b: &Board) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for (corner, other) in a.corners.iter().zip(same_corners(a, b)) {
        if let Some(other) = other {
            sum += (other - corner.pixel).norm();
            count += 1;
        }
    }
    if count == 0 { f64::INFINITY } else { sum / f64::from(count) }
}

/// How fast the corners of `board` move, px/s, by where they were `gap_s` earlier and later: `before` and `after`. A plane's flow is nearly
/// a polynomial of second degree over it, which takes out most of the corners' noise. Empty: what is left is noise, or nobody knows.
fn velocities(board: &Board, before: &Board, after: &Board, gap_s: f64) -> Vec<Vector2<f64>> {
    const TERMS: usize = 6;
    let terms = |c: &BoardCorner| {
        let (x, y) = (f64::from(c.column), f64::from(c.row));
        SVector::<f64, TERMS>::from([1.0, x, y, x * x, x * y, y * y])
    };
    let pairs = same_corners(board, before).into_iter().zip(same_corners(board, after));
    let moved: Vec<(SVector<f64, TERMS>, Vector2<f64>)> = (board.corners.iter().zip(pairs))
        .filter_map(|(corner, (from, to))| Some((terms(corner), (to? - from?) / gap_s)))
        .collect();
    if moved.len() < 2 * TERMS {
        return Vec::new();
    }
    let (mut normal, mut right) = (SMatrix::<f64, TERMS, TERMS>::zeros(), SMatrix::<f64, TERMS, 2>::zeros());
    for (t, v) in &moved {
        normal += t * t.transpose();
        right += t * v.transpose();
    }
    let Some(cholesky) = normal.cholesky() else { return Vec::new() };
    let flow = cholesky.solve(&right);
    let at = |t: &SVector<f64, TERMS>| flow.tr_mul(t);
    let noise: f64 = moved.iter().map(|(t, v)| (v - at(t)).norm_squared()).sum();
    let signal: f64 = moved.iter().map(|(t, _)| at(t).norm_squared()).sum();
    // Noise alone leaves so much of itself in a fit of so many terms.
    let left = noise * TERMS as f64 / (moved.len() - TERMS) as f64;
    if signal <= MOVES * left { Vec::new() } else { board.corners.iter().map(|c| at(&terms(c))).collect() }
}

impl Guide {
    pub fn new(pattern: Pattern, distortion: Distortion) -> Self {
        Self {
            pattern,
            distortion,
            keeps_pictures: true,
            detector: Detector::default(),
            size: (0, 0),
            previous: None,
            waiting_since_ns: None,
            views: Vec::new(),
            unsettled: None,
            solution: None,
        }
    }

    /// The pictures of its views, megabytes each, are for a report: without one they need not be kept.
    pub fn without_pictures(mut self) -> Self {
        self.keeps_pictures = false;
        self
    }

    /// One frame, taken at `time_ns`. Pictures of another size than the first ones start it all over.
    pub fn step(&mut self, picture: &GreyImage, time_ns: i64) -> Seen {
        let size = (picture.width as u32, picture.height as u32);
        if size != self.size {
            self.size = size;
            self.previous = None;
            self.waiting_since_ns = None;
            self.views.clear();
            self.unsettled = None;
            self.solution = None;
        }
        let sighting = self.detector.detect(picture, &self.pattern);
        self.settle(&sighting, time_ns);
        let board = match sighting {
            Sighting::Board(board) => board,
            Sighting::OtherSize(columns, rows) => {
                self.previous = None;
                return Seen::OtherSize(columns, rows);
            }
            Sighting::Nothing => {
                self.previous = None;
                return Seen::NoBoard;
            }
        };
        let waiting_ns = time_ns - *self.waiting_since_ns.get_or_insert(time_ns);
        let speed = self.speed(&board, time_ns);
        let seen = self.judge(&board, speed, waiting_ns as f64 * 1e-9);
        let kept = || if self.keeps_pictures { picture.clone() } else { GreyImage::default() };
        let taken = || Taken { board: board.clone(), speed, velocity: Vec::new(), picture: kept() };
        let index = match seen {
            Seen::Taken => {
                self.views.push(taken());
                self.waiting_since_ns = Some(time_ns);
                Some(self.views.len() - 1)
            }
            Seen::Better(n) => {
                self.views[n] = taken();
                Some(n)
            }
            _ => None,
        };
        // A view that was taken has a frame before it.
        if let (Some(n), Some((before_ns, before))) = (index, self.previous.take()) {
            let gap_s = (time_ns - before_ns) as f64 * 1e-9;
            self.views[n].velocity = velocities(&board, &before, &board, gap_s);
            self.unsettled = Some((n, before_ns, before));
            self.solve();
        }
        self.previous = Some((time_ns, board));
        seen
    }

    /// The frame after a view shows better how it moved: in the middle between two others instead of at the end.
    fn settle(&mut self, sighting: &Sighting, time_ns: i64) {
        let Some((n, before_ns, before)) = self.unsettled.take() else { return };
        let gap_s = (time_ns - before_ns) as f64 * 1e-9;
        if let (Sighting::Board(after), true) = (sighting, gap_s > 0.0 && gap_s < 2.0 * MAX_GAP_S) {
            self.views[n].velocity = velocities(&self.views[n].board, &before, after, gap_s);
            self.solve();
        }
    }

    fn solve(&mut self) {
        if self.views.len() > MIN_VIEWS {
            // Too little so far is no fault: it goes on.
            self.solution = solve(&self.board_views(), &self.pattern, self.size, self.distortion).ok();
        }
    }

    /// Picture widths a second since the frame before; infinite if that is unknown.
    fn speed(&self, board: &Board, time_ns: i64) -> f64 {
        let Some((before_ns, before)) = &self.previous else { return f64::INFINITY };
        let gap_s = (time_ns - before_ns) as f64 * 1e-9;
        if !(gap_s > 0.0 && gap_s < MAX_GAP_S) {
            return f64::INFINITY;
        }
        distance(board, before) / (gap_s * f64::from(self.size.0))
    }

    fn judge(&self, board: &Board, speed: f64, waiting_s: f64) -> Seen {
        let width = f64::from(self.size.0);
        let (stiff, loose) = STILL_WIDTHS_S;
        let limit = stiff + (loose - stiff) * (waiting_s / PATIENCE_S).clamp(0.0, 1.0);
        if !(speed <= limit) {
            return Seen::Moving;
        }
        if board.blur_px > (SHARP_PX * width / 640.0).min(board.spacing_px / 6.0).max(1.2) {
            return Seen::Blurred;
        }
        if !board.complete {
            return Seen::Incomplete;
        }
        let mut near = (0..self.views.len()).filter(|n| distance(board, &self.views[*n].board) < NEW_WIDTHS * width);
        match (near.next(), near.next()) {
            (None, _) => Seen::Taken,
            (Some(n), None) if speed < STILLER * self.views[n].speed => Seen::Better(n),
            _ => Seen::Known,
        }
    }

    /// The views that were taken, as they are solved.
    pub fn board_views(&self) -> Vec<BoardView> {
        let view = |(k, v): (usize, &Taken)| BoardView {
            name: format!("view {}", k + 1),
            board: v.board.clone(),
            velocity: v.velocity.clone(),
        };
        self.views.iter().enumerate().map(view).collect()
    }

    /// Nothing is missing any more, or there is no room for more.
    pub fn is_done(&self) -> bool {
        let good = self.solution.as_ref().is_some_and(|s| s.verdict.is_good());
        let settled = self.unsettled.is_none();
        settled && (self.views.len() >= MAX_VIEWS || (self.views.len() >= ENOUGH_VIEWS && good))
    }

    /// The board in the last frame, if it was there.
    pub fn board(&self) -> Option<&Board> {
        self.previous.as_ref().map(|(_, board)| board)
    }

    pub fn views(&self) -> &[Taken] {
        &self.views
    }

    /// The camera as far as it is known.
    pub fn solution(&self) -> Option<&Calibrated> {
        self.solution.as_ref()
    }

    /// Views, coverage and uncertainty, for one line of a terminal.
    pub fn progress(&self) -> String {
        let mut text = format!("{} views", self.views.len());
        if let Some(s) = &self.solution {
            text += &format!(
                ", {:.0} % covered, fx {:.1} +- {:.2} px, residual {:.2} px",
                s.verdict.covered_percent,
                s.camera.fx,
                s.solved.sigmas()[0],
                s.solved.rms_px
            );
        }
        text
    }

    /// What to do next, in view of what the last frame came to.
    pub fn advice(&self, seen: Seen) -> String {
        match seen {
            Seen::NoBoard => format!("show the board ({}x{} inner corners)", self.pattern.columns, self.pattern.rows),
            Seen::OtherSize(columns, rows) => format!(
                "a board of {columns}x{rows} inner corners is seen, {}x{} was asked for",
                self.pattern.columns, self.pattern.rows
            ),
            Seen::Incomplete => "a part of the board is hidden".into(),
            Seen::Moving => "hold still".into(),
            Seen::Blurred => "the board is blurred: more light, or another distance".into(),
            Seen::Known | Seen::Better(_) | Seen::Taken => {
                match self.solution.as_ref().and_then(|s| s.verdict.needs.first().copied()) {
                    Some(need) => need.advice(),
                    None if self.views.len() < ENOUGH_VIEWS => {
                        "move the board: tilt it, bring it to the picture's edges".into()
                    }
                    None => "done".into(),
                }
            }
        }
    }
}

#[cfg(all(test, feature = "tools"))]
mod tests;
