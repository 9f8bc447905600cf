//! What a map of a building takes: memory, and time at a keyframe, as the map grows to 10,000 keyframes.

use std::sync::Arc;
use std::time::Instant;

use nalgebra::{Matrix2, UnitQuaternion, Vector2, Vector3};
use rustix::time::{ClockId, clock_gettime};

use super::cull::{cull_keyframes, cull_landmarks, thin_out};
use super::pictures::{condense_pictures, reduce_pictures};
use crate::features::descriptor::Descriptor;
use crate::features::gradients::{GradientDescriptor, NUMBERS};
use crate::geometry::random::Random;
use crate::geometry::{CameraModel, Se3};
use crate::image::{GreyImage, Pyramid};
use crate::map::examples;
use crate::map::view::{CoarseDescriptor, DESCRIBED_LEVELS, Description, PLACE_DESCRIPTORS};
use crate::map::{Keyframe, KeyframeId, Landmark, LandmarkId, Map, MapId, Observation};
use crate::places::index::{DESCRIPTORS, PlaceIndex};
use crate::places::store::MapFile;
use crate::reconstruction::far_pictures::FarPictures;
use crate::reconstruction::relocalise::other_maps::OtherMaps;
use crate::reconstruction::{Counters, ReconstructionConfig, TrajectoryEvent};

/// Landmarks that a keyframe adds, and how many keyframes see one on average: as in `tum_fr1_desk` (37 and 5.6).
const NEW: usize = 37;
const SEEN_BY: f64 = 5.6;

/// A robot that drives along a corridor and sees ever new landmarks.
struct Drive {
    map: Map,
    index: PlaceIndex,
    random: Random,
    pyramid: Arc<Pyramid>,
    far: FarPictures,
    others: OtherMaps,
    counters: Counters,
    config: ReconstructionConfig,
    lens: CameraModel,
    /// Landmarks in view, and for how many keyframes yet.
    in_view: Vec<(LandmarkId, u32)>,
    thinned: u32,
    gone: u64,
    /// Of one room only: what may be in view at all.
    room: Vec<LandmarkId>,
    held: Vec<KeyframeId>,
    /// Keyframes that went, and what the trajectory hangs on instead.
    removed: Vec<(KeyframeId, KeyframeId)>,
}

impl Drive {
    fn new(config: ReconstructionConfig) -> Self {
        let mut random = Random::new(61);
        let mut image = GreyImage::new(640, 480);
        image.data.iter_mut().for_each(|v| *v = random.below(256) as u8);
        let mut pyramid = Pyramid::new(5);
        pyramid.build(&image);
        let (map, index, pyramid) = (Map::default(), PlaceIndex::default(), Arc::new(pyramid));
        let (in_view, room, held, removed) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let lens = examples::lens();
        let (far, others, counters) = Default::default();
        Self {
            map,
            index,
            random,
            pyramid,
            far,
            others,
            counters,
            config,
            lens,
            in_view,
            thinned: 0,
            gone: 0,
            room,
            held,
            removed,
        }
    }

    /// The same in a room of so many landmarks, of which every keyframe sees a quarter: all share some with all.
    fn in_room(config: ReconstructionConfig, landmarks: usize) -> Self {
        let mut drive = Self::new(config);
        while drive.map.landmarks.len() < landmarks {
            drive.step();
        }
        drive.room = drive.map.landmarks.ids().map(LandmarkId).collect();
        drive
    }

    fn observation(&mut self, landmark: LandmarkId) -> Observation {
        let mut at = |size: f64| self.random.uniform(20.0, size - 20.0) as f32;
        Observation {
            landmark,
            pixel: Vector2::new(at(640.0), at(480.0)),
            normalised: Vector2::zeros(),
            displacement: Vector2::zeros(),
            inv_sigma_px: 1.0,
            normalised_from_pixel: Matrix2::identity(),
        }
    }

