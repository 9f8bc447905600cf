//! The feature thread's work as a plain step: decode, pyramid, follow tracks, start new ones where cells are empty.
//!
//! Where a track is looked for comes from the motion between blurred thumbnails of the two pictures (fast turns); a track
//! that is lost there gets a second chance at the median motion of its neighbours. Where the picture moves quickly, corners that
//! look like others nearby (`repetition`) are followed last and only near where their neighbours went. Corners are detected in cells without
//! a track, each cell at a threshold of its own that follows its texture; weak ones only where a dark or bare picture has few others.
//! Deterministic; allocates nothing once warm.

use std::sync::Arc;

use nalgebra::Vector2;

use super::alignment::Template;
use super::config::{DetectorKind, FeaturesConfig};
use super::fast::FastDetector;
use super::optical_flow::{FlowOptions, Point, follow};
use super::repetition::is_repeated;
use super::susan::SusanDetector;
use super::thumbnail::{Thumbnail, ThumbnailAligner};
use super::{CellGrid, Corner, CornerDetector, Feedback, FrameFeatures, Track};
use crate::frame::{RawFrame, monotonic_ns};
use crate::image::decode::{DecodeError, Decoder};
use crate::image::pyramid::PyramidPool;
use crate::image::{GreyImage, Pyramid};

/// Pyramid levels: 640x480 down to 40x30.
const LEVELS: usize = 5;
/// Pyramids under way at once: the stage's previous one, the frame in the channel, the one being tracked, two to spare.
const POOL: usize = 6;
/// Corners nearer to the picture's edge than this are not started, px.
const BORDER_PX: f32 = 10.0;
/// Thumbnails less alike than this say nothing about the motion.
const THUMBNAIL_NCC: f32 = 0.5;
/// Smallest side of a cell of the detection grid, px.
const MIN_CELL_PX: usize = 12;
/// Neighbours whose median motion gives a lost track its second chance.
const NEIGHBOURS: usize = 5;
/// Between pictures that moved by more than this a guess can be off by half the period of a pattern, px.
const QUICK_PX: f32 = 32.0;
/// Corners are detected when tracks fill less than this share of the cells.
const FILLED_SHARE: f32 = 0.95;
/// Corners weaker than the configuration asks for are followed, the strongest first, while tracks are fewer than this share of the most
/// that there may be (one a cell). Chosen on half of 158 recordings made darker, quicker, shorter and smaller than those that they were
/// made of (0.3 to 0.7 tried); on the other half 3 % more frames had a pose at once, and errors were a twentieth smaller.
const FEW_SHARE: f32 = 0.5;
/// The smaller eigenvalue of such a corner at the least, grey²/px² (of pure noise of one grey level it is 0.4), and its share of the larger
/// one: below that a patch slides along its edge, however much stands out from the noise.
const WEAKEST_EIGENVALUE: f32 = 1.0;
const EDGE_SHARE: f32 = 0.1;
/// A first picture is searched down to there at once; later, what is asked sinks by this factor a picture with few tracks of strong corners.
/// A dark room stays, while what blur leaves of strong corners for some frames is not worth following.
const PATIENCE: f32 = 0.97;
/// How much a cell without a corner lowers its threshold, and how often at once in a first picture.
const LOWERED: f32 = 0.7;
const SETTLING_PASSES: usize = 4;
/// What was lowered comes back by this factor a picture.
const RAISED: f32 = 1.1;

/// A track of the previous frame on its way into this one.
#[derive(Debug, Clone, Copy)]
struct Step {
    track: Track,
    guess: Vector2<f32>,
    found: Option<Vector2<f32>>,
    /// Followed last.
    repeated: bool,
}

impl Step {
    /// Looks for the track around `guess`; `template` becomes that of the place found.
    fn follow(
        &mut self,
        previous: &Pyramid,
        current: &Pyramid,
        template: &mut Template,
        guess: Vector2<f32>,
        options: &FlowOptions,
    ) {
        let point = Point { place: self.track.position, template: *template };
        if let Some(found) = follow(previous, current, &point, guess, options) {
            (self.found, *template) = (Some(found.place), found.template);
        }
    }
}

