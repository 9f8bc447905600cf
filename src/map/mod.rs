//! Keyframes, landmarks and their covisibility. Knows no threads.
//!
//! One owner (reconstruction's thread) reads and writes it; mapping jobs work on copies of parts of it. World = the
//! optical axes of the map's first keyframe; lengths are map units.

pub mod away;
pub mod colmap;
mod consistency;
mod correction;
pub mod export;
pub mod graph;
mod landmark;
mod numbers;
pub mod observations;
mod part;
pub mod picture;
pub mod reduction;
pub mod remade;
pub mod saved;
pub mod scale;
mod snapshot;
pub mod store;
pub mod view;

use std::collections::BTreeSet;
use std::sync::Arc;

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::features::descriptor::Descriptor;
use crate::features::thumbnail::Thumbnail;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;
use crate::geometry::{CameraModel, Se3};
pub use correction::Correction;
pub use landmark::{AssumedDistance, Landmark};
pub use numbers::Numbers;
use observations::Observations;
pub use observations::{LandmarkId, Observation};
use picture::KeyframePicture;
pub use snapshot::{Around, KeyframeView, LandmarkView, MapSnapshot, largest_sigma};
use store::Store;

/// A keyframe of a map; never reused within a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct KeyframeId(pub u32);

/// A connected map; a new one begins after every re-initialisation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct MapId(pub u32);

/// A turn on the spot of a map, from which on lengths are those of an assumed distance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TurnId(pub u16);

/// A corner of a keyframe that is no landmark yet.
#[derive(Debug, Clone, Copy)]
pub struct FreeCorner {
    /// Level-0 pixel, distorted as in the picture.
    pub pixel: Vector2<f32>,
    /// The same, undistorted, on the plane z = 1.
    pub normalised: Vector2<f64>,
    pub descriptor: Descriptor,
}

/// A frame that the map keeps, with its picture.
#[derive(Debug, Clone)]
pub struct Keyframe {
    /// Sequence number of the frame.
    pub sequence: u64,
    pub timestamp_ns: i64,
    /// The map that it was made in; it may have been joined to another since.
    pub map: MapId,
    pub camera_from_world: Se3<Camera, World>,
    /// How the camera moved then, if that is known.
    pub motion: Option<CameraMotion>,
    /// Templates of its observations are cut from here.
    pub picture: KeyframePicture,
    /// For relocalisation; of a condensed keyframe it is made from the picture when it is needed.
    pub thumbnail: Thumbnail,
    /// The last turn that its scale came through; `None`: its scale is that of the map's start.
    pub scale_from: Option<TurnId>,
    /// Packed once the picture is condensed.
    pub observations: Observations,
    /// Keyframes that share landmarks with this one and how many; ascending id.
    pub covisible: Vec<(KeyframeId, u32)>,
    /// Corners that may become landmarks once a later keyframe sees them, too.
    pub corners: Vec<FreeCorner>,
}

impl Keyframe {
    /// Optical centre in the world.
    pub fn centre(&self) -> Vector3<f64> {
        self.camera_from_world.inverse().translation
    }

    /// This keyframe's observation of `landmark`.
    pub fn observation(&self, landmark: LandmarkId) -> Option<Observation> {
        self.observations.get(landmark)
    }
}

/// Keyframes and landmarks of the current map.
#[derive(Default)]
pub struct Map {
    pub keyframes: Store<Keyframe>,
    pub landmarks: Store<Landmark>,
    /// Grows with every change that is worth publishing.
    pub revision: u64,
    /// Which keyframes are this run's.
    pub numbers: Numbers,
    /// Keyframes whose pictures are not condensed.
    detailed: BTreeSet<KeyframeId>,
    /// Keyframes whose pictures are condensed and here, not elsewhere.
    condensed_here: BTreeSet<KeyframeId>,
    /// Keyframes whose pictures are elsewhere.
    away: BTreeSet<KeyframeId>,
    /// What observations were packed by last: they share it.
    lens: Option<Arc<CameraModel>>,
}

