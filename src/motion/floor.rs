//! The scale of the map by the camera's height above the floor, and how the camera really sits above that.
//!
//! Keyframe (its map, and the way so far) -> [`Floor::see`] -> ln(metres per map unit) with its standard deviation. [`plane`] finds the floor among
//! the landmarks that the newest keyframes see, and says why it does not. Believed is what several keyframes in a row tell alike
//! (`ASKED`), once the camera was driven over it; a word is given again once half of the keyframes asked are new, so that words share little but
//! what adjustments made of them: once the map is metric they hold its floor ([`Floor::driven`]). What is wrong with the measured height (`camera_height_sigma_m`) is in all of them
//! ([`Floor::common_sigma`]).
//!
//! Cost: at keyframes only, after the pose was published: 2 to 4 ms, and some 5 to look at the landmarks, here and where it is held. Bounded: the newest `KEYFRAMES` keyframes and `LANDMARKS` landmarks.
//!
//! Behind a turn on the spot whose next step had an assumed length a part of the map begins with a unit of its own: the floor is asked anew there, among
//! that part's keyframes alone, and its word is that part's.
//!
//! Not here: what becomes of the word; obstacles on the floor.

pub mod plane;
pub mod seen;

use nalgebra::{Unit, Vector3};

use super::hand_eye::Robot;
use super::scale::{ScaleFusion, ScaleMeasurement};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::ros_from_optical;
use crate::geometry::sim3::Sim3;
use crate::map::scale::ScaleSource;
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map, MapId, TurnId};
pub use plane::{Driven, FloorPoint, Found, NoFloor, Plane, UpPrior};

/// Keyframes whose landmarks are asked, and landmarks at the most: the newest.
const KEYFRAMES: usize = 40;
const LANDMARKS: usize = 1200;
/// A landmark that fewer keyframes saw may be a mistake.
pub const LEAST_OBSERVERS: usize = 3;
/// So many keyframes in a row must tell heights that differ by less than so many of their sigmas.
const ASKED: usize = 3;
const ALIKE_SIGMAS: f64 = 3.0;
/// New keyframes between two words.
const BETWEEN_WORDS: usize = KEYFRAMES / 2;
/// Standard deviation of roll and pitch of a mount that a person has measured, and of one of which nothing is said: webcams on robots look up
/// or down by some degrees.
const GIVEN_TILT_RAD: f64 = 0.05;
const UNSAID_TILT_RAD: f64 = 0.15;
/// The same of one above a floor that was found: it is so to 0.3 degrees in the simulator, and a robot nods.
const FOUND_TILT_RAD: f64 = 0.02;

/// `[scale]`: what a person has measured of the robot that tells the map's scale.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScaleConfig {
    /// Height of the camera's optical centre above the floor, m. 0 (the floor is not looked for) or 0.03..=3.0.
    pub camera_height_m: f64,
    /// Standard deviation of that, m. 0.0005..=0.1, and less than a tenth of the height.
    pub camera_height_sigma_m: f64,
}

impl Default for ScaleConfig {
    fn default() -> Self {
        Self { camera_height_m: 0.0, camera_height_sigma_m: 0.003 }
    }
}

impl ScaleConfig {
    /// Whether the floor is looked for.
    pub fn is_on(&self) -> bool {
        self.camera_height_m > 0.0
    }

    /// First value out of its range: key, and what is allowed.
    pub fn validate(&self) -> Result<(), (&'static str, String)> {
        let (height, sigma) = (self.camera_height_m, self.camera_height_sigma_m);
        // Written so that NaN fails.
        if !(height == 0.0 || (0.03..=3.0).contains(&height)) {
            return Err(("camera_height_m", "must be 0 (the floor is not looked for) or 0.03 to 3 m".into()));
        }
        if !((0.0005..=0.1).contains(&sigma) && (height == 0.0 || sigma < 0.1 * height)) {
            let reason = "must be 0.0005 to 0.1 m, and less than a tenth of camera_height_m";
            return Err(("camera_height_sigma_m", reason.into()));
        }
        Ok(())
    }
}

/// Roll and pitch of the camera's body above the floor, as in `[mount] rpy_deg`, rad.
pub fn roll_pitch(up_camera: &Unit<Vector3<f64>>) -> (f64, f64) {
    let up = ros_from_optical() * up_camera.into_inner();
    (up.y.atan2(up.z), -up.x.clamp(-1.0, 1.0).asin())
}

