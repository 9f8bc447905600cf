//! Spools: a run's poses on disk while it lasts, a TUM file at its end.
//!
//! Input: [`TrajectoryEvent`]s (pose relative to a keyframe, 80 bytes each) or published poses, as they come. Output: one
//! TUM file of the largest map, and one for each other map beside it if that is wanted. A frame's pose is `world_from_keyframe * keyframe_from_camera` with the keyframe as the
//! map knows it at the end; a keyframe that was removed hands its frames to its parent, however often. Maps that were joined are one:
//! what was recorded in the unit of one is written in that of the other. Frames between two keyframes follow both ([`between`](super::between)).
//!
//! Memory does not grow while recording: a 64 KiB buffer over a temporary file that has no name any more once it is open,
//! so nothing is left behind however the process ends. 30 frames a second are 8.6 MB of disk an hour; the file stops
//! growing at [`MAX_SPOOL_BYTES`], and what is lost then, or to a full disk, is counted. Writing takes 16 bytes a pose
//! and about 1.5 us a pose (an hour at 30 Hz: 0.2 s); it can be repeated, so a full disk costs nothing but another path.
//!
//! Deliberately not here: filling gaps.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

use super::beside::{self, Beside};
use super::between::{Made, Tracked, between};
use super::record::{RECORD_BYTES, decode, encode};
use super::{TrajectoryError, write_tum_line};
use crate::atomic_file::{create_unique, write_atomically};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe, World};
use crate::map::{KeyframeId, MapId};
use crate::reconstruction::{PoseEstimate, TrackingState, TrajectoryEvent};

/// Size at which a spool stops growing: 41 days at 30 frames a second.
pub const MAX_SPOOL_BYTES: u64 = 8 << 30;
const BUFFER_RECORDS: usize = 819;

/// What writing a trajectory came to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TrajectorySummary {
    /// Lines in the file.
    pub poses_written: u64,
    /// The map that they belong to: the one with the most poses, the earliest of several.
    pub map: Option<MapId>,
    /// Maps that are not in this file, and their poses.
    pub other_maps: u64,
    pub poses_in_other_maps: u64,
    /// Poses replaced by a later one of the same timestamp.
    pub poses_replaced: u64,
    /// Poses of the map whose keyframe is not known.
    pub poses_unresolved: u64,
    /// Events that could not be recorded (disk full, spool at its limit).
    pub events_lost: u64,
}

/// The trajectory as the map knows it at the end.
#[derive(Debug)]
pub struct TrajectorySpool {
    records: RecordFile,
}

impl TrajectorySpool {
    /// `directory`: where the temporary file goes; choose the output's own folder, since `/tmp` may be memory.
    pub fn create(directory: &Path) -> Result<Self, TrajectoryError> {
        Ok(Self { records: RecordFile::create(directory)? })
    }

    /// Takes one event. An error means that events were lost (they are counted); recording may go on.
    pub fn record(&mut self, event: &TrajectoryEvent) -> Result<(), TrajectoryError> {
        self.records.push(event)
    }

    /// Writes the largest map's poses in ascending time. `keyframe_poses`: every keyframe that still exists. Can be called
    /// again (another path after a full disk; later, with more events).
    pub fn write_tum(
        &mut self,
        path: &Path,
        keyframe_poses: &[(KeyframeId, Se3<World, Camera>)],
    ) -> Result<TrajectorySummary, TrajectoryError> {
        self.write(path, keyframe_poses, &mut None)
    }

    /// The same, and the poses of each other map beside it ([`beside`]). What an earlier run has left there of other maps is removed. A file
    /// beside it that fails takes none of the others with it.
    pub fn write_all_maps(
        &mut self,
        path: &Path,
        keyframe_poses: &[(KeyframeId, Se3<World, Camera>)],
    ) -> Result<(TrajectorySummary, Beside), TrajectoryError> {
        let mut others = Some(Beside::default());
        let summary = self.write(path, keyframe_poses, &mut others)?;
        let mut others = others.unwrap_or_default();
        others.failures.extend(beside::remove_others(path, &others.files).err());
        Ok((summary, others))
    }