impl Map {
    pub fn keyframe(&self, id: KeyframeId) -> Option<&Keyframe> {
        self.keyframes.get(id.0)
    }

    pub fn landmark(&self, id: LandmarkId) -> Option<&Landmark> {
        self.landmarks.get(id.0)
    }

    /// Adds a keyframe; its observations are linked into the landmarks and the covisibility of both sides is counted.
    pub fn add_keyframe(&mut self, mut keyframe: Keyframe) -> KeyframeId {
        let landmarks = &self.landmarks;
        keyframe.observations.retain(|landmark| landmarks.get(landmark.0).is_some());
        keyframe.covisible.clear();
        let seen: Vec<LandmarkId> = keyframe.observations.landmarks().collect();
        let id = KeyframeId(self.keyframes.insert(keyframe));
        self.detailed.insert(id);
        for landmark in seen {
            self.link(id, landmark);
        }
        self.revision += 1;
        id
    }

    /// Gives a keyframe its free corners.
    pub fn set_corners(&mut self, keyframe: KeyframeId, corners: Vec<FreeCorner>) {
        if let Some(k) = self.keyframes.get_mut(keyframe.0) {
            k.corners = corners;
        }
    }

    /// Takes corners (by index) away from a keyframe: they are landmarks now.
    pub fn drop_corners(&mut self, keyframe: KeyframeId, used: &mut [usize]) {
        used.sort_unstable();
        if let Some(k) = self.keyframes.get_mut(keyframe.0) {
            for &i in used.iter().rev() {
                k.corners.swap_remove(i);
            }
        }
    }

    /// Adds a landmark seen by the given keyframes.
    pub fn add_landmark(&mut self, mut landmark: Landmark, observations: &[(KeyframeId, Observation)]) -> LandmarkId {
        landmark.observers.clear();
        let id = LandmarkId(self.landmarks.insert(landmark));
        for &(keyframe, observation) in observations {
            self.add_observation(keyframe, Observation { landmark: id, ..observation });
        }
        self.revision += 1;
        id
    }

    /// Adds one observation to a keyframe that is in the map. Replaces nothing: a second one of the same landmark is ignored.
    pub fn add_observation(&mut self, keyframe_id: KeyframeId, observation: Observation) {
        if self.landmarks.get(observation.landmark.0).is_none() {
            return;
        }
        let Some(keyframe) = self.keyframes.get_mut(keyframe_id.0) else { return };
        if keyframe.observations.insert(observation) {
            self.link(keyframe_id, observation.landmark);
        }
    }

    /// Enters `keyframe` among the observers of `landmark` and counts covisibility with the others.
    fn link(&mut self, keyframe: KeyframeId, landmark: LandmarkId) {
        let Some(entry) = self.landmarks.get_mut(landmark.0) else { return };
        let Err(i) = entry.observers.binary_search(&keyframe) else { return };
        for &other in &entry.observers {
            change_covisibility(&mut self.keyframes, keyframe, other, 1);
        }
        entry.observers.insert(i, keyframe);
    }

    /// Takes one observation away; a landmark left with fewer than two observers, or with none that shows it, goes as well.
    pub fn remove_observation(&mut self, keyframe: KeyframeId, landmark: LandmarkId) {
        let Some(entry) = self.landmarks.get_mut(landmark.0) else { return };
        let Ok(i) = entry.observers.binary_search(&keyframe) else { return };
        let from_next = (i == 0).then(|| assumed_from_next(&self.keyframes, entry)).flatten();
        entry.observers.remove(i);
        entry.assumed = from_next.or(entry.assumed);
        for &other in &entry.observers {
            change_covisibility(&mut self.keyframes, keyframe, other, -1);
        }
        if let Some(k) = self.keyframes.get_mut(keyframe.0)
            && k.observations.remove(landmark)
        {
            k.picture.forget(landmark.0);
        }
        if self.landmarks.get(landmark.0).is_some_and(|l| l.observers.len() < 2 || self.is_hidden(landmark, l)) {
            self.remove_landmark(landmark);
        }
        self.revision += 1;
    }

