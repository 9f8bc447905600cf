//! A frame's pixels in rows without gaps, as encoders want them.

use std::borrow::Cow;

use crate::client::Frame;

/// A grey picture of a size that JPEG can have.
#[derive(Debug)]
pub struct Grey<'a> {
    pub width: u16,
    pub height: u16,
    pub pixels: Cow<'a, [u8]>,
}

/// `None` for a picture that is too large, or smaller than it says.
pub fn grey(frame: &Frame) -> Option<Grey<'_>> {
    let h = frame.header();
    rows(frame, (h.width, h.height), h.stride as usize)
}

fn rows(bytes: &[u8], (width, height): (u32, u32), stride: usize) -> Option<Grey<'_>> {
    let (width, height) = (u16::try_from(width).ok()?, u16::try_from(height).ok()?);
    let (row, lines) = (usize::from(width), usize::from(height));
    if row == 0 || lines == 0 || stride < row {
        return None;
    }
    let bytes = bytes.get(..stride * (lines - 1) + row)?;
    let pixels = if stride == row {
        Cow::Borrowed(bytes)
    } else {
        Cow::Owned(bytes.chunks(stride).flat_map(|line| line.iter().take(row)).copied().collect())
    };
    Some(Grey { width, height, pixels })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_between_rows_are_left_out_and_a_short_picture_is_none() {
        let bytes = [1, 2, 0, 3, 4, 0];
        assert_eq!(*rows(&bytes, (2, 2), 3).expect("picture").pixels, [1, 2, 3, 4]);
        assert_eq!(*rows(&bytes, (3, 2), 3).expect("picture").pixels, bytes);
        assert_eq!(*rows(&bytes[..5], (2, 2), 3).expect("no gap behind the last row").pixels, [1, 2, 3, 4]);
        for (size, stride) in [((3, 3), 3), ((2, 2), 1), ((70_000, 1), 70_000), ((0, 2), 3)] {
            assert!(rows(&bytes, size, stride).is_none(), "{size:?} {stride}");
        }
    }
}
