//! The two poses of a camera before a small plane.
//!
//! Points of a plane (z = 0, any unit) and where they are seen, undistorted on z = 1 -> two `camera_from_plane`, the one that fits better
//! first; `None` for too few, collinear or non-finite points. A plane that is small against its distance looks nearly the same when its
//! normal is mirrored about the line of sight: the second pose is nearly that mirror image, and which is the true one another view says.
//! Collins & Bartoli, Infinitesimal plane-based pose estimation (2014): the homography's first order at the plane's origin, which
//! should be the middle of the points, fixes both rotations in closed form; translations are linear. Cost: 8 us for four points.

use nalgebra::{Matrix2, Matrix3, Rotation3, Vector2, Vector3};

use super::Se3;
use super::homography::dlt;
use super::rotation::quaternion;

/// A pose and how well it fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanarPose<To, From> {
    pub camera_from_plane: Se3<To, From>,
    /// Root of the mean squared distance between seen and projected points, normalised units.
    pub error: f64,
}

/// The two poses of four or more points.
pub fn planar_poses<To, From>(plane: &[Vector2<f64>], seen: &[Vector2<f64>]) -> Option<[PlanarPose<To, From>; 2]> {
    let h = dlt(plane, seen)?;
    let h = h / h.m33;
    let v = Vector2::new(h.m13, h.m23);
    let jacobian = Matrix2::new(h.m11 - h.m31 * v.x, h.m12 - h.m32 * v.x, h.m21 - h.m31 * v.y, h.m22 - h.m32 * v.y);
    // Takes the axis to the line of sight.
    let sight = *Rotation3::rotation_between(&Vector3::z(), &v.push(1.0))?.matrix();
    let across = sight.fixed_view::<2, 2>(0, 0) - v * sight.fixed_view::<1, 2>(2, 0);
    let a = across.try_inverse()? * jacobian;
    // Its larger singular value is 1 / depth.
    let (squares, determinant) = (a.norm_squared(), a.determinant());
    let inverse_depth =
        (0.5 * (squares + (squares * squares - 4.0 * determinant * determinant).max(0.0).sqrt())).sqrt();
    let upper = a / inverse_depth;
    let rest = Matrix2::identity() - upper.tr_mul(&upper);
    let lower = Vector2::new(rest.m11.max(0.0).sqrt(), rest.m22.max(0.0).sqrt().copysign(rest.m12));
    let pose = |lower: Vector2<f64>| {
        let (x, y) = (upper.column(0).push(lower.x), upper.column(1).push(lower.y));
        let rotation = sight * Matrix3::from_columns(&[x, y, x.cross(&y)]);
        fitted(plane, seen, &rotation)
    };
    let (one, other) = (pose(lower)?, pose(-lower)?);
    Some(if other.error < one.error { [other, one] } else { [one, other] })
}

