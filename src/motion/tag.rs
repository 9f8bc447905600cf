//! Tags of a known size, and a chessboard as one more: the map's scale in metres from what keyframes see of them.
//!
//! Keyframe (its picture, and its pose in the map) -> [`Tags::see`] -> ln(metres per map unit) with its standard deviation
//! ([`Tags::measurement`]), once a tag was seen from three keyframes in directions 3 degrees apart.
//! 1. `features::tags` finds tags in the keyframe's picture; corners are where their edges meet on the camera's undistorted plane.
//! 2. [`mod@edge_length`]: each tag's edge in map units from all keyframes of the map that saw it and are still there, at their present poses.
//! 3. [`combine`]: tags weighed by their variances. What a keyframe's pose has wrong all tags in it share, so that part does not shrink with
//!    their number; tags that disagree by more than their sigmas raise the sigma; one that is far off (another size) is left out.
//!    What the size itself has wrong (`size_sigma_m`) is common to all of one printer and comes on top.
//!
//! Everything that was seen is in every measurement: the newest replaces the one before, and two are not independent.
//! Keyframes of a part of the map with another unit, behind a turn on the spot or before it, say nothing of this one's.
//! A keyframe that is culled takes its sightings along; a map that is joined to another is found by its keyframes' numbers.
//!
//! Cost: at keyframes only, after the pose was published: 3 ms to look (640 x 480), and 0.2 to 0.3 ms for each tag. Bounded: 16 tags of 24 sightings.
//!
//! Once the map is metric the tags take part in its adjustments ([`Tags::held`]), so that lengths stay what they are where one is in view.
//!
//! Not here: what becomes of the measurement; the adjustment; how the dock's place moves the published map ([`dock`] is what is said of it).

pub mod chessboard;
pub mod dock;
pub mod edge_length;
pub mod sheet;

use nalgebra::{UnitQuaternion, Vector2, Vector3};
use tracing::warn;

use super::scale::{ScaleFusion, ScaleMeasurement};
use crate::features::tags::{FAMILY_SIZE, KNOWN_INSET_PX, Tag, TagDetector, UNKNOWN_INSET_PX};
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;
use crate::geometry::{CameraModel, Se3};
use crate::image::GreyImage;
use crate::map::scale::ScaleSource;
use crate::map::{KeyframeId, Map, MapId, TurnId};
use chessboard::{ChessboardConfig, Finder};
use dock::DockConfig;
use edge_length::{CORNERS, LEAST_VIEWS, NoLength, PlacedTag, View, edge_length};

/// Sides of a black square that are believed, m: a stamp, and a wall.
pub const LEAST_SIZE_M: f64 = 0.01;
pub const MOST_SIZE_M: f64 = 2.0;

/// Tags that are kept, and sightings of each.
const MOST_TAGS: usize = 16;
const MOST_SIGHTINGS: usize = 24;
/// A surer measurement than 10 % is handed out.
const MOST_SIGMA: f64 = 0.1;
/// A tag farther than this many sigmas from the median of all is another size, or a mistake; and what two are allowed to differ by anyway.
const OUTLIER_SIGMAS: f64 = 4.0;
const ALLOWED_DIFFERENCE: f64 = 0.02;

/// `[tag]`: tags of a known size in the robot's surroundings.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct TagConfig {
    /// Side of their black squares, m; all are of one size. 0 (no tags are looked for) or 0.01..=2.0.
    pub size_m: f64,
    /// Standard deviation of that, m: a ruler's, and the printer's. 0.0..=0.1, and less than a tenth of the size.
    pub size_sigma_m: f64,
    /// Numbers of the tags that have this size; empty: all of the family.
    pub ids: Vec<u16>,
    /// A chessboard that serves as a tag.
    pub chessboard: ChessboardConfig,
    /// The tag that says where the map is.
    pub dock: DockConfig,
}

