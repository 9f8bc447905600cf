//! Publishing a pose allocates nothing, with and without readers, and a recorder's picture or a list of features no more than iceoryx2 does. A
//! binary of its own, for its allocator that counts.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
use std::time::{Duration, Instant};

use cairn::client::Client;
use cairn::frame::{Clock, PixelFormat, RawFrame};
use cairn::geometry::Se3;
use cairn::map::{KeyframeId, LandmarkId};
use cairn::messages::services::MAX_FEATURES;
use cairn::messages::{Endpoint, NO_LANDMARK, NO_TRACK};
use cairn::publish::{CameraView, Conversion, FrameStamp, Limits, Publisher};
use cairn::reconstruction::{PoseEstimate, TrackingState};
use nalgebra::{Matrix6, Vector3};

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
fn publishing_a_pose_allocates_nothing() {
    let name = format!("ca{}", std::process::id());
    let root = Path::new("/tmp").join(&name);
    let endpoint = Endpoint::new("robot").and_then(|e| e.with_root(&root));
    let endpoint = endpoint.and_then(|e| e.with_ipc_prefix(&format!("{name}_"))).expect("endpoint");
    let limits = Limits { landmarks: 10, keyframes: 10, frame_bytes: 10 };
    let mut publisher = Publisher::open(&endpoint, &limits).expect("publisher");
    let estimate = PoseEstimate {
        state: TrackingState::Tracking,
        world_from_camera: Some(Se3::identity()),
        odom_from_camera: Some(Se3::identity()),
        anchor: Some(KeyframeId(0)),
        covariance: Matrix6::identity(),
        angular_velocity: Vector3::zeros(),
        linear_velocity: Vector3::zeros(),
        landmarks: 100,
        landmarks_sought: 120,
        quality: 0.9,
        ..PoseEstimate::default()
    };
    let mut allocations = |times: usize| {
        let mut allocations = 0;
        for _ in 0..times {
            publisher.poses.prepare();
            let before = ALLOCATIONS.get();
            publisher.poses.publish(&estimate, &Conversion::default(), 0).expect("pose");
            allocations += ALLOCATIONS.get() - before;
        }
        allocations
    };
    allocations(10);
    assert_eq!(allocations(1_000), 0, "without a reader");

    let client = Client::with_endpoint(endpoint).expect("client");
    let mut poses = client.poses();
    let start = Instant::now();
    while poses.latest().expect("latest").is_none() {
        assert!(start.elapsed() < Duration::from_secs(10), "no pose has come");
        allocations(1);
    }
    allocations(10);
    // Its queue overflows and gives the oldest message back each time.
    assert_eq!(allocations(1_000), 0, "with a reader");

    let mut encoded = client.encoded();
    let camera = CameraView { pinhole_px: [1.0; 4], distortion: [0.0; 5], intrinsics: 0, lens_model: 0 };
    let data = vec![7; 10];
    let frame = RawFrame { format: PixelFormat::Grey, width: 5, height: 2, stride: 5, data, ..RawFrame::default() };
    let mut pictures = |times: usize| {
        let before = ALLOCATIONS.get();
        for _ in 0..times {
            publisher.encoded.publish(&frame, &camera).expect("picture");
        }
        ALLOCATIONS.get() - before
    };
    assert_eq!(pictures(1_000), 0, "nobody records");
    while encoded.try_next().expect("next").is_none() {
        assert!(start.elapsed() < Duration::from_secs(10), "no picture has come");
        pictures(1);
    }
    pictures(20);
    let each = pictures(1_000);
    assert!(each <= 1_000, "{each} allocations for 1000 pictures: one each is iceoryx2's");
    // More bytes than there is room for are an error and no crash.
    let large = RawFrame { data: vec![7; 11], ..frame.clone() };
    assert!(publisher.encoded.publish(&large, &camera).is_err());

    let mut features = client.features();
    let stamp = FrameStamp { sequence: 1, timestamp_ns: 2, arrival_ns: 3, clock: Clock::Recording };
    let mut lists = |times: usize| {
        let (before, mut sent) = (ALLOCATIONS.get(), 0);
        for _ in 0..times {
            let matches = (0..5).map(|i| (LandmarkId(i), [1.0, 2.0]));
            let tracks = (0..MAX_FEATURES as u64).map(|id| (id, [3.0, 4.0], 6));
            sent += usize::from(publisher.features.publish(matches, tracks, (640, 480), &stamp).expect("features"));
        }
        (ALLOCATIONS.get() - before, sent)
    };
    assert_eq!(lists(1_000), (0, 0), "nobody asks for features");
    let list = loop {
        assert!(start.elapsed() < Duration::from_secs(10), "no features have come");
        if let Some(list) = features.try_next().expect("next") {
            break list;
        }
        lists(1);
    };
    // Landmarks first, and the newest tracks are what there is no room for.
    assert_eq!((list.header().count as usize, list.header().total as usize), (MAX_FEATURES, MAX_FEATURES + 5));
    assert_eq!((list[4].landmark, list[4].track), (4, NO_TRACK));
    assert_eq!((list[5].landmark, list[5].track, list[5].age), (NO_LANDMARK, 0, 6));
    drop(list);
    lists(20);
    let (each, sent) = lists(1_000);
    assert!(sent == 1_000 && each <= 1_000, "{each} allocations for {sent} lists: one each is iceoryx2's");
    drop((publisher, poses, encoded, features));
    let _ = std::fs::remove_dir_all(&root);
    for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
        if entry.file_name().to_string_lossy().starts_with(&name) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
