//! The map as COLMAP's text model, for programs that make dense models of it.
//!
//! Input: a map and the camera that its observations are undistorted by. Output: a folder with `cameras.txt`, `images.txt` and `points3D.txt`
//! (<https://colmap.github.io/format.html>), each whole or not at all. One camera: `FULL_OPENCV` for a pinhole with k1 k2 p1 p2 k3,
//! `OPENCV_FISHEYE` for a Kannala-Brandt lens. Poses are COLMAP's own way, camera from world; world and unit are the map's. COLMAP has pixel
//! (0.5, 0.5) in the middle of the first one, so half a pixel is added. Ids are the map's and one more, as COLMAP's begin at 1.
//! An image is named by its timestamp, `SECONDS.NANOSECONDS.png`. Landmarks whose distance is assumed are left out; all are grey.
//!
//! Deliberately not here: the pictures themselves (a map keeps none), reading a model.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::Path;

use super::{Keyframe, KeyframeId, Landmark, LandmarkId, Map};
use crate::atomic_file::{WriteError, write_atomically};
use crate::geometry::{CameraModel, LensModel};

/// Writes the three files into `folder`, which is made if it is missing.
pub fn write_colmap(folder: &Path, map: &Map, camera: &CameraModel) -> Result<(), WriteError> {
    // What cannot be made is told by the first file that is to lie there.
    let _ = std::fs::create_dir_all(folder);
    let points: BTreeSet<u32> = map.landmarks.iter().filter(|(_, l)| l.assumed.is_none()).map(|(id, _)| id).collect();
    write_atomically(&folder.join("cameras.txt"), |out| write_camera(out, camera))?;
    write_atomically(&folder.join("images.txt"), |out| {
        map.keyframes.iter().try_for_each(|(id, k)| write_image(out, id, k, &points))
    })?;
    write_atomically(&folder.join("points3D.txt"), |out| {
        let landmarks = map.landmarks.iter().filter(|(id, _)| points.contains(id));
        landmarks.into_iter().try_for_each(|(id, l)| write_point(out, id, l, map, camera, &points))
    })
}

fn write_camera(out: &mut impl Write, camera: &CameraModel) -> io::Result<()> {
    let CameraModel { width, height, fx, fy, .. } = camera;
    let (cx, cy) = (camera.cx + 0.5, camera.cy + 0.5);
    match camera.lens {
        LensModel::RadialTangential([k1, k2, p1, p2, k3]) => {
            writeln!(out, "1 FULL_OPENCV {width} {height} {fx} {fy} {cx} {cy} {k1} {k2} {p1} {p2} {k3} 0 0 0")
        }
        LensModel::KannalaBrandt([k1, k2, k3, k4]) => {
            writeln!(out, "1 OPENCV_FISHEYE {width} {height} {fx} {fy} {cx} {cy} {k1} {k2} {k3} {k4}")
        }
    }
}

/// Two lines: pose and name, then the observations.
fn write_image(out: &mut impl Write, id: u32, keyframe: &Keyframe, points: &BTreeSet<u32>) -> io::Result<()> {
    let (q, t) = (keyframe.camera_from_world.rotation, keyframe.camera_from_world.translation);
    let (seconds, ns) =
        (keyframe.timestamp_ns.div_euclid(1_000_000_000), keyframe.timestamp_ns.rem_euclid(1_000_000_000));
    write!(out, "{} {} {} {} {} {} {} {} 1 ", id + 1, q.w, q.i, q.j, q.k, t.x, t.y, t.z)?;
    writeln!(out, "{seconds}.{ns:09}.png")?;
    for (id, pixel) in keyframe.observations.pixels().filter(|(id, _)| points.contains(&id.0)) {
        write!(out, "{} {} {} ", pixel.x + 0.5, pixel.y + 0.5, id.0 + 1)?;
    }
    writeln!(out)
}

/// Place, colour, mean reprojection error in px, and who sees it: image and number of the observation there.
fn write_point(
    out: &mut impl Write,
    id: u32,
    landmark: &Landmark,
    map: &Map,
    camera: &CameraModel,
    points: &BTreeSet<u32>,
) -> io::Result<()> {
    let mut errors = Vec::new();
    let mut track = String::new();
    for &KeyframeId(k) in &landmark.observers {
        let Some(keyframe) = map.keyframe(KeyframeId(k)) else { continue };
        let Some(o) = keyframe.observation(LandmarkId(id)) else { continue };
        let seen = camera.project(&keyframe.camera_from_world.transform(&landmark.position));
        errors.extend(seen.map(|p| (p - o.pixel.cast()).norm()));
        let place = keyframe.observations.landmarks().filter(|l| points.contains(&l.0)).take_while(|l| l.0 != id);
        track += &format!(" {} {}", k + 1, place.count());
    }
    let error = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    let p = landmark.position;
    writeln!(out, "{} {} {} {} 128 128 128 {error}{track}", id + 1, p.x, p.y, p.z)
}
