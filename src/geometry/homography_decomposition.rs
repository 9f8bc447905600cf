//! Motions of a camera over a plane, from the plane's homography.
//!
//! H in normalised coordinates (`x2 ~ H x1`) -> up to four `(R, t / d, n)` with `H ~ R + (t / d) nᵀ`, where the plane is
//! `nᵀ X = d` in the first camera, n of unit length, d > 0. Two of them survive when the plane must be in front of
//! both cameras; which of the two is the true one a third view, or points beside the plane,
//! must say.
//! Analytic, from the eigenvectors of `HᵀH` (Ma, Soatto, Kosecka, Sastry: An Invitation to 3-D Vision, section 5.3.3;
//! the same four as Faugeras & Lustman 1988 and Malis & Vargas 2007). Cost: about 2 us.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::rotation::quaternion;

/// A motion and the plane that it was seen by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneMotion {
    /// `second_from_first` rotation.
    pub rotation: UnitQuaternion<f64>,
    /// `second_from_first` translation in units of the plane's distance d.
    pub translation: Vector3<f64>,
    /// Unit normal of the plane in the first camera, pointing away from it.
    pub normal: Vector3<f64>,
}

/// What a homography says about the motion.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant)] // a result that lives on the stack for a moment
pub enum PlaneMotions {
    /// A rotation: no translation, or a plane at infinity. Nothing is known of the plane.
    Rotation(UnitQuaternion<f64>),
    /// Four motions, in two pairs of opposite normal and translation.
    Four([PlaneMotion; 4]),
}

/// The motions of a homography with `det H > 0`. `rotation_tolerance`: how far the singular values, the middle one
/// being 1, may be from 1 in a rotation. `None` for a singular or non-finite H.
pub fn decompose_homography(h: &Matrix3<f64>, rotation_tolerance: f64) -> Option<PlaneMotions> {
    if !h.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = h.try_svd(true, true, f64::EPSILON, 200)?;
    let (u, v_t, s) = (svd.u?, svd.v_t?, svd.singular_values);
    if !(s[2] > 1e-9 * s[0]) {
        return None;
    }
    // The middle singular value of R + (t/d) nᵀ is 1.
    let (s1, s3) = (s[0] / s[1], s[2] / s[1]);
    let h = h * (h.determinant().signum() / s[1]);
    if s1 - 1.0 <= rotation_tolerance && 1.0 - s3 <= rotation_tolerance {
        return Some(PlaneMotions::Rotation(quaternion(&(u * v_t * (u * v_t).determinant().signum()))));
    }
    let v = v_t.transpose();
    let (v1, v2, v3) = (v.column(0).into_owned(), v.column(1).into_owned(), v.column(2).into_owned());
    // Directions in the plane that H maps without change of length.
    let (a, b) = ((1.0 - s3 * s3).max(0.0).sqrt(), (s1 * s1 - 1.0).max(0.0).sqrt());
    let scale = 1.0 / (s1 * s1 - s3 * s3).sqrt();
    let motion = |u: Vector3<f64>| {
        let frame = |x: Vector3<f64>, y: Vector3<f64>| Matrix3::from_columns(&[x, y, x.cross(&y)]);
        let rotation = frame(h * v2, h * u) * frame(v2, u).transpose();
        let normal = v2.cross(&u);
        let translation = (h - rotation) * normal;
        PlaneMotion { rotation: quaternion(&rotation), translation, normal }
    };
    let opposite = |m: &PlaneMotion| PlaneMotion { translation: -m.translation, normal: -m.normal, ..*m };
    let first = motion((v1 * a + v3 * b) * scale);
    let second = motion((v1 * a - v3 * b) * scale);
    let all = [first, second, opposite(&first), opposite(&second)];
    all.iter().all(|m| m.translation.iter().all(|x| x.is_finite())).then_some(PlaneMotions::Four(all))
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::random_rotation;
    use super::*;
    use nalgebra::Vector2;

    fn case(random: &mut Random) -> PlaneMotion {
        PlaneMotion {
            rotation: random_rotation(random, 0.4),
            translation: Vector3::new(random.normal(), random.normal(), random.normal()) * 0.2,
            normal: Vector3::new(random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6), 1.0).normalize(),
        }
    }

    fn homography(m: &PlaneMotion) -> Matrix3<f64> {
        m.rotation.to_rotation_matrix().matrix() + m.translation * m.normal.transpose()
    }

    #[test]
    fn one_of_the_four_is_the_true_motion_and_all_give_h_back() {
        for seed in 0..200 {
            let mut random = Random::new(seed);
            let truth = case(&mut random);
            let h = homography(&truth);
            // The scale and the sign of H do not matter.
            let PlaneMotions::Four(found) = decompose_homography(&(h * -2.5), 1e-9).expect("regular") else {
                panic!("seed {seed}: a rotation")
            };
            for m in &found {
                assert!((homography(m) - h).norm() < 1e-9, "seed {seed}: {m:?}");
                assert!((m.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
                assert!((m.normal.norm() - 1.0).abs() < 1e-12);
            }
            let error = found
                .iter()
                .map(|m| {
                    m.rotation.angle_to(&truth.rotation)
                        + (m.translation - truth.translation).norm()
                        + (m.normal - truth.normal).norm()
                })
                .fold(f64::INFINITY, f64::min);
            assert!(error < 1e-6, "seed {seed}: {error}");
        }
    }

    /// Is the plane's point seen at `x1` in front of both cameras?
    fn sees(motion: &PlaneMotion, x1: &Vector2<f64>) -> bool {
        let ray = x1.push(1.0);
        let along = motion.normal.dot(&ray);
        // X = ray / along; its depth in the second camera.
        along > 0.0 && (motion.rotation * ray + motion.translation * along).z > 0.0
    }

    #[test]
    fn at_most_two_motions_see_the_plane() {
        for seed in 0..200 {
            let mut random = Random::new(seed);
            let truth = case(&mut random);
            let PlaneMotions::Four(found) = decompose_homography(&homography(&truth), 1e-9).expect("regular") else {
                panic!("seed {seed}: a rotation")
            };
            let points: Vec<Vector2<f64>> = (0..100)
                .map(|_| Vector2::new(random.uniform(-0.6, 0.6), random.uniform(-0.5, 0.5)))
                .filter(|x| sees(&truth, x))
                .collect();
            let full = found.iter().filter(|m| points.iter().all(|x| sees(m, x))).count();
            assert!((1..=2).contains(&full), "seed {seed}: {full}");
        }
    }

    #[test]
    fn rotations_are_told_and_bad_matrices_give_none() {
        let mut random = Random::new(2);
        let r = random_rotation(&mut random, 0.4);
        let Some(PlaneMotions::Rotation(found)) = decompose_homography(&(r.to_rotation_matrix().matrix() * 3.0), 1e-9)
        else {
            panic!("a rotation")
        };
        assert!(found.angle_to(&r) < 1e-7);
        assert!(decompose_homography(&Matrix3::from_element(f64::NAN), 1e-9).is_none());
        assert!(decompose_homography(&Matrix3::zeros(), 1e-9).is_none());
        assert!(decompose_homography(&Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0)), 1e-9).is_none());
    }
}