    /// Takes a landmark and all of its observations away.
    pub fn remove_landmark(&mut self, landmark: LandmarkId) {
        let Some(entry) = self.landmarks.remove(landmark.0) else { return };
        for (n, &a) in entry.observers.iter().enumerate() {
            if let Some(k) = self.keyframes.get_mut(a.0)
                && k.observations.remove(landmark)
            {
                k.picture.forget(landmark.0);
            }
            for &b in &entry.observers[n + 1..] {
                change_covisibility(&mut self.keyframes, a, b, -1);
            }
        }
        self.revision += 1;
    }

    /// Takes a keyframe away; landmarks left with fewer than two observers, or with none that shows them, go as well.
    pub fn remove_keyframe(&mut self, id: KeyframeId) -> Option<Keyframe> {
        let landmarks: Vec<LandmarkId> = self.keyframe(id)?.observations.landmarks().collect();
        for landmark in landmarks {
            self.remove_observation(id, landmark);
        }
        self.revision += 1;
        self.detailed.remove(&id);
        self.condensed_here.remove(&id);
        self.away.remove(&id);
        self.keyframes.remove(id.0)
    }

    /// Covisible keyframes with at least `minimum` shared landmarks, strongest first (ties: newer first), into `out`.
    pub fn covisible(&self, id: KeyframeId, minimum: u32, limit: usize, out: &mut Vec<(KeyframeId, u32)>) {
        out.clear();
        let Some(keyframe) = self.keyframe(id) else { return };
        out.extend(keyframe.covisible.iter().filter(|c| c.1 >= minimum));
        out.sort_unstable_by(|a, b| b.1.cmp(&a.1).then(b.0.cmp(&a.0)));
        out.truncate(limit);
    }

    /// A keyframe is there instead.
    pub fn place_keyframe(&mut self, keyframe: KeyframeId, camera_from_world: Se3<Camera, World>) {
        if let Some(k) = self.keyframes.get_mut(keyframe.0) {
            k.camera_from_world = camera_from_world;
        }
    }

    /// The scale of a keyframe's place came through a turn.
    pub fn set_scale_origin(&mut self, keyframe: KeyframeId, turn: Option<TurnId>) {
        if let Some(k) = self.keyframes.get_mut(keyframe.0) {
            k.scale_from = turn;
        }
    }

    /// The frame that a keyframe was made of, and the map that it was made in.
    pub fn set_frame(&mut self, keyframe: KeyframeId, map: MapId, sequence: u64, timestamp_ns: i64) {
        if let Some(k) = self.keyframes.get_mut(keyframe.0) {
            (k.map, k.sequence, k.timestamp_ns) = (map, sequence, timestamp_ns);
        }
    }

    /// How the camera moved at a keyframe, and how a rolling shutter displaced what it saw (by the landmark in camera
    /// coordinates and the observation; what lies behind the camera keeps what it had).
    pub fn set_motion(
        &mut self,
        keyframe: KeyframeId,
        motion: CameraMotion,
        displacement: impl Fn(&Vector3<f64>, &Observation) -> Vector2<f64>,
    ) {
        let Some(k) = self.keyframes.get_mut(keyframe.0) else { return };
        k.motion = Some(motion);
        let (pose, landmarks) = (k.camera_from_world, &self.landmarks);
        k.observations.displace(|o| {
            let p = pose.transform(&landmarks.get(o.landmark.0)?.position);
            (p.z > 1e-6).then(|| displacement(&p, o))
        });
    }

    /// A landmark is there, as far as is known; what is known of it stays.
    pub fn place_landmark(&mut self, landmark: LandmarkId, position: Vector3<f64>) {
        if let Some(l) = self.landmarks.get_mut(landmark.0) {
            l.position = position;
        }
    }

