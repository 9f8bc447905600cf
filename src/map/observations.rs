//! What a keyframe saw: in full while the keyframe is detailed, packed once its picture is condensed.
//!
//! An observation takes 88 bytes, most of them what follows from its pixel and the lens. Packed it takes `size_of::<Packed>()`: the
//! landmark, the pixel in steps of 1/32 px (1/16 of pictures wider than 2047 px; off by 0.01 px in the mean, a thirtieth of what an alignment is
//! sure to), displacement and weight as f32 cut to 16 bits (off by 0.2 %). The rest is computed anew whenever one is asked for: some 0.1 us.
//! Packing what was packed before changes nothing, so a map that is stored and loaded again is the same to the bit.

use std::sync::Arc;

use nalgebra::{Matrix2, Vector2};

use crate::geometry::CameraModel;

/// A landmark of a map; never reused within a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct LandmarkId(pub u32);

/// Where a keyframe saw a landmark.
#[derive(Debug, Clone, Copy)]
pub struct Observation {
    pub landmark: LandmarkId,
    /// Level-0 pixel, distorted as in the picture.
    pub pixel: Vector2<f32>,
    /// The same, undistorted, on the plane z = 1.
    pub normalised: Vector2<f64>,
    /// How far a rolling shutter moved it, per second of readout time.
    pub displacement: Vector2<f64>,
    /// One over the standard deviation of `pixel`, 1/px.
    pub inv_sigma_px: f64,
    /// d normalised / d pixel at `pixel`: takes pixel offsets to ray offsets.
    pub normalised_from_pixel: Matrix2<f64>,
}

impl Observation {
    /// Where the middle row's pose would have seen it, for a readout time in seconds.
    pub fn at_middle_row(&self, readout_s: f64) -> Vector2<f64> {
        self.normalised - self.displacement * readout_s
    }
}

/// Observations of one keyframe, ascending landmark id, one each.
#[derive(Clone)]
pub struct Observations(Kept);

#[derive(Clone)]
enum Kept {
    Whole(Vec<Observation>),
    Packed { lens: Arc<CameraModel>, all: Vec<Packed> },
}

/// See the module.
#[derive(Debug, Clone, Copy)]
struct Packed {
    landmark: LandmarkId,
    pixel: [u16; 2],
    displacement: [u16; 2],
    inv_sigma_px: u16,
}

/// The largest number of 16 bits that is finite.
const LARGEST: f32 = f32::from_bits(0x7F7F_0000);

/// The upper half of a f32, rounded to nearest; what is larger than the largest becomes the largest.
fn half(value: f64) -> u16 {
    let bits = (value as f32).clamp(-LARGEST, LARGEST).to_bits();
    (bits.saturating_add(0x8000) >> 16) as u16
}

fn whole(half: u16) -> f64 {
    f64::from(f32::from_bits(u32::from(half) << 16))
}

/// Steps of a pixel: the finest power of two with which all of the picture is told.
fn steps(lens: &CameraModel) -> f32 {
    let longest = lens.width.max(lens.height).max(1);
    (u32::from(u16::MAX) / longest).checked_ilog2().map_or(1.0, |log| (1u32 << log.min(5)) as f32)
}

impl Packed {
    fn of(o: &Observation, lens: &CameraModel) -> Self {
        let steps = steps(lens);
        Self {
            landmark: o.landmark,
            // Saturates, but no observation lies outside of its picture.
            pixel: [o.pixel.x, o.pixel.y].map(|v| (v * steps).round() as u16),
            displacement: [half(o.displacement.x), half(o.displacement.y)],
            inv_sigma_px: half(o.inv_sigma_px),
        }
    }

    fn pixel(&self, lens: &CameraModel) -> Vector2<f32> {
        Vector2::from(self.pixel.map(f32::from)) / steps(lens)
    }

