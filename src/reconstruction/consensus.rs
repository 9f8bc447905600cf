//! Does a map explain most of the picture? Something large that moves past has the most corners where it is, and two views of
//! it are as good a start as two views of the world; but the world fills more of the picture.
//!
//! In: views with their poses, and where each saw its tracks. Out: the share of the picture's cells (those with
//! tracks that can tell) in which most tracks agree with the views' motion. It is asked of a start, in the second after it
//! ([`probation`]) and ever after ([`contradiction`]).
//!
//! A track agrees when it lies within 3 px of the epipolar line of the earliest view that saw it, and meets its ray in
//! front of both cameras. One that a rotation alone explains says nothing. How a rolling shutter bends tracks by the camera's turn is undone; what
//! it does by the way is not, as nobody knows how far the points are. Cost: some 0.05 ms. Not here: what moves slower than that, or fills more of the
//! picture than the world; a lens that is a guess, whose own error bends the picture.

pub mod contradiction;
pub mod probation;

use std::collections::VecDeque;
use std::f64::consts::SQRT_2;

use nalgebra::Vector2;

use super::measurement::rolling_shutter::Shutter;
use crate::features::FrameFeatures;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::epipolar::sampson_squared;
use crate::geometry::essential::essential_of;
use crate::geometry::frames::{Camera, World};
use crate::geometry::triangulation::intersect;
use crate::geometry::{CameraModel, Se3};

/// Share of the picture that must agree with a new map's motion; not more, as something may cover a part of it for good.
pub const AGREEING_SHARE: f64 = 0.7;
/// How often more the picture must disagree than agree to be believed, at the most.
pub const MAX_DISAGREEMENTS: u32 = 5;
/// Of the picture's cells with tracks, so many must tell for a frame to count: where the camera comes back to where it began, only what moves does.
const MIN_TELLING: f64 = 0.5;
/// Cells across the picture; as many rows as make them about square, up to twice as many.
const COLUMNS: usize = 10;
const MAX_ROWS: usize = 2 * COLUMNS;
/// Sampson distance of a track that agrees, px. Tracks drift over a start's frames.
const AGREEING_PX: f64 = 3.0;

/// What a frame saw of its tracks.
#[derive(Debug, Clone, Default)]
pub struct FrameTracks {
    pub sequence: u64,
    pub timestamp_ns: i64,
    /// Track id and level-0 pixel, ascending id.
    pub tracks: Vec<(u64, Vector2<f32>)>,
}

impl FrameTracks {
    pub fn of(features: &FrameFeatures) -> Self {
        let mut frame = Self::default();
        frame.copy_from(features);
        frame
    }

    fn copy_from(&mut self, features: &FrameFeatures) {
        (self.sequence, self.timestamp_ns) = (features.sequence, features.timestamp_ns);
        self.tracks.clear();
        self.tracks.extend(features.tracks.iter().map(|t| (t.id, t.position)));
    }

    /// Pixel of a track.
    pub fn track(&self, id: u64) -> Option<Vector2<f32>> {
        let i = self.tracks.binary_search_by_key(&id, |t| t.0).ok()?;
        Some(self.tracks[i].1)
    }
}

#[derive(Debug, Clone)]
struct PosedView {
    frame: FrameTracks,
    camera_from_world: Se3<Camera, World>,
    /// How the camera turned there, by the views before and after; its way is left out.
    turn: Option<CameraMotion>,
}

/// Views with their poses, in order of time.
#[derive(Debug, Clone, Default)]
pub struct PosedViews {
    views: VecDeque<PosedView>,
    /// Of views that are forgotten, for the next ones.
    spare: Vec<FrameTracks>,
}

/// What the picture says, by its cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Agreement {
    /// Of the cells with telling tracks, those in which most agree (0 to 1).
    pub share: f64,
    /// Of the cells with tracks that an earlier view saw, those with telling ones.
    pub telling: f64,
}

#[derive(Clone, Copy, Default)]
struct Cell {
    /// Agreeing less dissenting tracks.
    balance: i32,
    telling: u32,
    seen: u32,
}