impl Default for TagConfig {
    fn default() -> Self {
        Self {
            size_m: 0.0,
            size_sigma_m: 0.0003,
            ids: Vec::new(),
            chessboard: ChessboardConfig::default(),
            dock: DockConfig::default(),
        }
    }
}

impl TagConfig {
    /// Whether tags are looked for.
    pub fn is_on(&self) -> bool {
        self.size_m > 0.0
    }

    /// Side of what this is and its standard deviation, m.
    fn size(&self, target: Target) -> (f64, f64) {
        match target {
            Target::Tag(_) => (self.size_m, self.size_sigma_m),
            Target::Chessboard => self.chessboard.size(),
        }
    }

    /// First value out of its range: key, and what is allowed.
    pub fn validate(&self) -> Result<(), (&'static str, String)> {
        let size = self.size_m;
        // Written so that NaN fails.
        if !(size == 0.0 || (LEAST_SIZE_M..=MOST_SIZE_M).contains(&size)) {
            return Err(("size_m", format!("must be 0 (no tags) or {LEAST_SIZE_M} to {MOST_SIZE_M} m")));
        }
        if !((0.0..=0.1).contains(&self.size_sigma_m) && (size == 0.0 || self.size_sigma_m < 0.1 * size)) {
            return Err(("size_sigma_m", "must be 0 to 0.1 m, and less than a tenth of size_m".into()));
        }
        self.chessboard.validate()?;
        match self.ids.iter().find(|id| **id >= FAMILY_SIZE) {
            Some(id) => Err(("ids", format!("the family 36h11 has the tags 0 to {}, not {id}", FAMILY_SIZE - 1))),
            None => self.dock.validate(self.is_on() && (self.ids.is_empty() || self.ids.contains(&self.dock.id))),
        }
    }
}

/// The camera at a keyframe.
#[derive(Debug, Clone, Copy)]
pub struct Optics<'a> {
    pub camera: &'a CameraModel,
    /// Readout time of a rolling shutter, s; 0: none.
    pub readout_s: f64,
}

/// What hangs somewhere and has a known size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    /// By its number.
    Tag(u16),
    Chessboard,
}

impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tag(id) => write!(f, "{id}"),
            Self::Chessboard => write!(f, "chessboard"),
        }
    }
}

/// A tag in a keyframe.
#[derive(Debug, Clone, Copy)]
struct Sighting {
    keyframe: KeyframeId,
    /// Pixels, on edges that are straight without the lens's distortion.
    corners: [Vector2<f64>; 4],
    /// Standard deviation of the tag's size in the picture, which all sightings through one camera share, as a share.
    size_sigma: f64,
}

/// A tag for who is told of it.
#[derive(Debug, Clone, Copy)]
pub struct TagView {
    pub id: u16,
    /// Keyframes of the map that saw it, as far as they are kept.
    pub sightings: usize,
    /// `None`: from too few directions so far.
    pub placed: Option<PlacedTag>,
}

/// A tag as a rigid body of known size, for an adjustment of the map's part that tells metres.
#[derive(Debug, Clone)]
pub struct HeldTag {
    /// A keyframe that saw it, and how the tag, its edge of length 1, lies before that camera: the ratio to the edge that is held is the unit's alone.
    pub from: (KeyframeId, Se3<Camera, Camera>),
    /// Its corners in its own coordinates, map units.
    pub places: [Vector3<f64>; 4],
    /// Where keyframes saw these, px, and the standard deviation.
    pub seen: Vec<(KeyframeId, [Vector2<f64>; 4])>,
    pub sigma_px: f64,
}

/// What the sightings of a tag say together.
struct Fit {
    found: Result<PlacedTag, NoLength>,
    /// Sightings that were left out as they do not fit the others.
    wrong: Vec<usize>,
    /// Sightings of the part of the map that was asked for.
    all: usize,
}

/// A tag and the keyframes that saw it.
#[derive(Debug, Clone)]
struct Known {
    target: Target,
    sightings: Vec<Sighting>,
    placed: Option<PlacedTag>,
    /// As it lay when it was placed before the newest keyframe that had seen it, in edges.
    lay: Option<(KeyframeId, Se3<Camera, Camera>)>,
}

