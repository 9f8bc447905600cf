//! Where a keyframe saw the floor itself: patches that look in earlier keyframes as the floor's plane has it, and not as anything that stands up would.
//!
//! Plane, camera, the keyframe's picture and those of a few before it -> for each of a fan of bearings from where to where the floor is seen, where
//! what is seen begins to be something else, and where that stands; in the keyframe's own axes on the floor (forward, left), in heights of the
//! camera: they hold in any unit and move with the keyframe.
//!
//! The floor's plane takes one picture to another by a homography; so does an upright face at the same pixel, which is nearer: it meets the pixel's ray
//! at some height h above the floor. A patch of the new picture is compared with the earlier ones both ways. After gain and offset the residual variance of a
//! patch of contrast c that correlates by r is `e = c² (1 - r²)`, and
//!
//! `Λ(h) = n Σ (e(h) - e(floor)) / s²`, `s² = max(NOISE², mean e(floor))`
//!
//! is twice the logarithm of the likelihood ratio (Gaussian noise, n independent pixels of a patch, sum over the earlier pictures, as if these were
//! independent: they share the newest patch's noise, so the ratio is larger than what is known by up to the number of pictures). The same is asked of
//! levels beneath the floor (`DROPS`): a step down fits the floor better than any face does. The place is floor if `Λ >` `SURE` for every drop and for
//! every face of `FACES` but the lowest, and none of these is better than the floor by as much; it is something else if a drop, or a face but the very
//! lowest, is. A bare patch, or a line along the camera's motion, tells neither.
//!
//! What that proves is the ray and not the place: faces lower than the lowest that is excluded, `h`, look like the floor, so a place at distance d
//! proves that nothing stands nearer than `d (1 - h)`; and of the ray only that nothing that reaches down to the floor crosses it: what hangs above it is
//! not seen. Between the last proven distance p and what the next place, at d, proves, the ray to d is `1 - p / d` of the camera's height above p: so
//! high a thing may hide there, and a hole. Where that is more than a share `HIDES` of the camera's height, or `HIDES_M`, the stretch ends at p, and another
//! begins where the ray to d is that low; the first one begins so, too. Something else ends them all. So unknown places in between are filled up to a share
//! `HIDES` of the distance.
//!
//! Where a face is better than the floor and than all faces but its neighbours, it tells how far away it is. What stands upright does so alike at several
//! heights: places of one bearing, one beyond the other, whose faces are at one distance (to `ONE_FACE`) are a thing.
//!
//! Pictures of about 320 pixels' width do best (noise); whoever calls takes that level of the pyramids, and the camera to it.
//!
//! Cost: 1000 places in view, up to 6 pictures and 11 hypotheses each, while somebody asks: some 15 ms a keyframe when it were 4 pictures, not measured since. Not here: what becomes of it; a floor that moves.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::plane::Plane;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::GreyImage;

/// A keyframe's pose and picture.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'a> {
    pub camera_from_world: &'a Se3<Camera, World>,
    pub image: &'a GreyImage,
}