    fn unpacked(&self, lens: &CameraModel) -> Observation {
        let pixel = self.pixel(lens);
        let (normalised, normalised_from_pixel) = lens.undistort_jacobian(&pixel.cast()).unwrap_or_else(|| {
            // A lens that was refined since may not reach so far any more: as if it bent nothing there.
            let off = Vector2::new(f64::from(pixel.x) - lens.cx, f64::from(pixel.y) - lens.cy);
            let per_px = Matrix2::new(1.0 / lens.fx, 0.0, 0.0, 1.0 / lens.fy);
            (per_px * off, per_px)
        });
        Observation {
            landmark: self.landmark,
            pixel,
            normalised,
            displacement: Vector2::from(self.displacement.map(whole)),
            inv_sigma_px: whole(self.inv_sigma_px),
            normalised_from_pixel,
        }
    }
}

impl Default for Observations {
    fn default() -> Self {
        Self(Kept::Whole(Vec::new()))
    }
}

impl From<Vec<Observation>> for Observations {
    /// Of each landmark the first one stays.
    fn from(mut all: Vec<Observation>) -> Self {
        all.sort_by_key(|o| o.landmark);
        all.dedup_by_key(|o| o.landmark);
        Self(Kept::Whole(all))
    }
}

impl FromIterator<Observation> for Observations {
    fn from_iter<I: IntoIterator<Item = Observation>>(all: I) -> Self {
        all.into_iter().collect::<Vec<_>>().into()
    }
}

impl std::fmt::Debug for Observations {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}

impl Observations {
    pub fn len(&self) -> usize {
        match &self.0 {
            Kept::Whole(all) => all.len(),
            Kept::Packed { all, .. } => all.len(),
        }
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn landmark_at(&self, i: usize) -> LandmarkId {
        match &self.0 {
            Kept::Whole(all) => all[i].landmark,
            Kept::Packed { all, .. } => all[i].landmark,
        }
    }

    fn at(&self, i: usize) -> Observation {
        match &self.0 {
            Kept::Whole(all) => all[i],
            Kept::Packed { lens, all } => all[i].unpacked(lens),
        }
    }

    fn place_of(&self, landmark: LandmarkId) -> Result<usize, usize> {
        match &self.0 {
            Kept::Whole(all) => all.binary_search_by_key(&landmark, |o| o.landmark),
            Kept::Packed { all, .. } => all.binary_search_by_key(&landmark, |o| o.landmark),
        }
    }

    /// All of them, ascending.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Observation> + Clone + '_ {
        (0..self.len()).map(|i| self.at(i))
    }