/// The pose of this rotation: its translation is linear.
fn fitted<To, From>(
    plane: &[Vector2<f64>],
    seen: &[Vector2<f64>],
    rotation: &Matrix3<f64>,
) -> Option<PlanarPose<To, From>> {
    let rotation = quaternion(rotation);
    let (mut hessian, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
    for (p, s) in plane.iter().zip(seen) {
        let turned = rotation * p.push(0.0);
        for (row, k) in [(Vector3::new(1.0, 0.0, -s.x), 0), (Vector3::new(0.0, 1.0, -s.y), 1)] {
            hessian += row * row.transpose();
            gradient -= row * (turned[k] - s[k] * turned.z);
        }
    }
    let translation = nalgebra::Cholesky::new(hessian)?.solve(&gradient);
    let mut squares = 0.0;
    for (p, s) in plane.iter().zip(seen) {
        let q = rotation * p.push(0.0) + translation;
        // Written so that NaN fails.
        if !(q.z > 0.0) {
            return None;
        }
        squares += (q.xy() / q.z - s).norm_squared();
    }
    let error = (squares / plane.len() as f64).sqrt();
    Some(PlanarPose { camera_from_plane: Se3::new(rotation, translation), error })
}

#[cfg(test)]
mod tests {
    use super::super::frames::{Camera, World};
    use super::super::random::Random;
    use super::*;
    use nalgebra::UnitQuaternion;

    const SQUARE: [[f64; 2]; 4] = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]];

    fn case(random: &mut Random) -> Se3<Camera, World> {
        let (tilt, around) = (random.uniform(0.1, 1.1), random.uniform(0.0, std::f64::consts::TAU));
        let axis = Vector3::new(around.cos(), around.sin(), 0.0) * tilt;
        let roll = UnitQuaternion::from_scaled_axis(Vector3::z() * random.uniform(-3.0, 3.0));
        let depth = random.uniform(3.0, 30.0);
        let at = Vector3::new(random.uniform(-0.4, 0.4), random.uniform(-0.3, 0.3), 1.0) * depth;
        Se3::new(UnitQuaternion::from_scaled_axis(axis) * roll, at)
    }

    fn seen(pose: &Se3<Camera, World>) -> Vec<Vector2<f64>> {
        let project = |p: [f64; 2]| {
            let q = pose.transform(&Vector2::from(p).push(0.0));
            q.xy() / q.z
        };
        SQUARE.map(project).to_vec()
    }

    #[test]
    fn exact_points_give_the_exact_pose_first() {
        let plane = SQUARE.map(Vector2::from);
        for seed in 0..200 {
            let truth = case(&mut Random::new(seed));
            let [found, _] = planar_poses::<Camera, World>(&plane, &seen(&truth)).expect("regular");
            let pose = found.camera_from_plane;
            assert!(pose.rotation.angle_to(&truth.rotation) < 1e-6, "seed {seed}");
            assert!((pose.translation - truth.translation).norm() < 1e-6 * truth.translation.norm(), "seed {seed}");
            assert!(found.error < 1e-9, "seed {seed}");
        }
    }

    #[test]
    fn under_noise_one_of_the_two_is_near_and_the_other_its_mirror_image() {
        let plane = SQUARE.map(Vector2::from);
        let mut first = 0;
        for seed in 0..200 {
            let random = &mut Random::new(seed);
            let truth = case(random);
            let noise = 0.002 / truth.translation.z;
            let noisy: Vec<_> =
                seen(&truth).iter().map(|p| p + Vector2::new(random.normal(), random.normal()) * noise).collect();
            let found = planar_poses::<Camera, World>(&plane, &noisy).expect("regular");
            let off = |i: usize| {
                let z = |pose: &Se3<Camera, World>| pose.rotation * Vector3::z();
                z(&found[i].camera_from_plane).angle(&z(&truth))
            };
            assert!(off(0).min(off(1)) < 0.12, "seed {seed}: {} {}", off(0), off(1));
            first += usize::from(off(0) < off(1));
            // Both normals make the same angle with the line of sight.
            let sight = truth.translation.normalize();
            let to_sight = |i: usize| (found[i].camera_from_plane.rotation * Vector3::z()).angle(&sight);
            assert!((to_sight(0) - to_sight(1)).abs() < 0.03, "seed {seed}");
        }
        assert!(first > 120, "the better fitting one is the true one in {first} of 200");
    }

    #[test]
    fn points_that_fix_no_pose_give_none() {
        let plane = SQUARE.map(Vector2::from);
        let line: Vec<_> = (0..4).map(|i| Vector2::new(0.1 * f64::from(i), 0.0)).collect();
        assert!(planar_poses::<Camera, World>(&plane, &line).is_none());
        assert!(planar_poses::<Camera, World>(&plane, &[Vector2::repeat(f64::NAN); 4]).is_none());
        assert!(planar_poses::<Camera, World>(&plane[..3], &line[..3]).is_none());
    }
}