impl PosedViews {
    pub fn push(&mut self, frame: FrameTracks, camera_from_world: &Se3<Camera, World>) {
        let new = PosedView { frame, camera_from_world: *camera_from_world, turn: None };
        let turn = self.views.back().and_then(|before| turn_over(before, &new));
        if let Some(last) = self.views.len().checked_sub(1) {
            self.views[last].turn = turn_over(&self.views[last.saturating_sub(1)], &new);
        }
        self.views.push_back(PosedView { turn, ..new });
    }

    /// The same of a frame, in the memory of one that was forgotten.
    pub fn push_features(&mut self, features: &FrameFeatures, camera_from_world: &Se3<Camera, World>) {
        let mut frame = self.spare.pop().unwrap_or_default();
        frame.copy_from(features);
        self.push(frame, camera_from_world);
    }

    /// Forgets the views from before this time; all where the clock went back.
    pub fn forget_before(&mut self, timestamp_ns: i64, now_ns: i64) {
        let goes_back = self.newest_ns().is_some_and(|newest| newest > now_ns);
        while self.views.front().is_some_and(|view| goes_back || view.frame.timestamp_ns < timestamp_ns) {
            self.spare.extend(self.views.pop_front().map(|view| view.frame));
        }
    }

    /// An adjustment has moved the map around them.
    fn correct(&mut self, old_from_new: &Se3<World, World>) {
        for view in &mut self.views {
            view.camera_from_world = view.camera_from_world * *old_from_new;
        }
    }

    pub fn newest_ns(&self) -> Option<i64> {
        self.views.back().map(|view| view.frame.timestamp_ns)
    }

    pub fn into_frames(self) -> impl DoubleEndedIterator<Item = FrameTracks> {
        self.views.into_iter().map(|view| view.frame)
    }

    /// Whether the picture of the last view agrees with the motion of all, by a camera with this shutter. `None` when no track can tell.
    pub fn agreement(&self, camera: &CameraModel, shutter: &Shutter) -> Option<Agreement> {
        let newest = self.views.back()?;
        let rows = (COLUMNS * camera.height as usize).div_ceil((camera.width as usize).max(1)).clamp(1, MAX_ROWS);
        let cell = |p: &Vector2<f32>| {
            let (x, y) = (p.x / camera.width as f32 * COLUMNS as f32, p.y / camera.height as f32 * rows as f32);
            (y as usize).min(rows - 1) * COLUMNS + (x as usize).min(COLUMNS - 1)
        };
        // Where the middle row would have seen it.
        let ray = |pixel: &Vector2<f32>, view: &PosedView| {
            let seen = camera.undistort(&pixel.cast())?;
            Some(seen - shutter.displacement(view.turn.as_ref(), &seen.push(1.0), pixel.y) * shutter.readout_s)
        };
        let mut cells = [Cell::default(); COLUMNS * MAX_ROWS];
        for (track, pixel) in &newest.frame.tracks {
            let mut earlier = self.views.iter().take(self.views.len() - 1);
            let first = earlier.find_map(|view| Some((view, view.frame.track(*track)?)));
            let Some((first, first_pixel)) = first else { continue };
            let cell = &mut cells[cell(pixel)];
            cell.seen += 1;
            let rays = ray(&first_pixel, first).zip(ray(pixel, newest));
            let motion = (newest.camera_from_world * first.camera_from_world.inverse()).relabel();
            let Some(agrees) = rays.and_then(|rays| agrees(&rays, &motion, camera)) else { continue };
            cell.balance += if agrees { 1 } else { -1 };
            cell.telling += 1;
        }
        let telling = cells.iter().filter(|c| c.telling > 0).count();
        let agreeing = cells.iter().filter(|c| c.telling > 0 && c.balance > 0).count() as f64;
        let even = cells.iter().filter(|c| c.telling > 0 && c.balance == 0).count() as f64;
        let seen = cells.iter().filter(|c| c.seen > 0).count() as f64;
        (telling > 0)
            .then(|| Agreement { share: (agreeing + 0.5 * even) / telling as f64, telling: telling as f64 / seen })
    }

