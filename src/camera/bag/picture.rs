//! A message with a picture into a frame, and a CameraInfo into a camera model.

use super::super::recording::MAX_PICTURE_BYTES;
use super::bayer::{self, Mosaic};
use crate::frame::{PixelFormat, RawFrame};
use crate::geometry::{CameraModel, LensModel};
use crate::image::decode::{luma, sniff};
use crate::ros::Reader;

/// Which message a topic's pictures are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// sensor_msgs/Image.
    Raw,
    /// sensor_msgs/CompressedImage.
    Compressed,
}

/// A message's stamp, ns; what is behind it stays in `reader`.
pub fn stamp_ns(reader: &mut Reader) -> Result<i64, String> {
    let read = |reader: &mut Reader| -> Result<i64, crate::ros::CdrError> {
        let (seconds, nanoseconds) = (reader.i32()?, reader.u32()?);
        // The frame's name.
        reader.text()?;
        Ok(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds))
    };
    read(reader).map_err(|e| e.to_string())
}

/// The stamp alone, ns since 1970 or whatever the recording counts from.
pub fn read_stamp(message: &[u8]) -> Result<i64, String> {
    stamp_ns(&mut Reader::new(message).map_err(|e| e.to_string())?)
}

/// A picture into `slot`; its stamp.
pub fn read(kind: Kind, message: &[u8], slot: &mut RawFrame) -> Result<i64, String> {
    if message.len() as u64 > MAX_PICTURE_BYTES {
        return Err(format!("{} bytes are more than the {MAX_PICTURE_BYTES} that a picture may have", message.len()));
    }
    let mut reader = Reader::new(message).map_err(|e| e.to_string())?;
    let stamp = stamp_ns(&mut reader)?;
    match kind {
        Kind::Raw => raw(&mut reader, slot)?,
        Kind::Compressed => compressed(&mut reader, slot)?,
    }
    Ok(stamp)
}

fn compressed(reader: &mut Reader, slot: &mut RawFrame) -> Result<(), String> {
    let format = reader.text().map_err(|e| e.to_string())?;
    let data = reader.bytes().map_err(|e| e.to_string())?;
    // What it is stands in its bytes; the format's text varies from driver to driver.
    slot.format = sniff(data).ok_or_else(|| {
        format!("is neither JPEG nor PNG (format {format:?}), begins with {:02x?}", &data[..data.len().min(8)])
    })?;
    slot.data.clear();
    slot.data.extend_from_slice(data);
    (slot.width, slot.height, slot.stride) = (0, 0, 0);
    Ok(())
}

fn raw(reader: &mut Reader, slot: &mut RawFrame) -> Result<(), String> {
    let mut parts = || -> Result<_, crate::ros::CdrError> {
        let (height, width) = (reader.u32()?, reader.u32()?);
        let (encoding, is_bigendian, step) = (reader.text()?, reader.u8()? != 0, reader.u32()?);
        Ok((height, width, encoding, is_bigendian, step, reader.bytes()?))
    };
    let (height, width, encoding, is_bigendian, step, data) = parts().map_err(|e| e.to_string())?;
    let bytes_per_pixel = bytes_per_pixel(encoding).ok_or_else(|| {
        format!(
            "encoding {encoding:?} is not read; mono8, mono16, bgr8, rgb8, bgra8, rgba8, yuv422_yuy2 (yuyv), yuv422 (uyvy) and bayer_* are"
        )
    })?;
    let is_mosaic = encoding.starts_with("bayer_");
    let row = u64::from(width) * bytes_per_pixel;
    let needed = (u64::from(height).saturating_sub(1) * u64::from(step)).saturating_add(row);
    let least = if is_mosaic { 2 } else { 1 };
    if width < least || height < least || u64::from(step) < row || (data.len() as u64) < needed {
        let have = data.len();
        return Err(format!("{width}x{height} px of {encoding} with rows of {step} bytes are not in {have} bytes"));
    }
    (slot.width, slot.height) = (width, height);
    slot.data.clear();
    let rows = data.chunks(step as usize).take(height as usize).map(|line| &line[..row as usize]);
    let as_is = matches!(encoding, "mono8" | "8UC1" | "yuyv" | "yuv422_yuy2");
    if as_is {
        slot.format = if bytes_per_pixel == 1 { PixelFormat::Grey } else { PixelFormat::Yuyv };
        slot.stride = step;
        slot.data.extend_from_slice(&data[..needed as usize]);
        return Ok(());
    }
    (slot.format, slot.stride) = (PixelFormat::Grey, width);
    // A two-byte grey keeps its upper byte, as of a PNG; UYVY has its luma second.
    let upper = usize::from(!is_bigendian || matches!(encoding, "uyvy" | "yuv422"));
    if is_mosaic {
        let (step, width, height) = (step as usize, width as usize, height as usize);
        let bytes_per_pixel = bytes_per_pixel as usize;
        let byte = if bytes_per_pixel == 2 { upper } else { 0 };
        bayer::grey(&Mosaic { data, step, width, height, bytes_per_pixel, byte }, &mut slot.data);
        return Ok(());
    }
    for line in rows {
        match encoding {
            "bgr8" | "8UC3" => slot.data.extend(line.chunks_exact(3).map(|p| luma(p[2], p[1], p[0]))),
            "rgb8" => slot.data.extend(line.chunks_exact(3).map(|p| luma(p[0], p[1], p[2]))),
            "bgra8" | "8UC4" => slot.data.extend(line.chunks_exact(4).map(|p| luma(p[2], p[1], p[0]))),
            "rgba8" => slot.data.extend(line.chunks_exact(4).map(|p| luma(p[0], p[1], p[2]))),
            _ => slot.data.extend(line.chunks_exact(2).map(|p| p[upper])),
        }
    }
    Ok(())
}

