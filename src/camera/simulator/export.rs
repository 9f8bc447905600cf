//! A simulated drive as a recording on disk, in TUM RGB-D layout.
//!
//! Output, in one folder: `rgb/SECONDS.png` (8-bit grey), `rgb.txt` (timestamp file), `groundtruth.txt` (timestamp tx ty
//! tz qx qy qz qw = world_from_camera, m, z up; one line a frame, same timestamps), `camera.yaml` (fx fy cx cy and
//! distortion in OpenCV's order, lens_model of a wide-angle lens), and where a base drives the camera and tells of it `odometry.txt` (as
//! `cairn replay` reads it; comments say the true mount and where the wheels slipped). Timestamps come back to the nanosecond. `rgb.txt` is written last: a folder without it
//! was interrupted. Cost: rendering plus about 10 ms a frame for the PNG.

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use super::Simulator;
use super::trajectory::{CAMERA_HEIGHT_M, CAMERA_PITCH_RAD};
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
        if let Some(text) = self.odometry(seconds) {
            let path = dir.join("odometry.txt");
            fs::write(&path, text).map_err(failed(&path))?;
        }
        for (name, text) in [("camera.yaml", self.camera_yaml()), ("rgb.txt", list)] {
            let path = dir.join(name);
            fs::write(&path, text).map_err(failed(&path))?;
        }
        Ok(Recorded { frames })
    }

    /// What the base's driver tells in so many seconds, and what it does not know, as comments.
    fn odometry(&self, seconds: f64) -> Option<String> {
        let mut odometer = self.odometer()?;
        let (config, start_ns) = (&self.config.wheels, self.trajectory.start_ns());
        let ([x, y], [left, right]) = (config.camera_m, config.radius_error);
        let mut text = format!(
            "# wheels of {}: {} m apart, radius error {left} {right}, stamps {} ms late\n\
             # true camera on the base: x {x} y {y} z {CAMERA_HEIGHT_M} m, yaw {} pitch {} degrees (left, up)\n",
            self.description.name,
            config.track_m,
            config.delay_ms,
            config.camera_yaw_deg,
            CAMERA_PITCH_RAD.to_degrees(),
        );
        for slip in odometer.slips(seconds) {
            let [from, to] = [slip.start_s, slip.end_s].map(|s| format_timestamp(start_ns + (s * 1e9) as i64));
            let [left, right] = slip.share;
            text.push_str(&format!(
                "# slip from {from} to {to}: left {left:.3} right {right:.3} of the turning in vain\n"
            ));
        }
        text.push_str("# timestamp linear_x_mps linear_y_mps angular_z_radps\n");
        while odometer.next_stamp_ns() <= start_ns + (seconds * 1e9) as i64 {
            if let Some(m) = odometer.next_message() {
                let stamp = format_timestamp(m.timestamp_ns);
                let [x, y, yaw] = [m.linear_x_mps, m.linear_y_mps, m.angular_z_radps];
                text.push_str(&format!("{stamp} {x:.6} {y:.6} {yaw:.6}\n"));
            }
        }
        Some(text)
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
