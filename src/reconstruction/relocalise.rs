//! Where a frame might be when prediction has failed.
//!
//! Two ways, each bounded in every frame, the first that the search by projection confirms wins:
//! - by thumbnails: the most similar keyframe's pose, turned by the plane motion between the thumbnails (Klein & Murray 2008,
//!   section 5): a view near one that is known, however blurred;
//! - by descriptors (`descriptors`): a pose from the landmarks of a few keyframes, the ones around the last known place first,
//!   then the ones whose thumbnails are most similar, then all others in turn: half of the likely ones in a frame, the others in the next.
//!
//! Both try the keyframes as well that the index over the places of the map ([`places`](crate::places)) says are likely: in a large map that turn
//! takes long.
//!
//! A keyframe whose picture is elsewhere ([`far_pictures`](super::far_pictures)) is not tried; [`Relocaliser::ahead`] says which ones are to be here when
//! the rounds come to them.
//!
//! The same finds a frame of one map in another (`other_maps`).

pub mod asked;
pub mod descriptors;
pub mod joining;
pub mod merging;
pub mod other_maps;
pub mod spread;
pub mod taking_up;

use nalgebra::{UnitQuaternion, Vector3};

use super::track::frame::Frame;
use super::track::{Guess, PLENTY, Tracked, Tracker};
use crate::features::thumbnail::{ImageMotion, Thumbnail, ThumbnailAligner};
use crate::geometry::frames::Camera;
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;
use crate::map::{KeyframeId, Map};
use descriptors::DescriptorSearch;

/// Keyframes whose thumbnails are compared in one frame.
const COMPARED: usize = 6;
/// Thumbnails that correlate less are of another place.
const MIN_NCC: f32 = 0.6;
/// Keyframes whose descriptors are matched in two frames, every second one of these in each: around the last place, by thumbnail.
const MATCHED_NEAR: usize = 2;
const MATCHED_SIMILAR: usize = 1;
/// Keyframes that the rounds come to in the next frames: pictures that are elsewhere are to be here by then, and with them those of neighbours, which
/// have neighbouring numbers for the most part.
const AHEAD: usize = 12;
/// Guesses from descriptors in one frame.
const DESCRIPTOR_GUESSES: usize = 2;

/// Buffers of relocalisation.
#[derive(Debug, Default)]
pub struct Relocaliser {
    /// Of its own, so that what the usual one has found is there still if this finds nothing better.
    pub tracker: Tracker,
    current: Thumbnail,
    /// A condensed keyframe's.
    remade: Thumbnail,
    aligner: ThumbnailAligner,
    around: Vec<(KeyframeId, u32)>,
    chosen: Vec<KeyframeId>,
    /// By thumbnail, the most similar first.
    ranked: Vec<(f32, Guess)>,
    /// Where the round over all keyframes goes on.
    next: usize,
    descriptors: DescriptorSearch,
    /// Where the round of descriptors goes on, a keyframe a frame.
    next_described: usize,
    /// Which half of the likeliest keyframes is matched in the next frame.
    second_half: bool,
    solved: Vec<(usize, Guess)>,
}

impl Relocaliser {
    /// Places a frame that prediction could not place, or does not; `likely`: where it may be. By descriptors it tries half of the likeliest keyframes,
    /// and the others in the next frame: each costs several times what a frame does that is tracked.
    pub fn place(&mut self, frame: &Frame<'_>, last_reference: KeyframeId, likely: &[KeyframeId]) -> Option<Tracked> {
        let half = Some(usize::from(self.second_half));
        self.second_half = !self.second_half;
        self.place_by(frame, (last_reference, likely), half)
    }

    /// The same of a picture that is not tried again soon: by all of the likeliest keyframes.
    pub fn place_once(&mut self, frame: &Frame<'_>, reference: KeyframeId, likely: &[KeyframeId]) -> Option<Tracked> {
        self.place_by(frame, (reference, likely), None)
    }

    fn place_by(
        &mut self,
        frame: &Frame<'_>,
        (last_reference, likely): (KeyframeId, &[KeyframeId]),
        half: Option<usize>,
    ) -> Option<Tracked> {
        let Frame { features, map, camera, .. } = *frame;
        self.look(map, camera, &features.pyramid, last_reference, likely);
        self.place_by_thumbnail(frame).or_else(|| {
            self.choose_described(map, last_reference, likely, half);
            self.place_by_descriptors(frame)
        })
    }

    /// What the rounds over all keyframes come to next; none is passed over because its picture is elsewhere.
    pub fn ahead(&self, map: &Map) -> impl Iterator<Item = KeyframeId> {
        let rounds = [self.next_described, self.next].map(|next| round(map, next, AHEAD.min(map.keyframes.len())));
        rounds.into_iter().flatten()
    }