    fn write(
        &mut self,
        path: &Path,
        keyframe_poses: &[(KeyframeId, Se3<World, Camera>)],
        others: &mut Option<Beside>,
    ) -> Result<TrajectorySummary, TrajectoryError> {
        let joined = self.records.joined_maps()?;
        let (mut moved, mut made) = (BTreeMap::new(), Vec::new());
        // A keyframe's frame is its camera's.
        let mut known: BTreeMap<KeyframeId, Option<Se3<World, Keyframe>>> =
            keyframe_poses.iter().map(|(id, pose)| (*id, Some(pose.relabel()))).collect();
        let mut units = Units::default();
        self.records.for_each(|number, event| match event {
            TrajectoryEvent::KeyframeRemoved { map, keyframe, parent, mut parent_from_keyframe } => {
                parent_from_keyframe.translation *= joined.of(map).1;
                units.removed.insert(keyframe, (number, parent));
                moved.insert(keyframe, (parent, parent_from_keyframe));
            }
            TrajectoryEvent::KeyframeMade { timestamp_ns, keyframe } => made.push((timestamp_ns, number, keyframe)),
            TrajectoryEvent::KeyframeScaled { keyframe, scale } => units.note(keyframe, number, scale),
            TrajectoryEvent::KeyframeRetired { keyframe, world_from_camera } => {
                known.insert(keyframe, Some(world_from_camera.relabel()));
            }
            TrajectoryEvent::Pose { .. } | TrajectoryEvent::MapJoined { .. } => {}
        })?;
        for (keyframe, (_, parent_from_keyframe)) in &mut moved {
            let Some(&(number, parent)) = units.removed.get(keyframe) else { continue };
            parent_from_keyframe.translation *= units.since(parent, number);
        }
        let resolve = |number, map, keyframe, mut keyframe_from_camera: Se3<Keyframe, Camera>| {
            keyframe_from_camera.translation *= joined.of(map).1 * units.since(keyframe, number);
            world_from_keyframe(keyframe, &mut known, &moved).map(|w| w * keyframe_from_camera)
        };
        made.sort_unstable();
        self.records.write_maps(path, (&joined, &made), resolve, others)
    }
}

/// How closed loops have changed the unit of lengths around keyframes.
#[derive(Debug, Default)]
struct Units {
    /// By record, ascending: the unit of what was recorded before it in what holds after all of them.
    changes: BTreeMap<KeyframeId, Vec<(u32, f64)>>,
    /// Record at which a keyframe was removed, and who has its poses since.
    removed: BTreeMap<KeyframeId, (u32, KeyframeId)>,
}

impl Units {
    fn note(&mut self, keyframe: KeyframeId, number: u32, scale: f64) {
        let changes = self.changes.entry(keyframe).or_default();
        changes.iter_mut().for_each(|change| change.1 *= scale);
        changes.push((number, scale));
    }

    /// By what lengths around a keyframe, or around whoever has its poses, that were recorded as `number` are to be multiplied.
    fn since(&self, keyframe: KeyframeId, number: u32) -> f64 {
        let (mut at, mut number, mut unit) = (keyframe, number, 1.0);
        for _ in 0..=self.removed.len() {
            let changes = self.changes.get(&at).map_or(&[][..], Vec::as_slice);
            unit *= changes.get(changes.partition_point(|c| c.0 < number)).map_or(1.0, |c| c.1);
            let Some((removed, parent)) = self.removed.get(&at) else { break };
            (at, number) = (*parent, *removed);
        }
        unit
    }
}

/// Which map each map has become a part of, and its unit in that one's.
#[derive(Debug, Default)]
struct JoinedMaps(BTreeMap<MapId, (MapId, f64)>);

impl JoinedMaps {
    fn of(&self, map: MapId) -> (MapId, f64) {
        let (mut at, mut scale) = (map, 1.0);
        // A map is joined to a younger one, so this ends; the bound only says so.
        for _ in 0..=self.0.len() {
            let Some((into, unit)) = self.0.get(&at) else { break };
            (at, scale) = (*into, scale * unit);
        }
        (at, scale)
    }
}