    /// One keyframe more; seconds that the work took which the map's size could matter to.
    fn step(&mut self) -> f64 {
        let before = self.map.newest();
        let along = f64::from(self.map.keyframes.next_id());
        let living = |(id, left): (LandmarkId, u32)| Some((id, left.checked_sub(1)?));
        self.in_view = std::mem::take(&mut self.in_view).into_iter().filter_map(living).collect();
        let mut seen: Vec<LandmarkId> = self.in_view.iter().map(|l| l.0).collect();
        if !self.room.is_empty() {
            let quarter = (0..self.room.len() / 4).map(|_| self.room[self.random.below(self.room.len())]);
            seen = quarter.collect();
        }
        let observations = seen.iter().map(|id| self.observation(*id)).collect();
        let began = cpu_seconds();
        let pose = Se3::new(UnitQuaternion::identity(), Vector3::x() * -0.3 * along);
        let keyframe = Keyframe { observations, ..examples::keyframe(self.pyramid.clone(), pose) };
        let id = self.map.add_keyframe(keyframe);
        let mut took = cpu_seconds() - began;
        for _ in 0..NEW * usize::from(before.is_some() && self.room.is_empty()) {
            let ends = [before.unwrap_or_default(), id].map(|k| (k, self.observation(LandmarkId(0))));
            let position = Vector3::new(0.3 * along, 0.0, self.random.uniform(1.0, 6.0));
            let landmark = self.map.add_landmark(examples::landmark(position, id), &ends);
            // As many more as it takes to the average, in the mean: exponential.
            let more = -(SEEN_BY - 2.0) * self.random.uniform(1e-9, 1.0).ln();
            self.in_view.push((landmark, more.round() as u32));
        }
        seen.iter().for_each(|l| self.map.count_sighting(*l, true));
        let whole = Descriptor(std::array::from_fn(|_| 0));
        let mut word = || self.random.below(1 << 32) as u64 | (self.random.below(1 << 32) as u64) << 32;
        let described: Vec<Descriptor> = (0..DESCRIPTORS).map(|_| Descriptor(whole.0.map(|_| word()))).collect();

        let began = cpu_seconds();
        let (map, config) = (&mut self.map, &self.config);
        let mut events = Vec::new();
        cull_landmarks(map);
        let culled = cull_keyframes((map, MapId(0)), id, (&self.lens, &self.held), config, &mut events)
            + thin_out((map, MapId(0)), id, (config.max_keyframes, &self.held), &mut self.thinned, &mut events);
        self.removed.extend(events.iter().filter_map(|event| match event {
            TrajectoryEvent::KeyframeRemoved { keyframe, parent, .. } => Some((*keyframe, *parent)),
            _ => None,
        }));
        reduce_pictures(map, id);
        let kept = CoarseDescriptor::of(&GradientDescriptor([40; NUMBERS]));
        let (condensed, _) = condense_pictures(map, id, (config.detailed_keyframes, &self.lens), |_, l| Description {
            landmarks: vec![[Some(kept); DESCRIBED_LEVELS]; l.len()],
            place: described[..PLACE_DESCRIPTORS].to_vec(),
        });
        for id in condensed {
            self.index.replace(id, &described[..PLACE_DESCRIPTORS]);
        }
        self.index.add(id, &described);
        self.exchange(id);
        took += cpu_seconds() - began;
        self.gone += culled;
        took
    }

    /// After a frame with the robot at this keyframe.
    fn exchange(&mut self, at: KeyframeId) {
        self.counters.frames += 1;
        let Self { far, map, others, config, counters, .. } = self;
        far.exchange((map, others), at, config.detailed_keyframes, false, counters);
    }

    /// Bytes: pictures, observations and links, landmarks, index.
    fn bytes(&self) -> [usize; 4] {
        let mut sums = [0, 0, 0, self.index.bytes()];
        // Of whole pictures all are one here, as in the program's pool they are not.
        for (_, k) in self.map.keyframes.iter() {
            sums[0] += k.picture.bytes();
            sums[1] += size_of::<Keyframe>()
                + k.observations.bytes()
                + k.covisible.capacity() * size_of::<(KeyframeId, u32)>();
        }
        for (_, l) in self.map.landmarks.iter() {
            sums[2] += size_of::<Landmark>() + l.observers.capacity() * size_of::<KeyframeId>();
        }
        sums
    }
}

