//! Where a frame might be when prediction has failed.
//!
//! Keyframes keep a blurred thumbnail. A lost frame's own is compared with a bounded number of them in each frame (the ones
//! around the last known place first, then all others in turn); the most similar give guesses of the pose: the keyframe's,
//! turned by the plane motion between the thumbnails (Klein & Murray 2008, section 5). The search by projection decides.
//! Finds views near a keyframe. Not here: places seen from elsewhere, which need descriptors.

use nalgebra::{UnitQuaternion, Vector3};

use crate::features::thumbnail::{ImageMotion, Thumbnail, ThumbnailAligner};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;
use crate::map::{KeyframeId, Map};

/// A pose to start a search from, and the keyframe whose surroundings are searched.
#[derive(Debug, Clone, Copy)]
pub struct Guess {
    pub camera_from_world: Se3<Camera, World>,
    pub reference: KeyframeId,
}

/// Keyframes compared in one frame.
const COMPARED: usize = 12;
/// Guesses given in one frame.
const GUESSES: usize = 3;
/// Thumbnails that correlate less are of another place.
const MIN_NCC: f32 = 0.6;

/// Buffers of relocalisation.
#[derive(Debug, Default)]
pub struct Relocaliser {
    current: Thumbnail,
    aligner: ThumbnailAligner,
    around: Vec<(KeyframeId, u32)>,
    chosen: Vec<KeyframeId>,
    ranked: Vec<(f32, Guess)>,
    /// Where the round over all keyframes goes on.
    next: usize,
}

impl Relocaliser {
    /// Adds up to three guesses for the frame with `pyramid` to `out`, the most similar first.
    pub fn guess(
        &mut self,
        map: &Map,
        camera: &CameraModel,
        pyramid: &Pyramid,
        last_reference: KeyframeId,
        out: &mut Vec<Guess>,
    ) {
        self.ranked.clear();
        if !self.current.build(pyramid) || map.keyframes.is_empty() {
            return;
        }
        map.covisible(last_reference, 1, COMPARED / 2, &mut self.around);
        self.chosen.clear();
        self.chosen.push(last_reference);
        self.chosen.extend(self.around.iter().map(|a| a.0));
        let total = map.keyframes.len();
        let round = COMPARED.saturating_sub(self.chosen.len()).min(total);
        for (id, _) in map.keyframes.iter().chain(map.keyframes.iter()).skip(self.next % total).take(round) {
            self.chosen.push(KeyframeId(id));
        }
        self.next = (self.next + round) % total;
        self.chosen.sort_unstable();
        self.chosen.dedup();
        for &id in &self.chosen {
            let Some(keyframe) = map.keyframe(id) else { continue };
            let Some(motion) = self.aligner.align(&keyframe.thumbnail, &self.current) else { continue };
            if motion.ncc < MIN_NCC {
                continue;
            }
            let turned: Se3<Camera, Camera> = Se3::new(rotation_of(&motion, camera), Vector3::zeros());
            let guess = Guess { camera_from_world: turned * keyframe.camera_from_world, reference: id };
            self.ranked.push((motion.ncc, guess));
        }
        self.ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        out.extend(self.ranked.iter().take(GUESSES).map(|r| r.1));
    }
}

/// A keyframe's thumbnail; empty (like no other) for a picture too small for one.
pub fn thumbnail_of(pyramid: &Pyramid) -> Thumbnail {
    let mut thumbnail = Thumbnail::default();
    thumbnail.build(pyramid);
    thumbnail
}

/// Rotation of the camera that moves the picture's centre and turns the picture as `motion` does.
fn rotation_of(motion: &ImageMotion, camera: &CameraModel) -> UnitQuaternion<f64> {
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), f64::from(motion.angle_rad));
    let (dx, dy) = (f64::from(motion.shift_px.x) / camera.fx, f64::from(motion.shift_px.y) / camera.fy);
    let shift = UnitQuaternion::rotation_between(&Vector3::z(), &Vector3::new(dx, dy, 1.0));
    shift.unwrap_or_else(UnitQuaternion::identity) * roll
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;

    #[test]
    fn a_picture_that_moved_right_was_turned_left() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).unwrap();
        let motion = ImageMotion {
            angle_rad: 0.1,
            shift_px: Vector2::new(50.0, -20.0),
            center_px: Vector2::new(319.5, 239.5),
            ncc: 1.0,
            overlap: 0.9,
        };
        let rotation = rotation_of(&motion, &camera);
        // The ray of the old picture's centre is seen where the motion says.
        let seen = camera.project(&(rotation * Vector3::z())).unwrap();
        let told = motion.apply(Vector2::new(319.5, 239.5));
        assert!((seen - told.cast::<f64>()).norm() < 1e-3);
        let near = camera.project(&(rotation * Vector3::new(0.05, 0.0, 1.0))).unwrap();
        assert!((near - motion.apply(Vector2::new(344.5, 239.5)).cast::<f64>()).norm() < 1.0);
    }
}