/// Of an encoding of sensor_msgs; `None`: it is not read.
fn bytes_per_pixel(encoding: &str) -> Option<u64> {
    Some(match encoding {
        "mono8" | "8UC1" | "bayer_rggb8" | "bayer_bggr8" | "bayer_gbrg8" | "bayer_grbg8" => 1,
        "yuyv" | "yuv422_yuy2" | "uyvy" | "yuv422" | "mono16" | "16UC1" => 2,
        "bayer_rggb16" | "bayer_bggr16" | "bayer_gbrg16" | "bayer_grbg16" => 2,
        "bgr8" | "rgb8" | "8UC3" => 3,
        "bgra8" | "rgba8" | "8UC4" => 4,
        _ => return None,
    })
}

/// The camera of a sensor_msgs/CameraInfo, of its raw or its rectified pictures; `None` if it says that there is no calibration (`k` all zero).
pub fn camera_info(message: &[u8], rectified: bool) -> Result<Option<CameraModel>, String> {
    let mut reader = Reader::new(message).map_err(|e| e.to_string())?;
    stamp_ns(&mut reader)?;
    let mut parts = || -> Result<_, crate::ros::CdrError> {
        let (height, width) = (reader.u32()?, reader.u32()?);
        let (model, d, k) = (reader.text()?.to_owned(), reader.f64_sequence()?, reader.f64_array::<9>()?);
        let _rectification = reader.f64_array::<9>()?;
        let p = reader.f64_array::<12>()?;
        let (binning_x, binning_y) = (reader.u32()?, reader.u32()?);
        let (x_offset, y_offset) = (reader.u32()?, reader.u32()?);
        Ok((height, width, model, d, k, p, binning_x.max(binning_y), x_offset.max(y_offset)))
    };
    let (height, width, model, d, k, p, binning, cut) = parts().map_err(|e| e.to_string())?;
    if k.iter().all(|v| *v == 0.0) {
        return Ok(None);
    }
    if binning > 1 {
        return Err(format!("binning {binning} is not supported, give --camera"));
    }
    if cut > 0 {
        return Err(format!("a region of interest that begins at {cut} px is not supported, give --camera"));
    }
    if rectified {
        let [fx, _, cx, _, _, fy, cy, ..] = p;
        let camera = CameraModel::new(width, height, fx, fy, cx, cy, LensModel::PINHOLE);
        return camera.map(Some).map_err(|e| e.to_string());
    }
    let lens = match (model.as_str(), d.as_slice()) {
        (_, []) => LensModel::PINHOLE,
        ("equidistant" | "fisheye", [k1, k2, k3, k4]) => LensModel::KannalaBrandt([*k1, *k2, *k3, *k4]),
        // rational_polynomial without its denominator is the same.
        ("plumb_bob" | "rational_polynomial" | "", [k1, k2, p1, p2, rest @ ..])
            if rest.iter().skip(1).all(|v| *v == 0.0) =>
        {
            LensModel::RadialTangential([*k1, *k2, *p1, *p2, rest.first().copied().unwrap_or(0.0)])
        }
        _ => {
            return Err(format!(
                "distortion model {model:?} with {} coefficients is not supported, give --camera",
                d.len()
            ));
        }
    };
    let [fx, _, cx, _, fy, cy, ..] = k;
    CameraModel::new(width, height, fx, fy, cx, cy, lens).map(Some).map_err(|e| e.to_string())
}
