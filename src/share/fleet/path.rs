//! Where a robot was: its last poses, thinned out. Pure; believes nothing.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::listing::Place;
use super::report::FARTHEST_M;
use crate::messages::Transform;
use crate::ros::{CdrError, Reader};
use crate::share::frames::METRIC;

/// Bytes of a PoseWithCovarianceStamped with a name of a frame that nobody has.
pub const MOST_BYTES: usize = 4096;
/// Points of a trail, one each [`EVERY`]: the last five minutes. 16 kB a robot.
const MOST_POINTS: usize = 600;
const EVERY: Duration = Duration::from_millis(500);
/// What is older is no place of now; poses come many times a second.
const FRESH: Duration = Duration::from_secs(3);

/// See module.
#[derive(Debug, Default)]
pub struct Path {
    points: VecDeque<[f64; 2]>,
    last: Option<(Place, Instant)>,
    added: Option<Instant>,
}

impl Path {
    /// Of a map that is in metres; anything else is no place in a frame that others have. `origin`: of the trail's frame, in the map.
    pub fn add(&mut self, message: &[u8], origin: &Transform, now: Instant) {
        let Ok(Some(place)) = place(message, origin) else { return };
        self.last = Some((place, now));
        if self.added.is_none_or(|at| now.saturating_duration_since(at) >= EVERY) {
            self.added = Some(now);
            if self.points.len() == MOST_POINTS {
                self.points.pop_front();
            }
            self.points.push_back([place.x_m, place.y_m]);
        }
    }

    /// The last one, in the frame in which the trail's lies there; a fresh one only.
    pub fn place(&self, now: Instant, there: &Transform) -> Option<Place> {
        let (Place { x_m, y_m, yaw_rad }, _) =
            self.last.filter(|(_, at)| now.saturating_duration_since(*at) <= FRESH)?;
        let place = *there * Transform::level(x_m, y_m, yaw_rad);
        let [x_m, y_m, _] = place.position;
        Some(Place { x_m, y_m, yaw_rad: place.yaw_rad() })
    }

    /// Oldest first, in the same frame.
    pub fn points(&self, there: &Transform) -> Vec<[f64; 2]> {
        let point = |[x, y]: [f64; 2]| {
            let [x, y, _] = there.apply(&[x, y, 0.0]);
            [x, y]
        };
        self.points.iter().copied().map(point).collect()
    }
}

fn place(message: &[u8], origin: &Transform) -> Result<Option<Place>, CdrError> {
    let mut reader = Reader::new(message)?;
    let _stamp = (reader.i32()?, reader.u32()?);
    let is_map = reader.text()? == METRIC.map;
    let [x_m, y_m, z_m]: [f64; 3] = reader.f64_array()?;
    let is_near = [x_m, y_m, z_m].iter().all(|v| v.abs() <= FARTHEST_M);
    let there = origin.inverse() * Transform { position: [x_m, y_m, z_m], orientation: reader.f64_array()? };
    let ([x_m, y_m, _], yaw_rad) = (there.position, there.yaw_rad());
    Ok((is_map && is_near && yaw_rad.is_finite()).then_some(Place { x_m, y_m, yaw_rad }))
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::ros::Message;
    use crate::ros::standard::{self as ros, Header, PoseWithCovariance, PoseWithCovarianceStamped, Time};

    const HERE: Transform = Transform::IDENTITY;

    pub fn pose(frame_id: &str, x: f64, y: f64, yaw: f64) -> Vec<u8> {
        let orientation = [0.0, 0.0, (yaw / 2.0).sin(), (yaw / 2.0).cos()];
        let pose = ros::Pose { position: [x, y, 0.0].into(), orientation: orientation.into() };
        let pose = PoseWithCovariance { pose, covariance: [0.0; 36] };
        PoseWithCovarianceStamped { header: Header { stamp: Time::from_ns(1), frame_id }, pose }.to_cdr()
    }

    #[test]
    fn a_trail_is_thinned_out_and_ends() {
        let (mut path, start) = (Path::default(), Instant::now());
        for i in 0..20 * MOST_POINTS as u32 {
            path.add(&pose("map", f64::from(i), 1.0, 0.5), &HERE, start + i * Duration::from_millis(50));
        }
        assert_eq!(path.points(&HERE).len(), MOST_POINTS);
        assert_eq!(path.points(&HERE)[MOST_POINTS - 1][0] - path.points(&HERE)[MOST_POINTS - 2][0], 10.0);
        let end = start + 20 * MOST_POINTS as u32 * Duration::from_millis(50);
        let place = path.place(end, &HERE).expect("a place");
        assert!((place.yaw_rad - 0.5).abs() < 1e-12 && place.x_m == 20.0 * MOST_POINTS as f64 - 1.0, "{place:?}");
        assert_eq!(path.place(end + 2 * FRESH, &HERE), None);
    }

    #[test]
    fn a_place_is_in_the_frame_that_others_have() {
        let (mut path, now) = (Path::default(), Instant::now());
        path.add(&pose("map", 50.0, -18.0, 2.0), &Transform::level(50.0, -20.0, std::f64::consts::FRAC_PI_2), now);
        let place = path.place(now, &HERE).expect("a place");
        let off = [place.x_m - 2.0, place.y_m, place.yaw_rad - (2.0 - std::f64::consts::FRAC_PI_2)];
        assert!(off.iter().all(|v| v.abs() < 1e-12), "{place:?}");
    }

    #[test]
    fn what_is_of_another_frame_or_no_place_is_none() {
        let (mut path, now) = (Path::default(), Instant::now());
        let whole = pose("map", 1.0, 2.0, 0.0);
        path.add(&pose("map_unscaled", 1.0, 2.0, 0.0), &HERE, now);
        for x in [f64::NAN, f64::INFINITY, 1e9] {
            path.add(&pose("map", x, 0.0, 0.0), &HERE, now);
        }
        for end in 0..whole.len() - 8 * 36 {
            path.add(&whole[..end], &HERE, now);
        }
        assert_eq!((path.place(now, &HERE), path.points(&HERE).len()), (None, 0));
        path.add(&whole, &HERE, now);
        assert!(path.place(now, &HERE).is_some());
    }
}