/// Follows removed keyframes to one that exists. Every step of a chain is remembered, so that all chains together cost
/// one step a keyframe; a loop or an end in nothing is `None`.
fn world_from_keyframe(
    keyframe: KeyframeId,
    known: &mut BTreeMap<KeyframeId, Option<Se3<World, Keyframe>>>,
    moved: &BTreeMap<KeyframeId, (KeyframeId, Se3<Keyframe, Keyframe>)>,
) -> Option<Se3<World, Keyframe>> {
    let mut chain = Vec::new();
    let mut at = keyframe;
    let mut world_from_at = loop {
        if let Some(pose) = known.get(&at) {
            break *pose;
        }
        match moved.get(&at) {
            Some((parent, parent_from_at)) if chain.len() <= moved.len() => {
                chain.push((at, *parent_from_at));
                at = *parent;
            }
            _ => break None,
        }
    };
    for (id, parent_from_id) in chain.into_iter().rev() {
        world_from_at = world_from_at.map(|w| w * parent_from_id);
        known.insert(id, world_from_at);
    }
    world_from_at
}

/// The trajectory as it was published: the map pose of every tracked frame at its time.
#[derive(Debug)]
pub struct LiveTrajectory {
    records: RecordFile,
}

impl LiveTrajectory {
    /// See [`TrajectorySpool::create`].
    pub fn create(directory: &Path) -> Result<Self, TrajectoryError> {
        Ok(Self { records: RecordFile::create(directory)? })
    }

    /// Takes what was published for a frame; frames without a pose are skipped.
    pub fn record(&mut self, estimate: &PoseEstimate) -> Result<(), TrajectoryError> {
        match estimate.world_from_camera {
            Some(pose) if estimate.state == TrackingState::Tracking => {
                self.records.push(&TrajectoryEvent::Pose {
                    timestamp_ns: estimate.timestamp_ns,
                    map: estimate.map,
                    keyframe: KeyframeId::default(),
                    // Stored in the place of a relative pose and read back as what it is.
                    keyframe_from_camera: pose.relabel(),
                })
            }
            _ => Ok(()),
        }
    }

    /// Writes the poses of the map that most of them were published in (poses of different maps are unrelated).
    pub fn write_tum(&mut self, path: &Path) -> Result<TrajectorySummary, TrajectoryError> {
        self.records.write_maps(path, (&JoinedMaps::default(), &[]), |_, _, _, pose| Some(pose.relabel()), &mut None)
    }
}

/// Append-only file of fixed-size records without a name in the file system.
#[derive(Debug)]
struct RecordFile {
    file: File,
    directory: String,
    buffer: Vec<u8>,
    written_bytes: u64,
    limit_bytes: u64,
    lost: u64,
}

impl RecordFile {
    fn create(directory: &Path) -> Result<Self, TrajectoryError> {
        // An output path without a folder has the empty path as its parent.
        let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
        let named = |source| TrajectoryError::Spool { directory: directory.display().to_string(), source };
        let (file, path) = create_unique(directory, ".cairn-spool", true).map_err(named)?;
        std::fs::remove_file(&path).map_err(named)?;
        Ok(Self {
            file,
            directory: directory.display().to_string(),
            buffer: Vec::with_capacity(BUFFER_RECORDS * RECORD_BYTES),
            written_bytes: 0,
            limit_bytes: MAX_SPOOL_BYTES,
            lost: 0,
        })
    }

    fn error(&self, source: io::Error) -> TrajectoryError {
        TrajectoryError::Spool { directory: self.directory.clone(), source }
    }

    fn push(&mut self, event: &TrajectoryEvent) -> Result<(), TrajectoryError> {
        self.buffer.extend_from_slice(&encode(event));
        if self.buffer.len() < BUFFER_RECORDS * RECORD_BYTES { Ok(()) } else { self.flush() }
    }

