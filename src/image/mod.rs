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

/// A rectangle of a picture, whose pixels keep the coordinates that they have there.
#[derive(Debug, Clone, Copy)]
pub struct Crop<'a> {
    /// Column and row of its first pixel in the picture.
    pub left: usize,
    pub top: usize,
    pub width: usize,
    pub height: usize,
    /// `width * height` bytes, row by row.
    pub data: &'a [u8],
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

    /// The picture as a crop that leaves nothing out.
    #[inline]
    pub fn whole(&self) -> Crop<'_> {
        Crop { left: 0, top: 0, width: self.width, height: self.height, data: &self.data }
    }

    /// One row.
    #[inline]
    pub fn row(&self, y: usize) -> &[u8] {
        &self.data[y * self.width..(y + 1) * self.width]
    }
}
