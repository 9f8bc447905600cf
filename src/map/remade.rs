//! The picture of a keyframe as it was, as far as it is kept, for who looks for the keyframe's place in another map.

use std::sync::Arc;

use super::picture::{KeyframePicture, PATCH_PX};
use crate::image::Pyramid;

/// All levels of a picture that is not condensed. Of a reduced one level 0 is level 1 doubled, but for the patches that are left of it: what is found
/// there is measured finely, the rest as in a blurred picture. `None`: a condensed one has too little to be found by.
pub fn remade(picture: &KeyframePicture) -> Option<Arc<Pyramid>> {
    if let Some(whole) = picture.shared() {
        return Some(whole);
    }
    if picture.is_condensed() {
        return None;
    }
    let mut base = picture.level(0)?.into_owned();
    for (_, [left, top], pixels) in picture.patches() {
        let (left, top) = (usize::from(left), usize::from(top));
        // Of a picture of odd size the last column and row are not there.
        let width = PATCH_PX.min(base.width.saturating_sub(left));
        let rows = base.data.chunks_exact_mut(base.width).skip(top);
        for (row, patch) in rows.zip(pixels.chunks_exact(PATCH_PX)).filter(|_| width > 0) {
            row[left..left + width].copy_from_slice(&patch[..width]);
        }
    }
    let mut pyramid = picture.pyramid().clone();
    *pyramid.levels.first_mut()? = base;
    Some(Arc::new(pyramid))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2, Vector3};

    use super::super::{LandmarkId, Map, Observation, examples};
    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::random::Random;
    use crate::image::GreyImage;
    use crate::map::view::{DESCRIBED_LEVELS, Description};

    #[test]
    fn a_reduced_picture_is_as_it_was_around_its_landmarks_and_blurred_elsewhere() {
        let mut random = Random::new(3);
        let mut image = GreyImage::new(641, 481);
        image.data.iter_mut().for_each(|v| *v = random.below(256) as u8);
        let mut pyramid = Pyramid::new(5);
        pyramid.build(&image);
        let mut map = Map::default();
        let pyramid = Arc::new(pyramid);
        let ids = [(); 2].map(|()| map.add_keyframe(examples::keyframe(pyramid.clone(), Se3::identity())));
        for x in [100.0, 630.0] {
            let seen = Observation {
                landmark: LandmarkId(0),
                pixel: Vector2::new(x, 240.0),
                normalised: Vector2::zeros(),
                displacement: Vector2::zeros(),
                inv_sigma_px: 1.0,
                normalised_from_pixel: Matrix2::identity(),
            };
            map.add_landmark(examples::landmark(Vector3::z(), ids[0]), &ids.map(|id| (id, seen)));
        }
        let made = |map: &Map| remade(&map.keyframe(ids[0]).expect("there").picture);
        assert!(Arc::ptr_eq(&made(&map).expect("whole"), &pyramid));
        map.reduce_picture(ids[0]);
        let again = made(&map).expect("most of it");
        assert_eq!(again.levels[1].data, pyramid.levels[1].data);
        assert_eq!((again.levels[0].width, again.levels[0].height), (640, 480));
        let same = |x: usize, y: usize| again.levels[0].row(y)[x] == image.row(y)[x];
        assert!((92..108).all(|x| same(x, 240)) && (625..638).all(|x| same(x, 235)));
        assert!(!(300..330).all(|x| same(x, 240)));
        map.condense_picture(ids[0], &examples::lens(), |_, l| Description {
            landmarks: vec![[None; DESCRIBED_LEVELS]; l.len()],
            place: vec![],
        });
        assert!(made(&map).is_none());
    }
}
