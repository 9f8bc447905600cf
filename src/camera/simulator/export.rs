//! A simulated drive as a recording on disk, in TUM RGB-D layout.
//!
//! Output, in one folder: `rgb/SECONDS.png` (8-bit grey), `rgb.txt` (timestamp file), `groundtruth.txt` (timestamp tx ty
//! tz qx qy qz qw = world_from_camera, one line a frame, same timestamps), `camera.yaml` (fx fy cx cy and distortion in
//! OpenCV's order). Timestamps have nine decimals, so they come back to the nanosecond.

use std::fmt::Write as _;
use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use super::Simulator;
use crate::image::GreyImage;

/// Why a recording could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A file or folder.
    #[error("{path}: {source}")]
    Write { path: PathBuf, source: io::Error },
    /// Would be mixed up with an older recording.
    #[error("{path}: folder is not empty")]
    NotEmpty { path: PathBuf },
}

/// What was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Recorded {
    /// Number of frames.
    pub frames: u64,
}

impl Simulator {
    /// Writes the frames from 0 on, `seconds` of them, into the folder `dir`, which must be new or empty.
    pub fn write_recording(&mut self, dir: &Path, seconds: f64) -> Result<Recorded, ExportError> {
        let frames = (seconds.max(0.0) * self.config.rate_hz).ceil() as u64;
        let rgb = dir.join("rgb");
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| ExportError::Write { path, source }
        };
        fs::create_dir_all(dir).map_err(failed(dir))?;
        if fs::read_dir(dir).map_err(failed(dir))?.next().is_some() {
            return Err(ExportError::NotEmpty { path: dir.to_owned() });
        }
        fs::create_dir(&rgb).map_err(failed(&rgb))?;
        let mut list = String::from("# timestamp filename\n");
        let mut truth = String::from("# timestamp tx ty tz qx qy qz qw = world_from_camera, m; world z up\n");
        let mut picture = GreyImage::default();
        for sequence in 0..frames {
            let ns = self.timestamp_ns(sequence);
            let stamp = format!("{}.{:09}", ns / 1_000_000_000, ns % 1_000_000_000);
            self.render(sequence, &mut picture);
            let path = rgb.join(format!("{stamp}.png"));
            write_png(&path, &picture).map_err(failed(&path))?;
            let pose = self.trajectory.pose_at(ns);
            let (t, q) = (pose.translation, pose.rotation.coords);
            // Writing into a String cannot fail.
            let _ = writeln!(list, "{stamp} rgb/{stamp}.png");
            let _ = writeln!(
                truth,
                "{stamp} {:.9} {:.9} {:.9} {:.12} {:.12} {:.12} {:.12}",
                t.x, t.y, t.z, q.x, q.y, q.z, q.w
            );
        }
        for (name, text) in [("rgb.txt", list), ("groundtruth.txt", truth), ("camera.yaml", self.camera_yaml())] {
            let path = dir.join(name);
            fs::write(&path, text).map_err(failed(&path))?;
        }
        Ok(Recorded { frames })
    }

    fn camera_yaml(&self) -> String {
        let c = &self.camera;
        let [k1, k2, p1, p2, k3] = c.distortion;
        format!(
            "# pinhole + radial-tangential (OpenCV order k1 k2 p1 p2 k3); pixel (0, 0) is a pixel's centre\n\
             width: {}\nheight: {}\nfx: {:?}\nfy: {:?}\ncx: {:?}\ncy: {:?}\n\
             distortion: [{k1:?}, {k2:?}, {p1:?}, {p2:?}, {k3:?}]\nfps: {:?}\nsource: \"{}\"\n",
            c.width, c.height, c.fx, c.fy, c.cx, c.cy, self.config.rate_hz, self.description.name
        )
    }
}

fn write_png(path: &Path, picture: &GreyImage) -> io::Result<()> {
    let mut file = BufWriter::new(fs::File::create(path)?);
    let mut encoder = png::Encoder::new(&mut file, picture.width as u32, picture.height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(io::Error::other)?;
    writer.write_image_data(&picture.data).map_err(io::Error::other)?;
    writer.finish().map_err(io::Error::other)?;
    file.flush()
}