/// Where a landmark lies by its pictures alone, the keyframes held: adjustments pull what was once taken for floor to the floor, and it would never be told
/// from it again. `None`: nothing to rest on.
pub type Look<'a> = &'a dyn Fn(LandmarkId) -> Option<FloorPoint>;

/// The floor under a robot, for an adjustment.
#[derive(Debug, Clone, Copy)]
pub struct DrivenFloor<'a> {
    pub plane: Plane,
    /// Of cameras above it, map units, as all that tells the scale has it together.
    pub height: f64,
    /// What the newest keyframes saw, on the floor or not.
    pub landmarks: &'a [LandmarkId],
}

/// What is known of the floor.
#[derive(Debug, Clone)]
pub struct Floor {
    config: ScaleConfig,
    prior: UpPrior,
    /// Of this map are the rest, and of this part of it.
    map: MapId,
    part: Option<TurnId>,
    /// What the newest keyframes told, in the present unit; at most `ASKED`.
    told: Vec<Plane>,
    /// The last that was believed.
    believed: Option<Plane>,
    /// The floor's normal in the camera's axes, as it was found in this map.
    up_found: Option<Unit<Vector3<f64>>>,
    /// Why the newest keyframe told none.
    refused: Option<NoFloor>,
    /// Keyframes since the last word; `None`: there was none.
    since_word: Option<usize>,
    /// Made anew at each keyframe: the landmarks that it asked, the newest first.
    landmarks: Vec<LandmarkId>,
    points: Vec<FloorPoint>,
}

impl Floor {
    /// `None` where it is not to be looked for. `base`: how the camera sits on the robot, as far as that is said.
    pub fn new(config: &ScaleConfig, base: &Robot) -> Option<Self> {
        let up_camera = Unit::new_normalize(base.base_from_camera.inverse() * Vector3::z());
        let said = base.sigma[..2].iter().all(|sigma| *sigma < GIVEN_TILT_RAD);
        let sigma_rad = if said { GIVEN_TILT_RAD } else { UNSAID_TILT_RAD };
        config.is_on().then(|| Self {
            config: *config,
            prior: UpPrior { up_camera, sigma_rad },
            map: MapId::default(),
            part: None,
            told: Vec::with_capacity(ASKED + 1),
            believed: None,
            up_found: None,
            refused: None,
            since_word: None,
            landmarks: Vec::new(),
            points: Vec::new(),
        })
    }

    /// Asks a new keyframe; a word on the map's scale, if there is a new one.
    pub fn see(&mut self, map: &Map, id: MapId, newest: KeyframeId, look: Look<'_>) -> Option<ScaleMeasurement> {
        let part = map.keyframe(newest)?.scale_from;
        if (self.map, self.part) != (id, part) {
            // The robot has not left the floor by turning on it.
            let up_found = self.up_found.filter(|_| self.map == id);
            self.forget();
            (self.map, self.part, self.up_found) = (id, part, up_found);
        }
        self.since_word = self.since_word.map(|n| n + 1);
        // Behind a turn a floor that was found is still there, and the camera sits as it did.
        let (prior, least) = match self.up_found.filter(|_| part.is_some()) {
            Some(up_camera) => (UpPrior { up_camera, sigma_rad: FOUND_TILT_RAD }, Driven::AGAIN),
            None => (self.prior, Driven::FIRST),
        };
        let found = self.look(map, newest, &prior, look);
        let driven_over = found.and_then(|found| found.driven_over(&least));
        self.refused = driven_over.err();
        let Ok(Found { plane, .. }) = found else {
            self.told.clear();
            return None;
        };
        self.told.push(plane);
        if self.told.len() > ASKED {
            self.told.remove(0);
        }
        let alike =
            |told: &Plane| (told.height / plane.height).ln().abs() <= ALIKE_SIGMAS * told.sigma.hypot(plane.sigma);
        if !self.told.iter().all(alike) {
            self.told.drain(..self.told.len() - 1);
            return None;
        }
        if self.told.len() < ASKED || driven_over.is_err() {
            return None;
        }
        self.believed = Some(plane);
        self.up_found = Some(plane.up_camera);
        if self.since_word.is_some_and(|n| n < BETWEEN_WORDS) {
            return None;
        }
        self.since_word = Some(0);
        let log_metres_per_unit = (self.config.camera_height_m / plane.height).ln();
        Some(ScaleMeasurement { source: ScaleSource::Height, log_metres_per_unit, sigma: plane.sigma })
    }

