//! A simulated drive as a recording on disk, in TUM RGB-D layout.
//!
//! Output, in one folder: `rgb/SECONDS.png` (8-bit grey), `rgb.txt` (timestamp file), `groundtruth.txt` (timestamp tx ty
//! tz qx qy qz qw = world_from_camera, m, z up; one line a frame, same timestamps), `camera.yaml` (fx fy cx cy and
//! distortion in OpenCV's order, lens_model of a wide-angle lens). Timestamps come back to the nanosecond. `rgb.txt` is written last: a folder without it
//! was interrupted. Cost: rendering plus about 10 ms a frame for the PNG.

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use super::Simulator;
use crate::geometry::LensModel;
use crate::image::GreyImage;
use crate::trajectory::{TrajectoryError, TumPose, format_timestamp, write_tum};

/// Why a recording could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A file or folder.
    #[error("{path}: {source}")]
    Write { path: PathBuf, source: io::Error },
    /// The ground truth.
    #[error(transparent)]
    Truth(#[from] TrajectoryError),
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
        let mut truth = Vec::new();
        let mut picture = GreyImage::default();
        for sequence in 0..frames {
            let timestamp_ns = self.timestamp_ns(sequence);
            let stamp = format_timestamp(timestamp_ns);
            self.render(sequence, &mut picture);
            let path = rgb.join(format!("{stamp}.png"));
            write_png(&path, &picture).map_err(failed(&path))?;
            list.push_str(&format!("{stamp} rgb/{stamp}.png\n"));
            truth.push(TumPose { timestamp_ns, world_from_camera: self.trajectory.pose_at(timestamp_ns) });
        }
        write_tum(&dir.join("groundtruth.txt"), &truth)?;
        for (name, text) in [("camera.yaml", self.camera_yaml()), ("rgb.txt", list)] {
            let path = dir.join(name);
            fs::write(&path, text).map_err(failed(&path))?;
        }
        Ok(Recorded { frames })
    }

    fn camera_yaml(&self) -> String {
        let c = &self.camera;
        let list = c.lens.coefficients().iter().map(|k| format!("{k:?}")).collect::<Vec<_>>().join(", ");
        let (title, model) = match c.lens {
            LensModel::RadialTangential(_) => {
                ("pinhole + radial-tangential (OpenCV order k1 k2 p1 p2 k3)", String::new())
            }
            LensModel::KannalaBrandt(_) => (
                "wide angle, Kannala-Brandt (OpenCV fisheye order k1 k2 k3 k4)",
                format!("lens_model: {}\n", c.lens.name()),
            ),
        };
        format!(
            "# {title}; pixel (0, 0) is a pixel's centre\n\
             width: {}\nheight: {}\nfx: {:?}\nfy: {:?}\ncx: {:?}\ncy: {:?}\n\
             {model}distortion: [{list}]\nfps: {:?}\nsource: \"{}\"\n",
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
