//! What is kept for a second look, and how far that has come.

use crate::image::GreyImage;
use crate::map::{Keyframe, KeyframeId, MapId};
use crate::reconstruction::active_map::ActiveMap;
use crate::reconstruction::adjust::intrinsics::LensPrior;
use crate::reconstruction::adjust::job::{MappingJob, Piece};
use crate::reconstruction::recorded::Recorded;
use crate::reconstruction::types::TrajectoryEvent;

/// Pictures that are kept, bytes at the most: 80 keyframes of 640x480, but 12 of 1920x1080, which is too few; beyond it every second one goes.
const MOST_BYTES: usize = 24 << 20;
/// Frames after which nobody waits for the lens any more: eleven minutes at 30 frames a second.
const MOST_FRAMES: usize = 20_000;

/// The frame that became a keyframe.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    pub map: MapId,
    pub keyframe: KeyframeId,
    pub sequence: u64,
    pub timestamp_ns: i64,
}

/// What is kept for a second look, until that is over.
pub struct SecondLook {
    kept: Kept,
    stage: Stage,
}

/// How far it has come.
enum Stage {
    /// The lens is not known yet.
    Keeping,
    /// Some pictures are still to be looked at; `rests`: an adjustment goes first.
    Waiting {
        look: Box<dyn Piece>,
        rests: bool,
    },
    WithWorker,
    /// Nothing is left to do: the lens is known, or it does not come.
    Over,
}

/// What is kept for it.
#[derive(Debug, Default)]
pub struct Kept {
    /// In the order in which they were made.
    pub seen: Vec<(Frame, GreyImage)>,
    /// Keyframes with smaller numbers have been asked for their pictures.
    next: u32,
    /// Those that were recorded, with their timestamps.
    pub frames: Vec<(i64, Recorded)>,
    /// Maps that were put aside as their lens was wrong.
    pub begun_wrongly: Vec<MapId>,
}

impl SecondLook {
    pub fn new(prior: LensPrior) -> Self {
        let is_guess = matches!(prior, LensPrior::Guess { .. });
        Self { kept: Kept::default(), stage: if is_guess { Stage::Keeping } else { Stage::Over } }
    }

    /// Hears what is recorded of frames.
    pub fn hear(&mut self, events: &[TrajectoryEvent]) {
        if matches!(self.stage, Stage::Over) {
            return;
        }
        events.iter().for_each(|event| self.kept.hear(event));
        if self.kept.frames.len() > MOST_FRAMES {
            self.end();
        }
    }

    /// What is kept, while the lens is not known.
    pub fn keeping(&mut self) -> Option<&mut Kept> {
        matches!(self.stage, Stage::Keeping).then_some(&mut self.kept)
    }

    /// The lens is known.
    pub fn begin(&mut self, look: Box<dyn Piece>) {
        self.stage = Stage::Waiting { look, rests: false };
    }

    /// Nothing is left to do. Returns what was kept.
    pub fn end(&mut self) -> Kept {
        self.stage = Stage::Over;
        std::mem::take(&mut self.kept)
    }

    /// The next piece for the worker; `is_alone`: no adjustment waits for it.
    pub fn next_piece(&mut self, is_alone: bool) -> Option<MappingJob> {
        let Stage::Waiting { rests, .. } = &mut self.stage else { return None };
        if std::mem::take(rests) && !is_alone {
            return None;
        }
        let Stage::Waiting { look, .. } = std::mem::replace(&mut self.stage, Stage::WithWorker) else { return None };
        Some(MappingJob::Piece(look))
    }

    /// The worker gives the look back. It is returned if that was its last piece; else it waits for the next. Nothing,
    /// too, if it is another camera's.
    pub fn take_done(&mut self, look: Box<dyn Piece>) -> Option<Box<dyn Piece>> {
        if !matches!(self.stage, Stage::WithWorker) {
            return None;
        }
        if look.is_done() {
            self.stage = Stage::Over;
            return Some(look);
        }
        self.stage = Stage::Waiting { look, rests: true };
        None
    }
}