impl Known {
    /// From its sightings. One that does not fit the others is dropped for good; where that would be more than a third of them, the tag was moved, and only
    /// the newest are kept.
    fn place(&mut self, map: &Map, part: Option<TurnId>, optics: &Optics<'_>) {
        let Fit { found, mut wrong, all } = self.fit(map, part, optics);
        self.placed = found.ok();
        let seen = self.sightings.iter().rev().filter_map(|s| Some((s.keyframe, map.keyframe(s.keyframe)?)));
        let newest = seen.into_iter().find(|(_, keyframe)| keyframe.scale_from == part);
        self.lay = self.placed.zip(newest).map(|(placed, (id, keyframe))| {
            let tag_from_camera = placed.world_from_tag.inverse() * keyframe.camera_from_world.inverse();
            (id, Se3::new(tag_from_camera.rotation, tag_from_camera.translation / placed.log_edge.exp()))
        });
        match found {
            Ok(_) => {
                wrong.sort_unstable();
                for i in wrong.into_iter().rev() {
                    self.sightings.remove(i);
                }
            }
            Err(NoLength::Moved { .. }) if all > LEAST_VIEWS => {
                warn!(tag = %self.target, sightings = all, "tag has moved");
                self.sightings.drain(..self.sightings.len() - LEAST_VIEWS);
            }
            // Three that do not fit: the oldest is of before it was moved, or the newest is wrong and goes as soon as there are more.
            Err(_) => {}
        }
    }

    fn fit(&self, map: &Map, part: Option<TurnId>, optics: &Optics<'_>) -> Fit {
        // Others are of keyframes that are gone, of another map, or of a part of it that has another unit.
        let mut used: Vec<usize> = Vec::new();
        let mut views: Vec<View> = Vec::new();
        for (i, sighting) in self.sightings.iter().enumerate() {
            if let Some(view) = view(map, part, sighting, optics) {
                used.push(i);
                views.push(view);
            }
        }
        let (all, mut wrong) = (views.len(), Vec::new());
        let mut found = loop {
            match edge_length(&views, optics.camera.focal_px()) {
                Err(NoLength::Moved { worst }) if views.len() > LEAST_VIEWS && 3 * (wrong.len() + 1) <= all => {
                    wrong.push(used.remove(worst));
                    views.remove(worst);
                }
                found => break found,
            }
        };
        if let Ok(placed) = &mut found {
            let sum: f64 = used.iter().map(|i| self.sightings[*i].size_sigma).sum();
            placed.view_variance += (sum / used.len() as f64).powi(2);
        }
        Fit { found, wrong, all }
    }

    /// As the keyframes of now see it, in the part of the map where it was seen last; `None`: no keyframe that is left has seen it, or it has no number.
    fn told(&self, map: &Map, optics: &Optics<'_>) -> Option<TagView> {
        let Target::Tag(id) = self.target else { return None };
        let seen = || self.sightings.iter().filter_map(|s| map.keyframe(s.keyframe));
        let part = seen().next_back()?.scale_from;
        Some(TagView { id, sightings: seen().count(), placed: self.fit(map, part, optics).found.ok() })
    }
}

/// What is known of the tags around.
pub struct Tags {
    config: TagConfig,
    detector: TagDetector,
    chessboard: Option<Finder>,
    found: Vec<Tag>,
    known: Vec<Known>,
    /// Of this map, and of its part behind this turn on the spot.
    measured: MapId,
    part: Option<TurnId>,
    measurement: Option<ScaleMeasurement>,
}

impl Tags {
    /// `None` where none are to be looked for.
    pub fn new(config: &TagConfig) -> Option<Self> {
        let chessboard = Finder::new(&config.chessboard);
        (config.is_on() || chessboard.is_some()).then(|| Self {
            config: config.clone(),
            detector: TagDetector::default(),
            chessboard,
            found: Vec::new(),
            known: Vec::new(),
            measured: MapId::default(),
            part: None,
            measurement: None,
        })
    }