/// The grid: bearings, degrees; distances, heights, each ring farther than the last by the factor. Beyond the last one the floor is foreshortened to nothing.
const BEARING_STEP_DEG: f64 = 2.0;
const WIDEST_DEG: f64 = 60.0;
const NEAREST: f64 = 0.8;
const FARTHEST: f64 = 8.0;
const RING_FACTOR: f64 = 1.05;
/// Side of a patch, px, and the least standard deviation of its grey levels: what is barer tells nothing.
const PATCH_PX: usize = 9;
const LEAST_CONTRAST: f64 = 2.5;
/// Pixels of a patch whose errors are independent: interpolation and the picture's level make four of one.
const INDEPENDENT: f64 = (PATCH_PX * PATCH_PX) as f64 / 4.0;
/// Heights, shares of the camera's, at which upright faces meet a pixel's ray. All but the lowest of these, fewer than the second number, must be excluded.
const FACES: [f64; 7] = [0.06, 0.12, 0.18, 0.27, 0.40, 0.55, 0.70];
const LOWEST: usize = 3;
/// Levels beneath the floor that must be excluded, shares of the camera's height: half the first looks like the floor.
const DROPS: [f64; 3] = [0.15, 0.3, 0.6];
/// Least standard deviation of what two pictures of one patch differ by, grey levels.
const NOISE: f64 = 3.0;
/// Twice the logarithm of a likelihood ratio that decides: four sigmas.
const SURE: f64 = 16.0;
/// Shares of a patch's variance that the floor, and what is taken for something else, may leave unexplained.
const FLOOR_UNEXPLAINED: f64 = 0.7;
const OTHER_UNEXPLAINED: f64 = 0.4;
/// What may hide between two proven distances at the most: a share of the camera's height, and m.
const HIDES: f64 = 0.2;
const HIDES_M: f64 = 0.1;
/// Places of a bearing, and how far apart at the most the nearest and the farthest of their faces are (a share), that make a thing.
const LEAST_PLACES: usize = 3;
const ONE_FACE: f64 = 0.07;

/// The camera over the floor: foot point, and forward and left on the floor.
#[derive(Debug, Clone, Copy)]
pub struct Footing {
    pub foot: Vector3<f64>,
    pub forward: Vector3<f64>,
    pub left: Vector3<f64>,
}

impl Footing {
    /// `None`: the camera looks straight up or down.
    pub fn of(plane: &Plane, camera_from_world: &Se3<Camera, World>) -> Option<Self> {
        let world_from_camera = camera_from_world.inverse();
        let centre = world_from_camera.translation;
        let axis = world_from_camera.rotation * Vector3::z();
        let forward = (axis - plane.normal * plane.normal.dot(&axis)).try_normalize(0.1)?;
        let foot = centre - plane.normal * plane.height_of(&centre);
        Some(Self { foot, forward, left: plane.normal.cross(&forward) })
    }

    /// World, from forward and left.
    pub fn place(&self, at: [f64; 2]) -> Vector3<f64> {
        self.foot + self.forward * at[0] + self.left * at[1]
    }
}

/// Of a bearing (rad, positive to the left of forward), heights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stretch {
    pub bearing: f32,
    pub from: f32,
    pub to: f32,
}

/// What a keyframe saw.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    /// Nothing stands on these.
    pub floor: Vec<Stretch>,
    /// On these something else begins.
    pub ends: Vec<Stretch>,
    /// Within these something stands, seen from this height to that one, heights.
    pub things: Vec<(Stretch, [f32; 2])>,
}

impl Seen {
    pub fn clear(&mut self) {
        self.floor.clear();
        self.ends.clear();
        self.things.clear();
    }
}

/// What a place is.
enum Place {
    /// No face of this height or higher is seen there.
    Floor(f64),
    /// Something else; its face's height, if there is only one that it can be.
    Other(Option<f64>),
    Unknown,
}