impl Kept {
    pub fn hear(&mut self, event: &TrajectoryEvent) {
        if let TrajectoryEvent::Pose { timestamp_ns, map, keyframe, keyframe_from_camera } = *event {
            self.frames.push((timestamp_ns, Recorded { map, keyframe, keyframe_from_camera }));
            return;
        }
        self.frames.iter_mut().for_each(|(_, place)| place.hear(event));
        if let TrajectoryEvent::MapJoined { map, into, .. } = *event {
            let pictures = self.seen.iter_mut().map(|(of, _)| &mut of.map);
            pictures.chain(&mut self.begun_wrongly).filter(|of| **of == map).for_each(|of| *of = into);
        }
    }

    /// Takes the pictures of the keyframes that have been made since the last time.
    pub fn keep(&mut self, active: &ActiveMap) {
        if self.next == active.map.keyframes.next_id() {
            return;
        }
        for id in active.map.keyframes.ids_from(self.next).map(KeyframeId) {
            let Some(Keyframe { sequence, timestamp_ns, picture, .. }) = active.map.keyframe(id) else { continue };
            let Some(finest) = picture.whole().and_then(|pyramid| pyramid.levels.first()) else { continue };
            let (sequence, timestamp_ns) = (*sequence, *timestamp_ns);
            self.seen.push((Frame { map: active.id, keyframe: id, sequence, timestamp_ns }, finest.clone()));
        }
        self.next = active.map.keyframes.next_id();
        let bytes = |seen: &[(Frame, GreyImage)]| seen.iter().map(|(_, picture)| picture.data.len()).sum::<usize>();
        while self.seen.len() > 1 && bytes(&self.seen) > MOST_BYTES {
            let mut stays = false;
            self.seen.retain(|_| {
                stays = !stays;
                stays
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::geometry::Se3;

    #[test]
    fn a_frame_is_remembered_where_it_hangs_now_and_in_the_unit_of_now() {
        let step = |x: f64| Se3::new(UnitQuaternion::identity(), Vector3::x() * x);
        let pose = |timestamp_ns, keyframe| TrajectoryEvent::Pose {
            timestamp_ns,
            map: MapId(3),
            keyframe: KeyframeId(keyframe),
            keyframe_from_camera: step(1.0),
        };
        let mut look = SecondLook::new(LensPrior::UNKNOWN);
        look.keeping().expect("the lens is not known").begun_wrongly.push(MapId(3));
        look.hear(&[pose(1, 7), pose(2, 8), TrajectoryEvent::KeyframeScaled { keyframe: KeyframeId(7), scale: 3.0 }]);
        look.hear(&[
            TrajectoryEvent::KeyframeRemoved {
                map: MapId(3),
                keyframe: KeyframeId(7),
                parent: KeyframeId(8),
                parent_from_keyframe: step(10.0).relabel(),
            },
            TrajectoryEvent::MapJoined { map: MapId(3), into: MapId(4), scale: 2.0 },
        ]);
        assert!(look.next_piece(true).is_none(), "nobody looks yet");
        let kept = look.keeping().expect("the lens is not known");
        let frames: Vec<_> =
            kept.frames.iter().map(|(_, f)| (f.map.0, f.keyframe.0, f.keyframe_from_camera.translation.x)).collect();
        assert_eq!((frames, &kept.begun_wrongly), (vec![(4, 8, 26.0), (4, 8, 2.0)], &vec![MapId(4)]));
    }

    #[test]
    fn a_calibrated_camera_keeps_nothing_and_a_lens_that_does_not_come_is_not_waited_for() {
        assert!(SecondLook::new(LensPrior::Calibrated).keeping().is_none());
        let mut look = SecondLook::new(LensPrior::UNKNOWN);
        let (map, keyframe) = (MapId(0), KeyframeId(0));
        for timestamp_ns in 0..=MOST_FRAMES as i64 {
            assert!(look.keeping().is_some());
            look.hear(&[TrajectoryEvent::Pose { timestamp_ns, map, keyframe, keyframe_from_camera: Se3::identity() }]);
        }
        assert!(look.keeping().is_none());
    }
}