/// Memory of this process, kB; with nothing else in it when this test runs alone.
fn resident_kb() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

fn median(mut seconds: Vec<f64>) -> f64 {
    seconds.sort_unstable_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}

/// What this thread has computed so far: what else the machine does meanwhile is not in it.
fn cpu_seconds() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

#[test]
fn a_building_of_ten_thousand_keyframes_costs_no_more_time_a_keyframe_and_bounded_memory() {
    let folder = tempfile::tempdir().expect("folder");
    let drive_of = |name: &str, keyframes: usize| {
        let config = ReconstructionConfig { max_keyframes: 10_000, redundant_share: 1.0, ..Default::default() };
        let mut drive = Drive::new(config);
        let spool = folder.path().join(name);
        std::fs::create_dir(&spool).expect("folder");
        drive.far.spool_in(&spool);
        for made in 1..=keyframes {
            drive.step();
            if [800, 3_000, 9_800].contains(&made) {
                println!("{made} keyframes: {:?} bytes counted, {} kB resident", drive.bytes(), resident_kb());
            }
        }
        drive
    };
    // From some 600 on pictures are put away as well. In turn, so that a slow moment of the machine slows both.
    let (mut young, mut drive) = (drive_of("young", 800), drive_of("old", 9_800));
    let (early, late): (Vec<f64>, Vec<f64>) = (0..200).map(|_| (young.step(), drive.step())).unzip();
    drop(young);
    let (early, late) = (median(early), median(late));
    drive.map.check_consistency().expect("consistent");
    assert_eq!((drive.map.keyframes.len(), drive.gone), (10_000, 0), "a drive forgets nothing");
    let bytes = drive.bytes();
    let landmarks = drive.map.landmarks.len();
    println!(
        "at a keyframe {early:.6} s, in the end {late:.6} s; pictures, observations, landmarks ({landmarks}), index: {bytes:?}"
    );
    // The robot is back where it began: what is wanted there comes within as many frames as it takes.
    let (began, frames) = (Instant::now(), 40);
    let old = KeyframeId(300);
    let is_here = |drive: &Drive, id: KeyframeId| drive.map.keyframe(id).is_some_and(|k| !k.picture.is_away());
    assert!(!is_here(&drive, old) && drive.map.condensed_here().len() <= 2 * drive.config.detailed_keyframes);
    for _ in 0..frames {
        drive.exchange(old);
    }
    println!(
        "{:.6} s a frame with the robot elsewhere, {} kB resident",
        began.elapsed().as_secs_f64() / f64::from(frames),
        resident_kb()
    );
    let mut around = Vec::new();
    drive.map.covisible(old, 1, usize::MAX, &mut around);
    assert!(around.len() >= 8 && around.iter().all(|a| is_here(&drive, a.0)) && is_here(&drive, old));
    assert!(drive.map.condensed_here().len() <= 2 * drive.config.detailed_keyframes);
    assert_eq!((drive.counters.spool_faults, drive.counters.pictures_lost), (0, 0));
    drive.map.check_consistency().expect("consistent");
    assert!(late < 2.0 * early, "{early} s at 1,000 keyframes, {late} s at 10,000");
    let total: usize = bytes.iter().sum();
    assert!(total < 10_000 * MOST_BYTES, "{total} bytes");
    // On the disk; the pictures are noise, of which nothing can be deflated.
    let (path, lens) = (folder.path().join("building.map"), drive.lens.clone());
    let file = MapFile::create(&path, &examples::changes(&lens, &mut drive.map, true)).expect("made");
    file.close().expect("closed");
    let bytes = std::fs::metadata(&path).expect("there").len();
    println!("a file of {bytes} bytes");
    assert!(bytes < MOST_FILE_BYTES, "a file of {bytes} bytes");
}

