//! What moves with a time of its own: the occluder before the lens, people in the room.
//!
//! Input: a time, the camera's pose then. Output: faces in camera coordinates, drawn where they are nearer than what stands still.

use super::cull::View;
use super::occluder::Occluder;
use super::people::People;
use super::scene::Quad;
use super::texture::Texture;
use crate::camera::simulator_config::SimulatorConfig;
use crate::geometry::CameraModel;

/// Everything that moves.
#[derive(Debug)]
pub(super) struct Actors {
    occluder: Option<Occluder>,
    people: Option<People>,
}

impl Actors {
    /// `None`: nothing does.
    pub(super) fn new(config: &SimulatorConfig, camera: &CameraModel) -> Option<Self> {
        let occluder = config.occluder.enabled.then(|| Occluder::new(config, camera));
        let people = config.people.enabled.then(|| People::new(config));
        (occluder.is_some() || people.is_some()).then_some(Self { occluder, people })
    }

    /// Faces at `time_s` as the camera at `view` has them before it; always the same number, in the same order.
    pub(super) fn quads(&self, time_s: f64, view: &View) -> Vec<Quad> {
        let mut quads = Vec::new();
        if let Some(people) = &self.people {
            people.add_quads(time_s, 0, &mut quads);
            for quad in &mut quads {
                quad.origin = view.rotation.tr_mul(&(quad.origin - view.position));
                for axis in [&mut quad.right, &mut quad.down, &mut quad.away] {
                    *axis = view.rotation.tr_mul(axis);
                }
            }
        }
        if let Some(occluder) = &self.occluder {
            quads.extend(occluder.quads(time_s, self.people.as_ref().map_or(0, |p| p.textures().len())));
        }
        quads
    }

    /// Texture of a face's number, see [`Quad::texture`].
    pub(super) fn texture(&self, index: usize) -> Option<&Texture> {
        let people = self.people.as_ref().map_or(&[][..], People::textures);
        let occluder = self.occluder.as_ref().map_or(&[][..], Occluder::textures);
        people.iter().chain(occluder).nth(index)
    }

    /// Fastest movement through the room, m/s: how much farther than the camera's own movement faces may get. (The occluder's faces
    /// are large beside what it moves in an exposure.)
    pub(super) fn fastest_m_s(&self) -> f64 {
        self.people.as_ref().map_or(0.0, People::fastest_m_s)
    }
}
