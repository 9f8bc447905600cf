//! A picture as a CompressedImage holds it: compressed ones as they came, raw ones as PNG (lossless).

use crate::messages::{ENCODED_GREY, ENCODED_JPEG, ENCODED_PNG, ENCODED_YUYV, EncodedHeader};

/// Format and bytes; `None` where the kind is not known or rows are not there. `png` is room for what is made here.
pub fn compressed<'a>(
    header: &EncodedHeader,
    data: &'a [u8],
    png: &'a mut Vec<u8>,
) -> Option<(&'static str, &'a [u8])> {
    match header.format {
        ENCODED_JPEG => Some(("jpeg", data)),
        ENCODED_PNG => Some(("png", data)),
        ENCODED_GREY | ENCODED_YUYV => {
            write_png(header, data, png)?;
            Some(("png", png))
        }
        _ => None,
    }
}

/// Rows of grey, or the luma of YUYV, as a PNG file; `None` if they are not there.
fn write_png(header: &EncodedHeader, data: &[u8], out: &mut Vec<u8>) -> Option<()> {
    let (width, height, stride) = (header.width as usize, header.height as usize, header.stride as usize);
    let bytes_a_pixel = if header.format == ENCODED_YUYV { 2 } else { 1 };
    let row = bytes_a_pixel * width;
    if width == 0 || stride < row || data.len() < stride.checked_mul(height.checked_sub(1)?)?.checked_add(row)? {
        return None;
    }
    out.clear();
    let mut encoder = ::png::Encoder::new(&mut *out, header.width, header.height);
    encoder.set_color(::png::ColorType::Grayscale);
    encoder.set_depth(::png::BitDepth::Eight);
    encoder.set_compression(::png::Compression::Fast);
    let mut writer = encoder.write_header().ok()?;
    if bytes_a_pixel == 1 && stride == width {
        writer.write_image_data(&data[..width * height]).ok()?;
    } else {
        let rows = data.chunks(stride).take(height).flat_map(|line| line[..row].iter().step_by(bytes_a_pixel));
        let rows: Vec<u8> = rows.copied().collect();
        writer.write_image_data(&rows).ok()?;
    }
    writer.finish().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_grey_come_back_from_their_png() {
        let header = EncodedHeader { width: 5, height: 3, stride: 8, ..EncodedHeader::default() };
        let data: Vec<u8> = (0..3 * 8 - 3).collect();
        let mut file = Vec::new();
        assert_eq!(write_png(&header, &data, &mut file), Some(()));
        let raw =
            crate::frame::RawFrame { format: crate::frame::PixelFormat::Png, data: file.clone(), ..Default::default() };
        let mut grey = crate::image::GreyImage::default();
        crate::image::decode::Decoder::default().decode(&raw, &mut grey).expect("PNG");
        assert_eq!(grey.data, [0, 1, 2, 3, 4, 8, 9, 10, 11, 12, 16, 17, 18, 19, 20]);
        let yuyv = EncodedHeader { width: 4, height: 2, stride: 8, format: ENCODED_YUYV, ..header };
        assert_eq!(write_png(&yuyv, &data[..16], &mut file), Some(()));
        let raw = crate::frame::RawFrame { data: file.clone(), ..raw };
        crate::image::decode::Decoder::default().decode(&raw, &mut grey).expect("PNG");
        assert_eq!(grey.data, [0, 2, 4, 6, 8, 10, 12, 14]);
        for wrong in [
            EncodedHeader { height: 4, ..header },
            EncodedHeader { stride: 4, ..header },
            EncodedHeader { width: 0, ..header },
            EncodedHeader { height: 0, ..header },
        ] {
            assert_eq!(write_png(&wrong, &data, &mut file), None);
        }
    }
}