/// Of a keyframe with all that belongs to it. 200 detailed keyframes (26 MB) and 400 condensed pictures (9 MB) are among the 10,000.
const MOST_BYTES: usize = 12_500;
/// Of the whole map's file.
const MOST_FILE_BYTES: u64 = 300_000_000;

#[test]
fn a_map_at_its_limit_is_thinned_evenly_and_never_where_the_robot_is() {
    let config = ReconstructionConfig { max_keyframes: 400, detailed_keyframes: 40, ..Default::default() };
    let mut drive = Drive::new(config);
    for _ in 0..800 {
        drive.step();
        assert!(drive.map.keyframes.len() <= 400);
    }
    drive.map.check_consistency().expect("consistent");
    let left: Vec<u32> = drive.map.keyframes.ids().collect();
    assert!((780..800).all(|id| left.contains(&id)), "the newest stay");
    let in_part = |part: u32| left.iter().filter(|id| **id / 200 == part).count();
    let parts = [0, 1, 2, 3].map(in_part);
    println!("left of each 200: {parts:?}");
    assert!(parts.iter().all(|n| *n >= 60), "{parts:?}");
    assert!(drive.map.detailed().len() <= 40 + 24);
}

/// Nothing of it is far from the robot, and nobody but the limit has anything go.
#[test]
fn where_all_of_a_map_is_one_room_its_limits_hold_as_well() {
    let config = ReconstructionConfig {
        max_keyframes: 60,
        detailed_keyframes: 24,
        redundant_share: 1.0,
        ..ReconstructionConfig::default()
    };
    let mut drive = Drive::in_room(config, 400);
    for _ in 0..400 {
        let id = KeyframeId(drive.map.keyframes.next_id());
        drive.step();
        assert!(drive.map.keyframes.len() <= 60, "{} keyframes", drive.map.keyframes.len());
        assert!(drive.map.detailed().len() <= 24, "{} with pictures", drive.map.detailed().len());
        assert!((0..12).all(|age| drive.map.keyframe(KeyframeId(id.0 - age)).is_some()), "the young ones stay");
    }
    drive.map.check_consistency().expect("consistent");
    let last = drive.map.newest().and_then(|id| drive.map.keyframe(id)).expect("there");
    assert!(last.covisible.len() > 50, "it is one room");
    assert!(last.observations.len() > 70, "{} of its landmarks are left", last.observations.len());
}

#[test]
fn a_keyframe_that_sees_nothing_goes_first_and_what_something_rests_on_last() {
    let config = ReconstructionConfig { max_keyframes: 40, redundant_share: 1.0, ..ReconstructionConfig::default() };
    let mut drive = Drive::in_room(config, 400);
    while drive.map.keyframes.len() < 40 {
        drive.step();
    }
    let blank = KeyframeId(10);
    let seen: Vec<LandmarkId> = drive.map.keyframe(blank).expect("there").observations.landmarks().collect();
    seen.into_iter().for_each(|landmark| drive.map.remove_observation(blank, landmark));
    drive.held = drive.map.keyframes.ids().take(10).map(KeyframeId).collect();
    drive.step();
    assert_eq!(drive.removed, [(blank, KeyframeId(9))], "its neighbour in time stands for it");
    for _ in 0..200 {
        drive.step();
        assert!(drive.map.keyframes.len() <= 40);
    }
    assert!(drive.held.iter().all(|id| drive.map.keyframe(*id).is_some()), "tags were seen from these");
    // More than there is room for: the limit holds.
    drive.held = drive.map.keyframes.ids().map(KeyframeId).collect();
    for _ in 0..30 {
        drive.step();
        drive.held = drive.map.keyframes.ids().map(KeyframeId).collect();
        assert!(drive.map.keyframes.len() <= 40);
    }
}
