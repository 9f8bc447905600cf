//! Messages to a page as bytes, little-endian; `docs/console.md` describes them, and the page's `wire.js` reads them.

use serde::Serialize;

use crate::messages::{Feature, GraphEdge, Keyframe, Landmark, NO_LANDMARK, NO_TRACK, Obstacles, SCALE_METRIC, Tags};

/// A message as it goes on the wire; its copies share the memory.
pub type Bytes = tungstenite::Bytes;

/// First byte of a message. In the order in which waiting ones are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    State = 1,
    Poses = 2,
    Keyframes = 3,
    Map = 4,
    Frame = 5,
    Log = 6,
    Reply = 7,
    Picture = 8,
    History = 9,
    /// Loops and joins.
    Ties = 10,
    /// Covisibility.
    Covisible = 11,
    Calibration = 12,
    /// What stands around the robot, and where the floor is free.
    Obstacles = 13,
    Tags = 14,
}

/// One more than the last kind.
pub const KINDS: usize = 15;

impl Kind {
    /// Kinds that a page acknowledges: they are large.
    pub const ACKNOWLEDGED: [Self; 3] = [Self::Frame, Self::Map, Self::Covisible];

    pub fn is_newest_only(self) -> bool {
        matches!(
            self,
            Self::State
                | Self::Poses
                | Self::Keyframes
                | Self::Map
                | Self::Frame
                | Self::Ties
                | Self::Covisible
                | Self::Calibration
                | Self::Obstacles
                | Self::Tags
        )
    }

    /// Of an acknowledgement.
    pub fn acknowledged(number: u64) -> Option<Self> {
        Self::ACKNOWLEDGED.into_iter().find(|kind| *kind as u64 == number)
    }
}

/// Where a frame's robot was and how it went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// CLOCK_MONOTONIC of publication, s.
    pub time_s: f64,
    pub position: [f32; 3],
    pub orientation: [f32; 4],
    pub latency_ms: f32,
    pub quality: f32,
    pub landmarks: u32,
    pub sought: u32,
    /// Positions of samples with another epoch mean another map, or one since corrected.
    pub epoch: u32,
    pub dropped: u32,
    pub state: u8,
    pub scale: u8,
    pub keyframe: bool,
}

/// Bytes of a sample.
pub const SAMPLE: usize = 64;

/// `kind`, three zeros, a count.
fn head(kind: Kind, count: usize, capacity: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(8 + capacity);
    out.extend_from_slice(&[kind as u8, 0, 0, 0]);
    out.extend_from_slice(&u32::try_from(count).unwrap_or(u32::MAX).to_le_bytes());
    out
}

fn floats(out: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
}

fn words(out: &mut Vec<u8>, values: &[u32]) {
    values.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
}

/// [`Kind::Poses`] or [`Kind::History`].
pub fn samples<'a>(kind: Kind, samples: impl ExactSizeIterator<Item = &'a Sample>) -> Bytes {
    let mut out = head(kind, samples.len(), samples.len() * SAMPLE);
    for s in samples {
        out.extend_from_slice(&s.time_s.to_le_bytes());
        floats(&mut out, &s.position);
        floats(&mut out, &s.orientation);
        floats(&mut out, &[s.latency_ms, s.quality]);
        words(&mut out, &[s.landmarks, s.sought, s.epoch, s.dropped]);
        out.extend_from_slice(&[s.state, s.scale, u8::from(s.keyframe), 0]);
    }
    out.into()
}

/// What a map or keyframes message says before its elements: count, epoch, total, scale and a number of its content.
#[derive(Debug, Clone, Copy)]
pub struct MapHead {
    pub epoch: u32,
    pub total: u32,
    pub scale: u8,
    pub revision: u64,
}

fn map_head(kind: Kind, count: usize, h: &MapHead, element: usize) -> Vec<u8> {
    let mut out = head(kind, count, 16 + count * element);
    words(&mut out, &[h.epoch, h.total, h.revision as u32, u32::from(h.scale)]);
    out
}

/// x, y, z, sigma of each landmark, 16 bytes.
pub fn map(landmarks: &[Landmark], h: &MapHead) -> Bytes {
    let mut out = map_head(Kind::Map, landmarks.len(), h, 16);
    landmarks.iter().for_each(|l| {
        floats(&mut out, &l.position);
        floats(&mut out, &[l.sigma]);
    });
    out.into()
}