    /// Moves the buffer to the file, or counts its records as lost: the file always ends with a whole record.
    fn flush(&mut self) -> Result<(), TrajectoryError> {
        let bytes = self.buffer.len() as u64;
        let outcome = if self.written_bytes + bytes > self.limit_bytes {
            Err(io::Error::other(format!("limit of {} bytes reached", self.limit_bytes)))
        } else {
            self.file.write_all_at(&self.buffer, self.written_bytes)
        };
        match outcome {
            Ok(()) => self.written_bytes += bytes,
            Err(_) => self.lost += bytes / RECORD_BYTES as u64,
        }
        self.buffer.clear();
        outcome.map_err(|source| self.error(source))
    }

    /// Calls `each` with every record and its number, oldest first.
    fn for_each(&mut self, mut each: impl FnMut(u32, TrajectoryEvent)) -> Result<(), TrajectoryError> {
        // Lost records are in the summary; what was recorded is still worth writing.
        let _ = self.flush();
        let mut block = vec![0; BUFFER_RECORDS * RECORD_BYTES];
        let (mut at, mut number) = (0, 0);
        while at < self.written_bytes {
            let bytes = ((self.written_bytes - at) as usize).min(block.len());
            self.file.read_exact_at(&mut block[..bytes], at).map_err(|e| self.error(e))?;
            for record in block[..bytes].chunks_exact(RECORD_BYTES) {
                if let Some(event) = decode(record) {
                    each(number, event);
                }
                number += 1;
            }
            at += bytes as u64;
        }
        Ok(())
    }

    fn joined_maps(&mut self) -> Result<JoinedMaps, TrajectoryError> {
        let mut joined = JoinedMaps::default();
        self.for_each(|_, event| {
            if let TrajectoryEvent::MapJoined { map, into, scale } = event {
                joined.0.insert(map, (into, scale));
            }
        })?;
        Ok(joined)
    }

    /// Writes the map with the most poses that `resolve` can place; with `others`, each other one beside it.
    fn write_maps(
        &mut self,
        path: &Path,
        maps: (&JoinedMaps, &[(i64, u32, KeyframeId)]),
        mut resolve: impl FnMut(u32, MapId, KeyframeId, Se3<Keyframe, Camera>) -> Option<Se3<World, Camera>>,
        others: &mut Option<Beside>,
    ) -> Result<TrajectorySummary, TrajectoryError> {
        let joined = maps.0;
        let mut poses_of_map = BTreeMap::<MapId, u64>::new();
        self.for_each(|_, event| {
            if let TrajectoryEvent::Pose { map, .. } = event {
                *poses_of_map.entry(joined.of(map).0).or_default() += 1;
            }
        })?;
        let largest = poses_of_map.iter().max_by_key(|(map, poses)| (**poses, std::cmp::Reverse(**map)));
        let (map, poses) = largest.map(|(map, poses)| (*map, *poses)).unzip();
        let mut summary = self.write_map((path, ""), (map, poses.unwrap_or_default()), maps, &mut resolve)?;
        summary.other_maps = poses_of_map.len().saturating_sub(1) as u64;
        summary.poses_in_other_maps = poses_of_map.values().sum::<u64>() - poses.unwrap_or_default();
        // A pipe or a device has nothing beside it.
        if let Some(others) = others.as_mut().filter(|_| path.is_file()) {
            for (other, poses) in poses_of_map.iter().filter(|(other, _)| Some(**other) != map) {
                let path = beside::path_of(path, *other);
                let written = beside::check_free(&path)
                    .and_then(|()| self.write_map((&path, beside::MARK), (Some(*other), *poses), maps, &mut resolve));
                match written {
                    Ok(_) => others.files.push(path),
                    Err(error) => others.failures.push(error),
                }
            }
        }
        Ok(summary)
    }

