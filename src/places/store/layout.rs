//! Records of a map file and what they stand for. Floats are kept bit for bit.
//!
//! What undistorts to the very same numbers by the header's camera is not kept: of an observation its pixel is enough then. Sizes: 35 bytes an
//! observation, 48 a free corner, 125 a landmark; pictures are in [`picture`](super::picture).

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Matrix2, Matrix3, Quaternion, UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::records::Tally;
use crate::features::descriptor::Descriptor;
use crate::features::thumbnail::{Thumbnail, thumbnail_of};
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::{CameraModel, LensModel, Se3};
use crate::map::observations::Observations;
use crate::map::picture::KeyframePicture;
use crate::map::saved::{MapHead, SavedMap, SavedMaps, SavedOptics, SavedTurn};
use crate::map::scale::{MapScale, ScaleSources};
use crate::map::store::PAGE;
use crate::map::{
    AssumedDistance, FreeCorner, Keyframe, KeyframeId, Landmark, LandmarkId, Map, MapId, Observation, TurnId,
};

/// Ids of keyframes, and of landmarks, that a file may have used up: at 30 new landmarks a second 100 days.
pub const MOST_IDS: u32 = 1 << 28;

/// The one record that tells what the others are.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct HeaderRecord {
    /// Version of the program that wrote it.
    pub cairn: String,
    /// When it was written, ns since 1970.
    pub written_ns: i64,
    /// Timestamp of the newest frame.
    frame_ns: i64,
    optics: OpticsRecord,
    maps: Vec<MapRecord>,
    next_keyframe: u32,
    next_landmark: u32,
    pub records: u64,
    pub checksums: u64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct CameraRecord {
    width: u32,
    height: u32,
    focal: [f64; 2],
    centre: [f64; 2],
    is_wide_angle: bool,
    lens: Vec<f64>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct OpticsRecord {
    calibration: CameraRecord,
    is_guessed: bool,
    camera: CameraRecord,
    expected: CameraRecord,
    sigma: [f64; 7],
    refined_sigma: [f64; 7],
    begun_with_px: f64,
    restarts: u32,
    found_before: Vec<(f64, f64)>,
    unsettled: f64,
    readout_s: f64,
    readout_information: f64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct MapRecord {
    id: u32,
    reference: u32,
    frames: u64,
    /// Where lengths are metres: standard deviation, as a share, and who told it.
    metric: Option<(f64, u8)>,
    /// Keyframe, centre, variance, turn before.
    turns: Vec<(u32, [f64; 3], f64, Option<u16>)>,
    /// Ascending.
    keyframes: Vec<u32>,
}

#[derive(Serialize, Deserialize)]
struct KeyframeRecord {
    sequence: u64,
    timestamp_ns: i64,
    map: u32,
    /// camera_from_world: x y z w, then the translation.
    pose: [f64; 7],
    motion: Option<[f64; 6]>,
    scale_from: Option<u16>,
    observations: Vec<ObservationRecord>,
    /// Point on z = 1 and Jacobian (by column) of each observation, where they do not follow from the camera.
    undistorted: Option<Vec<[f64; 6]>>,
    corners: Vec<CornerRecord>,
    undistorted_corners: Option<Vec<[f64; 2]>>,
}

#[derive(Serialize, Deserialize)]
struct ObservationRecord {
    landmark: u32,
    pixel: [f32; 2],
    displacement: [f64; 2],
    inv_sigma_px: f64,
}

#[derive(Serialize, Deserialize)]
struct CornerRecord {
    pixel: [f32; 2],
    descriptor: [[u8; 8]; 4],
}

#[derive(Serialize, Deserialize)]
struct LandmarkRecord {
    id: u32,
    position: [f64; 3],
    /// By column.
    covariance: [f64; 9],
    created_by: u32,
    assumed: Option<[f64; 2]>,
    sought: u32,
    found: u32,
    /// Once the frames in a row in which it disagreed: zero since.
    reserved: u32,
}

/// What a header is made of.
pub struct HeaderOf<'a> {
    pub frame_ns: i64,
    pub optics: &'a SavedOptics,
    pub maps: &'a [(MapHead, Vec<u32>)],
    pub next_keyframe: u32,
    pub next_landmark: u32,
    pub written_ns: i64,
}

impl HeaderRecord {
    pub fn encode(of: &HeaderOf<'_>, tally: Tally) -> Option<Vec<u8>> {
        let map = |(head, keyframes): &(MapHead, Vec<u32>)| MapRecord {
            id: head.id.0,
            reference: head.reference.0,
            frames: head.frames,
            metric: match head.scale {
                MapScale::Unknown => None,
                MapScale::Metric { sigma, sources } => Some((sigma, sources.bits())),
            },
            turns: head.turns.iter().map(turn_record).collect(),
            keyframes: keyframes.clone(),
        };
        let header = Self {
            cairn: env!("CARGO_PKG_VERSION").into(),
            written_ns: of.written_ns,
            frame_ns: of.frame_ns,
            optics: OpticsRecord::of(of.optics),
            maps: of.maps.iter().map(map).collect(),
            next_keyframe: of.next_keyframe,
            next_landmark: of.next_landmark,
            records: tally.records,
            checksums: tally.sum,
        };
        postcard::to_stdvec(&header).ok()
    }

    pub fn decode(bytes: &[u8]) -> Option<Self> {
        postcard::from_bytes(bytes).ok()
    }

    pub fn tally(&self) -> Tally {
        Tally { records: self.records, sum: self.checksums }
    }
}

fn turn_record(turn: &SavedTurn) -> (u32, [f64; 3], f64, Option<u16>) {
    (turn.keyframe.0, turn.centre.into(), turn.variance, turn.before.map(|t| t.0))
}

impl CameraRecord {
    fn of(camera: &CameraModel) -> Self {
        Self {
            width: camera.width,
            height: camera.height,
            focal: [camera.fx, camera.fy],
            centre: [camera.cx, camera.cy],
            is_wide_angle: matches!(camera.lens, LensModel::KannalaBrandt(_)),
            lens: camera.lens.coefficients().to_vec(),
        }
    }

    fn restored(&self) -> Option<CameraModel> {
        let lens = match self.is_wide_angle {
            true => LensModel::KannalaBrandt(self.lens.as_slice().try_into().ok()?),
            false => LensModel::RadialTangential(self.lens.as_slice().try_into().ok()?),
        };
        let ([fx, fy], [cx, cy]) = (self.focal, self.centre);
        CameraModel::new(self.width, self.height, fx, fy, cx, cy, lens).ok()
    }
}

impl OpticsRecord {
    fn of(optics: &SavedOptics) -> Self {
        Self {
            calibration: CameraRecord::of(&optics.calibration),
            is_guessed: optics.is_guessed,
            camera: CameraRecord::of(&optics.camera),
            expected: CameraRecord::of(&optics.expected),
            sigma: optics.sigma,
            refined_sigma: optics.refined_sigma,
            begun_with_px: optics.begun_with_px,
            restarts: optics.restarts,
            found_before: optics.found_before.clone(),
            unsettled: optics.unsettled,
            readout_s: optics.readout_s,
            readout_information: optics.readout_information,
        }
    }

    fn restored(&self) -> Option<SavedOptics> {
        Some(SavedOptics {
            calibration: self.calibration.restored()?,
            is_guessed: self.is_guessed,
            camera: self.camera.restored()?,
            expected: self.expected.restored()?,
            sigma: self.sigma,
            refined_sigma: self.refined_sigma,
            begun_with_px: self.begun_with_px,
            restarts: self.restarts,
            found_before: self.found_before.clone(),
            unsettled: self.unsettled,
            readout_s: self.readout_s,
            readout_information: self.readout_information,
        })
    }
}

/// A keyframe without its picture. `camera`: the header's.
pub fn encode_keyframe(keyframe: &Keyframe, camera: &CameraModel) -> Option<Vec<u8>> {
    let pose = &keyframe.camera_from_world;
    let (q, t) = (pose.rotation.coords, pose.translation);
    let motion = keyframe.motion.map(|m| [m.turn.x, m.turn.y, m.turn.z, m.shift.x, m.shift.y, m.shift.z]);
    let follow = |o: &Observation| undistorted(o.pixel, camera).is_some_and(|u| same(&u, &own_undistorted(o)));
    let corner_follows = |c: &FreeCorner| {
        let follows = camera.undistort(&c.pixel.cast());
        follows.is_some_and(|n| same(n.as_slice(), c.normalised.as_slice()))
    };
    let observations = &keyframe.observations;
    let record = KeyframeRecord {
        sequence: keyframe.sequence,
        timestamp_ns: keyframe.timestamp_ns,
        map: keyframe.map.0,
        pose: [q.x, q.y, q.z, q.w, t.x, t.y, t.z],
        motion,
        scale_from: keyframe.scale_from.map(|t| t.0),
        observations: observations
            .iter()
            .map(|o| ObservationRecord {
                landmark: o.landmark.0,
                pixel: o.pixel.into(),
                displacement: o.displacement.into(),
                inv_sigma_px: o.inv_sigma_px,
            })
            .collect(),
        undistorted: (!observations.iter().all(|o| follow(&o)))
            .then(|| observations.iter().map(|o| own_undistorted(&o)).collect()),
        corners: keyframe
            .corners
            .iter()
            .map(|c| CornerRecord { pixel: c.pixel.into(), descriptor: c.descriptor.0.map(u64::to_le_bytes) })
            .collect(),
        undistorted_corners: (!keyframe.corners.iter().all(corner_follows))
            .then(|| keyframe.corners.iter().map(|c| c.normalised.into()).collect()),
    };
    postcard::to_stdvec(&record).ok()
}

fn same(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}

fn own_undistorted(o: &Observation) -> [f64; 6] {
    let (n, j) = (o.normalised, o.normalised_from_pixel);
    [n.x, n.y, j.m11, j.m21, j.m12, j.m22]
}

fn undistorted(pixel: Vector2<f32>, camera: &CameraModel) -> Option<[f64; 6]> {
    let (n, j) = camera.undistort_jacobian(&pixel.cast())?;
    Some([n.x, n.y, j.m11, j.m21, j.m12, j.m22])
}

/// A keyframe from its record and its picture; `None` if it is not one.
fn decode_keyframe(bytes: &[u8], picture: KeyframePicture, camera: &Arc<CameraModel>) -> Option<Keyframe> {
    let record: KeyframeRecord = postcard::from_bytes(bytes).ok()?;
    record.is_sound().then_some(())?;
    let mut observations = Vec::with_capacity(record.observations.len());
    for (i, o) in record.observations.iter().enumerate() {
        let pixel = Vector2::from(o.pixel);
        let [x, y, m11, m21, m12, m22] = match &record.undistorted {
            Some(all) => *all.get(i)?,
            None => undistorted(pixel, camera)?,
        };
        observations.push(Observation {
            landmark: LandmarkId(o.landmark),
            pixel,
            normalised: Vector2::new(x, y),
            displacement: o.displacement.into(),
            inv_sigma_px: o.inv_sigma_px,
            normalised_from_pixel: Matrix2::new(m11, m12, m21, m22),
        });
    }
    let mut observations = Observations::from(observations);
    if picture.is_condensed() {
        observations.pack(camera);
    }
    let mut corners = Vec::with_capacity(record.corners.len());
    for (i, c) in record.corners.iter().enumerate() {
        let pixel = Vector2::from(c.pixel);
        let normalised = match &record.undistorted_corners {
            Some(all) => Vector2::from(*all.get(i)?),
            None => camera.undistort(&pixel.cast())?,
        };
        corners.push(FreeCorner { pixel, normalised, descriptor: Descriptor(c.descriptor.map(u64::from_le_bytes)) });
    }
    let [x, y, z, w, tx, ty, tz] = record.pose;
    // A unit quaternion when it was written: normalising again could change its last digit.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, x, y, z));
    let is_pose = record.pose.iter().all(|v| v.is_finite()) && (rotation.norm() - 1.0).abs() < 1e-6;
    is_pose.then(|| Keyframe {
        sequence: record.sequence,
        timestamp_ns: record.timestamp_ns,
        map: MapId(record.map),
        camera_from_world: Se3::new(rotation, Vector3::new(tx, ty, tz)),
        motion: record
            .motion
            .map(|[a, b, c, d, e, f]| CameraMotion { turn: Vector3::new(a, b, c), shift: Vector3::new(d, e, f) }),
        thumbnail: match picture.is_condensed() {
            true => Thumbnail::default(),
            false => thumbnail_of(picture.pyramid()),
        },
        picture,
        scale_from: record.scale_from.map(TurnId),
        observations,
        covisible: Vec::new(),
        corners,
    })
}

impl KeyframeRecord {
    fn is_sound(&self) -> bool {
        let seen = |o: &ObservationRecord| {
            o.pixel.iter().all(|v| v.is_finite()) && are_finite(&o.displacement) && o.inv_sigma_px.is_finite()
        };
        self.map != u32::MAX
            && self.motion.as_ref().is_none_or(|motion| are_finite(motion))
            && self.observations.iter().all(seen)
            && self.corners.iter().all(|c| c.pixel.iter().all(|v| v.is_finite()))
            && self.undistorted.iter().flatten().all(|u| are_finite(u))
            && self.undistorted_corners.iter().flatten().all(|u| are_finite(u))
    }
}

impl LandmarkRecord {
    /// The covariance is not looked at: of a landmark that was never adjusted it may be none.
    fn is_sound(&self) -> bool {
        let is_distance = |assumed: [f64; 2]| assumed.iter().all(|v| v.is_finite() && *v > 0.0);
        are_finite(&self.position) && self.assumed.is_none_or(is_distance)
    }
}

impl MapRecord {
    fn is_sound(&self) -> bool {
        self.metric.is_none_or(|(sigma, _)| sigma.is_finite() && sigma >= 0.0)
            && self.turns.iter().all(|(_, centre, variance, _)| are_finite(centre) && !variance.is_nan())
    }
}

fn are_finite(values: &[f64]) -> bool {
    values.iter().all(|v| v.is_finite())
}

/// A page of landmarks.
pub fn encode_landmarks(page: &[(u32, Landmark)]) -> Option<Vec<u8>> {
    let record = |(id, l): &(u32, Landmark)| LandmarkRecord {
        id: *id,
        position: l.position.into(),
        covariance: std::array::from_fn(|i| l.covariance.as_slice()[i]),
        created_by: l.created_by.0,
        assumed: l.assumed.map(|a| [a.inverse, a.sigma]),
        sought: l.sought,
        found: l.found,
        reserved: 0,
    };
    postcard::to_stdvec(&page.iter().map(record).collect::<Vec<_>>()).ok()
}

/// Everything in a file, as it was read.
#[derive(Default)]
pub struct Raw {
    pub header: Option<HeaderRecord>,
    pub keyframes: BTreeMap<u32, Vec<u8>>,
    pub pictures: BTreeMap<u32, KeyframePicture>,
    pub landmarks: Vec<(u32, Landmark)>,
}

impl Raw {
    /// Takes a page of landmarks; `None` if it is not one.
    pub fn add_landmarks(&mut self, number: u32, bytes: &[u8]) -> Option<()> {
        let page: Vec<LandmarkRecord> = postcard::from_bytes(bytes).ok()?;
        page.iter().all(|l| l.id / PAGE as u32 == number && l.is_sound()).then_some(())?;
        for l in page {
            let mut landmark = Landmark {
                position: l.position.into(),
                covariance: Matrix3::from_column_slice(&l.covariance),
                observers: Vec::new(),
                created_by: KeyframeId(l.created_by),
                assumed: l.assumed.map(|[inverse, sigma]| AssumedDistance { inverse, sigma }),
                sought: l.sought,
                found: l.found,
            };
            landmark.bound_counts();
            self.landmarks.push((l.id, landmark));
        }
        Some(())
    }

    /// The maps, the largest first; the error says what does not fit together.
    pub fn maps(mut self) -> Result<SavedMaps, String> {
        let header = self.header.take().ok_or("it has no header")?;
        self.check_ids(&header)?;
        let optics = header.optics.restored().ok_or("its camera is none")?;
        let camera = Arc::new(optics.camera.clone());
        let mut owner = BTreeMap::new();
        let mut parts = Vec::new();
        for (index, record) in header.maps.iter().enumerate() {
            let keyframes = self.keyframes_of(record, &camera)?;
            for o in keyframes.iter().flat_map(|(_, k)| k.observations.landmarks()) {
                if *owner.entry(o.0).or_insert(index) != index {
                    return Err(format!("landmark {} is in two maps", o.0));
                }
            }
            parts.push((record, keyframes, Vec::new()));
        }
        if let Some((id, _)) = self.keyframes.first_key_value() {
            return Err(format!("keyframe {id} is in no map"));
        }
        for (id, landmark) in self.landmarks {
            if let Some(index) = owner.get(&id) {
                parts[*index].2.push((id, landmark));
            }
        }
        let mut maps = Vec::with_capacity(parts.len());
        for (record, keyframes, landmarks) in parts {
            let mut map = Map::restored(keyframes, landmarks)?;
            map.skip_ids_to(header.next_keyframe, header.next_landmark);
            maps.push(SavedMap { head: record.head(), map });
        }
        maps.sort_by_key(|m| std::cmp::Reverse(m.map.keyframes.len()));
        Ok(SavedMaps { frame_ns: header.frame_ns, optics, maps })
    }

    /// Room is made for all ids below the largest, so it must not lie.
    fn check_ids(&self, header: &HeaderRecord) -> Result<(), String> {
        let (next_keyframe, next_landmark) = (header.next_keyframe, header.next_landmark);
        if next_keyframe.max(next_landmark) > MOST_IDS {
            return Err(format!("its next ids are {next_keyframe} and {next_landmark}, more than {MOST_IDS}"));
        }
        let largest =
            self.keyframes.last_key_value().map(|(id, _)| *id).max(self.pictures.last_key_value().map(|(id, _)| *id));
        if let Some(id) = largest.filter(|id| *id >= next_keyframe) {
            return Err(format!("keyframe {id} is there, and the next one has {next_keyframe}"));
        }
        if let Some(id) = self.landmarks.iter().map(|(id, _)| *id).find(|id| *id >= next_landmark) {
            return Err(format!("landmark {id} is there, and the next one has {next_landmark}"));
        }
        let mut maps: Vec<u32> = header.maps.iter().map(|map| map.id).collect();
        maps.sort_unstable();
        if !maps.is_sorted_by(|a, b| a < b) || maps.last() == Some(&u32::MAX) {
            return Err("its maps' numbers are no numbers of maps".into());
        }
        if let Some(map) = header.maps.iter().find(|map| !map.is_sound()) {
            return Err(format!("map {} has a scale or a turn that is no number", map.id));
        }
        Ok(())
    }

    fn keyframes_of(&mut self, record: &MapRecord, camera: &Arc<CameraModel>) -> Result<Vec<(u32, Keyframe)>, String> {
        let mut keyframes = Vec::with_capacity(record.keyframes.len());
        for id in &record.keyframes {
            let bytes = self.keyframes.remove(id).ok_or_else(|| format!("keyframe {id} is missing"))?;
            let picture = self.pictures.remove(id).unwrap_or_default();
            let keyframe =
                decode_keyframe(&bytes, picture, camera).ok_or_else(|| format!("keyframe {id} makes no sense"))?;
            keyframes.push((*id, keyframe));
        }
        Ok(keyframes)
    }
}

impl MapRecord {
    fn head(&self) -> MapHead {
        let turn = |&(keyframe, centre, variance, before): &(u32, [f64; 3], f64, Option<u16>)| SavedTurn {
            keyframe: KeyframeId(keyframe),
            centre: centre.into(),
            variance,
            before: before.map(TurnId),
        };
        MapHead {
            id: MapId(self.id),
            reference: KeyframeId(self.reference),
            frames: self.frames,
            scale: self.metric.map_or(MapScale::Unknown, |(sigma, sources)| MapScale::Metric {
                sigma,
                sources: ScaleSources::from_bits(sources),
            }),
            turns: self.turns.iter().map(turn).collect(),
        }
    }
}
