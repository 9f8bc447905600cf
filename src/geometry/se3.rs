//! Rigid motions whose type carries both frames.
//!
//! `a_from_b: Se3<A, B>` maps coordinates in `B` to coordinates in `A`; neighbours cancel in a product:
//! `a_from_b * b_from_c` is a `Se3<A, C>`. Nothing else composes.

use std::marker::PhantomData;
use std::ops::Mul;

use nalgebra::{Matrix3, Matrix3x4, Matrix6, UnitQuaternion, Vector3, Vector6};

use super::epipolar::skew;

/// Rigid motion `x_to = rotation * x_from + translation`.
pub struct Se3<To, From> {
    /// Rotation part, `to_from_from`.
    pub rotation: UnitQuaternion<f64>,
    /// Origin of `From`, in `To`'s coordinates and the map's unit.
    pub translation: Vector3<f64>,
    frames: PhantomData<fn() -> (To, From)>,
}

impl<A, B> Clone for Se3<A, B> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<A, B> Copy for Se3<A, B> {}
impl<A, B> PartialEq for Se3<A, B> {
    fn eq(&self, other: &Self) -> bool {
        self.rotation == other.rotation && self.translation == other.translation
    }
}
impl<A, B> std::fmt::Debug for Se3<A, B> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (q, t) = (self.rotation.coords, self.translation);
        write!(f, "Se3 {{ t: [{}, {}, {}], q_xyzw: [{}, {}, {}, {}] }}", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
    }
}
impl<A, B> Default for Se3<A, B> {
    fn default() -> Self {
        Self::identity()
    }
}

impl<To, From> Se3<To, From> {
    /// From its parts.
    pub fn new(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation, frames: PhantomData }
    }

    /// Both frames coincide.
    pub fn identity() -> Self {
        Self::new(UnitQuaternion::identity(), Vector3::zeros())
    }

    /// From a rotation matrix (must be a rotation; it is renormalised) and a translation.
    pub fn from_matrix(rotation: &Matrix3<f64>, translation: Vector3<f64>) -> Self {
        let r = nalgebra::Rotation3::from_matrix_unchecked(*rotation);
        Self::new(UnitQuaternion::from_rotation_matrix(&r), translation)
    }

    /// The inverse motion.
    pub fn inverse(&self) -> Se3<From, To> {
        let r = self.rotation.inverse();
        Se3::new(r, -(r * self.translation))
    }

    /// A point of `From` in `To`'s coordinates.
    pub fn transform(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// `[R | t]`, 3x4.
    pub fn matrix(&self) -> Matrix3x4<f64> {
        let r = self.rotation.to_rotation_matrix();
        let mut m = Matrix3x4::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(r.matrix());
        m.set_column(3, &self.translation);
        m
    }

    /// Same numbers, other frame names. The one place where frames are renamed: say why at each call.
    pub fn relabel<A, B>(&self) -> Se3<A, B> {
        Se3::new(self.rotation, self.translation)
    }

    /// The same with lengths that are `factor` times as long.
    pub fn rescaled(&self, factor: f64) -> Self {
        Self::new(self.rotation, self.translation * factor)
    }

    /// Decoupled left perturbation, tangent `[rotation (rad), translation]` in `To`'s axes:
    /// `R' = exp(w) R`, `t' = t + v`... applied as `x' = exp(w) (R x + t) + v`.
    pub fn perturb_left(&self, delta: &Vector6<f64>) -> Self {
        let dr = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned());
        let mut rotation = dr * self.rotation;
        rotation.renormalize_fast();
        Self::new(rotation, dr * self.translation + delta.fixed_rows::<3>(3))
    }

    /// Exponential of a twist `[w, v]` (rotation in radians, translation): the motion after one unit of time at constant
    /// body velocity. Unlike [`Se3::perturb_left`], the translation is bent along: `t = V(w) v`.
    pub fn exp(twist: &Vector6<f64>) -> Self {
        let (w, v) = (twist.fixed_rows::<3>(0).into_owned(), twist.fixed_rows::<3>(3).into_owned());
        Self::new(UnitQuaternion::from_scaled_axis(w), left_jacobian(&w) * v)
    }

    /// Logarithm: the twist `[w, v]` with `exp` of it equal to this motion; |w| <= pi.
    pub fn log(&self) -> Vector6<f64> {
        let w = self.rotation.scaled_axis();
        let v = left_jacobian_inverse(&w) * self.translation;
        Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z)
    }

    /// Adjoint: takes a twist `[w, v]` of `From` to `To`, `T exp(x) = exp(Ad x) T`.
    pub fn adjoint(&self) -> Matrix6<f64> {
        let r = *self.rotation.to_rotation_matrix().matrix();
        let mut m = Matrix6::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&r);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&(skew(&self.translation) * r));
        m
    }

    /// All numbers finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.coords.iter().chain(self.translation.iter()).all(|v| v.is_finite())
    }
}

impl<Frame> Se3<Frame, Frame> {
    /// The motion in `share` times the time: rotation and translation each by itself, not along the screw of [`Self::exp`].
    pub fn scaled(&self, share: f64) -> Self {
        Self::new(UnitQuaternion::from_scaled_axis(self.rotation.scaled_axis() * share), self.translation * share)
    }
}

