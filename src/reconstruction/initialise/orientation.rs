//! How the camera has turned since the first frame, while there is no map.
//!
//! One frame is the anchor; each later one is turned against it by their common tracks ([`view_turn`]), so that errors do not grow with the
//! frames. When too few tracks are left the newest frame becomes the anchor, and its uncertainty is handed on. With `F` the
//! first frame from the anchor, `R` this frame from the anchor, and right tangents `e` (camera's axes):
//!
//! ```text
//! first_from_camera = F Rᵀ        e = R e_F - w        P = R P_F Rᵀ + P_w        l = R l_F - l_w
//! ```
//!
//! `w` is the left perturbation of `R`; its covariance `P_w` is what noise makes of it, `l_w` what one standard deviation of the focal
//! length and one of each other unknown of the lens do (3x4). A lens that is wrong is so at every anchor, so `l` is added up as it is, a turn back takes it
//! away, and the covariance that is told is `P + l lᵀ`.
//!
//! Where nothing supports a turn (dark, covered, too few tracks, or most of them on something that moves otherwise) there is none, and once
//! the anchor's tracks are gone all that is left is to begin anew: [`OrientationTracker::restarts`] counts that, as orientations before
//! and after have nothing to do with each other. A crowd that fills most of the picture and moves as one is taken for the world.

use nalgebra::{Matrix3, Matrix3x4, UnitQuaternion, Vector2, Vector3};

use super::turn::{MAX_PAIRS, MIN_TRACKS, Pair, TurnState, ViewTurn, view_turn};
use crate::features::FrameFeatures;
use crate::geometry::CameraModel;
use crate::reconstruction::adjust::intrinsics::SupposedLens;
use crate::reconstruction::odometry::LONGEST_STEP_S;
use crate::reconstruction::types::OrientationEstimate;

/// The anchor is given up when less than this share of its tracks is left, or fewer than so many where the newest frame has more.
const FEW_TRACKS: usize = 50;
const FEW_SHARE: f64 = 0.5;
/// A frame with so many times the tracks that it has in common with the anchor is worth becoming the anchor.
const OUTGROWN: f64 = 1.2;
/// What all tracks of two frames share in drift of the flow, readout and lens, rad: 0.3 px of a usual camera.
const SHARED_RAD: f64 = 6e-4;
/// What is told of the covariance, over what the formulas above give: they leave out the lens's further coefficients, the readout of the rows, and
/// what neighbouring tracks have in common beyond that. In four simulated turns on the spot (seeds 4 and 11 to 13, 300 frames each) the mean of
/// the squared error in standard deviations was 10 to 19 without it, where 3 is due; of three more with every flaw but somebody who walks by, 13 % of
/// the frames were outside their 95 % interval with 5.
const LEFT_OUT: f64 = 8.0;

/// An orientation with what is needed to go on from it.
#[derive(Debug, Clone, Copy)]
struct Known {
    timestamp_ns: i64,
    first_from_camera: UnitQuaternion<f64>,
    /// Right tangent, rad², without the lens's part.
    covariance: Matrix3<f64>,
    /// Right tangent for one standard deviation of each unknown of the lens, rad.
    by_lens: Matrix3x4<f64>,
}

impl Known {
    /// By definition, at the first frame; a covariance of zero would be read as an unknown one.
    fn first(timestamp_ns: i64) -> Self {
        let covariance = Matrix3::from_diagonal_element(SHARED_RAD * SHARED_RAD);
        let by_lens = Matrix3x4::zeros();
        Self { timestamp_ns, first_from_camera: UnitQuaternion::identity(), covariance, by_lens }
    }

    /// The formulas above, of a frame turned so against this one, the anchor.
    fn turned(&self, timestamp_ns: i64, turn: &ViewTurn) -> Self {
        let r = turn.second_from_first.to_rotation_matrix();
        Self {
            timestamp_ns,
            first_from_camera: self.first_from_camera * turn.second_from_first.inverse(),
            covariance: r * self.covariance * r.transpose()
                + turn.covariance
                + Matrix3::from_diagonal_element(SHARED_RAD * SHARED_RAD),
            by_lens: r * self.by_lens - turn.by_lens,
        }
    }

    /// Angular velocity in the camera's axes, rad/s, if `before` is the frame before; else NaN.
    fn angular_velocity(&self, before: Option<&Self>) -> Vector3<f64> {
        let velocity = before.and_then(|before| {
            let dt = (self.timestamp_ns - before.timestamp_ns) as f64 * 1e-9;
            let step = before.first_from_camera.inverse() * self.first_from_camera;
            (dt > 0.0 && dt < LONGEST_STEP_S).then(|| step.scaled_axis() / dt)
        });
        velocity.unwrap_or(Vector3::from_element(f64::NAN))
    }
}

