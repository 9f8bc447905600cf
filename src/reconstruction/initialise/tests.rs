//! Of a map's beginning as a whole: what its frames, its keyframes and the picture have to do with each other.

use nalgebra::{UnitQuaternion, Vector2};

use super::initialiser::Start;
use super::views::{View, Views};
use super::*;
use crate::features::{Feedback, Track};
use crate::geometry::CameraModel;
use crate::map::examples;
use crate::reconstruction::adjust::mapper::Merge;
use crate::reconstruction::consensus::tests as consensus;
use crate::reconstruction::keyframe::triangulate;
use crate::reconstruction::tests::{FOCAL_PX, FRAME_NS, camera, frame, wall};
use crate::reconstruction::{InlineWorker, ReconstructionConfig, TrackingState};

fn reconstruction(camera: &CameraModel) -> Reconstruction {
    Reconstruction::new(&ReconstructionConfig::default(), camera, Box::new(InlineWorker::default()), true)
}

/// A frame before the wall with a track on each place of a grid, and where those places are in the first camera's axes.
fn tracked(n: u64, shift: usize) -> (FrameFeatures, Vec<(u64, Vector3<f64>)>) {
    let place = |i: u64| Vector2::new(72.0 + 16.0 * (i % 15) as f32, 24.0 + 18.0 * (i / 15) as f32);
    let moved = Vector2::x() * shift as f32;
    let tracks = (0..165).map(|id| Track { id, position: place(id) - moved, age: 1 }).collect();
    let points = (0..165).map(|id| (id, camera().undistort(&place(id).cast()).unwrap().push(1.0))).collect();
    (FrameFeatures { sequence: n, tracks, ..frame(n as i64 * FRAME_NS, shift) }, points)
}

#[test]
fn keyframes_of_a_start_are_known_to_the_index_of_places() {
    let [(first, points), (between, _), (newest, _)] = [(0, 0), (1, 30), (2, 60)].map(|(n, shift)| tracked(n, shift));
    let views = Views { first: View::of(&first), between: vec![View::of(&between)], newest: FrameTracks::of(&newest) };
    let second_from_first = Se3::new(UnitQuaternion::identity(), Vector3::x() * (-60.0 / FOCAL_PX));
    let start = Start { views, by_corners: false, second_from_first, points };
    let mut r = reconstruction(&camera());
    // A wall tells the direction of a motion poorly.
    r.initialiser.trying_s = 60.0;
    let begun = r.start_from(&[start], &newest).expect("a map");
    assert_eq!((begun.state, r.active.map.keyframes.len(), r.loops.entered()), (TrackingState::Tracking, 3, 0));
    r.map(&newest, &mut Feedback::default());
    assert_eq!(r.loops.entered(), 3, "with the first frame's work");
    assert_eq!(r.loops.likely(&r.active.map, &wall(60)).first(), Some(&r.active.reference));
}

#[test]
fn the_probation_of_a_new_map_follows_adjustments() {
    let camera = consensus::camera();
    let views = consensus::views(22, 0.02, 0.0);
    // The camera has turned by so much in the map as it was; the adjustment says that it has not.
    let off: Se3<World, World> = Se3::new(UnitQuaternion::from_scaled_axis(Vector3::x() * 0.05), Vector3::zeros());
    let fails = |is_adjusted: bool| {
        let mut r = reconstruction(&camera);
        let map = &mut r.active.map;
        let seen = [0, 4, 8].map(|n| {
            let (frame, pose): &consensus::View = &views[n];
            let pose = if n == 8 { *pose * off } else { *pose };
            (map.add_keyframe(examples::keyframe(Default::default(), pose)), frame)
        });
        for (track, pixel) in &views[0].0.tracks {
            let Some(last) = views[8].0.track(*track) else { continue };
            let [a, b] = [*pixel, last].map(|pixel| camera.undistort(&pixel.cast()).unwrap());
            let Some((position, _)) = triangulate(&views[0].1, &a, &views[8].1, &b) else { continue };
            let observed = |(id, frame): &(KeyframeId, &FrameTracks)| {
                Some((*id, observe(&camera, LandmarkId(0), frame.track(*track)?, 1.0)?))
            };
            let observed: Vec<_> = seen.iter().filter_map(observed).collect();
            map.add_landmark(Landmark::new(position, Matrix3::identity() * 1e-4, seen[0].0), &observed);
        }
        let mut start = PosedViews::default();
        views[..2].iter().for_each(|(frame, pose)| start.push(frame.clone(), &(*pose * off)));
        r.active.probation.begin(start, &r.optics.shutter);
        if is_adjusted {
            (r.active.unadjusted, r.active.next_global) = (r.active.map.newest(), 0);
            r.post_adjustment();
            r.merge_adjustment(Merge::AtTheEnd);
            assert_eq!(r.counters.adjustments, 1);
        }
        views[2..].iter().any(|(frame, pose)| r.active.probation.fails(&consensus::features(frame), pose, &camera))
    };
    assert!(fails(false), "frames of another frame of coordinates contradict it");
    assert!(!fails(true));
}