    /// The same, where so much of the picture tells that the frame counts.
    fn verdict(&self, camera: &CameraModel, shutter: &Shutter) -> Option<f64> {
        self.agreement(camera, shutter).filter(|told| told.telling >= MIN_TELLING).map(|told| told.share)
    }
}

fn turn_over(before: &PosedView, after: &PosedView) -> Option<CameraMotion> {
    let dt = (after.frame.timestamp_ns - before.frame.timestamp_ns) as f64 * 1e-9;
    let motion = (after.camera_from_world * before.camera_from_world.inverse()).relabel();
    (dt > 0.0).then(|| CameraMotion::over(&motion, dt).turned_only())
}

/// Does a track that was seen along two rays agree with the camera's motion from the first to the second? `None` when it cannot tell.
fn agrees((x1, x2): &(Vector2<f64>, Vector2<f64>), motion: &Se3<Camera, Camera>, camera: &CameraModel) -> Option<bool> {
    let turned = motion.rotation * x1.push(1.0);
    if !(turned.z > 1e-3) {
        return None;
    }
    // A step across the epipolar line counts in both pictures: shorter than this it agrees in any direction.
    if camera.pixels(x2, &(x2 - turned.xy() / turned.z)) < SQRT_2 * AGREEING_PX {
        return None;
    }
    let distance = sampson_squared(&essential_of(motion), x1, x2).sqrt() * camera.focal_px();
    let in_front = intersect(motion, x1, x2).is_some_and(|met| met.depth1 > 0.0 && met.depth2 > 0.0);
    Some(distance <= AGREEING_PX && in_front)
}