    /// As configured, m.
    pub fn camera_height_m(&self) -> f64 {
        self.config.camera_height_m
    }

    /// What all words share: the measured height's own standard deviation, as a share.
    pub fn common_sigma(&self) -> f64 {
        self.config.camera_height_sigma_m / self.config.camera_height_m
    }

    /// The floor around the newest keyframes of this map, in its unit of now.
    pub fn plane(&self, map: MapId) -> Option<&Plane> {
        self.believed.as_ref().filter(|_| self.map == map)
    }

    /// The floor under `camera` (its centre), for an adjustment of the map's part that tells metres.
    pub fn driven(&self, map: MapId, fusion: &ScaleFusion, camera: &Vector3<f64>) -> Option<DrivenFloor<'_>> {
        let ((log, ..), own) = fusion.fused().zip(fusion.word(ScaleSource::Height))?;
        // Carried, or on a table: not where there is merely little to see.
        let elsewhere = matches!(self.refused, Some(NoFloor::NotParallel(_) | NoFloor::SomethingBeneath(_)));
        let plane = self.plane(map).filter(|plane| self.part.is_none() && !elsewhere && plane.carries(camera))?;
        let height = self.config.camera_height_m * (log - own).exp();
        Some(DrivenFloor { plane: *plane, height, landmarks: &self.landmarks })
    }

    /// Why the newest keyframe told none.
    pub fn refused(&self) -> Option<NoFloor> {
        self.refused
    }

    /// Parts of the map have other names: what is known of the one that was asked last holds on.
    pub fn rename(&mut self, becomes: impl Fn(Option<TurnId>) -> Option<TurnId>) {
        self.part = becomes(self.part);
    }

    /// The map where the robot is was moved by this, as by a loop: the floor with it.
    pub fn follow(&mut self, motion: &Sim3<World, World>) {
        self.told.iter_mut().chain(&mut self.believed).for_each(|plane| plane.follow(motion));
    }

    /// Lengths of the map were multiplied by `factor`, and it has this number now.
    pub fn rescale(&mut self, factor: f64, map: MapId) {
        self.told.iter_mut().chain(&mut self.believed).for_each(|plane| plane.rescale(factor));
        self.map = map;
    }

    /// Nothing is known, as of a map that begins.
    pub fn forget(&mut self) {
        self.told.clear();
        (self.believed, self.up_found, self.refused, self.since_word) = (None, None, None, None);
    }

    fn look(&mut self, map: &Map, newest: KeyframeId, prior: &UpPrior, look: Look<'_>) -> Result<Found, NoFloor> {
        let Some(last) = map.keyframe(newest) else { return Err(NoFloor::FewMetres) };
        // Behind a turn on the spot lengths may be those of an assumption: other ones than before it.
        let recent = |id: &u32| map.keyframe(KeyframeId(*id)).filter(|k| k.scale_from == last.scale_from);
        let lately = map.numbers.below(newest.0 + 1).take(4 * KEYFRAMES + 1);
        let mut keyframes: Vec<&Keyframe> = lately.filter_map(|id| recent(&id)).take(KEYFRAMES).collect();
        keyframes.reverse();
        let mut seen: Vec<LandmarkId> = keyframes.iter().flat_map(|k| k.observations.landmarks()).collect();
        seen.sort_unstable();
        seen.dedup();
        let tells = |id: &LandmarkId| Some((*id, look(*id)?));
        self.landmarks.clear();
        self.points.clear();
        for (id, point) in seen.iter().rev().filter_map(tells).take(LANDMARKS) {
            self.landmarks.push(id);
            self.points.push(point);
        }
        let cameras: Vec<Se3<Camera, World>> = keyframes.iter().map(|k| k.camera_from_world).collect();
        plane::find_floor(&self.points, &cameras, prior, u64::from(newest.0))
    }
}

#[cfg(test)]
mod tests;
