//! Where a keyframe saw the floor itself: patches that look in earlier keyframes as the floor's plane has it, and not as anything above it would.
//!
//! Plane, camera, the keyframe's picture and those of a few before it -> places on the floor, in the keyframe's own axes on the floor (forward, left),
//! in heights of the camera: they hold in any unit and move with the keyframe.
//!
//! The floor's plane takes one picture to another by a homography. Around each place of a polar grid on the floor a patch of the new picture is
//! compared (normalised correlation) with the earlier one where the plane leads (h = 0), and where planes a little above and below would lead
//! (`OTHER_HEIGHTS`). It is floor where it looks alike at h = 0 and clearly less so elsewhere; a bare patch, or a line along the camera's motion, tells nothing.
//!
//! Pictures of about 320 pixels' width do best (in the simulator's rooms, of 700 places in view 210 are seen, of 640 pixels' width 140: noise); whoever calls
//! takes that level of the pyramids, and the camera to it.
//!
//! Cost: 1000 places, 2 us each with one earlier picture: 2 to 4 ms a keyframe. Not here: what becomes of it; a floor that moves.

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
/// Side of a patch, px, and what its grey levels must differ by (one sigma): noise is 1 to 2 in a picture of half size.
const PATCH_PX: usize = 9;
const LEAST_CONTRAST: f64 = 3.0;
/// Heights above the floor, shares of the camera's, at which the patch must fit worse; each at which it would move by less than this says nothing, and
/// if that is all of them, neither does the patch.
const OTHER_HEIGHTS: [f64; 3] = [-0.15, 0.12, 0.25];
const LEAST_SHIFT_PX: f64 = 0.8;
/// Correlation that is alike, and what it must be more than elsewhere.
const ALIKE: f64 = 0.75;
const CLEARLY: f64 = 0.12;
/// A patch of so much contrast that is like this in none of the earlier pictures is something else: a thing on the floor, or before it.
const UNLIKE: f64 = 0.4;
const RICH_CONTRAST: f64 = 6.0;

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

/// Places, forward and left in heights.
#[derive(Debug, Clone, Default)]
pub struct Places {
    /// Where the floor was seen.
    pub floor: Vec<[f32; 2]>,
    /// Where something else was.
    pub other: Vec<[f32; 2]>,
}

/// Appends what was seen.
pub fn floor_seen(plane: &Plane, camera: &CameraModel, now: &Picture<'_>, before: &[Picture<'_>], out: &mut Places) {
    let Some(footing) = Footing::of(plane, now.camera_from_world) else { return };
    let bearings = (WIDEST_DEG / BEARING_STEP_DEG) as i32;
    let mut distance = NEAREST;
    while distance < FARTHEST {
        for step in -bearings..=bearings {
            let bearing = (f64::from(step) * BEARING_STEP_DEG).to_radians();
            let at = [distance * bearing.cos(), distance * bearing.sin()];
            let world = footing.place(at.map(|v| v * plane.height));
            match judged(plane, camera, now, before, &world) {
                Some(true) => out.floor.push(at.map(|v| v as f32)),
                Some(false) => out.other.push(at.map(|v| v as f32)),
                None => {}
            }
        }
        distance *= RING_FACTOR;
    }
}

/// Floor, something else, or nothing is known.
fn judged(
    plane: &Plane,
    camera: &CameraModel,
    now: &Picture<'_>,
    before: &[Picture<'_>],
    world: &Vector3<f64>,
) -> Option<bool> {
    let pixel = project(camera, now.camera_from_world, world)?;
    let patch = Patch::cut(now.image, &pixel, &Matrix2::identity())?;
    if patch.contrast() < LEAST_CONTRAST {
        return None;
    }
    let mut most_alike: Option<f64> = None;
    let is_floor = before.iter().any(|earlier| {
        let seen_at = |share: f64| {
            let (at, warp) = lead(plane.offset + share * plane.height, plane, camera, now, earlier, &pixel)?;
            Some((at, patch.correlation(&Patch::cut(earlier.image, &at, &warp)?)))
        };
        let Some((at, alike)) = seen_at(0.0) else { return false };
        most_alike = Some(most_alike.map_or(alike, |most| most.max(alike)));
        if alike < ALIKE {
            return false;
        }
        let mut told = false;
        for height in OTHER_HEIGHTS {
            let Some((other, correlation)) = seen_at(height) else { continue };
            if (other - at).norm() < LEAST_SHIFT_PX {
                continue;
            }
            if correlation > alike - CLEARLY {
                return false;
            }
            told = true;
        }
        told
    });
    let other = most_alike.is_some_and(|most| most < UNLIKE) && patch.contrast() >= RICH_CONTRAST;
    (is_floor || other).then_some(is_floor)
}

fn project(camera: &CameraModel, camera_from_world: &Se3<Camera, World>, world: &Vector3<f64>) -> Option<Vector2<f64>> {
    camera.project(&camera_from_world.transform(world))
}

/// Where a pixel of the one picture is in the other if it shows the plane `n x = offset`, and d other / d one.
fn lead(
    offset: f64,
    plane: &Plane,
    camera: &CameraModel,
    one: &Picture<'_>,
    other: &Picture<'_>,
    pixel: &Vector2<f64>,
) -> Option<(Vector2<f64>, Matrix2<f64>)> {
    let world_from_camera = one.camera_from_world.inverse();
    let centre = world_from_camera.translation;
    let through = |pixel: &Vector2<f64>| {
        let ray = world_from_camera.rotation * camera.undistort(pixel)?.push(1.0);
        let fall = plane.normal.dot(&ray);
        let reach = (offset - plane.normal.dot(&centre)) / fall;
        (fall < 0.0 && reach > 0.0).then_some(())?;
        project(camera, other.camera_from_world, &(centre + ray * reach))
    };
    const STEP_PX: f64 = 3.0;
    let at = through(pixel)?;
    let right = (through(&(pixel + Vector2::new(STEP_PX, 0.0)))? - at) / STEP_PX;
    let down = (through(&(pixel + Vector2::new(0.0, STEP_PX)))? - at) / STEP_PX;
    Some((at, Matrix2::from_columns(&[right, down])))
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

    fn correlation(&self, other: &Self) -> f64 {
        let product: f64 = self.values.iter().zip(&other.values).map(|(a, b)| a * b).sum();
        product / (self.norm * other.norm).max(1e-9)
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