    /// Looks at a new keyframe's picture; true if that shows a tag, by which the measurement may have changed.
    pub fn see(
        &mut self,
        (map, map_id): (&Map, MapId),
        keyframe: KeyframeId,
        image: &GreyImage,
        optics: &Optics<'_>,
    ) -> bool {
        if self.config.is_on() {
            self.detector.detect(image, &mut self.found);
        }
        let found = std::mem::take(&mut self.found);
        let mut seen = false;
        for (i, tag) in found.iter().enumerate() {
            // Two of one number: nobody knows which is which.
            let twice = found.iter().enumerate().any(|(j, other)| j != i && other.id == tag.id);
            let wanted = self.config.ids.is_empty() || self.config.ids.contains(&tag.id);
            if !twice
                && wanted
                && let Some(corners) = straight_corners(tag, optics.camera)
            {
                self.note(map, Target::Tag(tag.id), Sighting { keyframe, corners, size_sigma: size_sigma(tag) });
                seen = true;
            }
        }
        self.found = found;
        if let Some(corners) = self.chessboard.as_mut().and_then(|finder| finder.find(image, optics.camera)) {
            // Where two dark and two bright squares meet no tone curve moves anything.
            self.note(map, Target::Chessboard, Sighting { keyframe, corners, size_sigma: 0.0 });
            seen = true;
        }
        if seen {
            let part = map.keyframe(keyframe).and_then(|k| k.scale_from);
            self.measure(map, part, optics);
            (self.measured, self.part) = (map_id, part);
        }
        seen
    }

    /// The scale of this map, or of its part behind a turn on the spot that keyframe is in, as of the last keyframe that showed a tag. Replaces what was told before.
    pub fn measurement(&self, map: MapId) -> Option<ScaleMeasurement> {
        self.measurement.filter(|_| self.measured == map)
    }

    /// The tags, as long as all sources of a metric map's scale together say that they are: what they were measured to be in the map by themselves
    /// is no reason to bend it. In parts of the map behind a turn on the spot nothing is held.
    pub fn held(&self, map: &Map, fusion: &ScaleFusion) -> Vec<HeldTag> {
        let told = fusion.is_metric().then(|| fusion.fused().zip(fusion.word(ScaleSource::Tag))).flatten();
        let Some(((log, ..), own)) = told else { return Vec::new() };
        let tells = |id: KeyframeId| map.keyframe(id).is_some_and(|keyframe| keyframe.scale_from.is_none());
        let held = self.known.iter().filter_map(|known| {
            let (placed, from) = (known.placed?, known.lay.filter(|lay| tells(lay.0))?);
            let seen = known.sightings.iter().filter(|s| tells(s.keyframe)).map(|s| (s.keyframe, s.corners)).collect();
            let edge = self.config.size(known.target).0 * (log - own).exp();
            let places = CORNERS.map(|[x, y]| Vector3::new(x, y, 0.0) * edge);
            Some(HeldTag { from, places, seen, sigma_px: placed.corner_px })
        });
        held.collect()
    }

    /// Fills `out` with the tags that keyframes of this map have seen, by number, each at its place by the keyframes' poses of now: those follow corrections
    /// of the map, a place that was noted does so with the next sighting only. Changes nothing that is known.
    pub fn tell(&self, map: &Map, optics: &Optics<'_>, out: &mut Vec<TagView>) {
        out.clear();
        out.extend(self.known.iter().filter_map(|known| known.told(map, optics)));
        out.sort_unstable_by_key(|tag| tag.id);
    }

    /// The same of one tag's place alone.
    pub fn placed_now(&self, id: u16, map: &Map, optics: &Optics<'_>) -> Option<PlacedTag> {
        self.known.iter().find(|known| known.target == Target::Tag(id))?.told(map, optics)?.placed
    }

