//! A patch of a keyframe, found in another picture.
//!
//! Input: a keyframe's observation, the picture's pyramid, where the patch should be, and how it is warped there. Output: its place,
//! sub-pixel, by inverse compositional alignment ([`alignment`](crate::features::alignment)) from coarse to fine, on the level at which neither picture
//! is magnified. Cost: 2 us a patch.

use nalgebra::{Matrix2, Matrix3x2, Vector2, Vector3};

use crate::features::alignment::{AlignOptions, Template, align};
use crate::features::patch_sampling::warp_patch;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;
use crate::image::pyramid::{base_from_level, level_from_base};
use crate::map::view::ROOM;
use crate::map::{Keyframe, LandmarkId, Observation};

/// Observation of a pixel; `None` where the lens model does not reach.
pub fn observe(
    camera: &CameraModel,
    landmark: LandmarkId,
    pixel: Vector2<f32>,
    inv_sigma_px: f64,
) -> Option<Observation> {
    let (normalised, normalised_from_pixel) = camera.undistort_jacobian(&pixel.cast())?;
    Some(Observation {
        landmark,
        pixel,
        normalised,
        displacement: Vector2::zeros(),
        inv_sigma_px,
        normalised_from_pixel,
    })
}

/// How a patch is looked for.
#[derive(Debug, Clone, Copy)]
pub struct SearchOptions {
    /// Found positions farther from the prediction are refused, px of the level that they were found on. (Alignment ends some px from where it began all the
    /// same: in a narrow search that decides.)
    pub radius_px: f64,
    /// Pyramid levels above the landmark's own at which alignment starts: 0 for a good prediction, 2 or 3 for a poor one.
    pub coarse_levels: usize,
    /// Standard deviation at full resolution, px.
    pub sigma_px: f64,
    /// Coarser levels than its own that may measure a landmark where the finer ones fail (a blurred picture), each half as exactly.
    pub blurred_levels: usize,
}

impl SearchOptions {
    /// For one patch whose place a track or a corner tells: on its own level only, within 2 px.
    pub fn precise(sigma_px: f64) -> Self {
        Self { radius_px: 2.0, coarse_levels: 0, sigma_px, blurred_levels: 0 }
    }
}

/// `blurred_levels` for a picture that is blurred.
pub const BLURRED_LEVELS: usize = 2;
/// A found patch must correlate at least this well with its template.
const MIN_CORRELATION: f32 = 0.75;

/// A position found by [`align_template`].
pub struct Found {
    pub pixel: Vector2<f32>,
    pub inv_sigma_px: f64,
}

/// Finds the patch around `observation` of `keyframe` near `start` (level-0 px) in `pyramid`; `affine` = d frame pixel / d
/// keyframe pixel. The level is chosen so that neither picture is magnified.
pub fn align_template(
    keyframe: &Keyframe,
    observation: &Observation,
    pyramid: &Pyramid,
    affine: &Matrix2<f64>,
    start: Vector2<f64>,
    options: &SearchOptions,
) -> Option<Found> {
    let inverse = affine.try_inverse()?;
    let log_scale = 0.5 * affine.determinant().abs().log2();
    if !log_scale.is_finite() || log_scale.abs() > 2.5 {
        return None;
    }
    let top = pyramid.levels.len().min(keyframe.picture.levels()).checked_sub(1)?;
    // A magnified patch is looked for at a coarser level of the frame, a minified one is cut from a coarser level.
    let own = (log_scale.round().max(0.0) as usize).min(top);
    let mut position = start.cast::<f32>();
    let mut found_level = None;
    let coarse_levels = options.coarse_levels.max(options.blurred_levels);
    for level in (own..=(own + coarse_levels).min(top)).rev() {
        let source_level = ((level as f64 - log_scale).round().max(0.0) as usize).min(top);
        let mut room = ROOM;
        let mut cut = |source_level: usize| {
            let scale = (1u32 << level) as f64 / (1u32 << source_level) as f64;
            let source_from_patch = (inverse * scale).cast::<f32>();
            let mut pixels = [0.0f32; 100];
            let source = level_from_base(source_level, observation.pixel);
            let crop = keyframe.picture.around(source_level, observation.landmark.0, &mut room)?;
            warp_patch(&crop, source, &source_from_patch, &mut pixels).then_some(pixels)
        };
        // Of a picture that was reduced there may be no patch, or too small a one, and of a condensed one no such level: half the resolution is
        // better than nothing.
        let is_short = source_level < top && !keyframe.picture.has_level(source_level);
        let Some(pixels) = cut(source_level).or_else(|| if is_short { cut(source_level + 1) } else { None }) else {
            continue;
        };
        let template = Template::from_pixels(&pixels);
        match align(&template, &pyramid.levels[level], level_from_base(level, position), &AlignOptions::default()) {
            Some(aligned) if aligned.ncc >= MIN_CORRELATION => {
                position = base_from_level(level, aligned.position);
                found_level = Some(level);
            }
            // A coarse level may lack texture.
            _ if level > own => {}
            _ => break,
        }
    }
    let level = found_level.filter(|&l| l <= own + options.blurred_levels)?;
    if (position.cast::<f64>() - start).norm() > options.radius_px * (1u32 << level) as f64 {
        return None;
    }
    Some(Found { pixel: position, inv_sigma_px: 1.0 / (options.sigma_px * (1u32 << level) as f64) })
}