impl<A, B, C> Mul<Se3<B, C>> for Se3<A, B> {
    type Output = Se3<A, C>;
    fn mul(self, rhs: Se3<B, C>) -> Se3<A, C> {
        let mut rotation = self.rotation * rhs.rotation;
        rotation.renormalize_fast();
        Se3::new(rotation, self.rotation * rhs.translation + self.translation)
    }
}

/// `V(w) = I + (1 - cos a) / a² [w]x + (a - sin a) / a³ [w]x²`, a = |w|: the left Jacobian of SO(3).
fn left_jacobian(w: &Vector3<f64>) -> Matrix3<f64> {
    let squared = w.norm_squared();
    let angle = squared.sqrt();
    // Below, the next term of the series is under the rounding.
    let (b, c) = if angle < 1e-2 {
        (0.5 - squared / 24.0 + squared * squared / 720.0, 1.0 / 6.0 - squared / 120.0 + squared * squared / 5040.0)
    } else {
        ((1.0 - angle.cos()) / squared, (angle - angle.sin()) / (squared * angle))
    };
    let m = skew(w);
    Matrix3::identity() + m * b + m * m * c
}

/// Inverse of [`left_jacobian`]: `I - [w]x / 2 + (1 / a² - (1 + cos a) / (2 a sin a)) [w]x²`.
fn left_jacobian_inverse(w: &Vector3<f64>) -> Matrix3<f64> {
    let squared = w.norm_squared();
    let angle = squared.sqrt();
    let c = if angle < 1e-2 {
        1.0 / 12.0 + squared / 720.0 + squared * squared / 30240.0
    } else {
        // By half angles: (1 + cos) / sin = cot(a / 2), which is fine at pi too.
        (1.0 - 0.5 * angle * (0.5 * angle).cos() / (0.5 * angle).sin()) / squared
    };
    let m = skew(w);
    Matrix3::identity() - m * 0.5 + m * m * c
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Debug)]
    struct A;
    #[derive(Debug)]
    struct B;
    #[derive(Debug)]
    struct C;

    fn twists(reach: f64) -> impl Strategy<Value = Vector6<f64>> {
        // Angles from far below the series' limit to the reach.
        (prop::array::uniform6(-1.0..1.0), -6.0..0.0f64).prop_filter_map("a direction", move |(d, exponent)| {
            let d = Vector6::from(d);
            let w = d.fixed_rows::<3>(0).try_normalize(1e-3)? * (reach * 10f64.powf(exponent));
            Some(Vector6::new(w.x, w.y, w.z, d[3], d[4], d[5]))
        })
    }

    fn numbers<X, Y>(m: &Se3<X, Y>) -> Matrix3x4<f64> {
        m.matrix()
    }

    proptest! {
        // proptest prints the failing case and keeps its seed.
        #[test]
        fn log_inverts_exp(twist in twists(3.1)) {
            let back = Se3::<A, B>::exp(&twist).log();
            // Near pi the axis is known to the square root of the rounding.
            prop_assert!((back - twist).norm() < 1e-9, "{} {}", back, twist);
        }

        #[test]
        fn exp_inverts_log_and_inverse_negates(a in twists(3.0)) {
            let m = Se3::<A, B>::exp(&a);
            prop_assert!((numbers(&Se3::<A, B>::exp(&m.log())) - numbers(&m)).norm() < 1e-11);
            prop_assert!((numbers(&Se3::<B, A>::exp(&-a)) - numbers(&m.inverse())).norm() < 1e-12);
        }

        #[test]
        fn twists_of_one_axis_add(a in twists(1.5)) {
            let m: Se3<A, A> = Se3::exp(&a);
            prop_assert!((numbers(&(m * m)) - numbers(&Se3::<A, A>::exp(&(a * 2.0)))).norm() < 1e-12);
        }

        #[test]
        fn the_adjoint_moves_a_twist_across(a in twists(3.0), x in twists(2.0)) {
            let m: Se3<A, B> = Se3::exp(&a);
            let right = m * Se3::<B, B>::exp(&x);
            let left = Se3::<A, A>::exp(&(m.adjoint() * x)) * m;
            prop_assert!((numbers(&right) - numbers(&left)).norm() < 1e-11);
        }

        #[test]
        fn neighbours_cancel(a in twists(3.0), b in twists(3.0)) {
            let (ab, bc): (Se3<A, B>, Se3<B, C>) = (Se3::exp(&a), Se3::exp(&b));
            let p = Vector3::new(0.3, -1.0, 2.0);
            prop_assert!(((ab * bc).transform(&p) - ab.transform(&bc.transform(&p))).norm() < 1e-13);
            prop_assert!((ab.inverse().transform(&ab.transform(&p)) - p).norm() < 1e-13);
            prop_assert!((numbers(&(ab * ab.inverse())) - numbers(&Se3::<A, A>::identity())).norm() < 1e-13);
        }

        #[test]
        fn perturb_left_is_exp_to_first_order(a in twists(3.0), x in twists(1.0)) {
            let m: Se3<A, B> = Se3::exp(&a);
            let x = x * 1e-5;
            let bent = Se3::<A, A>::exp(&x) * m;
            prop_assert!((numbers(&m.perturb_left(&x)) - numbers(&bent)).norm() < 1e-9);
            // Decoupled: the numbers of the step are the step's.
            let step = Se3::<A, A>::identity().perturb_left(&x);
            prop_assert!((step.translation - x.fixed_rows::<3>(3)).norm() < 1e-18);
        }
    }
}