/// Appends what was seen. `camera_height_m`: metres, whatever the plane's unit.
pub fn floor_seen(
    plane: &Plane,
    camera_height_m: f64,
    camera: &CameraModel,
    now: &Picture<'_>,
    before: &[Picture<'_>],
    out: &mut Seen,
) {
    let hides = HIDES.min(HIDES_M / camera_height_m);
    let Some(footing) = Footing::of(plane, now.camera_from_world) else { return };
    let bearings = (WIDEST_DEG / BEARING_STEP_DEG) as i32;
    // Of a bearing: distance and height.
    let mut faces: Vec<(f64, f64)> = Vec::new();
    for step in -bearings..=bearings {
        let bearing = (f64::from(step) * BEARING_STEP_DEG).to_radians();
        let stretch = |from: f64, to: f64| Stretch { bearing: bearing as f32, from: from as f32, to: to as f32 };
        let tell = |out: &mut Seen, free: Option<(f64, f64)>| {
            out.floor.extend(free.map(|(from, to)| stretch(from, to)));
        };
        let (mut free, mut ended): (Option<(f64, f64)>, bool) = (None, false);
        faces.clear();
        let mut distance = NEAREST;
        while distance < FARTHEST {
            let at = [distance * bearing.cos(), distance * bearing.sin()];
            match judged(plane, camera, now, before, &footing.place(at.map(|v| v * plane.height))) {
                Place::Floor(height) if !ended => {
                    let proven = distance * (1.0 - height);
                    // The ray to the place, and not to what it proves, passes over what may hide: from here on not too much.
                    let low = distance * (1.0 - hides);
                    match &mut free {
                        Some((_, last)) if *last >= low => *last = last.max(proven),
                        _ if proven > low => {
                            tell(out, free);
                            free = Some((low, proven));
                        }
                        _ => {}
                    }
                }
                Place::Other(face) => {
                    faces.extend(face.map(|height| (distance * (1.0 - height), height)));
                    if !ended {
                        // Where no floor was seen before it, too: an older keyframe may have seen some.
                        let foot = distance * (1.0 - face.unwrap_or(FACES[0]));
                        out.ends.push(stretch(free.map_or(foot, |(_, last)| last.min(foot)), distance));
                    }
                    ended = true;
                }
                Place::Floor(_) | Place::Unknown => {}
            }
            distance *= RING_FACTOR;
        }
        tell(out, free);
        faces.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let one = |first: usize| {
            let nearest = faces[first].0;
            faces[first..].iter().take_while(|(distance, _)| *distance < nearest * (1.0 + ONE_FACE)).count()
        };
        if let Some(first) = (0..faces.len()).find(|first| one(*first) >= LEAST_PLACES) {
            let thing = &faces[first..first + one(first)];
            let lowest = thing.iter().map(|(_, height)| *height).fold(f64::INFINITY, f64::min);
            let highest = thing.iter().map(|(_, height)| *height).fold(0.0, f64::max);
            out.things.push((stretch(thing[0].0, thing[thing.len() - 1].0), [lowest as f32, highest as f32]));
        }
    }
}

/// What an upright face, or a level beneath the floor, leaves unexplained beyond the floor, and in all, and in how many pictures it was looked for.
#[derive(Clone, Copy, Default)]
struct Face {
    more: f64,
    all: f64,
    pictures: usize,
}

impl Face {
    fn add(&mut self, by_face: f64, by_floor: f64) {
        *self = Self { more: self.more + by_face - by_floor, all: self.all + by_face, pictures: self.pictures + 1 };
    }
}

fn judged(
    plane: &Plane,
    camera: &CameraModel,
    now: &Picture<'_>,
    before: &[Picture<'_>],
    world: &Vector3<f64>,
) -> Place {
    let Some(pixel) = project(camera, now.camera_from_world, world) else { return Place::Unknown };
    let Some(patch) = Patch::cut(now.image, &pixel, &Matrix2::identity()) else { return Place::Unknown };
    if patch.contrast() < LEAST_CONTRAST {
        return Place::Unknown;
    }
    let Some(pencil) = Pencil::through(plane, camera, now, pixel) else { return Place::Unknown };
    let (mut floor, mut pictures) = (0.0, 0_usize);
    let (mut faces, mut drops) = ([Face::default(); FACES.len()], [Face::default(); DROPS.len()]);
    for earlier in before {
        let left = |normal: &Vector3<f64>, height: f64| {
            let (at, warp) = pencil.lead(normal, height, earlier)?;
            Some(patch.unexplained(&Patch::cut(earlier.image, &at, &warp)?))
        };
        let Some(by_floor) = left(&plane.normal, 0.0) else { continue };
        floor += by_floor;
        pictures += 1;
        for (face, height) in faces.iter_mut().zip(FACES) {
            if let Some(by_face) = left(&pencil.towards, height) {
                face.add(by_face, by_floor);
            }
        }
        for (drop, depth) in drops.iter_mut().zip(DROPS) {
            if let Some(by_drop) = left(&plane.normal, -depth) {
                drop.add(by_drop, by_floor);
            }
        }
    }
    if pictures == 0 {
        return Place::Unknown;
    }
    let (variance, mean) = (patch.contrast().powi(2), floor / pictures as f64);
    // What a hypothesis must leave unexplained beyond one that leaves so much a picture.
    let clearly = |mean: f64| SURE * (NOISE * NOISE).max(mean) / INDEPENDENT;
    let left = |face: &Face| face.all / face.pictures.max(1) as f64;
    let is_better = |face: &Face| face.pictures > 0 && -face.more > clearly(left(face));
    let excluded = |faces: &[Face]| faces.iter().all(|face| face.pictures > 0 && face.more > clearly(mean));
    if mean < FLOOR_UNEXPLAINED * variance && excluded(&drops) && !faces[..LOWEST].iter().any(is_better) {
        for (lowest, height) in FACES.iter().enumerate().take(LOWEST) {
            if excluded(&faces[lowest..]) {
                return Place::Floor(*height);
            }
        }
    }
    let is_seen = |face: &Face| is_better(face) && left(face) < OTHER_UNEXPLAINED * variance;
    if drops.iter().any(is_seen) {
        return Place::Other(None);
    }
    if !faces[1..].iter().any(is_seen) {
        return Place::Unknown;
    }
    // Of one height alone: but for its neighbours all others are worse, and between these it is where the slope is none.
    let whole = |i: usize| faces.get(i).filter(|face| face.pictures == pictures).map(|face| face.all);
    let best = (0..FACES.len()).filter(|i| whole(*i).is_some()).min_by(|a, b| faces[*a].all.total_cmp(&faces[*b].all));
    let height = best.filter(|best| best + 1 < FACES.len()).and_then(|best| {
        let here = whole(best)?;
        let far = |i: &usize| i.abs_diff(best) > 1;
        let worse = |more: f64| more - here > clearly(here / pictures as f64);
        if !(0..FACES.len()).filter(far).filter_map(whole).all(worse) {
            return None;
        }
        let (lower, below) = if best > 0 { (FACES[best - 1], whole(best - 1)) } else { (0.0, Some(floor)) };
        let (Some(below), Some(above)) = (below, whole(best + 1)) else { return Some(FACES[best]) };
        let (fall, rise) = ((below - here) / (FACES[best] - lower), (above - here) / (FACES[best + 1] - FACES[best]));
        let (before, behind) = (0.5 * (lower + FACES[best]), 0.5 * (FACES[best] + FACES[best + 1]));
        Some(before + (behind - before) * fall.max(0.0) / (fall.max(0.0) + rise.max(0.0)).max(1e-12))
    });
    Place::Other(height)
}

fn project(camera: &CameraModel, camera_from_world: &Se3<Camera, World>, world: &Vector3<f64>) -> Option<Vector2<f64>> {
    camera.project(&camera_from_world.transform(world))
}

/// Rays of a pixel and of two beside it.
struct Pencil<'a> {
    camera: &'a CameraModel,
    centre: Vector3<f64>,
    rays: [Vector3<f64>; 3],
    /// Of the floor under the camera, and the camera's height.
    up: Vector3<f64>,
    foot: f64,
    height: f64,
    /// Horizontal, from the pixel's place to the camera: the normal of what stands up there.
    towards: Vector3<f64>,
}

impl<'a> Pencil<'a> {
    const STEP_PX: f64 = 3.0;

    /// `None` where the pixel does not look down.
    fn through(plane: &Plane, camera: &'a CameraModel, one: &Picture<'_>, pixel: Vector2<f64>) -> Option<Self> {
        let world_from_camera = one.camera_from_world.inverse();
        let ray = |x: f64, y: f64| {
            let seen = camera.undistort(&(pixel + Vector2::new(x, y)))?.push(1.0);
            Some(world_from_camera.rotation * seen)
        };
        let rays = [ray(0.0, 0.0)?, ray(Self::STEP_PX, 0.0)?, ray(0.0, Self::STEP_PX)?];
        let fall = plane.normal.dot(&rays[0]);
        let towards = -(rays[0] - plane.normal * fall).try_normalize(1e-6)?;
        let centre = world_from_camera.translation;
        (fall < 0.0).then_some(Self {
            camera,
            centre,
            rays,
            up: plane.normal,
            foot: plane.offset,
            height: plane.height,
            towards,
        })
    }

    /// Where the pixel is in the other picture if it shows a plane with this normal that meets its ray at this height, a share of the camera's; and
    /// d other / d one.
    fn lead(&self, normal: &Vector3<f64>, height: f64, other: &Picture<'_>) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let reach = (self.foot + height * self.height - self.up.dot(&self.centre)) / self.up.dot(&self.rays[0]);
        let before = normal.dot(&self.rays[0]) * reach;
        let through = |ray: &Vector3<f64>| {
            let reach = before / normal.dot(ray);
            // Written so that NaN fails.
            (reach > 0.0).then_some(())?;
            project(self.camera, other.camera_from_world, &(self.centre + ray * reach))
        };
        let at = through(&self.rays[0])?;
        let right = (through(&self.rays[1])? - at) / Self::STEP_PX;
        let down = (through(&self.rays[2])? - at) / Self::STEP_PX;
        Some((at, Matrix2::from_columns(&[right, down])))
    }
}

/// Grey values around a place, mean taken off.
struct Patch {
    values: [f64; PATCH_PX * PATCH_PX],
    norm: f64,
}

impl Patch {
    /// `None` where it leaves the picture. `warp`: picture's pixels per patch's.
    fn cut(image: &GreyImage, at: &Vector2<f64>, warp: &Matrix2<f64>) -> Option<Self> {
        let mut values = [0.0; PATCH_PX * PATCH_PX];
        let half = (PATCH_PX / 2) as f64;
        for (i, value) in values.iter_mut().enumerate() {
            let offset = Vector2::new((i % PATCH_PX) as f64 - half, (i / PATCH_PX) as f64 - half);
            *value = bilinear(image, &(at + warp * offset))?;
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        values.iter_mut().for_each(|value| *value -= mean);
        let norm = values.iter().map(|value| value * value).sum::<f64>().sqrt();
        Some(Self { values, norm })
    }

    /// Standard deviation, grey levels.
    fn contrast(&self) -> f64 {
        self.norm / PATCH_PX as f64
    }

    /// Variance of what the other, by a gain that is not negative, leaves of this one, grey levels squared.
    fn unexplained(&self, other: &Self) -> f64 {
        let product: f64 = self.values.iter().zip(&other.values).map(|(a, b)| a * b).sum();
        let correlation = (product / (self.norm * other.norm).max(1e-9)).max(0.0);
        self.contrast().powi(2) * (1.0 - correlation * correlation)
    }
}

fn bilinear(image: &GreyImage, at: &Vector2<f64>) -> Option<f64> {
    // Written so that NaN is outside.
    let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < image.width as f64 - 1.0 && at.y < image.height as f64 - 1.0;
    if !inside {
        return None;
    }
    let (x, y) = (at.x as usize, at.y as usize);
    let (fx, fy) = (at.x - x as f64, at.y - y as f64);
    let value = |x: usize, y: usize| f64::from(image.at(x, y));
    let upper = value(x, y) * (1.0 - fx) + value(x + 1, y) * fx;
    let lower = value(x, y + 1) * (1.0 - fx) + value(x + 1, y + 1) * fx;
    Some(upper * (1.0 - fy) + lower * fy)
}

#[cfg(test)]
mod tests;