    /// Places a frame by some keyframes alone.
    pub fn place_among(&mut self, frame: &Frame<'_>, keyframes: &[KeyframeId]) -> Option<Tracked> {
        let Frame { features, map, camera, .. } = *frame;
        self.ranked.clear();
        self.chosen.clear();
        self.chosen.extend_from_slice(keyframes);
        if self.current.build(&features.pyramid) {
            self.rank_chosen(map, camera);
        }
        self.place_by_thumbnail(frame).or_else(|| self.place_by_descriptors(frame))
    }

    /// By the keyframe whose thumbnail is most similar.
    fn place_by_thumbnail(&mut self, frame: &Frame<'_>) -> Option<Tracked> {
        let (_, guess) = self.ranked.first()?;
        self.tracker.relocalise(frame, guess, false)
    }

    /// By the descriptors of the chosen keyframes.
    fn place_by_descriptors(&mut self, frame: &Frame<'_>) -> Option<Tracked> {
        self.solve_chosen(frame);
        let Self { tracker, solved, .. } = self;
        solved.iter().take(DESCRIPTOR_GUESSES).find_map(|(_, guess)| tracker.relocalise(frame, guess, true))
    }

    /// Compares thumbnails: the first step in every frame that has lost its place.
    fn look(
        &mut self,
        map: &Map,
        camera: &CameraModel,
        pyramid: &Pyramid,
        last_reference: KeyframeId,
        likely: &[KeyframeId],
    ) {
        self.ranked.clear();
        map.covisible(last_reference, 1, COMPARED / 2, &mut self.around);
        if !self.current.build(pyramid) || map.keyframes.is_empty() {
            return;
        }
        self.chosen.clear();
        self.chosen.push(last_reference);
        self.chosen.extend(self.around.iter().map(|a| a.0));
        let total = map.keyframes.len();
        let round = COMPARED.saturating_sub(self.chosen.len()).min(total);
        in_turn(map, &mut self.next, round, &mut self.chosen);
        self.chosen.extend_from_slice(likely);
        self.chosen.sort_unstable();
        self.chosen.dedup();
        self.rank_chosen(map, camera);
    }

    fn rank_chosen(&mut self, map: &Map, camera: &CameraModel) {
        for &id in &self.chosen {
            let Some(keyframe) = map.keyframe(id).filter(|k| !k.picture.is_away()) else { continue };
            let thumbnail = match keyframe.picture.is_condensed() {
                true => {
                    self.remade.build(keyframe.picture.pyramid());
                    &self.remade
                }
                false => &keyframe.thumbnail,
            };
            let Some(motion) = self.aligner.align(thumbnail, &self.current) else { continue };
            if motion.ncc < MIN_NCC {
                continue;
            }
            let turned: Se3<Camera, Camera> = Se3::new(rotation_of(&motion, camera), Vector3::zeros());
            let guess = Guess { camera_from_world: turned * keyframe.camera_from_world, reference: id };
            self.ranked.push((motion.ncc, guess));
        }
        self.ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
    }

    /// Poses from the chosen keyframes' descriptors, the best supported first.
    fn solve_chosen(&mut self, frame: &Frame<'_>) {
        self.solved.clear();
        let Frame { features, map, camera, .. } = *frame;
        if self.descriptors.describe_frame(&features.pyramid) {
            for &id in &self.chosen {
                // The frame's number is the seed.
                let Some(solved) = self.descriptors.pose_from(map, camera, id, features.sequence) else { continue };
                self.solved.push(solved);
                if solved.0 >= PLENTY {
                    break;
                }
            }
        }
        self.solved.sort_by_key(|s| std::cmp::Reverse(s.0));
    }

    /// Which keyframes to match, the likeliest first, none twice; `half`: every second one of the likeliest from that one on.
    fn choose_described(&mut self, map: &Map, last_reference: KeyframeId, likely: &[KeyframeId], half: Option<usize>) {
        let Self { around, ranked, chosen, next_described, .. } = self;
        chosen.clear();
        let (best, others) = likely.split_at(likely.len().min(1));
        let add = |chosen: &mut Vec<KeyframeId>, id: KeyframeId| (!chosen.contains(&id)).then(|| chosen.push(id));
        for id in std::iter::once(last_reference)
            .chain(around.iter().map(|a| a.0))
            .take(MATCHED_NEAR)
            .chain(best.iter().copied())
        {
            add(chosen, id);
        }
        ranked.iter().filter_map(|r| add(chosen, r.1.reference)).take(MATCHED_SIMILAR).for_each(drop);
        others.iter().for_each(|id| _ = add(chosen, *id));
        if let Some(first) = half.filter(|_| chosen.len() > 1) {
            let mut n = 0;
            chosen.retain(|_| {
                n += 1;
                n % 2 != first
            });
        }
        let next = round(map, *next_described, 1).next();
        *next_described = (*next_described + 1) % map.keyframes.len().max(1);
        next.into_iter().for_each(|id| _ = add(chosen, id));
    }
}