/// d pixel of a camera at `pose` / d keyframe pixel, for the patch that the keyframe has `seen` around `point` (world). The patch is taken to lie parallel to
/// the keyframe's picture, or for a wide-angle lens across its ray: parallel to the picture it would be seen under 70 degrees of slant where the ray is
/// 70 degrees off the axis.
pub fn affine_warp(
    camera: &CameraModel,
    keyframe: &Keyframe,
    seen: &Observation,
    pose: &Se3<Camera, World>,
    point: &Vector3<f64>,
) -> Option<Matrix2<f64>> {
    let (_, projection) = camera.project_jacobian(&pose.transform(point))?;
    let depth = keyframe.camera_from_world.transform(point).z;
    let rotation = (pose.rotation * keyframe.camera_from_world.rotation.inverse()).to_rotation_matrix();
    let in_plane: Matrix3x2<f64> = match camera.lens.is_wide_angle() {
        false => rotation.matrix().fixed_columns::<2>(0).into_owned(),
        true => {
            // A step dn on z = 1 is dn - r (r . dn) / |r|² across the ray r = (n, 1).
            let n = &seen.normalised;
            let along = n / (1.0 + n.norm_squared());
            let across = Matrix3x2::identity() - n.push(1.0) * along.transpose();
            rotation.matrix() * across
        }
    };
    Some(projection * in_plane * seen.normalised_from_pixel * depth)
}

/// The place of `a`'s patch (in `anchor`) near `start` in another keyframe, given the point's position; `sigma_px`: at
/// full resolution.
pub fn refine_in(
    anchor: &Keyframe,
    a: &Observation,
    other: &Keyframe,
    point: &Vector3<f64>,
    start: Vector2<f32>,
    camera: &CameraModel,
    sigma_px: f64,
) -> Option<Observation> {
    let affine = affine_warp(camera, anchor, a, &other.camera_from_world, point)?;
    let options = SearchOptions::precise(sigma_px);
    let found = align_template(anchor, a, other.picture.whole()?, &affine, start.cast(), &options)?;
    observe(camera, a.landmark, found.pixel, found.inv_sigma_px)
}

/// Discs of several sizes; `streak`: how far the camera moves to the right while the shutter is open, px.
#[cfg(test)]
pub fn picture(streak: usize) -> Pyramid {
    let sharp = |x: f64, y: f64| {
        let inside = |(cx, cy, r): &(f64, f64, f64)| (x - cx).hypot(y - cy) < *r;
        40.0 + 50.0
            * [(150.0, 118.0, 14.0), (173.0, 127.0, 9.0), (160.0, 104.0, 7.0)].iter().filter(|d| inside(d)).count()
                as f64
    };
    let mut picture = crate::image::GreyImage::new(320, 240);
    for (i, pixel) in picture.data.iter_mut().enumerate() {
        let (x, y) = ((i % 320) as f64, (i / 320) as f64);
        let n = 2 * streak + 1;
        let sum: f64 = (0..n).map(|k| sharp(x + 0.5 * (k as f64 - streak as f64), y)).sum();
        *pixel = (sum / n as f64).round() as u8;
    }
    let mut pyramid = Pyramid::new(4);
    pyramid.build(&picture);
    pyramid
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::map::examples;

    fn find_in_blur(streak: usize, blurred_levels: usize) -> Option<Found> {
        let camera = CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).unwrap();
        let keyframe = examples::keyframe(Arc::new(picture(0)), Se3::identity());
        let seen = observe(&camera, LandmarkId::default(), Vector2::new(163.0, 117.0), 1.0)?;
        let options = SearchOptions { blurred_levels, ..SearchOptions::precise(0.8) };
        align_template(&keyframe, &seen, &picture(streak), &Matrix2::identity(), Vector2::new(164.5, 116.0), &options)
    }

    #[test]
    fn a_landmark_in_a_blurred_picture_is_measured_on_a_coarser_level_and_said_to_be_less_exact() {
        let sharp = find_in_blur(0, BLURRED_LEVELS).unwrap();
        let coarser = |f: &Found| f.inv_sigma_px < 0.9 * sharp.inv_sigma_px;
        assert!((sharp.pixel - Vector2::new(163.0, 117.0)).norm() < 0.05, "{}", sharp.pixel);
        let found = |streak: &usize| find_in_blur(*streak, BLURRED_LEVELS).filter(coarser);
        let too_much = |streak: &usize| find_in_blur(*streak, 0).is_none() && found(streak).is_some();
        let streak = (8..=40).find(too_much).expect("one that the finest level cannot bear");
        let found = found(&streak).unwrap();
        assert!(found.inv_sigma_px <= 0.5 * sharp.inv_sigma_px);
        let off = (found.pixel - Vector2::new(163.0, 117.0)).norm();
        assert!(f64::from(off) < 2.0 / found.inv_sigma_px, "a streak of {streak} px: off by {off} px");
    }
}