    /// A landmark of assumed distance is taken to be at `position`, which is so far from its first observer. Nothing where it has been measured.
    pub fn assume_distance(&mut self, landmark: LandmarkId, position: Vector3<f64>, assumed: AssumedDistance) {
        if let Some(l) = self.landmarks.get_mut(landmark.0).filter(|l| l.assumed.is_some()) {
            (l.position, l.assumed) = (position, Some(assumed));
        }
    }

    /// A landmark was measured: its distance is no assumption any more.
    pub fn measure_landmark(&mut self, landmark: LandmarkId, position: Vector3<f64>, covariance: Matrix3<f64>) {
        if let Some(l) = self.landmarks.get_mut(landmark.0) {
            (l.position, l.covariance, l.assumed) = (position, covariance, None);
        }
    }

    /// A keyframe's observation of a landmark that it observes already is this one.
    pub fn replace_observation(&mut self, keyframe: KeyframeId, observation: Observation) {
        if let Some(k) = self.keyframes.get_mut(keyframe.0) {
            k.observations.replace(observation);
        }
    }

    /// Carries along what was added since these were the next ids, as an adjustment has moved its surroundings.
    pub fn carry_newer(&mut self, next_keyframe: u32, next_landmark: u32, old_from_new: &Se3<World, World>) {
        // By id: whatever is handed out to be changed is written to the map's file anew.
        for id in next_keyframe..self.keyframes.next_id() {
            let Some(k) = self.keyframes.get_mut(id) else { continue };
            k.camera_from_world = k.camera_from_world * *old_from_new;
        }
        let new_from_old = old_from_new.inverse();
        for id in next_landmark..self.landmarks.next_id() {
            let Some(l) = self.landmarks.get_mut(id) else { continue };
            l.position = new_from_old.transform(&l.position);
        }
    }

    /// Counts that a landmark was looked for in a frame, and whether it was found there. By itself no reason to write it to a file anew.
    pub fn count_sighting(&mut self, landmark: LandmarkId, found: bool) {
        if let Some(l) = self.landmarks.get_mut_unnoticed(landmark.0) {
            l.count(found);
        }
    }

    /// Landmarks that may have changed in any way since the last call, sightings among them, ascending.
    pub fn take_touched_landmarks(&mut self) -> Vec<LandmarkId> {
        self.landmarks.take_touched().into_iter().map(LandmarkId).collect()
    }

    /// The newest keyframe of this run.
    pub fn newest(&self) -> Option<KeyframeId> {
        let mut end = self.keyframes.next_id();
        loop {
            end = self.keyframes.last_before(end)?;
            if !self.numbers.is_merged(KeyframeId(end)) {
                return Some(KeyframeId(end));
            }
        }
    }

    /// An empty map whose ids go on after this one's, so that both can be joined later.
    pub fn successor(&self) -> Self {
        Self {
            keyframes: self.keyframes.successor(),
            landmarks: self.landmarks.successor(),
            revision: self.revision + 1,
            numbers: self.numbers.clone(),
            ..Self::default()
        }
    }

    /// Moves and scales everything: `x_new = new_from_old x_old`.
    pub fn transform(&mut self, new_from_old: &Sim3<World, World>) {
        self.correct(&Correction { keyframes: Vec::new(), younger: Some(*new_from_old) });
    }

    /// Keyframes that were made in one map were made in the other: it has another number now.
    pub fn renumber(&mut self, map: MapId, now: MapId) {
        self.keyframes.iter_mut().filter(|(_, k)| k.map == map).for_each(|(_, k)| k.map = now);
    }

    /// Takes over another map's keyframes and landmarks, which lie in the same frame and unit and have ids of their own
    /// ([`successor`](Self::successor)).
    pub fn absorb(&mut self, other: Self) {
        self.keyframes.absorb(other.keyframes);
        self.landmarks.absorb(other.landmarks);
        self.detailed.extend(other.detailed);
        self.condensed_here.extend(other.condensed_here);
        self.away.extend(other.away);
        self.numbers.absorb(other.numbers);
        self.revision = self.revision.max(other.revision) + 1;
    }