/// See the module.
#[derive(Debug)]
pub struct FeatureStage {
    config: FeaturesConfig,
    decoder: Decoder,
    pool: PyramidPool,
    detector: Box<dyn CornerDetector>,
    previous: Option<Arc<Pyramid>>,
    previous_thumbnail: Thumbnail,
    thumbnail: Thumbnail,
    aligner: ThumbnailAligner,
    tracks: Vec<Track>,
    /// What each of them is followed by.
    templates: Vec<Template>,
    steps: Vec<Step>,
    /// Tracks whose corner looks like another one nearby, ascending id.
    repeated: Vec<u64>,
    /// Tracks that began at a weak corner, ascending id.
    weak: Vec<u64>,
    next_id: u64,
    grid: CellGrid,
    /// Threshold of each cell, grey levels.
    thresholds: Vec<f32>,
    /// No picture of this size has been looked at so far.
    fresh: bool,
    corners: Vec<Corner>,
    /// Best corner of each cell with its eigenvalue.
    best: Vec<Option<(f32, Vector2<f32>)>>,
    /// Room to sort those of the cells without a track.
    eigenvalues: Vec<f32>,
    /// Smaller eigenvalue of the weakest corner that is looked at in these pictures, grey²/px².
    weakest: f32,
}

impl FeatureStage {
    pub fn new(config: &FeaturesConfig) -> Self {
        let detector: Box<dyn CornerDetector> = match config.detector {
            DetectorKind::Fast => Box::new(FastDetector::new()),
            DetectorKind::Susan => Box::new(SusanDetector::default()),
        };
        Self {
            config: config.clone(),
            decoder: Decoder::default(),
            pool: PyramidPool::new(POOL, LEVELS),
            detector,
            previous: None,
            previous_thumbnail: Thumbnail::default(),
            thumbnail: Thumbnail::default(),
            aligner: ThumbnailAligner::default(),
            tracks: Vec::new(),
            templates: Vec::new(),
            steps: Vec::new(),
            repeated: Vec::with_capacity(config.max_tracks),
            weak: Vec::with_capacity(config.max_tracks),
            next_id: 0,
            grid: CellGrid::new(0, 0, config.cell_px, config.threshold),
            thresholds: Vec::new(),
            fresh: true,
            corners: Vec::new(),
            best: Vec::new(),
            eigenvalues: Vec::new(),
            weakest: WEAKEST_EIGENVALUE,
        }
    }

    /// Decodes `frame` and fills `out`. A corrupt picture is an error and leaves the stage as it was.
    pub fn step(&mut self, frame: &RawFrame, out: &mut FrameFeatures) -> Result<(), DecodeError> {
        let decoder = &mut self.decoder;
        let mut decoded_ns = 0;
        let pyramid = self.pool.fill(|p| {
            decoder.decode(frame, p.base_mut())?;
            decoded_ns = monotonic_ns();
            p.rebuild();
            Ok(())
        })?;
        out.sequence = frame.sequence;
        out.timestamp_ns = frame.timestamp_ns;
        out.arrival_ns = frame.arrival_ns;
        out.decoded_ns = decoded_ns;
        self.follow_into(pyramid, out);
        Ok(())
    }

    /// The same for a picture that is grey already; `out`'s times and number are left alone.
    pub fn step_grey(&mut self, picture: &GreyImage, out: &mut FrameFeatures) {
        let filled: Result<_, std::convert::Infallible> = self.pool.fill(|p| {
            p.build(picture);
            Ok(())
        });
        let Ok(pyramid) = filled;
        self.follow_into(pyramid, out);
    }

    /// Takes reconstruction's feedback; applied from the next step on.
    pub fn feedback(&mut self, feedback: &Feedback) {
        let mut kept = 0;
        for i in 0..self.tracks.len() {
            if feedback.forget.binary_search(&self.tracks[i].id).is_err() {
                (self.tracks[kept], self.templates[kept]) = (self.tracks[i], self.templates[i]);
                kept += 1;
            }
        }
        self.tracks.truncate(kept);
        self.templates.truncate(kept);
    }

    fn follow_into(&mut self, pyramid: Arc<Pyramid>, out: &mut FrameFeatures) {
        let previous = self.previous.take().filter(|p| p.size() == pyramid.size());
        self.thumbnail.build(&pyramid);
        match &previous {
            Some(previous) => self.follow_tracks(previous, &pyramid),
            None => self.start_over(&pyramid),
        }
        std::mem::swap(&mut self.thumbnail, &mut self.previous_thumbnail);
        self.detect(&pyramid);
        out.tracks.clear();
        out.tracks.extend_from_slice(&self.tracks);
        self.previous = Some(pyramid.clone());
        out.pyramid = pyramid;
    }

