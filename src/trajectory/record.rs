//! One event of a trajectory as 80 bytes of a spool, bit for bit.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::geometry::Se3;
use crate::map::{KeyframeId, MapId};
use crate::reconstruction::TrajectoryEvent;

pub const RECORD_BYTES: usize = 80;

const KIND_POSE: u32 = 1;
const KIND_REMOVED: u32 = 2;
const KIND_RETIRED: u32 = 3;
const KIND_JOINED: u32 = 4;
const KIND_SCALED: u32 = 5;
const KIND_MADE: u32 = 6;

/// `kind u32, map or keyframe u32, keyframe, parent or map u32, map u32, timestamp i64, q xyzw 4 f64, t 3 f64`, little endian.
pub fn encode(event: &TrajectoryEvent) -> [u8; RECORD_BYTES] {
    let none = UnitQuaternion::identity();
    let (words, timestamp_ns, rotation, t) = match event {
        TrajectoryEvent::Pose { timestamp_ns, map, keyframe, keyframe_from_camera: pose } => {
            ([KIND_POSE, map.0, keyframe.0, 0], *timestamp_ns, pose.rotation, pose.translation)
        }
        TrajectoryEvent::KeyframeRemoved { map, keyframe, parent, parent_from_keyframe: pose } => {
            ([KIND_REMOVED, keyframe.0, parent.0, map.0], 0, pose.rotation, pose.translation)
        }
        TrajectoryEvent::KeyframeRetired { keyframe, world_from_camera: pose } => {
            ([KIND_RETIRED, keyframe.0, 0, 0], 0, pose.rotation, pose.translation)
        }
        TrajectoryEvent::MapJoined { map, into, scale } => {
            ([KIND_JOINED, map.0, into.0, 0], 0, none, Vector3::new(*scale, 0.0, 0.0))
        }
        TrajectoryEvent::KeyframeMade { timestamp_ns, keyframe } => {
            ([KIND_MADE, keyframe.0, 0, 0], *timestamp_ns, none, Vector3::zeros())
        }
        TrajectoryEvent::KeyframeScaled { keyframe, scale } => {
            ([KIND_SCALED, keyframe.0, 0, 0], 0, none, Vector3::new(*scale, 0.0, 0.0))
        }
    };
    let mut record = [0; RECORD_BYTES];
    for (slot, word) in record[..16].chunks_exact_mut(4).zip(words) {
        slot.copy_from_slice(&word.to_le_bytes());
    }
    record[16..24].copy_from_slice(&timestamp_ns.to_le_bytes());
    let q = rotation.coords;
    for (slot, value) in record[24..].chunks_exact_mut(8).zip([q.x, q.y, q.z, q.w, t.x, t.y, t.z]) {
        slot.copy_from_slice(&value.to_le_bytes());
    }
    record
}

pub fn decode(record: &[u8]) -> Option<TrajectoryEvent> {
    let word = |i: usize| record.get(4 * i..4 * i + 4)?.try_into().ok().map(u32::from_le_bytes);
    let long = |i: usize| -> Option<[u8; 8]> { record.get(16 + 8 * i..24 + 8 * i)?.try_into().ok() };
    let real = |i: usize| long(i).map(f64::from_le_bytes);
    // Already a unit quaternion when it was recorded: normalising again could change its last digit.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(real(4)?, real(1)?, real(2)?, real(3)?));
    let translation = Vector3::new(real(5)?, real(6)?, real(7)?);
    match word(0)? {
        KIND_POSE => Some(TrajectoryEvent::Pose {
            timestamp_ns: long(0).map(i64::from_le_bytes)?,
            map: MapId(word(1)?),
            keyframe: KeyframeId(word(2)?),
            keyframe_from_camera: Se3::new(rotation, translation),
        }),
        KIND_REMOVED => Some(TrajectoryEvent::KeyframeRemoved {
            map: MapId(word(3)?),
            keyframe: KeyframeId(word(1)?),
            parent: KeyframeId(word(2)?),
            parent_from_keyframe: Se3::new(rotation, translation),
        }),
        KIND_RETIRED => Some(TrajectoryEvent::KeyframeRetired {
            keyframe: KeyframeId(word(1)?),
            world_from_camera: Se3::new(rotation, translation),
        }),
        KIND_JOINED => {
            Some(TrajectoryEvent::MapJoined { map: MapId(word(1)?), into: MapId(word(2)?), scale: translation.x })
        }
        KIND_MADE => Some(TrajectoryEvent::KeyframeMade {
            timestamp_ns: long(0).map(i64::from_le_bytes)?,
            keyframe: KeyframeId(word(1)?),
        }),
        KIND_SCALED => Some(TrajectoryEvent::KeyframeScaled { keyframe: KeyframeId(word(1)?), scale: translation.x }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_survive_their_encoding_bit_for_bit() {
        let rotation = UnitQuaternion::from_euler_angles(0.1, -2.0, 3.0);
        let translation = Vector3::new(1e-300, -0.1, 1e17);
        for event in [
            TrajectoryEvent::Pose {
                timestamp_ns: i64::MIN,
                map: MapId(u32::MAX),
                keyframe: KeyframeId(1),
                keyframe_from_camera: Se3::new(rotation, translation),
            },
            TrajectoryEvent::MapJoined { map: MapId(2), into: MapId(5), scale: 0.3 },
            TrajectoryEvent::KeyframeScaled { keyframe: KeyframeId(6), scale: 1.25 },
            TrajectoryEvent::KeyframeMade { timestamp_ns: -7, keyframe: KeyframeId(8) },
            TrajectoryEvent::KeyframeRemoved {
                map: MapId(7),
                keyframe: KeyframeId(3),
                parent: KeyframeId(2),
                parent_from_keyframe: Se3::new(rotation, translation),
            },
            TrajectoryEvent::KeyframeRetired {
                keyframe: KeyframeId(9),
                world_from_camera: Se3::new(rotation, translation),
            },
        ] {
            assert_eq!(decode(&encode(&event)), Some(event));
        }
        assert_eq!(decode(&[0; RECORD_BYTES]), None);
        assert_eq!(decode(&[1; 20]), None);
    }
}