/// x, y, z, quaternion (x, y, z, w), id of each keyframe, 32 bytes.
pub fn keyframes(keyframes: &[Keyframe], h: &MapHead) -> Bytes {
    let mut out = map_head(Kind::Keyframes, keyframes.len(), h, 32);
    keyframes.iter().for_each(|k| {
        floats(&mut out, &k.position.map(|v| v as f32));
        floats(&mut out, &k.orientation.map(|v| v as f32));
        words(&mut out, &[k.id]);
    });
    out.into()
}

/// from, to, shared landmarks, joined map and kind of each edge, 20 bytes: [`Kind::Ties`] or [`Kind::Covisible`].
pub fn edges(kind: Kind, edges: &[GraphEdge], h: &MapHead) -> Bytes {
    let mut out = map_head(kind, edges.len(), h, 20);
    edges.iter().for_each(|e| words(&mut out, &[e.from, e.to, e.shared, e.joined_map, u32::from(e.kind)]));
    out.into()
}

/// x, y, z, quaternion (x, y, z, w), side, id and whether it is the dock, of each tag whose place is known, 40 bytes; the others are in the total only.
pub fn tags(tags: &Tags, epoch: u32) -> Bytes {
    let placed: Vec<_> = tags.seen().iter().filter(|tag| tag.is_placed()).collect();
    let head = MapHead { epoch, total: tags.count, scale: tags.scale, revision: tags.content_revision };
    let mut out = map_head(Kind::Tags, placed.len(), &head, 40);
    for tag in placed {
        floats(&mut out, &tag.position.map(|v| v as f32));
        floats(&mut out, &tag.orientation.map(|v| v as f32));
        // Without metres there is only what the map has of it.
        floats(&mut out, &[if tags.scale == SCALE_METRIC { tag.size } else { tag.edge }]);
        words(&mut out, &[tag.id, u32::from(tag.is_dock)]);
    }
    out.into()
}

/// A scan: what it tells, its place in the map, then range, `free_from` and `free` of each bearing, 12 bytes, then the points in the robot's axes,
/// 16 bytes each.
pub fn obstacles(scan: &Obstacles, epoch: u32) -> Bytes {
    let points = scan.in_the_way();
    let mut out = head(Kind::Obstacles, points.len(), 64 + scan.range.len() * 12 + points.len() * 16);
    words(&mut out, &[epoch, scan.total, u32::from(scan.told), scan.range.len() as u32]);
    floats(&mut out, &scan.position.map(|v| v as f32));
    floats(&mut out, &scan.orientation.map(|v| v as f32));
    floats(&mut out, &[scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max, scan.robot_height]);
    for ((range, from), free) in scan.range.iter().zip(&scan.free_from).zip(&scan.free) {
        floats(&mut out, &[*range, *from, *free]);
    }
    points.iter().for_each(|point| floats(&mut out, point));
    out.into()
}

/// Bytes of a feature, and its flags: a landmark of the map was found here; it is no track.
const FEATURE: usize = 16;
const MATCHED: u16 = 1;
const UNTRACKED: u16 = 2;

/// A picture: sequence, time, size, what was found in it (x, y, track, age, flags, 16 bytes each), then the JPEG.
pub fn frame(sequence: u64, time_s: f64, (width, height): (u32, u32), features: &[Feature], jpeg: &[u8]) -> Bytes {
    let mut out = head(Kind::Frame, features.len(), 24 + features.len() * FEATURE + jpeg.len());
    out.extend_from_slice(&sequence.to_le_bytes());
    out.extend_from_slice(&time_s.to_le_bytes());
    words(&mut out, &[width, height]);
    for f in features {
        let flag = |set: bool, flag: u16| if set { flag } else { 0 };
        let flags = flag(f.landmark != NO_LANDMARK, MATCHED) | flag(f.track == NO_TRACK, UNTRACKED);
        floats(&mut out, &f.position);
        words(&mut out, &[f.track as u32]);
        out.extend_from_slice(&u16::try_from(f.age).unwrap_or(u16::MAX).to_le_bytes());
        out.extend_from_slice(&flags.to_le_bytes());
    }
    out.extend_from_slice(jpeg);
    out.into()
}

/// A value as JSON behind eight bytes.
pub fn json(kind: Kind, value: &impl Serialize) -> Bytes {
    let mut out = head(kind, 0, 256);
    // What is not finite becomes null; our own types have no keys that are no text.
    if let Err(e) = serde_json::to_writer(&mut out, value) {
        tracing::error!(%e, "message for the page cannot be written");
        out.truncate(8);
        out.extend_from_slice(b"null");
    }
    out.into()
}

