//! Keyframes and landmarks for tests: what a test does not speak of is nothing.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use nalgebra::{Matrix3, Vector3};

use super::away::{Condensed, CopyFault, PictureCopy};
use super::picture::KeyframePicture;
use super::saved::{MapChanges, MapHead, SavedOptics};
use super::scale::MapScale;
use super::{Keyframe, KeyframeId, Landmark, Map, MapId};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;

/// Frame 0 of map 0, which has seen nothing.
pub fn keyframe(picture: Arc<Pyramid>, camera_from_world: Se3<Camera, World>) -> Keyframe {
    Keyframe {
        sequence: 0,
        timestamp_ns: 0,
        map: MapId(0),
        camera_from_world,
        motion: None,
        picture: KeyframePicture::new(picture),
        thumbnail: Default::default(),
        scale_from: None,
        observations: Default::default(),
        covisible: Vec::new(),
        corners: Vec::new(),
    }
}

/// Of pictures of 640 x 480 pixels.
pub fn lens() -> CameraModel {
    CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).expect("a camera")
}

/// All that there is of a map that this camera made, or what has changed in it.
pub fn changes(camera: &CameraModel, map: &mut Map, is_everything: bool) -> MapChanges {
    let optics = SavedOptics {
        calibration: camera.clone(),
        is_guessed: false,
        camera: camera.clone(),
        expected: camera.clone(),
        sigma: [0.0; 7],
        refined_sigma: [0.0; 7],
        begun_with_px: camera.focal_px(),
        restarts: 0,
        found_before: Vec::new(),
        unsettled: 0.0,
        readout_s: 0.0,
        readout_information: 0.0,
    };
    let (scale, turns) = (MapScale::Unknown, Vec::new());
    let head = MapHead { id: MapId(0), reference: KeyframeId(0), frames: 9, scale, turns };
    MapChanges::take(optics, 5, vec![(head, map)], is_everything)
}

/// A new one, a unit uncertain.
pub fn landmark(position: Vector3<f64>, created_by: KeyframeId) -> Landmark {
    Landmark::new(position, Matrix3::identity(), created_by)
}

/// A copy of this picture in memory, which cannot be read the first few times.
pub fn copied(picture: &KeyframePicture, failures: u32) -> Option<Arc<dyn PictureCopy>> {
    Some(Arc::new(Copied { picture: picture.clone(), failures: failures.into() }))
}

#[derive(Debug)]
struct Copied {
    picture: KeyframePicture,
    failures: AtomicU32,
}

impl PictureCopy for Copied {
    fn read(&self) -> Result<Condensed, CopyFault> {
        let fails = self.failures.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_ok();
        match self.picture.condensed() {
            _ if fails => Err(CopyFault::NotRead("a bad block".into())),
            Some(picture) => Ok(picture),
            None => Err(CopyFault::Senseless("no picture".into())),
        }
    }
}
