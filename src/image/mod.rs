//! Grey pictures and pyramids; decoding of what cameras and recordings deliver.

pub mod decode;
mod error;
mod jpeg;
mod png;
pub mod pyramid;

pub use pyramid::Pyramid;

/// 8-bit grey picture, rows contiguous (stride = width), top left first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GreyImage {
    pub width: usize,
    pub height: usize,
    /// `width * height` bytes.
    pub data: Vec<u8>,
}

impl GreyImage {
    /// A black picture.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, data: vec![0; width * height] }
    }

    /// Becomes `width` x `height`; the contents are unspecified afterwards. Allocates only when it grows.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.width = width;
        self.height = height;
        self.data.resize(width * height, 0);
    }

    /// Value at a pixel; panics outside.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.data[y * self.width + x]
    }

    /// One row.
    #[inline]
    pub fn row(&self, y: usize) -> &[u8] {
        &self.data[y * self.width..(y + 1) * self.width]
    }
}
