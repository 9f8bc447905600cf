//! From the decoded picture to the pose nothing is allocated once warm. A binary of its own, for its allocator that counts.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::image::GreyImage;
use cairn::reconstruction::{InlineWorker, Reconstruction, ReconstructionConfig, TrackingState};

struct Counting;

thread_local! {
    /// Of this thread: the test harness has others.
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

fn count() {
    // Gone while a thread ends, and then nobody asks.
    let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
}

// SAFETY: every call goes on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `realloc`.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn from_picture_to_pose_nothing_is_allocated_once_warm() {
    let keyframes = count_while_tracking(Scenario::HandHeld, 300, 120);
    assert!(keyframes > 0, "the frames after keyframes must be among them");
}

/// It turns from second 10 on, at first away from all that is mapped.
#[test]
fn turning_on_the_spot_allocates_nothing_either() {
    count_while_tracking(Scenario::MoveThenRotate, 360, 150);
}

/// Asserts that `frames` frames after `warm` others are tracked without an allocation, and gives the keyframes among them.
fn count_while_tracking(scenario: Scenario, warm: u64, frames: u64) -> u32 {
    let config = SimulatorConfig { seed: 3, ..SimulatorConfig::everything(scenario) };
    let mut simulator = Simulator::new(&config, Pacing::LockStep).unwrap();
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(&ReconstructionConfig::default(), &camera, worker, true);
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let mut events = Vec::new();
    let (mut keyframes, mut allocations) = (0, Vec::new());
    for sequence in 0..warm + frames {
        simulator.render(sequence, &mut picture);
        let before = ALLOCATIONS.get();
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        let estimate = reconstruction.track(&features);
        let allocated = ALLOCATIONS.get() - before;
        reconstruction.map(&features, &mut feedback);
        stage.feedback(&feedback);
        reconstruction.take_trajectory_events(&mut events);
        events.clear();
        if sequence >= warm {
            assert_eq!(estimate.state, TrackingState::Tracking, "frame {sequence}");
            allocations.extend((allocated > 0).then_some((sequence, allocated)));
            keyframes += u32::from(estimate.keyframe);
        }
    }
    assert!(allocations.is_empty(), "(frame, allocations): {allocations:?}");
    keyframes
}
