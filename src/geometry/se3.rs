//! Rigid motions whose type carries both frames.
//!
//! `a_from_b: Se3<A, B>` maps coordinates in `B` to coordinates in `A`; neighbours cancel in a product:
//! `a_from_b * b_from_c` is a `Se3<A, C>`. Nothing else composes.

use std::marker::PhantomData;
use std::ops::Mul;

use nalgebra::{Matrix3, Matrix3x4, UnitQuaternion, Vector3, Vector6};

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

    /// Decoupled left perturbation, tangent `[rotation (rad), translation]` in `To`'s axes:
    /// `R' = exp(w) R`, `t' = t + v`... applied as `x' = exp(w) (R x + t) + v`.
    pub fn perturb_left(&self, delta: &Vector6<f64>) -> Self {
        let dr = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned());
        let mut rotation = dr * self.rotation;
        rotation.renormalize_fast();
        Self::new(rotation, dr * self.translation + delta.fixed_rows::<3>(3))
    }

    /// All numbers finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.coords.iter().chain(self.translation.iter()).all(|v| v.is_finite())
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