    /// Keyframes of this map that tags were seen from, ascending: without these nothing would tell where they are.
    pub fn rest_on(&self, map: &Map) -> Vec<KeyframeId> {
        let seen = self.known.iter().flat_map(|known| known.sightings.iter().map(|s| s.keyframe));
        let mut seen: Vec<KeyframeId> = seen.filter(|id| map.keyframe(*id).is_some()).collect();
        seen.sort_unstable();
        seen.dedup();
        seen
    }

    /// Lengths of the map were multiplied by `scale`: what was told before is told in the new unit.
    pub fn rescale(&mut self, scale: f64) {
        self.carry(&Sim3::new(scale, UnitQuaternion::identity(), Vector3::zeros()));
    }

    /// Parts of the map have moved: what was told of one is told of it as it is now.
    pub fn follow_parts(&mut self, becomes: impl Fn(Option<TurnId>) -> (Option<TurnId>, Sim3<World, World>)) {
        let (part, motion) = becomes(self.part);
        self.part = part;
        self.carry(&motion);
    }

    fn carry(&mut self, motion: &Sim3<World, World>) {
        for placed in self.known.iter_mut().filter_map(|known| known.placed.as_mut()) {
            placed.log_edge += motion.scale.ln();
            let place = &mut placed.world_from_tag;
            place.rotation = motion.rotation * place.rotation;
            place.translation = motion.transform(&place.translation);
            placed.place_sigma *= motion.scale;
        }
        if let Some(measurement) = &mut self.measurement {
            measurement.log_metres_per_unit -= motion.scale.ln();
        }
    }

    /// The camera is another one: pixels of the one before say nothing.
    pub fn forget(&mut self) {
        self.known.clear();
        self.measurement = None;
    }

    fn note(&mut self, map: &Map, target: Target, sighting: Sighting) {
        let i = match self.known.iter().position(|known| known.target == target) {
            Some(i) => i,
            None => {
                if self.known.len() == MOST_TAGS {
                    // The one that was not seen for longest.
                    self.known.remove(0);
                }
                self.known.push(Known { target, sightings: Vec::new(), placed: None, lay: None });
                self.known.len() - 1
            }
        };
        // Most recently seen last.
        let mut known = self.known.remove(i);
        known.sightings.retain(|s| s.keyframe != sighting.keyframe);
        if known.sightings.len() == MOST_SIGHTINGS {
            drop_one(map, &mut known.sightings);
        }
        known.sightings.push(sighting);
        self.known.push(known);
    }

    fn measure(&mut self, map: &Map, part: Option<TurnId>, optics: &Optics<'_>) {
        for known in &mut self.known {
            known.place(map, part, optics);
        }
        let placed =
            self.known.iter().filter_map(|known| Some((known.placed.as_ref()?, self.config.size(known.target))));
        self.measurement = combine(placed);
    }
}

/// What the camera's tone curve may have left wrong of a tag's size, as a share: both ends of each side.
fn size_sigma(tag: &Tag) -> f64 {
    let around: f64 = (0..4).map(|i| (tag.corners[(i + 1) % 4] - tag.corners[i]).norm()).sum();
    let inset_px = if tag.inset_px.is_some() { KNOWN_INSET_PX } else { UNKNOWN_INSET_PX };
    2.0 * inset_px / (around / 4.0).max(1.0)
}

/// Corners of a tag, px, where its edges meet on the undistorted plane.
fn straight_corners(tag: &Tag, camera: &CameraModel) -> Option<[Vector2<f64>; 4]> {
    let corners = tag.corners_on(|pixel| camera.undistort(pixel))?;
    let mut pixels = [Vector2::zeros(); 4];
    for (pixel, corner) in pixels.iter_mut().zip(&corners) {
        *pixel = camera.distort(corner)?;
    }
    Some(pixels)
}

