//! Points followed from one picture to the next.
//!
//! In: the pyramids of two pictures, a point of the first with its template and a guess of its place in the second (level-0 pixels). Out:
//! the place with its template, by which the way back was found and the next picture's way is; or `None`. Coarse to fine with the patch alignment of [`alignment`](super::alignment); the way back from the place
//! found must end at the point (forward-backward check). Cost: about 3 us a point. Allocates nothing.

use nalgebra::Vector2;

use super::alignment::{AlignOptions, Template, align};
use crate::image::Pyramid;
use crate::image::pyramid::{base_from_level, level_from_base};

/// When a followed point counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlowOptions {
    /// Pyramid level that the descent starts at.
    pub coarsest_level: usize,
    /// Distance between the point and where the way back ends, px.
    pub max_return_px: f32,
    /// Correlation of the two patches at full resolution.
    pub min_ncc: f32,
}

impl Default for FlowOptions {
    fn default() -> Self {
        Self { coarsest_level: 2, max_return_px: 0.5, min_ncc: 0.8 }
    }
}

/// A coarse level steers the descent only when its patches are this much alike.
const COARSE_NCC: f32 = 0.6;

/// A place in a picture and what is looked for in the next one.
#[derive(Debug, Clone, Copy)]
pub struct Point {
    /// Level-0 pixel.
    pub place: Vector2<f32>,
    /// Around it, at full resolution.
    pub template: Template,
}

impl Point {
    /// `None` too near the edge.
    pub fn at(picture: &Pyramid, place: Vector2<f32>) -> Option<Self> {
        Some(Self { place, template: Template::from_image(picture.levels.first()?, place)? })
    }
}

/// The place in `current` of `point` of `previous`, looked for around `guess`.
pub fn follow(
    previous: &Pyramid,
    current: &Pyramid,
    point: &Point,
    guess: Vector2<f32>,
    options: &FlowOptions,
) -> Option<Point> {
    let (found, ncc) = descend(previous, current, point, guess, options.coarsest_level)?;
    if ncc < options.min_ncc {
        return None;
    }
    let found = Point::at(current, found)?;
    let (back, _) = descend(current, previous, &found, point.place, 0)?;
    ((back - point.place).norm() <= options.max_return_px).then_some(found)
}

/// Coarse to fine from `guess`; the place and the correlation at full resolution.
fn descend(
    from: &Pyramid,
    to: &Pyramid,
    point: &Point,
    guess: Vector2<f32>,
    coarsest: usize,
) -> Option<(Vector2<f32>, f32)> {
    let mut place = guess;
    let top = coarsest.min(from.levels.len().min(to.levels.len()).checked_sub(1)?);
    for level in (1..=top).rev() {
        let options = AlignOptions { max_iterations: 6, convergence_px: 0.06, accept_step_px: 0.3, max_shift_px: 4.0 };
        let Some(template) = Template::from_image(&from.levels[level], level_from_base(level, point.place)) else {
            continue;
        };
        if let Some(a) = align(&template, &to.levels[level], level_from_base(level, place), &options)
            && a.ncc > COARSE_NCC
        {
            place = base_from_level(level, a.position);
        }
    }
    let options = AlignOptions { max_shift_px: 4.0, ..AlignOptions::default() };
    let a = align(&point.template, &to.levels[0], place, &options)?;
    Some((a.position, a.ncc))
}
