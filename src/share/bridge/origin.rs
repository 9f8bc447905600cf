//! By what two robots see that they are in one map: its first keyframe, which a map that was fetched or joined keeps.
//!
//! The time of its capture, in ns of another machine's clock since that one's start, is its name; where it is published says how the published map
//! lies on the one that others publish. Told of metric maps alone.

use crate::messages::{Keyframe, KeyframesHeader, Scale, Transform};

/// See module.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Origin {
    /// As in the health: of another map it says nothing.
    pub map_id: u32,
    first_ns: i64,
    place: Transform,
}

impl Origin {
    /// `None`: there is none yet, or it is not in the message, which leaves out the oldest.
    pub fn of(header: &KeyframesHeader, keyframes: &[Keyframe]) -> Option<Self> {
        let is_whole = header.total == header.count && Scale::from_wire(header.scale) == Scale::Metric;
        let first = keyframes.first().filter(|_| is_whole)?;
        let place = Transform { position: first.position, orientation: first.orientation };
        Some(Self { map_id: header.map_id, first_ns: first.timestamp_ns, place })
    }

    /// One word.
    pub fn frame(&self) -> String {
        format!("map_{:x}", self.first_ns)
    }

    /// Where it is in the published map: x and y, m, and yaw, rad.
    pub fn place(&self) -> String {
        let [x, y, _] = self.place.position;
        format!("{x:.4} {y:.4} {:.5}", self.place.yaw_rad())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{SCALE_ESTIMATED, SCALE_METRIC};

    #[test]
    fn a_map_is_known_by_its_first_keyframe_wherever_that_is_published() {
        let level = Transform::level(2.0, -1.0, 0.5);
        let of = |timestamp_ns| Keyframe {
            timestamp_ns,
            position: level.position,
            orientation: level.orientation,
            ..Keyframe::default()
        };
        let header =
            KeyframesHeader { count: 2, total: 2, map_id: 3, scale: SCALE_METRIC, ..KeyframesHeader::default() };
        let keyframes = [of(0x1234), of(0x2000)];
        let origin = Origin::of(&header, &keyframes).expect("an origin");
        assert_eq!((origin.map_id, origin.frame().as_str()), (3, "map_1234"));
        assert_eq!(origin.place(), "2.0000 -1.0000 0.50000");
        // The oldest are not in it; not metres; nothing there.
        assert_eq!(Origin::of(&KeyframesHeader { total: 3, ..header }, &keyframes), None);
        assert_eq!(Origin::of(&KeyframesHeader { scale: SCALE_ESTIMATED, ..header }, &keyframes), None);
        assert_eq!(Origin::of(&KeyframesHeader { count: 0, total: 0, ..header }, &[]), None);
    }
}
