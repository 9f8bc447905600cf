//! Similarities whose type carries both frames: `x_to = scale * rotation * x_from + translation`.
//!
//! A monocular map has no scale of its own; two parts of it are related by seven numbers, not six. Used by loop closing
//! and by the evaluation of trajectories. Composition and inverse as for [`Se3`]; a seven-number tangent
//! `[rotation (rad), translation, log scale]` that acts on the left, decoupled.

use std::marker::PhantomData;
use std::ops::Mul;

use nalgebra::{SVector, UnitQuaternion, Vector3};

use super::Se3;

/// Similarity between two frames.
pub struct Sim3<To, From> {
    /// Unit of `From` in units of `To`; positive.
    pub scale: f64,
    pub rotation: UnitQuaternion<f64>,
    /// Origin of `From`, in `To`'s coordinates and unit.
    pub translation: Vector3<f64>,
    frames: PhantomData<fn() -> (To, From)>,
}

impl<A, B> Clone for Sim3<A, B> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<A, B> Copy for Sim3<A, B> {}
impl<A, B> PartialEq for Sim3<A, B> {
    fn eq(&self, other: &Self) -> bool {
        self.scale == other.scale && self.rotation == other.rotation && self.translation == other.translation
    }
}
impl<A, B> std::fmt::Debug for Sim3<A, B> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (q, t) = (self.rotation.coords, self.translation);
        let s = self.scale;
        write!(f, "Sim3 {{ s: {s}, t: [{}, {}, {}], q_xyzw: [{}, {}, {}, {}] }}", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
    }
}

impl<To, From> Sim3<To, From> {
    /// From its parts.
    pub fn new(scale: f64, rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { scale, rotation, translation, frames: PhantomData }
    }

    /// A rigid motion: scale one.
    pub fn from_se3(motion: &Se3<To, From>) -> Self {
        Self::new(1.0, motion.rotation, motion.translation)
    }

    /// Both frames and units coincide.
    pub fn identity() -> Self {
        Self::new(1.0, UnitQuaternion::identity(), Vector3::zeros())
    }

    /// The inverse similarity.
    pub fn inverse(&self) -> Sim3<From, To> {
        let (r, s) = (self.rotation.inverse(), 1.0 / self.scale);
        Sim3::new(s, r, -(r * self.translation) * s)
    }

    /// A point of `From` in `To`'s coordinates.
    #[inline]
    pub fn transform(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point * self.scale + self.translation
    }

    /// The rigid motion between the frames when both lengths are measured in `To`'s unit.
    pub fn rigid(&self) -> Se3<To, From> {
        Se3::new(self.rotation, self.translation)
    }

    /// Decoupled left perturbation `[w, v, l]`: `x' = exp(l) exp(w) x + v` after this similarity.
    pub fn perturb_left(&self, delta: &SVector<f64, 7>) -> Self {
        let dr = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned());
        let mut rotation = dr * self.rotation;
        rotation.renormalize_fast();
        let ds = delta[6].exp();
        Self::new(self.scale * ds, rotation, dr * self.translation * ds + delta.fixed_rows::<3>(3))
    }

    /// The `[w, v, l]` that [`Sim3::perturb_left`] would need to make this similarity of the identity.
    pub fn tangent(&self) -> SVector<f64, 7> {
        let mut delta = SVector::<f64, 7>::zeros();
        delta.fixed_rows_mut::<3>(0).copy_from(&self.rotation.scaled_axis());
        delta.fixed_rows_mut::<3>(3).copy_from(&self.translation);
        delta[6] = self.scale.ln();
        delta
    }

    /// All numbers finite and the scale positive.
    pub fn is_valid(&self) -> bool {
        self.scale > 0.0 && self.scale.is_finite() && self.rigid().is_finite()
    }
}

impl<A, B, C> Mul<Sim3<B, C>> for Sim3<A, B> {
    type Output = Sim3<A, C>;
    fn mul(self, rhs: Sim3<B, C>) -> Sim3<A, C> {
        let mut rotation = self.rotation * rhs.rotation;
        rotation.renormalize_fast();
        Sim3::new(self.scale * rhs.scale, rotation, self.transform(&rhs.translation))
    }
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::random_rotation;
    use super::*;

    struct A;
    struct B;
    struct C;

    fn random<T, F>(r: &mut Random) -> Sim3<T, F> {
        let t = Vector3::new(r.normal(), r.normal(), r.normal());
        Sim3::new(r.uniform(0.2, 4.0), random_rotation(r, 3.0), t)
    }

    #[test]
    fn products_inverses_and_tangents_agree_with_points() {
        for seed in 0..100 {
            let mut r = Random::new(seed);
            let (ab, bc): (Sim3<A, B>, Sim3<B, C>) = (random(&mut r), random(&mut r));
            let p = Vector3::new(r.normal(), r.normal(), r.normal());
            let tolerance = 1e-13 * 50.0;
            assert!(((ab * bc).transform(&p) - ab.transform(&bc.transform(&p))).norm() < tolerance, "seed {seed}");
            assert!((ab.inverse().transform(&ab.transform(&p)) - p).norm() < tolerance, "seed {seed}");
            let back = Sim3::<A, B>::identity().perturb_left(&ab.tangent());
            assert!((back.transform(&p) - ab.transform(&p)).norm() < tolerance, "seed {seed}");
            let delta = SVector::<f64, 7>::from_fn(|_, _| 0.1 * r.normal());
            let step = Sim3::<A, A>::identity().perturb_left(&delta);
            assert!(((step * ab).transform(&p) - ab.perturb_left(&delta).transform(&p)).norm() < tolerance);
        }
    }
}