/// Follows the orientation from frame to frame.
#[derive(Debug, Default)]
pub struct OrientationTracker {
    /// Tracks of the anchor: ascending id, place on z = 1.
    anchor: Vec<(u64, Vector2<f64>)>,
    first_from_anchor: Option<Known>,
    /// The last frame whose orientation was told, and the turn since the anchor to begin with at the next one.
    last: Option<(Known, TurnState)>,
    /// An orientation was told since the last restart.
    told: bool,
    /// Times that orientations became unrelated to those told before; never set back.
    pub restarts: u32,
    pairs: Vec<Pair>,
    lengths: Vec<f64>,
}

impl OrientationTracker {
    /// Forgets everything: what comes next is told to be unrelated by other means.
    pub fn clear(&mut self) {
        self.anchor.clear();
        (self.first_from_anchor, self.last, self.told) = (None, None, false);
    }

    /// A map begins at the frame of this time: its orientation, if it is known, so that the map's odometry can go on from it.
    pub fn end(&mut self, timestamp_ns: i64) -> Option<UnitQuaternion<f64>> {
        let known = self.last.map(|(last, _)| last).filter(|last| last.timestamp_ns == timestamp_ns);
        self.restarts += u32::from(self.told && known.is_none());
        self.clear();
        known.map(|known| known.first_from_camera)
    }

    /// The orientation of a frame; `lens`: what `camera` is believed to be.
    pub fn step(
        &mut self,
        features: &FrameFeatures,
        camera: &CameraModel,
        lens: SupposedLens,
    ) -> Option<OrientationEstimate> {
        let common = self.pair_up(features, camera);
        let Some(anchor) = self.first_from_anchor.filter(|_| common >= MIN_TRACKS) else {
            let known = self.begin(features, camera)?;
            return Some(self.tell(known, TurnState::none()));
        };
        let guess = self.last.map_or(TurnState::none(), |(_, turn)| turn);
        let turn = view_turn(&self.pairs, &guess, lens, &mut self.lengths)?;
        let known = anchor.turned(features.timestamp_ns, &turn);
        let halved = (common as f64) < FEW_SHARE * self.anchor.len() as f64;
        let outgrown = common < FEW_TRACKS && features.tracks.len() as f64 > OUTGROWN * common as f64;
        let since = if halved || outgrown {
            self.anchor_at(features, camera, known);
            turn.state.restarted()
        } else {
            turn.state
        };
        Some(self.tell(known, since))
    }

    fn tell(&mut self, known: Known, turn: TurnState) -> OrientationEstimate {
        self.told = true;
        let before = self.last.replace((known, turn));
        OrientationEstimate {
            first_from_camera: known.first_from_camera,
            covariance: (known.covariance + known.by_lens * known.by_lens.transpose()) * LEFT_OUT,
            angular_velocity: known.angular_velocity(before.as_ref().map(|(before, _)| before)),
        }
    }

    /// Begins with this frame; what was told before has nothing to do with it. `None` if it has too few tracks for that.
    fn begin(&mut self, features: &FrameFeatures, camera: &CameraModel) -> Option<Known> {
        let known = Known::first(features.timestamp_ns);
        self.last = None;
        self.anchor_at(features, camera, known);
        if self.anchor.len() < MIN_TRACKS {
            self.first_from_anchor = None;
            return None;
        }
        self.restarts += u32::from(std::mem::take(&mut self.told));
        Some(known)
    }

    fn anchor_at(&mut self, features: &FrameFeatures, camera: &CameraModel, known: Known) {
        let place = |pixel: &Vector2<f32>| camera.undistort(&pixel.cast()).filter(|n| camera.is_central(n));
        self.anchor.clear();
        self.anchor.extend(features.tracks.iter().filter_map(|t| Some((t.id, place(&t.position)?))));
        self.first_from_anchor = Some(known);
    }

    /// Fills `pairs` with some of the tracks that the anchor and this frame have in common; how many those are.
    fn pair_up(&mut self, features: &FrameFeatures, camera: &CameraModel) -> usize {
        self.pairs.clear();
        let anchor = &self.anchor;
        let place = |id: u64| anchor.binary_search_by_key(&id, |t| t.0).ok().map(|i| anchor[i].1);
        let common = features.tracks.iter().filter(|t| place(t.id).is_some()).count();
        let every = common.div_ceil(MAX_PAIRS).max(1);
        let shared = features.tracks.iter().filter_map(|t| Some((place(t.id)?, t.position))).step_by(every);
        self.pairs.extend(shared.filter_map(|(first, pixel)| Pair::of(first, &pixel, camera)));
        common
    }
}

#[cfg(test)]
mod tests;
