//! Moving the parts of a map by similarities of their own, as a closed loop does: each keyframe by its own, each landmark with a keyframe.

use nalgebra::Vector3;

use super::{KeyframeId, Landmark, Map};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;

/// How the surroundings of each keyframe move, `x_new = new_from_old x_old`; of those that are not named, as the last one.
#[derive(Debug, Clone, Default)]
pub struct Correction {
    /// Ascending id.
    pub keyframes: Vec<(KeyframeId, Sim3<World, World>)>,
    /// Of keyframes that are younger than all of these.
    pub younger: Option<Sim3<World, World>>,
}

impl Correction {
    /// How the surroundings of a keyframe move.
    pub fn of(&self, keyframe: KeyframeId) -> Sim3<World, World> {
        match self.keyframes.binary_search_by_key(&keyframe, |k| k.0) {
            Ok(i) => self.keyframes[i].1,
            Err(i) if i == self.keyframes.len() => self.younger.unwrap_or_else(Sim3::identity),
            // It went, and its neighbours tell.
            Err(i) => self.keyframes[i].1,
        }
    }

    /// A camera whose surroundings move so is there.
    pub fn placed(camera_from_world: &Se3<Camera, World>, new_from_old: &Sim3<World, World>) -> Se3<Camera, World> {
        (new_from_old.rigid() * camera_from_world.inverse().rescaled(new_from_old.scale)).inverse()
    }

    /// The keyframe that a landmark moves with: the one that it was made at, else the last of those that observe it.
    fn anchor(landmark: &Landmark) -> KeyframeId {
        let made_at = landmark.observers.binary_search(&landmark.created_by).is_ok();
        landmark.observers.last().copied().filter(|_| !made_at).unwrap_or(landmark.created_by)
    }
}

impl Map {
    /// Moves every keyframe and every landmark; lengths that belong to one are scaled with it. Links stay as they are.
    pub fn correct(&mut self, correction: &Correction) {
        for (id, k) in self.keyframes.iter_mut() {
            let new_from_old = correction.of(KeyframeId(id));
            k.camera_from_world = Correction::placed(&k.camera_from_world, &new_from_old);
            if let Some(motion) = &mut k.motion {
                motion.shift *= new_from_old.scale;
            }
        }
        for (_, l) in self.landmarks.iter_mut() {
            let new_from_old = correction.of(Correction::anchor(l));
            let (scale, turn) = (new_from_old.scale, new_from_old.rotation.to_rotation_matrix());
            let position: Vector3<f64> = new_from_old.transform(&l.position);
            l.position = position;
            l.covariance = turn * l.covariance * turn.transpose() * (scale * scale);
            if let Some(assumed) = &mut l.assumed {
                assumed.inverse /= scale;
                assumed.sigma /= scale;
            }
        }
        self.revision += 1;
    }
}