    /// First picture, or one of another size.
    fn start_over(&mut self, pyramid: &Pyramid) {
        let (width, height) = pyramid.size();
        self.tracks.clear();
        self.templates.clear();
        self.repeated.clear();
        self.weak.clear();
        self.weakest = WEAKEST_EIGENVALUE;
        self.fresh = true;
        // A small picture has as many cells as a large one, or it could not be tracked.
        let share = ((width * height) as f32 / self.config.max_tracks as f32).sqrt().round() as usize;
        let cell_px = share.clamp(MIN_CELL_PX, self.config.cell_px.max(MIN_CELL_PX));
        self.grid = CellGrid::new(width, height, cell_px, self.config.threshold);
        self.thresholds.clear();
        self.thresholds.resize(self.grid.cells.len(), self.config.threshold);
        self.eigenvalues.reserve(self.grid.cells.len());
    }

    fn follow_tracks(&mut self, previous: &Pyramid, current: &Pyramid) {
        let motion = self.aligner.align(&self.previous_thumbnail, &self.thumbnail).filter(|m| m.ncc >= THUMBNAIL_NCC);
        let options = FlowOptions {
            min_ncc: self.config.min_ncc,
            max_return_px: self.config.max_return_px,
            ..FlowOptions::default()
        };
        let quick = motion.is_some_and(|m| m.shift_px.norm() > QUICK_PX);
        self.steps.clear();
        for (&track, template) in self.tracks.iter().zip(&mut self.templates) {
            let guess = motion.map_or(track.position, |m| m.apply(track.position));
            let repeated = quick && self.repeated.binary_search(&track.id).is_ok();
            let mut step = Step { track, guess, found: None, repeated };
            if !repeated {
                step.follow(previous, current, template, guess, &options);
            }
            self.steps.push(step);
        }
        let wide = FlowOptions { coarsest_level: 3, ..options };
        let close = FlowOptions { coarsest_level: 1, ..options };
        for (repeated, options) in [(false, wide), (true, close)] {
            for i in 0..self.steps.len() {
                let step = self.steps[i];
                if step.found.is_none() && step.repeated == repeated {
                    let guess = step.guess + neighbours_residual(&self.steps, step.track.position);
                    self.steps[i].follow(previous, current, &mut self.templates[i], guess, &options);
                }
            }
        }
        let steps = &self.steps;
        let living = |id: &u64| steps.binary_search_by_key(id, |s| s.track.id).is_ok_and(|i| steps[i].found.is_some());
        self.repeated.retain(living);
        self.weak.retain(living);
        self.tracks.clear();
        for (i, step) in self.steps.iter().enumerate() {
            if let Some(position) = step.found {
                self.templates[self.tracks.len()] = self.templates[i];
                self.tracks.push(Track { position, age: step.track.age.saturating_add(1), ..step.track });
            }
        }
        self.templates.truncate(self.tracks.len());
    }

    /// Lowers the thresholds of cells without a corner at once, where no earlier picture could show what they need.
    fn settle_thresholds(&mut self, image: &GreyImage) {
        for _ in 0..SETTLING_PASSES {
            self.detector.detect(image, &self.grid, &mut self.corners);
            self.best.clear();
            self.best.resize(self.grid.cells.len(), None);
            for corner in &self.corners {
                if let Some(i) = self.grid.index(corner.x, corner.y) {
                    self.best[i] = Some((0.0, Vector2::zeros()));
                }
            }
            let mut lowered = false;
            for ((cell, threshold), best) in self.grid.cells.iter_mut().zip(&mut self.thresholds).zip(&self.best) {
                if best.is_none() && *threshold > self.config.min_threshold {
                    *threshold = (*threshold * LOWERED).max(self.config.min_threshold);
                    cell.threshold = *threshold;
                    lowered = true;
                }
            }
            if !lowered {
                break;
            }
        }
    }

    /// The best corner of each cell, the one with the largest smaller eigenvalue: strong ones, and weak ones that are no edges.
    fn find_best(&mut self, image: &GreyImage) {
        self.best.clear();
        self.best.resize(self.grid.cells.len(), None);
        let (right, bottom) = (image.width as f32 - 1.0 - BORDER_PX, image.height as f32 - 1.0 - BORDER_PX);
        for corner in &self.corners {
            let inside = corner.x >= BORDER_PX && corner.y >= BORDER_PX && corner.x <= right && corner.y <= bottom;
            let Some(i) = self.grid.index(corner.x, corner.y).filter(|_| inside) else { continue };
            let position = Vector2::new(corner.x, corner.y);
            let Some([smaller, larger]) = Template::eigenvalues_at(image, position) else { continue };
            let is_strong = smaller >= self.config.min_eigenvalue;
            let is_corner = smaller >= self.weakest && smaller >= EDGE_SHARE * larger;
            if (is_strong || is_corner) && self.best[i].is_none_or(|b| smaller > b.0) {
                self.best[i] = Some((smaller, position));
            }
        }
    }

