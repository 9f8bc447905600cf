//! One landmark over its observations, the keyframes held.

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{KeyframeId, LandmarkId, Map, Observation};
use crate::motion::floor::{FloorPoint, LEAST_OBSERVERS};
use crate::reconstruction::measurement::rolling_shutter::Shutter;
use crate::reconstruction::measurement::{NEAREST, jacobian_rows};

/// Squared, sigma-scaled distance of an observation from where the point is projected; infinite behind the camera.
pub fn reprojection_chi2(
    pose: &Se3<Camera, World>,
    point: &Vector3<f64>,
    o: &Observation,
    camera: &CameraModel,
    readout_s: f64,
) -> f64 {
    let p = pose.transform(point);
    if p.z < NEAREST {
        return f64::INFINITY;
    }
    let e = Vector2::new(p.x / p.z, p.y / p.z) - o.at_middle_row(readout_s);
    (camera.pixel_scale(&o.normalised) * e * o.inv_sigma_px).norm_squared()
}

/// Gauss-Newton on the point alone over its observations; its covariance with the keyframes held.
pub fn refine_point(
    map: &Map,
    seen: &[(KeyframeId, Observation)],
    camera: &CameraModel,
    readout_s: f64,
    point: &mut Vector3<f64>,
) -> Option<Matrix3<f64>> {
    let mut covariance = None;
    for _ in 0..5 {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for (k, o) in seen {
            let Some(keyframe) = map.keyframe(*k) else { continue };
            let pose = &keyframe.camera_from_world;
            let p = pose.transform(point);
            if p.z < NEAREST {
                return None;
            }
            let scale = camera.pixel_scale(&o.normalised) * o.inv_sigma_px;
            let (jx, jy) = jacobian_rows(&p, &scale);
            let r = pose.rotation.inverse();
            let (x, y) = (r * Vector3::new(jx[3], jx[4], jx[5]), r * Vector3::new(jy[3], jy[4], jy[5]));
            h += x * x.transpose() + y * y.transpose();
            let seen = o.at_middle_row(readout_s);
            let (dx, dy) = (p.x / p.z - seen.x, p.y / p.z - seen.y);
            g += x * scale.m11 * dx + y * scale.m22 * dy + (x * scale.m12 * dy + y * scale.m21 * dx);
        }
        let inverse = h.try_inverse()?;
        let step = -(inverse * g);
        *point += step;
        covariance = Some(inverse);
        if step.norm() < 1e-7 * point.norm() {
            break;
        }
    }
    covariance.filter(|c| c.iter().chain(point.iter()).all(|v| v.is_finite()))
}

/// Who saw a landmark, and how.
pub fn observations_of(map: &Map, id: LandmarkId) -> Vec<(KeyframeId, Observation)> {
    let observers = map.landmark(id).into_iter().flat_map(|landmark| &landmark.observers);
    observers.filter_map(|&k| Some((k, map.keyframe(k)?.observation(id)?))).collect()
}

/// A landmark that may lie on a floor, by its pictures alone: nothing of it is assumed, and keyframes enough agree on it.
pub fn floor_point(map: &Map, id: LandmarkId, camera: &CameraModel, shutter: &Shutter) -> Option<FloorPoint> {
    let landmark = map.landmark(id).filter(|l| l.assumed.is_none() && l.observers.len() >= LEAST_OBSERVERS)?;
    let mut position = landmark.position;
    let covariance = refine_point(map, &observations_of(map, id), camera, shutter.readout_s, &mut position)?;
    Some(FloorPoint { position, covariance })
}