/// A sighting with the present pose of its keyframe; `None` where that is not in this part of the map (any more).
fn view(map: &Map, part: Option<TurnId>, sighting: &Sighting, optics: &Optics<'_>) -> Option<View> {
    let keyframe = map.keyframe(sighting.keyframe).filter(|k| k.scale_from == part)?;
    let mut corners = [Vector2::zeros(); 4];
    let mut late_s = [0.0; 4];
    for ((corner, late_s), pixel) in corners.iter_mut().zip(&mut late_s).zip(&sighting.corners) {
        *corner = optics.camera.undistort(pixel)?;
        *late_s = optics.readout_s * ((pixel.y + 0.5) / f64::from(optics.camera.height) - 0.5);
    }
    Some(View { camera_from_world: keyframe.camera_from_world, corners, motion: keyframe.motion, late_s })
}

/// Makes room for one: a sighting whose keyframe is gone, or the one with the nearest neighbour, which says least.
fn drop_one(map: &Map, sightings: &mut Vec<Sighting>) {
    let centre = |s: &Sighting| map.keyframe(s.keyframe).map(|k| k.centre());
    let lonely = |i: usize| {
        let Some(here) = centre(&sightings[i]) else { return -1.0 };
        let others = sightings.iter().enumerate().filter(|(j, _)| *j != i).filter_map(|(_, s)| centre(s));
        others.map(|there| (there - here).norm()).fold(f64::INFINITY, f64::min)
    };
    let least = (0..sightings.len()).min_by(|&a, &b| lonely(a).total_cmp(&lonely(b)));
    if let Some(i) = least {
        sightings.remove(i);
    }
}

/// What several tags say together, each with its side and the standard deviation of that, m; `None` if most of them do not have the size that they should, or it
/// is not sure enough.
pub fn combine<'a>(placed: impl Iterator<Item = (&'a PlacedTag, (f64, f64))>) -> Option<ScaleMeasurement> {
    // ln(metres per map unit), the tag, and the standard deviation of its size as a share.
    let mut placed: Vec<(f64, &PlacedTag, f64)> =
        placed.map(|(tag, (size, sigma))| (size.ln() - tag.log_edge, tag, sigma / size)).collect();
    placed.sort_by(|a, b| a.0.total_cmp(&b.0));
    let variance = |tag: &PlacedTag| tag.corner_variance + tag.view_variance;
    let median = placed.get(placed.len() / 2)?.0;
    let all = placed.len();
    if all > 1 {
        let limit = |tag: &PlacedTag| OUTLIER_SIGMAS * (variance(tag) + ALLOWED_DIFFERENCE * ALLOWED_DIFFERENCE).sqrt();
        placed.retain(|(log, tag, _)| (log - median).abs() <= limit(tag));
    }
    // As many of one size as of another: nothing says which of them is the one that was given.
    if 2 * placed.len() <= all {
        return None;
    }
    let weights: f64 = placed.iter().map(|(_, tag, _)| variance(tag).recip()).sum();
    let share = |tag: &PlacedTag| variance(tag).recip() / weights;
    let mean: f64 = placed.iter().map(|(log, tag, _)| share(tag) * log).sum();
    // The corners' errors are each tag's own, the keyframes' are common, and so are those of one ruler.
    let own: f64 = placed.iter().map(|(_, tag, _)| share(tag).powi(2) * tag.corner_variance).sum();
    let common: f64 = placed.iter().map(|(_, tag, _)| share(tag) * tag.view_variance.sqrt()).sum();
    let of_size: f64 = placed.iter().map(|(_, tag, of_size)| share(tag) * of_size).sum();
    // Tags that scatter more than they should (Birge's ratio): printed unequally, or not flat.
    let chi2: f64 = placed.iter().map(|(log, tag, _)| (log - mean).powi(2) / variance(tag)).sum();
    let excess = (chi2 / (placed.len() as f64 - 1.0).max(1.0)).max(1.0);
    let sigma = ((own + common * common) * excess + of_size * of_size).sqrt();
    let (source, log_metres_per_unit) = (ScaleSource::Tag, mean);
    (sigma <= MOST_SIGMA).then_some(ScaleMeasurement { source, log_metres_per_unit, sigma })
}

#[cfg(test)]
mod tests;