/// A PNG behind a JSON of `count` bytes that says what it is.
pub fn picture(name: &str, png: &[u8]) -> Bytes {
    let said = serde_json::json!({ "name": name }).to_string();
    let mut out = head(Kind::Picture, said.len(), said.len() + png.len());
    out.extend_from_slice(said.as_bytes());
    out.extend_from_slice(png);
    out.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{OBSTACLES_TOLD, Tag};

    #[test]
    fn sizes_are_those_of_the_page() {
        let sample = Sample {
            time_s: 1.5,
            position: [1.0, 2.0, 3.0],
            orientation: [0.0, 0.0, 0.0, 1.0],
            latency_ms: 4.0,
            quality: 0.5,
            landmarks: 5,
            sought: 6,
            epoch: 7,
            dropped: 8,
            state: 1,
            scale: 2,
            keyframe: true,
        };
        let bytes = samples(Kind::Poses, [sample, sample].iter());
        assert_eq!(bytes.len(), 8 + 2 * SAMPLE);
        assert_eq!(bytes[..8], [2, 0, 0, 0, 2, 0, 0, 0]);
        assert_eq!(bytes[8..16], 1.5f64.to_le_bytes());
        assert_eq!(bytes[8 + 44..8 + 48], 5u32.to_le_bytes());
        assert_eq!(bytes[8 + 60..8 + 64], [1, 2, 1, 0]);
        let head = MapHead { epoch: 7, total: 9, scale: 0, revision: 3 };
        assert_eq!(map(&[Landmark::default(); 2], &head).len(), 24 + 32);
        assert_eq!(keyframes(&[Keyframe::default()], &head).len(), 24 + 32);
        let tie = GraphEdge { from: 1, to: 2, shared: 3, joined_map: 4, kind: 2, reserved: [0; 3] };
        let bytes = edges(Kind::Ties, &[tie, tie], &head);
        assert_eq!((bytes.len(), bytes[0], &bytes[40..44]), (24 + 40, 10, &2u32.to_le_bytes()[..]));
        let mut scan = Obstacles { told: OBSTACLES_TOLD, count: 1, total: 2, ..Obstacles::default() };
        (scan.free[179], scan.points[0]) = (1.5, [1.0, 2.0, 3.0, 0.25]);
        let bytes = obstacles(&scan, 7);
        assert_eq!((bytes.len(), bytes[0], &bytes[4..12]), (72 + 180 * 12 + 16, 13, &[1, 0, 0, 0, 7, 0, 0, 0][..]));
        assert_eq!(bytes[72 + 179 * 12 + 8..][..4], 1.5f32.to_le_bytes());
        assert_eq!(bytes[72 + 180 * 12 + 12..], 0.25f32.to_le_bytes());
        let mut told = Tags { count: 2, scale: SCALE_METRIC, ..Tags::default() };
        let (position, orientation) = ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]);
        told.tags[1] = Tag { id: 7, is_dock: 1, position, orientation, size: 0.5, edge: 0.25, ..Tag::default() };
        let bytes = tags(&told, 7);
        assert_eq!((bytes.len(), bytes[0], bytes[4], bytes[12]), (24 + 40, 14, 1, 2), "one of two is placed");
        assert_eq!(
            (&bytes[24 + 28..24 + 32], &bytes[24 + 32..]),
            (&0.5f32.to_le_bytes()[..], &[7, 0, 0, 0, 1, 0, 0, 0][..])
        );
        told.scale = 0;
        assert_eq!(tags(&told, 7)[24 + 28..24 + 32], 0.25f32.to_le_bytes());
        let found = Feature { track: NO_TRACK, position: [1.0, 2.0], age: 70_000, landmark: 3 };
        let bytes = frame(1, 2.0, (640, 480), &[found, Feature { landmark: NO_LANDMARK, ..found }], &[1, 2, 3]);
        assert_eq!(bytes.len(), 32 + 2 * FEATURE + 3);
        assert_eq!((&bytes[44..48], &bytes[60..64]), (&[255, 255, 3, 0][..], &[255, 255, 2, 0][..]));
        assert_eq!(json(Kind::State, &f32::NAN)[8..], *b"null");
    }
}
