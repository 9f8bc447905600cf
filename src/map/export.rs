//! The map as a PLY file, for CloudCompare, MeshLab, Open3D and their like.
//!
//! Input: a [`MapSnapshot`]. Output: binary little-endian PLY, one vertex a landmark and then one a keyframe (its camera's
//! centre), 28 bytes each, whole or not at all. Properties: `x y z` (world axes: right, down, forward of the first
//! keyframe's camera; metres or map units, as a comment says), `red green blue` (landmarks pale to dark blue by how often they were seen, keyframes
//! orange), `sigma` (one sigma along the line of sight, map units; NaN = unknown and for keyframes), `observations`
//! (keyframes that see the landmark; 0 for keyframes), `id`, `kind` (0 landmark, 1 keyframe).
//! Cost: 50 ns a vertex. What has no finite position is left out.
//!
//! Deliberately not here: reading a map back (a PLY has no observations to go on from), surfaces.

use std::io::{self, Write};
use std::path::Path;

use nalgebra::Vector3;

use super::MapSnapshot;
use crate::atomic_file::{WriteError, write_atomically};
use crate::map::scale::MapScale;

const KEYFRAME_COLOUR: [u8; 3] = [255, 110, 20];

/// Landmarks that were seen once are pale, those that were seen by 16 keyframes or more dark.
fn landmark_colour(observations: u32) -> [u8; 3] {
    let t = (f64::from(observations.max(1)).log2() / 4.0).min(1.0);
    [(170.0, 10.0), (190.0, 50.0), (215.0, 120.0)].map(|(pale, dark)| (pale + t * (dark - pale)).round() as u8)
}

/// Writes the map to `path`.
pub fn write_ply(path: &Path, map: &MapSnapshot) -> Result<(), WriteError> {
    write_atomically(path, |out| write_vertices(out, map))
}

fn unit(scale: MapScale) -> String {
    match scale {
        MapScale::Unknown => "map units (no metric scale)".into(),
        MapScale::Metric { sigma, .. } => format!("metres (scale known to {:.2} %)", 100.0 * sigma),
    }
}

fn write_vertices(out: &mut impl Write, map: &MapSnapshot) -> io::Result<()> {
    let finite = |p: &Vector3<f64>| p.iter().all(|v| (*v as f32).is_finite());
    let landmarks = || map.landmarks.iter().filter(|l| finite(&l.position_world));
    let keyframes = || map.keyframes.iter().filter(|k| finite(&k.world_from_camera.translation));
    let count = landmarks().count() + keyframes().count();
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment cairn map {} revision {}: {} landmarks, then {} keyframes\n\
         comment {}; axes of the first keyframe's camera: x right, y down, z forward\n\
         element vertex {count}\n\
         property float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\n\
         property float sigma\nproperty uint observations\nproperty uint id\nproperty uchar kind\n\
         end_header\n",
        map.map.0,
        map.revision,
        landmarks().count(),
        keyframes().count(),
        unit(map.scale),
    )?;
    let mut vertex = |p: &Vector3<f64>, colour: [u8; 3], sigma: f32, observations: u32, id: u32, kind: u8| {
        for value in [p.x as f32, p.y as f32, p.z as f32] {
            out.write_all(&value.to_le_bytes())?;
        }
        out.write_all(&colour)?;
        out.write_all(&sigma.to_le_bytes())?;
        out.write_all(&observations.to_le_bytes())?;
        out.write_all(&id.to_le_bytes())?;
        out.write_all(&[kind])
    };
    for l in landmarks() {
        vertex(&l.position_world, landmark_colour(l.observations), l.sigma, l.observations, l.id.0, 0)?;
    }
    for k in keyframes() {
        vertex(&k.world_from_camera.translation, KEYFRAME_COLOUR, f32::NAN, 0, k.id.0, 1)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Se3;
    use crate::map::{KeyframeId, KeyframeView, LandmarkId, LandmarkView, MapId};

    fn landmark(id: u32, x: f64, sigma: f32, observations: u32) -> LandmarkView {
        LandmarkView { id: LandmarkId(id), position_world: Vector3::new(x, -2.0, 3.5), sigma, observations }
    }

    fn keyframe(id: u32, z: f64) -> KeyframeView {
        let world_from_camera = Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::new(0.0, 0.0, z));
        KeyframeView { id: KeyframeId(id), timestamp_ns: 0, world_from_camera }
    }

    #[test]
    fn every_vertex_is_where_the_header_says_and_nothing_more() {
        let map = MapSnapshot {
            map: MapId(3),
            scale: Default::default(),
            revision: 9,
            landmarks: vec![landmark(7, 1.25, 0.5, 1), landmark(8, f64::NAN, 0.5, 2), landmark(9, 4.0, f32::NAN, 40)],
            keyframes: vec![keyframe(1, 2.0), keyframe(2, f64::INFINITY)],
            around: Default::default(),
            left_out: [0; 2],
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.ply");
        write_ply(&path, &map).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n") && header.is_ascii());
        assert!(
            header.contains("\nelement vertex 3\n") && header.contains("2 landmarks, then 1 keyframes"),
            "{header}"
        );
        assert!(header.lines().all(|l| l.trim() == l && !l.is_empty()), "{header}");
        let vertices: Vec<_> = bytes[end..].chunks(28).collect();
        assert_eq!(vertices.len(), 3);
        let f = |v: &[u8], at: usize| f32::from_le_bytes(v[at..at + 4].try_into().unwrap());
        let u = |v: &[u8], at: usize| u32::from_le_bytes(v[at..at + 4].try_into().unwrap());
        assert_eq!((f(vertices[0], 0), f(vertices[0], 4), f(vertices[0], 8)), (1.25, -2.0, 3.5));
        assert_eq!((f(vertices[0], 15), u(vertices[0], 19), u(vertices[0], 23), vertices[0][27]), (0.5, 1, 7, 0));
        assert!(f(vertices[1], 15).is_nan());
        assert_eq!((u(vertices[1], 19), u(vertices[1], 23)), (40, 9));
        assert!(vertices[1][12..15] < vertices[0][12..15], "seen often is darker than seen once");
        assert_eq!((f(vertices[2], 8), &vertices[2][12..15], vertices[2][27]), (2.0, &KEYFRAME_COLOUR[..], 1));
    }

    #[test]
    fn an_empty_map_is_a_valid_file_and_a_full_disk_a_named_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.ply");
        write_ply(&path, &MapSnapshot::default()).unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().ends_with("end_header\n"));
        let error = write_ply(Path::new("/dev/full"), &MapSnapshot::default()).unwrap_err().to_string();
        assert!(error.contains("/dev/full") && error.contains("No space"), "{error}");
    }
}
