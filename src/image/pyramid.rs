//! Half-sampled image pyramid.

use super::GreyImage;

/// Levels of halved pictures; level 0 is the picture itself.
///
/// A pixel (x, y) of level l covers level-0 pixels around ((x + 0.5) * 2^l - 0.5).
#[derive(Debug, Clone, Default)]
pub struct Pyramid {
    pub levels: Vec<GreyImage>,
}