/// Adds the next `count` keyframes of a round over the whole map.
fn in_turn(map: &Map, next: &mut usize, count: usize, out: &mut Vec<KeyframeId>) {
    out.extend(round(map, *next, count));
    *next = (*next + count) % map.keyframes.len().max(1);
}

/// `count` keyframes of a round over the whole map, which is at `next`; no more than there are.
fn round(map: &Map, next: usize, count: usize) -> impl Iterator<Item = KeyframeId> {
    let begin = next % map.keyframes.len().max(1);
    map.keyframes.ids().chain(map.keyframes.ids()).skip(begin).take(count).map(KeyframeId)
}

/// Rotation of the camera that moves the picture's centre and turns the picture as `motion` does.
fn rotation_of(motion: &ImageMotion, camera: &CameraModel) -> UnitQuaternion<f64> {
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), f64::from(motion.angle_rad));
    let (dx, dy) = (f64::from(motion.shift_px.x) / camera.fx, f64::from(motion.shift_px.y) / camera.fy);
    let shift = UnitQuaternion::rotation_between(&Vector3::z(), &Vector3::new(dx, dy, 1.0));
    shift.unwrap_or_else(UnitQuaternion::identity) * roll
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Keyframe, examples};
    use nalgebra::Vector2;

    #[test]
    fn every_keyframe_gets_its_turn() {
        let mut map = Map::default();
        for sequence in 0..7 {
            map.add_keyframe(Keyframe { sequence, ..examples::keyframe(Default::default(), Se3::identity()) });
        }
        let (mut next, mut seen) = (0, Vec::new());
        for _ in 0..4 {
            in_turn(&map, &mut next, 2, &mut seen);
        }
        assert_eq!(seen.iter().map(|id| id.0).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5, 6, 0]);
        in_turn(&Map::default(), &mut next, 2, &mut seen);
        assert_eq!(seen.len(), 8, "an empty map has no turn");
        let mut relocaliser = Relocaliser::default();
        (relocaliser.next, relocaliser.next_described) = (3, 6);
        let ahead: Vec<u32> = relocaliser.ahead(&map).map(|id| id.0).collect();
        assert_eq!(ahead, [6, 0, 1, 2, 3, 4, 5, 3, 4, 5, 6, 0, 1, 2]);
        assert_eq!(relocaliser.ahead(&Map::default()).count(), 0);
        let likely = [5, 3, 1].map(KeyframeId);
        let mut chosen = |half| {
            relocaliser.choose_described(&map, KeyframeId(3), &likely, half);
            let mut chosen: Vec<u32> = relocaliser.chosen.iter().map(|id| id.0).collect();
            let count = chosen.len();
            chosen.sort_unstable();
            chosen.dedup();
            assert_eq!(chosen.len(), count, "none twice");
            chosen
        };
        let mut in_turn = Vec::new();
        for _ in 0..20 {
            let (all, first, second) = (chosen(None), chosen(Some(0)), chosen(Some(1)));
            assert!([1, 3, 5].iter().all(|id| all.contains(id) && (first.contains(id) || second.contains(id))));
            assert!(first.len() <= 3 && second.len() <= 2, "half of three, and one more in turn");
            in_turn.extend([all, first, second].concat());
        }
        assert!((0..7).all(|id| in_turn.contains(&id)), "every keyframe gets its turn");
    }

    #[test]
    fn a_picture_that_moved_right_was_turned_left() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).unwrap();
        let motion = ImageMotion {
            angle_rad: 0.1,
            shift_px: Vector2::new(50.0, -20.0),
            center_px: Vector2::new(319.5, 239.5),
            ncc: 1.0,
        };
        let rotation = rotation_of(&motion, &camera);
        // The ray of the old picture's centre is seen where the motion says.
        let seen = camera.project(&(rotation * Vector3::z())).unwrap();
        let told = motion.apply(Vector2::new(319.5, 239.5));
        assert!((seen - told.cast::<f64>()).norm() < 1e-3);
        let near = camera.project(&(rotation * Vector3::new(0.05, 0.0, 1.0))).unwrap();
        assert!((near - motion.apply(Vector2::new(344.5, 239.5)).cast::<f64>()).norm() < 1.0);
    }
}
