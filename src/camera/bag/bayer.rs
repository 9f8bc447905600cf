//! Grey of a sensor's mosaic of colours (`bayer_rggb8` and its kin of sensor_msgs).
//!
//! Input: rows of one colour a pixel, 8 or 16 bits. Output: rows of 8-bit grey of the same size, without a shift: the pixel and its eight neighbours,
//! weighed 1 2 1 along either axis. Whatever the pattern and wherever the pixel, half of that weight falls on green and a quarter each on red and
//! blue, so an even colour is an even grey, (R + 2 G + B) / 4, and nobody has to know which pixel is which. It is bilinear interpolation of the three
//! colours and their mean in one, about as sharp. At the border the rows and columns inside are mirrored, which keeps the pattern.

/// The mosaic as it stands in a message.
#[derive(Debug, Clone, Copy)]
pub struct Mosaic<'a> {
    pub data: &'a [u8],
    /// Bytes from row to row.
    pub step: usize,
    /// At least 2 each.
    pub width: usize,
    pub height: usize,
    pub bytes_per_pixel: usize,
    /// Which of a pixel's bytes counts.
    pub byte: usize,
}

/// Appends the grey picture.
pub fn grey(mosaic: &Mosaic, out: &mut Vec<u8>) {
    let Mosaic { data, step, width, height, bytes_per_pixel, byte } = *mosaic;
    let row = |y: usize| &data[y * step..y * step + width * bytes_per_pixel];
    for y in 0..height {
        let (above, here, below) = (row(y.abs_diff(1)), row(y), row(inside(y + 1, height)));
        let column = |x: usize| {
            let at = x * bytes_per_pixel + byte;
            u32::from(above[at]) + 2 * u32::from(here[at]) + u32::from(below[at])
        };
        let (mut left, mut middle) = (column(1), column(0));
        for x in 0..width {
            let right = column(inside(x + 1, width));
            // At most 16 * 255.
            out.push(((left + 2 * middle + right + 8) / 16) as u8);
            (left, middle) = (middle, right);
        }
    }
}

/// The next one, mirrored at the far border.
fn inside(next: usize, length: usize) -> usize {
    if next < length { next } else { length - 2 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The grey of a mosaic whose pixel at (x, y) is so bright.
    fn of(width: usize, height: usize, value: impl Fn(usize, usize) -> u8) -> Vec<u8> {
        let data: Vec<u8> = (0..width * height).map(|i| value(i % width, i / width)).collect();
        let mut out = Vec::new();
        grey(&Mosaic { data: &data, step: width, width, height, bytes_per_pixel: 1, byte: 0 }, &mut out);
        out
    }

    #[test]
    fn an_even_colour_is_an_even_grey_in_every_pattern_and_at_every_border() {
        let (r, g, b) = (200, 60, 20);
        for pattern in [[r, g, g, b], [b, g, g, r], [g, r, b, g], [g, b, r, g]] {
            for (width, height) in [(2, 2), (3, 2), (4, 5), (7, 6)] {
                let out = of(width, height, |x, y| pattern[2 * (y % 2) + x % 2]);
                assert_eq!(out, vec![85; width * height], "{pattern:?} {width}x{height}");
            }
        }
    }

    #[test]
    fn nothing_is_shifted() {
        // A slope stays what it is, but at the mirrored borders.
        let out = of(8, 4, |x, y| (20 * x + 10 * y) as u8);
        for y in 1..3 {
            for x in 1..7 {
                assert_eq!(usize::from(out[8 * y + x]), 20 * x + 10 * y);
            }
        }
        // A single bright pixel lies in the middle of what becomes of it.
        let out = of(5, 5, |x, y| if (x, y) == (2, 2) { 160 } else { 0 });
        assert_eq!(out[5..20], [0, 10, 20, 10, 0, 0, 20, 40, 20, 0, 0, 10, 20, 10, 0]);
    }
}
