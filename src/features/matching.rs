//! Which point of one picture is which of another: by descriptors of two kinds, by attributes, by optical flow.
//!
//! Purpose: the matchers of two views, relocalisation and loops. Each is a file of its own; correlation, the study's other
//! way, is [`correlation`](super::correlation).
//! Output: pairs of corners ([`Match`]) or places in the second picture that need not be corners ([`PointMatch`]), both
//! ascending in the first index.
//! Pairs of corners are mutual (each is the other's nearest) and unambiguous (the second nearest is clearly farther).
//! It deliberately does not do: geometry (see `geometry::ransac`).

mod attributes;
mod descriptors;
mod flow;
pub(in crate::features) mod nearest;
mod places;
mod point_grid;

use nalgebra::Vector2;

pub use attributes::{AttributeMatching, match_attributes};
pub use descriptors::{DescriptorMatcher, DescriptorMatching, all_within};
pub use flow::{FlowMatching, match_flow};
pub use places::{Comparable, Place, PlaceMatching, SAME_CORNER_PX, match_places};
pub use point_grid::PointGrid;

/// Two corners that are taken for the same.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Match {
    /// Index among the first picture's corners.
    pub first: u32,
    /// Index among the second picture's.
    pub second: u32,
    /// How unlike they are: bits for binary descriptors, a share of their length for histograms of gradients, 0..1 of the thresholds for attributes, 1 - NCC for correlation.
    pub distance: f32,
}

/// A corner of the first picture and its place in the second, which need not be a corner there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointMatch {
    /// Index among the first picture's corners.
    pub first: u32,
    /// Place in the second picture, level-0 pixels, sub-pixel.
    pub position: Vector2<f32>,
    /// How unlike the two patches are: 1 - NCC.
    pub distance: f32,
}