    /// Writes one map, of which there are so many poses; `begin`: what stands before them.
    fn write_map(
        &mut self,
        (path, begin): (&Path, &str),
        (map, poses): (Option<MapId>, u64),
        (joined, made): (&JoinedMaps, &[(i64, u32, KeyframeId)]),
        resolve: &mut impl FnMut(u32, MapId, KeyframeId, Se3<Keyframe, Camera>) -> Option<Se3<World, Camera>>,
    ) -> Result<TrajectorySummary, TrajectoryError> {
        let mut summary = TrajectorySummary { map, events_lost: self.lost, ..Default::default() };
        // Frames that were solved afterwards come late: sort by time, the last record of a timestamp first.
        let mut order = Vec::<(i64, u32)>::with_capacity(poses as usize);
        self.for_each(|number, event| match event {
            TrajectoryEvent::Pose { timestamp_ns, map: of, keyframe, keyframe_from_camera }
                if Some(joined.of(of).0) == map =>
            {
                match resolve(number, of, keyframe, keyframe_from_camera).is_some_and(|pose| pose.is_finite()) {
                    true => order.push((timestamp_ns, number)),
                    false => summary.poses_unresolved += 1,
                }
            }
            _ => {}
        })?;
        order.sort_unstable_by_key(|(timestamp_ns, number)| (*timestamp_ns, std::cmp::Reverse(*number)));
        let resolved = order.len();
        order.dedup_by_key(|(timestamp_ns, _)| *timestamp_ns);
        summary.poses_replaced = (resolved - order.len()) as u64;
        summary.poses_written = order.len() as u64;

        write_atomically(path, |out| {
            out.write_all(begin.as_bytes())?;
            // The keyframe before each frame, and the one after it.
            let (mut made, mut before, mut after) = (made.iter(), None, None::<Made>);
            for at in &order {
                while after.is_none_or(|after| after.timestamp_ns() < at.0) {
                    before = after.take().or(before);
                    let Some((timestamp_ns, made_at, keyframe)) = made.next() else { break };
                    // What was recorded of a frame after it had become a keyframe is no place of that one: another map has seen it anew.
                    let recorded = order.binary_search_by_key(timestamp_ns, |at| at.0).ok().map(|i| order[i]);
                    let Some(own) = recorded.filter(|(_, number)| number < made_at) else { continue };
                    let (Some(tracked), number) = (self.tracked(own, resolve)?, own.1) else { continue };
                    // Without a way there is no unit.
                    let adjusted = resolve(number, map.unwrap_or_default(), *keyframe, Se3::identity());
                    after = adjusted.map(|adjusted| Made::new(tracked, *keyframe, &adjusted));
                }
                if let Some(tracked) = self.tracked(*at, resolve)? {
                    write_tum_line(out, at.0, &between(&tracked, before.as_ref(), after.as_ref()))?;
                }
            }
            Ok(())
        })?;
        Ok(summary)
    }

    /// The pose of a time that is recorded by a number.
    fn tracked(
        &self,
        (timestamp_ns, number): (i64, u32),
        resolve: &mut impl FnMut(u32, MapId, KeyframeId, Se3<Keyframe, Camera>) -> Option<Se3<World, Camera>>,
    ) -> io::Result<Option<Tracked>> {
        let mut record = [0; RECORD_BYTES];
        self.file.read_exact_at(&mut record, u64::from(number) * RECORD_BYTES as u64)?;
        let Some(TrajectoryEvent::Pose { map, keyframe, keyframe_from_camera, .. }) = decode(&record) else {
            return Ok(None);
        };
        let pose = resolve(number, map, keyframe, keyframe_from_camera);
        Ok(pose.map(|world_from_camera| Tracked { timestamp_ns, by: keyframe, world_from_camera }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spool_at_its_limit_counts_what_it_loses_and_writes_what_it_has() {
        let dir = tempfile::tempdir().unwrap();
        let mut spool = TrajectorySpool::create(dir.path()).unwrap();
        spool.records.limit_bytes = (BUFFER_RECORDS * RECORD_BYTES) as u64;
        let mut errors = 0;
        for i in 0..2 * BUFFER_RECORDS as i64 + 5 {
            let event = TrajectoryEvent::Pose {
                timestamp_ns: i,
                map: MapId(0),
                keyframe: KeyframeId(0),
                keyframe_from_camera: Se3::identity(),
            };
            errors += u32::from(spool.record(&event).is_err());
        }
        assert_eq!(errors, 1, "one error a lost block, for the log");
        let summary = spool.write_tum(&dir.path().join("t.txt"), &[(KeyframeId(0), Se3::identity())]).unwrap();
        assert_eq!((summary.poses_written, summary.events_lost), (BUFFER_RECORDS as u64, BUFFER_RECORDS as u64 + 5));
    }
}
