//! How far over a picture that was found lies of which a place is to be known.

use crate::geometry::CameraModel;
use crate::reconstruction::track::search::Match;

/// What was found of a place lies in so many parts of the picture at the least: landmarks on one poster say that this is the poster, and not
/// where it hangs.
const MIN_PARTS: usize = 5;

/// What was found is not on one poster.
pub fn shows_a_place(found: &[Match], camera: &CameraModel) -> bool {
    parts_seen(found, camera) >= MIN_PARTS
}

/// Parts of the picture in which something was found.
fn parts_seen(found: &[Match], camera: &CameraModel) -> usize {
    let mut seen = [false; CameraModel::PARTS];
    for m in found {
        seen[camera.part_of(&m.pixel.cast())] = true;
    }
    seen.iter().filter(|seen| **seen).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{KeyframeId, LandmarkId};
    use nalgebra::{Vector2, Vector3};

    #[test]
    fn what_lies_on_one_poster_is_no_place() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).expect("a camera");
        let at = |x: f32, y: f32| Match {
            landmark: LandmarkId(0),
            template: KeyframeId(0),
            point: Vector3::z(),
            pixel: Vector2::new(x, y),
            normalised: Vector2::zeros(),
            displacement: Vector2::zeros(),
            inv_sigma_px: 1.0,
            inlier: true,
            is_alike: true,
        };
        let poster: Vec<Match> = (0..60).map(|i| at(330.0 + i as f32, 170.0 + i as f32)).collect();
        assert!(parts_seen(&poster, &camera) < MIN_PARTS);
        let room: Vec<Match> = (0..60).map(|i| at(-0.4 + (i * 97 % 641) as f32, (i * 61 % 481) as f32)).collect();
        assert_eq!(parts_seen(&room, &camera), CameraModel::PARTS);
    }
}