#[cfg(test)]
pub mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::features::Track;

    pub fn camera() -> CameraModel {
        CameraModel::new(640, 480, 500.0, 500.0, 319.5, 239.5, [0.0; 5]).unwrap()
    }

    pub fn global_shutter() -> Shutter {
        Shutter::new(0.0, 480, false)
    }

    pub type View = (FrameTracks, Se3<Camera, World>);

    /// A camera that goes to the right before a wall of depth, whose left `share` moves down meanwhile; 30 pictures a second.
    #[derive(Clone)]
    pub struct Scene {
        /// From picture to picture.
        pub step: f64,
        pub share: f64,
        /// The pictures in which it moves.
        pub falls: std::ops::Range<f64>,
        /// How the camera turns down and, from picture 15 on, up again, rad/s: across its way, or a shutter moves all along epipolar lines.
        pub turn: f64,
        pub readout_s: f64,
    }

    impl Default for Scene {
        fn default() -> Self {
            Self { step: 0.02, share: 0.0, falls: 0.0..f64::INFINITY, turn: 0.0, readout_s: 0.0 }
        }
    }

    impl Scene {
        fn pose(&self, n: f64) -> Se3<Camera, World> {
            let angle = self.turn / 30.0 * (15.0 - (n - 15.0).abs());
            let turned = UnitQuaternion::from_scaled_axis(Vector3::x() * angle);
            Se3::new(turned, turned * Vector3::new(-self.step * n, 0.0, 0.0))
        }

        fn seen(&self, i: i32, j: i32, n: f64) -> Option<Vector2<f64>> {
            let depth = 2.0 + f64::from((i * 5 + j * 3) % 7) * 0.3;
            let ray = Vector3::new((f64::from(i) - 14.5) * 0.04, (f64::from(j) - 11.5) * 0.035, 1.0);
            let is_moving = f64::from(i) < 30.0 * self.share;
            let fallen = if is_moving { n.clamp(self.falls.start, self.falls.end) - self.falls.start } else { 0.0 };
            let point = ray * depth + Vector3::y() * (1.5 * self.step * fallen);
            camera().project(&self.pose(n).transform(&point))
        }

        pub fn view(&self, n: usize) -> View {
            let at = n as f64;
            let late = |row: f64| at + 30.0 * self.readout_s * (row / 480.0 - 0.5);
            let corners = (0..30).flat_map(|i| (0..24).map(move |j| (i, j)));
            let seen = |(i, j)| {
                let middle = self.seen(i, j, at)?;
                Some(((i * 24 + j) as u64, self.seen(i, j, late(middle.y))?.cast()))
            };
            let tracks = corners.filter_map(seen).collect();
            (FrameTracks { sequence: n as u64, timestamp_ns: n as i64 * 33_333_333, tracks }, self.pose(at))
        }

        pub fn views(&self, count: usize) -> Vec<View> {
            (0..count).map(|n| self.view(n)).collect()
        }
    }

    /// Of a camera that takes such steps, while `share` of the wall moves.
    pub fn views(count: usize, step: f64, share: f64) -> Vec<View> {
        Scene { step, share, ..Scene::default() }.views(count)
    }

    /// As the feature stage would hand it over.
    pub fn features(frame: &FrameTracks) -> FrameFeatures {
        let tracks = frame.tracks.iter().map(|&(id, position)| Track { id, position, age: 1 }).collect();
        FrameFeatures { sequence: frame.sequence, timestamp_ns: frame.timestamp_ns, tracks, ..FrameFeatures::default() }
    }

    pub fn posed(views: &[View]) -> PosedViews {
        let mut posed = PosedViews::default();
        views.iter().for_each(|(frame, pose)| posed.push(frame.clone(), pose));
        posed
    }

    fn told(views: &[View]) -> Option<Agreement> {
        posed(views).agreement(&camera(), &global_shutter())
    }

    #[test]
    fn the_world_agrees_and_what_moves_alone_does_not() {
        let share = |moving| told(&views(2, 0.1, moving)).map(|told| told.share);
        assert_eq!(share(0.0), Some(1.0));
        assert_eq!(told(&views(2, 0.1, 0.0)).map(|told| told.telling), Some(1.0));
        let third = share(0.3).unwrap();
        assert!((third - 0.7).abs() < 0.08, "{third}");
        let half = share(0.5).unwrap();
        assert!(half < AGREEING_SHARE, "{half}: no start");
    }

    #[test]
    fn a_camera_that_stands_is_told_nothing() {
        assert_eq!(told(&views(2, 0.0, 0.0)), None);
        assert_eq!(told(&[]), None);
    }

    #[test]
    fn what_a_rolling_shutter_bends_agrees_by_its_readout_and_not_by_none() {
        // At the last one the camera turns to the other side than at the first one.
        let all = posed(&Scene { turn: 2.0, readout_s: 0.02, ..Scene::default() }.views(28));
        let share = |readout_s| all.agreement(&camera(), &Shutter::new(readout_s, 480, false)).map_or(0.0, |t| t.share);
        let (right, none, wrong) = (share(0.02), share(0.0), share(-0.02));
        assert!(right > 0.9 && none < AGREEING_SHARE && wrong < none, "{right}, {none} by none, {wrong}");
    }

    #[test]
    fn views_are_forgotten_by_time_and_their_memory_goes_to_the_next() {
        let all = views(5, 0.1, 0.0);
        let mut posed = posed(&all);
        posed.forget_before(all[2].0.timestamp_ns, all[4].0.timestamp_ns);
        assert_eq!((posed.views.len(), posed.spare.len()), (3, 2));
        let next = FrameTracks { sequence: 9, timestamp_ns: 0, tracks: vec![(7, Vector2::new(1.0, 2.0))] };
        posed.push_features(&features(&next), &Se3::identity());
        assert_eq!(posed.spare.len(), 1);
        let newest = posed.views.back().unwrap();
        assert_eq!((newest.frame.sequence, newest.frame.tracks.as_slice()), (9, &[(7, Vector2::new(1.0, 2.0))][..]));
        posed.forget_before(-5, -1);
        assert!(posed.views.is_empty(), "the clock went back");
    }
}