    /// Tracks below which weak corners are followed.
    fn few(&self) -> usize {
        (FEW_SHARE * self.config.max_tracks.min(self.grid.cells.len()) as f32) as usize
    }

    /// The eigenvalue that a new track's corner must have: with few tracks less than the configuration asks for.
    fn least_eigenvalue(&mut self) -> f32 {
        let missing = self.few().saturating_sub(self.tracks.len());
        let Some(last) = missing.checked_sub(1) else { return self.config.min_eigenvalue };
        let wanted = self.best.iter().zip(&self.grid.cells).filter(|(_, cell)| cell.wanted);
        self.eigenvalues.clear();
        self.eigenvalues.extend(wanted.filter_map(|(best, _)| Some(best.as_ref()?.0)));
        self.eigenvalues.sort_unstable_by(|a, b| b.total_cmp(a));
        self.eigenvalues.get(last).map_or(0.0, |e| e.min(self.config.min_eigenvalue))
    }

    /// With few tracks of strong corners weaker ones are looked at in the next picture.
    fn adapt_weakest(&mut self) {
        let strong = self.tracks.len().saturating_sub(self.weak.len());
        let factor = if strong < self.few() { PATIENCE } else { RAISED };
        let most = self.config.min_eigenvalue.max(WEAKEST_EIGENVALUE);
        self.weakest = (self.weakest * factor).clamp(WEAKEST_EIGENVALUE, most);
    }

    /// One new track in each empty cell that has a corner.
    fn detect(&mut self, pyramid: &Pyramid) {
        let Some(image) = pyramid.levels.first() else { return };
        for (cell, &threshold) in self.grid.cells.iter_mut().zip(&self.thresholds) {
            cell.wanted = true;
            cell.threshold = threshold;
        }
        let mut filled = 0;
        for track in &self.tracks {
            if let Some(i) = self.grid.index(track.position.x, track.position.y)
                && std::mem::replace(&mut self.grid.cells[i].wanted, false)
            {
                filled += 1;
            }
        }
        let room = self.config.max_tracks.saturating_sub(self.tracks.len());
        if room == 0 || filled as f32 >= FILLED_SHARE * self.grid.cells.len() as f32 {
            self.adapt_weakest();
            return;
        }
        if std::mem::take(&mut self.fresh) {
            self.settle_thresholds(image);
        }
        self.detector.detect(image, &self.grid, &mut self.corners);
        self.find_best(image);
        let least = self.least_eigenvalue();
        let mut started = 0;
        for (i, best) in self.best.iter().enumerate() {
            if !self.grid.cells[i].wanted {
                continue;
            }
            // A cell without a corner is looked at more closely next time, one with a corner a little less so.
            let threshold = &mut self.thresholds[i];
            let Some((eigenvalue, position)) = best.filter(|b| b.0 >= least) else {
                *threshold = (*threshold * LOWERED).max(self.config.min_threshold);
                continue;
            };
            *threshold = (*threshold * RAISED).min(self.config.threshold);
            if started < room {
                let Some(template) = Template::from_image(image, position) else { continue };
                if is_repeated(image, &template, position, &self.corners) {
                    self.repeated.push(self.next_id);
                }
                if eigenvalue < self.config.min_eigenvalue {
                    self.weak.push(self.next_id);
                }
                self.templates.push(template);
                self.tracks.push(Track { id: self.next_id, position, age: 0 });
                self.next_id += 1;
                started += 1;
            }
        }
        self.adapt_weakest();
    }
}

/// Median of how far the nearest found tracks, of corners that look like no other, lie from their guesses.
fn neighbours_residual(steps: &[Step], position: Vector2<f32>) -> Vector2<f32> {
    let mut near = [(f32::INFINITY, Vector2::zeros()); NEIGHBOURS];
    let mut count = 0;
    for step in steps {
        let Some(found) = step.found.filter(|_| !step.repeated) else { continue };
        let distance = (step.track.position - position).norm_squared();
        if distance < near[NEIGHBOURS - 1].0 {
            let mut i = NEIGHBOURS - 1;
            while i > 0 && near[i - 1].0 > distance {
                near[i] = near[i - 1];
                i -= 1;
            }
            near[i] = (distance, found - step.guess);
            count = (count + 1).min(NEIGHBOURS);
        }
    }
    if count == 0 {
        return Vector2::zeros();
    }
    let component = |axis: usize| {
        let mut values = [0.0f32; NEIGHBOURS];
        for (v, n) in values.iter_mut().zip(&near[..count]) {
            *v = n.1[axis];
        }
        values[..count].sort_unstable_by(f32::total_cmp);
        values[count / 2]
    };
    Vector2::new(component(0), component(1))
}

#[cfg(test)]
mod tests;