    /// What was seen, ascending; cheaper than all that is known of it.
    pub fn landmarks(&self) -> impl ExactSizeIterator<Item = LandmarkId> + Clone + '_ {
        (0..self.len()).map(|i| self.landmark_at(i))
    }

    /// The same with its pixel.
    pub fn pixels(&self) -> impl ExactSizeIterator<Item = (LandmarkId, Vector2<f32>)> + Clone + '_ {
        (0..self.len()).map(|i| match &self.0 {
            Kept::Whole(all) => (all[i].landmark, all[i].pixel),
            Kept::Packed { lens, all } => (all[i].landmark, all[i].pixel(lens)),
        })
    }

    pub fn get(&self, landmark: LandmarkId) -> Option<Observation> {
        self.place_of(landmark).ok().map(|i| self.at(i))
    }

    pub fn contains(&self, landmark: LandmarkId) -> bool {
        self.place_of(landmark).is_ok()
    }

    /// Memory on the heap, bytes.
    pub fn bytes(&self) -> usize {
        match &self.0 {
            Kept::Whole(all) => all.capacity() * size_of::<Observation>(),
            Kept::Packed { all, .. } => all.capacity() * size_of::<Packed>(),
        }
    }

    /// Whether it was not there and is now.
    pub(super) fn insert(&mut self, observation: Observation) -> bool {
        let Err(i) = self.place_of(observation.landmark) else { return false };
        match &mut self.0 {
            Kept::Whole(all) => all.insert(i, observation),
            Kept::Packed { lens, all } => all.insert(i, Packed::of(&observation, lens)),
        }
        true
    }

    /// One that is there is this one now.
    pub(super) fn replace(&mut self, observation: Observation) {
        let Ok(i) = self.place_of(observation.landmark) else { return };
        match &mut self.0 {
            Kept::Whole(all) => all[i] = observation,
            Kept::Packed { lens, all } => all[i] = Packed::of(&observation, lens),
        }
    }

    /// Whether it was there and is not now.
    pub(super) fn remove(&mut self, landmark: LandmarkId) -> bool {
        let Ok(i) = self.place_of(landmark) else { return false };
        match &mut self.0 {
            Kept::Whole(all) => _ = all.remove(i),
            Kept::Packed { all, .. } => {
                all.remove(i);
                // Of an old keyframe most go in the end, as nothing shows their landmarks any more.
                if all.capacity() >= 2 * all.len() {
                    all.shrink_to_fit();
                }
            }
        }
        true
    }

    pub(super) fn retain(&mut self, mut stays: impl FnMut(LandmarkId) -> bool) {
        match &mut self.0 {
            Kept::Whole(all) => all.retain(|o| stays(o.landmark)),
            Kept::Packed { all, .. } => all.retain(|o| stays(o.landmark)),
        }
    }

    /// Landmarks have other ids now, in the same order.
    pub(super) fn rename_all(&mut self, new: impl Fn(LandmarkId) -> LandmarkId) {
        match &mut self.0 {
            Kept::Whole(all) => all.iter_mut().for_each(|o| o.landmark = new(o.landmark)),
            Kept::Packed { all, .. } => all.iter_mut().for_each(|o| o.landmark = new(o.landmark)),
        }
    }

    /// How a rolling shutter displaced each, where that is known.
    pub(super) fn displace(&mut self, displacement: impl Fn(&Observation) -> Option<Vector2<f64>>) {
        match &mut self.0 {
            Kept::Whole(all) => {
                for o in all {
                    o.displacement = displacement(o).unwrap_or(o.displacement);
                }
            }
            Kept::Packed { lens, all } => {
                for o in all {
                    if let Some(d) = displacement(&o.unpacked(lens)) {
                        o.displacement = [half(d.x), half(d.y)];
                    }
                }
            }
        }
    }

    /// Whether this lens has undistorted them: always all at once.
    pub(super) fn are_undistorted_by(&self, lens: &CameraModel) -> bool {
        match &self.0 {
            Kept::Whole(all) => all.first().is_some_and(|o| {
                let here = lens.undistort_jacobian(&o.pixel.cast());
                here == Some((o.normalised, o.normalised_from_pixel))
            }),
            Kept::Packed { lens: by, .. } => **by == *lens,
        }
    }

    /// Undistorts all by another lens of the same pictures.
    pub(super) fn undistort_anew(&mut self, by: &Arc<CameraModel>) {
        match &mut self.0 {
            Kept::Whole(all) => {
                for o in all {
                    if let Some((normalised, from_pixel)) = by.undistort_jacobian(&o.pixel.cast()) {
                        (o.normalised, o.normalised_from_pixel) = (normalised, from_pixel);
                    }
                }
            }
            Kept::Packed { lens, .. } => *lens = by.clone(),
        }
    }

    /// Packs them; they were undistorted by this lens.
    pub fn pack(&mut self, lens: &Arc<CameraModel>) {
        if let Kept::Whole(all) = &self.0 {
            let packed = all.iter().map(|o| Packed::of(o, lens)).collect::<Box<[_]>>().into_vec();
            self.0 = Kept::Packed { lens: lens.clone(), all: packed };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;

    fn lens() -> CameraModel {
        CameraModel::new(640, 480, 517.0, 516.0, 318.6, 255.3, [0.26, -0.95, -0.005, 0.003, 1.16]).expect("a camera")
    }

    fn seen(lens: &CameraModel, count: u32) -> Observations {
        let mut random = Random::new(9);
        let one = |i| {
            let pixel = Vector2::new(random.uniform(0.0, 639.0) as f32, random.uniform(0.0, 479.0) as f32);
            let (normalised, normalised_from_pixel) = lens.undistort_jacobian(&pixel.cast()).expect("in the picture");
            Observation {
                landmark: LandmarkId(3 * i),
                pixel,
                normalised,
                displacement: Vector2::new(random.normal(), random.normal()),
                inv_sigma_px: random.uniform(0.2, 3.0),
                normalised_from_pixel,
            }
        };
        (0..count).map(one).collect()
    }

    #[test]
    fn what_was_packed_is_nearly_what_was_seen_and_packing_it_again_changes_nothing() {
        let lens = Arc::new(lens());
        let whole = seen(&lens, 200);
        let mut packed = whole.clone();
        packed.pack(&lens);
        for (a, b) in whole.iter().zip(packed.iter()) {
            assert_eq!(a.landmark, b.landmark);
            assert!((a.pixel - b.pixel).amax() <= 1.0 / 64.0, "{} {}", a.pixel, b.pixel);
            let moved = (a.normalised - b.normalised).norm() * lens.focal_px();
            assert!(moved < 0.05, "{moved} px");
            assert!((a.normalised_from_pixel - b.normalised_from_pixel).norm() < 1e-3 * a.normalised_from_pixel.norm());
            assert!((a.displacement - b.displacement).norm() < 0.004 * a.displacement.norm());
            assert!((a.inv_sigma_px / b.inv_sigma_px - 1.0).abs() < 0.004);
        }
        let mut again: Observations = packed.iter().collect();
        again.pack(&lens);
        assert_eq!(format!("{packed:?}"), format!("{again:?}"));
        assert!(packed.bytes() <= 200 * 16 && whole.bytes() >= 200 * 88);
    }

    #[test]
    fn however_large_a_number_is_it_stays_finite() {
        for value in [1e300, f64::from(f32::MAX), 3.395e38, f64::INFINITY] {
            let packed = [value, -value].map(|v| whole(half(v)));
            assert_eq!(packed, [f64::from(LARGEST), -f64::from(LARGEST)], "{value}");
        }
        assert_eq!(half(whole(half(1.0 / 3.0))), half(1.0 / 3.0));
    }

    #[test]
    fn packed_or_not_they_are_found_entered_and_taken_away_alike() {
        let lens = Arc::new(lens());
        let mut whole = seen(&lens, 40);
        let mut packed = whole.clone();
        packed.pack(&lens);
        let ids = |o: &Observations| o.landmarks().collect::<Vec<_>>();
        for all in [&mut whole, &mut packed] {
            let one = all.get(LandmarkId(30)).expect("there");
            assert!(!all.insert(one) && all.insert(Observation { landmark: LandmarkId(31), ..one }));
            assert!(all.remove(LandmarkId(33)) && !all.remove(LandmarkId(33)) && !all.contains(LandmarkId(33)));
            all.replace(Observation { landmark: LandmarkId(36), inv_sigma_px: 2.0, ..one });
            assert_eq!(all.get(LandmarkId(36)).map(|o| o.inv_sigma_px), Some(2.0));
            all.retain(|l| l != LandmarkId(0));
            all.rename_all(|l| LandmarkId(l.0 + 100));
            all.displace(|o| (o.landmark == LandmarkId(103)).then(|| Vector2::new(0.5, -2.0)));
            assert_eq!(all.get(LandmarkId(103)).map(|o| o.displacement), Some(Vector2::new(0.5, -2.0)));
        }
        assert!(all_gone_leave_nothing(packed.clone()));
        assert_eq!(ids(&whole), ids(&packed));
        assert!(ids(&packed).is_sorted());
        // Another lens: both follow it.
        let other = Arc::new(CameraModel::new(640, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).expect("a camera"));
        for all in [&mut whole, &mut packed] {
            assert!(all.are_undistorted_by(&lens) && !all.are_undistorted_by(&other));
            all.undistort_anew(&other);
            assert!(all.are_undistorted_by(&other) && !all.are_undistorted_by(&lens));
            let o = all.get(LandmarkId(131)).expect("there");
            assert!((o.normalised.x - (f64::from(o.pixel.x) - 320.0) / 500.0).abs() < 1e-9);
        }
    }

    fn all_gone_leave_nothing(mut all: Observations) -> bool {
        let landmarks: Vec<LandmarkId> = all.landmarks().collect();
        landmarks.into_iter().for_each(|landmark| assert!(all.remove(landmark)));
        all.is_empty() && all.bytes() == 0
    }

    #[test]
    fn pictures_of_any_size_are_told_to_the_end() {
        for (width, told) in [(640, 32.0), (2047, 32.0), (2048, 16.0), (4096, 8.0)] {
            let lens = CameraModel::new(width, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).expect("a camera");
            assert_eq!(steps(&lens), told, "{width}");
        }
    }
}