    /// Two landmarks are one: all that `gone` was seen in now saw `kept`, and where both were seen the observation of `kept` stays.
    pub fn fuse(&mut self, kept: LandmarkId, gone: LandmarkId) {
        let Some(entry) = self.landmark(gone).filter(|_| kept != gone) else { return };
        let seen: Vec<(KeyframeId, Observation)> =
            entry.observers.iter().filter_map(|&k| Some((k, self.keyframe(k)?.observation(gone)?))).collect();
        for (keyframe, _) in &seen {
            if let Some(k) = self.keyframes.get_mut(keyframe.0) {
                k.picture.rename(gone.0, kept.0);
            }
        }
        self.remove_landmark(gone);
        for (keyframe, observation) in seen {
            self.add_observation(keyframe, Observation { landmark: kept, ..observation });
        }
        self.revision += 1;
    }

    /// Undistorts all observations and free corners by a camera model of the same pictures, where another one has done so.
    pub fn undistort_anew(&mut self, camera: &CameraModel) {
        let lens = Arc::new(camera.clone());
        self.lens = Some(lens.clone());
        let by_another = |(id, k): (u32, &Keyframe)| (!k.observations.are_undistorted_by(&lens)).then_some(id);
        // Only what changes is written to the map's file anew.
        for id in self.keyframes.iter().filter_map(by_another).collect::<Vec<_>>() {
            let Some(keyframe) = self.keyframes.get_mut(id) else { continue };
            keyframe.observations.undistort_anew(&lens);
            for corner in &mut keyframe.corners {
                corner.normalised = camera.undistort(&corner.pixel.cast()).unwrap_or(corner.normalised);
            }
        }
    }

    /// Forgets everything; ids go on.
    pub fn clear(&mut self) {
        self.keyframes.clear();
        self.landmarks.clear();
        self.detailed.clear();
        self.condensed_here.clear();
        self.away.clear();
        self.revision += 1;
    }
}

/// One more for a keyframe; `votes` by ascending id.
pub fn vote(votes: &mut Vec<(KeyframeId, u32)>, keyframe: KeyframeId) {
    match votes.binary_search_by_key(&keyframe, |v| v.0) {
        Ok(i) => votes[i].1 += 1,
        Err(i) => votes.insert(i, (keyframe, 1)),
    }
}

/// The distance that is assumed of a landmark as the second of its observers has it, from which it counts once the first one is gone.
fn assumed_from_next(keyframes: &Store<Keyframe>, landmark: &Landmark) -> Option<AssumedDistance> {
    let AssumedDistance { inverse, sigma } = landmark.assumed?;
    let [first, next, ..] = landmark.observers[..] else { return None };
    let (first, next) = (keyframes.get(first.0)?.centre(), keyframes.get(next.0)?.centre());
    let ray = (landmark.position - first).try_normalize(f64::MIN_POSITIVE)?;
    let from_next = (first + ray / inverse - next).norm().recip();
    let sigma = sigma * (from_next / inverse);
    (from_next > 0.0 && sigma.is_finite()).then_some(AssumedDistance { inverse: from_next, sigma })
}

fn change_covisibility(keyframes: &mut Store<Keyframe>, a: KeyframeId, b: KeyframeId, by: i32) {
    for (one, other) in [(a, b), (b, a)] {
        // Follows from the observations: no file keeps it.
        let Some(keyframe) = keyframes.get_mut_unnoticed(one.0) else { continue };
        match keyframe.covisible.binary_search_by_key(&other, |c| c.0) {
            Ok(i) => {
                let n = keyframe.covisible[i].1 as i32 + by;
                if n <= 0 {
                    keyframe.covisible.remove(i);
                } else {
                    keyframe.covisible[i].1 = n as u32;
                }
            }
            Err(i) if by > 0 => keyframe.covisible.insert(i, (other, by as u32)),
            Err(_) => {}
        }
    }
}

#[cfg(test)]
mod condensing_tests;
#[cfg(test)]
pub mod examples;
#[cfg(test)]
mod tests;
