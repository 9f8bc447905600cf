//! What the wire costs: `cargo bench --bench wire`; `cargo bench --bench wire -- maps` for the maps alone.
//!
//! Between processes on this machine: the cost of publishing, the time from publishing to the reader, woken by the event or
//! polling, with readers that are stuck, shared memory, the CPU of a reader that sleeps, and the way of a simulated camera's frame
//! from its arrival in the daemon to the planner. Beside it, turn by turn in the same run, iceoryx2 alone with messages of the
//! same size, so that the ratios hold on any machine.
//!
//! "To the reader" begins on both sides when the message is filled and only the sending is left (that is where `published_ns` is
//! stamped), and ends when the reader has been woken and holds it; of a map neither side's reader touches the landmarks. Filling
//! is the producer's own work, the same on both sides, and stands beside it; "publishing" is all that the publisher's thread
//! spends, filling and waking included. Printed as Markdown.

mod wire_readers;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use cairn::client::{Client, monotonic_ns};
use cairn::geometry::Se3;
use cairn::map::{KeyframeId, KeyframeView, LandmarkId, LandmarkView, MapId, MapSnapshot};
use cairn::messages::{Endpoint, Health};
use cairn::publish::{Conversion, Limits, MapContext, Publisher, convert};
use cairn::reconstruction::{PoseEstimate, TrackingState};
use iceoryx2::prelude::*;
use nalgebra::{Matrix6, Vector3};

use wire_readers::{Bare, Reader, bare_node, bare_service, bare_slices, percentiles};

/// Messages of one measurement, 200 a second.
const MESSAGES: u64 = 1_000;
const PERIOD: Duration = Duration::from_millis(5);
/// Landmarks of the largest map.
const LARGEST: usize = 100_000;
/// Length of the run with the simulator.
const DEMO: Duration = Duration::from_secs(8);

fn main() {
    if !wire_readers::played_a_role() {
        measure();
    }
}

fn measure() {
    let name = format!("cb{}", std::process::id());
    let root = Path::new("/tmp").join(&name);
    let endpoint = endpoint(&root);
    let bare = bare_publisher(&endpoint);
    let mut publisher = Publisher::open(&endpoint, &Limits::default()).expect("publisher");
    let at_the_start = shared_memory(&name);
    drop(publisher);
    publisher =
        Publisher::open(&endpoint, &Limits { landmarks: LARGEST, ..Limits::default() }).expect("a large publisher");

    println!("{MESSAGES} messages at {} Hz, of maps a tenth of them.\n", 1.0 / PERIOD.as_secs_f64());
    println!(
        "| message | iceoryx2 alone p50 µs | iceoryx2 alone p99 µs | Cairn p50 µs | Cairn p99 µs | ratio of the medians | ratio of the 99th percentiles | whole call, iceoryx2 alone p50 µs | whole call, Cairn p50 µs |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|---:|");
    if std::env::args().any(|argument| argument == "maps") {
        maps(&endpoint, &mut publisher, &root);
        drop((publisher, bare));
        return clean(&root, &name);
    }

    let mut unheard: Vec<i64> = (0..MESSAGES).map(|i| pose(&mut publisher, i)).collect();
    let (plain, ours) = (Reader::start("bare", &root), Reader::start("poses", &root));
    plain.wait_for(|| bare.0.dynamic_config().number_of_subscribers() > 0);
    ours.wait_for(|| publisher.poses.subscribers() == 1);
    let (mut plain_costs, mut our_costs) = (Vec::new(), Vec::new());
    // Turn by turn, so that both meet the same load of the machine.
    for sequence in 0..MESSAGES {
        plain_costs.push(bare_message(&bare));
        our_costs.push(pose(&mut publisher, sequence));
    }
    row("pose, 448 bytes", (&plain.result(), &mut plain_costs), (&ours.result(), &mut our_costs));
    // One after the other: a machine of two cores has room for one that polls.
    let mut plain = Reader::start("bare-poll", &root);
    plain.wait_for(|| bare.0.dynamic_config().number_of_subscribers() > 0);
    let mut plain_costs: Vec<i64> = (0..MESSAGES).map(|_| bare_message(&bare)).collect();
    plain.wait_for_end();
    let ours = Reader::start("poses-poll", &root);
    ours.wait_for(|| publisher.poses.subscribers() == 1);
    let mut our_costs: Vec<i64> = (0..MESSAGES).map(|i| pose(&mut publisher, i)).collect();
    row("pose, to a reader that polls", (&plain.result(), &mut plain_costs), (&ours.result(), &mut our_costs));
    maps(&endpoint, &mut publisher, &root);
    crowds(&mut publisher, &root);
    calls(&mut publisher, &mut unheard);

    let reader = Reader::start("idle", &root);
    println!("\n### Resources\n\n| what | value |\n|---|---:|");
    println!("| CPU of a reader while nothing comes % | {:.3} |", reader.result()[0]);
    let at_the_end = shared_memory(&name);
    for (when, [reserved, in_use]) in
        [("at the start, default limits", at_the_start), ("at the end, the largest maps", at_the_end)]
    {
        println!(
            "| shared memory reserved {when} MB | {reserved:.1} |\n| shared memory in use {when} MB | {in_use:.2} |"
        );
    }
    drop((publisher, bare));
    demo(&root);
    clean(&root, &name);
}

/// Publishes one message by iceoryx2 alone after a pause and returns what that cost, ns.
fn bare_message((_, publisher, notifier): &BarePublisher) -> i64 {
    std::thread::sleep(PERIOD);
    let start = Instant::now();
    publisher.send_copy(Bare { published_ns: monotonic_ns(), filler: [0; 55] }).expect("send");
    notifier.notify().expect("notify");
    start.elapsed().as_nanos() as i64
}

/// What readers measured and what publishing cost, of iceoryx2 alone and of ours.
fn row(what: &str, plain: (&[f64], &mut [i64]), ours: (&[f64], &mut [i64])) {
    let ((plain_us, plain_costs), (our_us, our_costs)) = (plain, ours);
    println!(
        "| {what} | {:.1} | {:.1} | {:.1} | {:.1} | {:.2} | {:.2} | {:.0} | {:.0} |",
        plain_us[0],
        plain_us[1],
        our_us[0],
        our_us[1],
        our_us[0] / plain_us[0],
        our_us[1] / plain_us[1],
        percentiles(plain_costs).0,
        percentiles(our_costs).0
    );
}

/// Publishes one pose after a pause and returns what that cost, ns.
fn pose(publisher: &mut Publisher, sequence: u64) -> i64 {
    publisher.poses.prepare();
    let estimate = estimate(sequence);
    std::thread::sleep(PERIOD);
    let start = Instant::now();
    publisher.poses.publish(&estimate, &Conversion::default(), 0).expect("pose");
    start.elapsed().as_nanos() as i64
}

/// Several readers, one of them stopped in its tracks: what the others lose, and what the daemon pays.
fn crowds(publisher: &mut Publisher, root: &Path) {
    println!("\n### Several readers of the pose\n");
    println!(
        "| readers | poses lost by those that run | publishing p50 µs | publishing p99 µs | to the reader p50 µs | to the reader p99 µs |"
    );
    println!("|---|---:|---:|---:|---:|---:|");
    for readers in [1, 4, 8] {
        for stuck in [false, true] {
            let mut all: Vec<Reader> = (0..readers).map(|_| Reader::start("poses", root)).collect();
            all[0].wait_for(|| {
                publisher.health.publish(&Health::default()).expect("health");
                publisher.poses.subscribers() == readers
            });
            let victim = if stuck { all.pop() } else { None };
            if let Some(victim) = &victim {
                victim.stop();
            }
            let mut costs: Vec<i64> = (0..MESSAGES).map(|i| pose(publisher, i)).collect();
            let mut results: Vec<Vec<f64>> = all.into_iter().map(Reader::result).collect();
            drop(victim);
            // The median reader: the first one woken is not the last.
            results.sort_by(|a, b| a[0].total_cmp(&b[0]));
            let lost: u64 = results.iter().map(|r| r[2] as u64).sum();
            let (p50, p99) = percentiles(&mut costs);
            let latency = results.get(results.len() / 2).map(|us| format!("{:.1} | {:.1}", us[0], us[1]));
            println!(
                "| {readers}{} | {lost} | {p50:.1} | {p99:.1} | {} |",
                if stuck { ", one stuck" } else { "" },
                latency.as_deref().unwrap_or("– | –")
            );
            // What was killed is cleared away.
            std::thread::sleep(Duration::from_millis(1_100));
            publisher.health.publish(&Health::default()).expect("health");
        }
    }
}

fn maps(endpoint: &Endpoint, publisher: &mut Publisher, root: &Path) {
    let node = bare_node(endpoint);
    let service = bare_slices(&node);
    let plain = service.publisher_builder().initial_max_slice_len(LARGEST).create().expect("publisher");
    let events = node.service_builder(&"bare-map".try_into().expect("name")).event().open_or_create().expect("events");
    let notifier = events.notifier_builder().create().expect("notifier");
    let map_from_optical = Conversion::default().map_from_optical();
    for landmarks in [1_000, 10_000, LARGEST] {
        let snapshot = snapshot(landmarks as u32);
        let (bare, ours) = (Reader::start("bare-map", root), Reader::start("map", root));
        bare.wait_for(|| service.dynamic_config().number_of_subscribers() == 1);
        std::thread::sleep(Duration::from_millis(300));
        let (mut plain_costs, mut costs) = (Vec::new(), Vec::new());
        for _ in 0..MESSAGES / 10 {
            std::thread::sleep(PERIOD * 4);
            let start = Instant::now();
            // Filled as ours is, so that both leave the caches alike.
            let sample = plain.loan_slice_uninit(landmarks).expect("memory");
            let mut sample = sample.write_from_fn(|i| convert::landmark(&snapshot.landmarks[i], &map_from_optical));
            sample.user_header_mut().published_ns = monotonic_ns();
            sample.send().expect("send");
            notifier.notify().expect("notify");
            plain_costs.push(start.elapsed().as_nanos() as i64);
            std::thread::sleep(PERIOD * 4);
            let start = Instant::now();
            publisher.map.publish(&snapshot, &Conversion::default(), &MapContext::default()).expect("map");
            costs.push(start.elapsed().as_nanos() as i64);
        }
        let what = format!("map of {landmarks} landmarks");
        row(&what, (&bare.result(), &mut plain_costs), (&ours.result(), &mut costs));
        std::thread::sleep(Duration::from_millis(300));
    }
}

/// What the publisher's other calls cost.
fn calls(publisher: &mut Publisher, unheard: &mut [i64]) {
    println!("\n### The publisher's other calls\n\n| call | p50 µs | p99 µs |\n|---|---:|---:|");
    let line = |what: &str, costs: &mut [i64]| {
        let (p50, p99) = percentiles(costs);
        println!("| {what} | {p50:.1} | {p99:.1} |");
    };
    line("pose, no reader", unheard);
    let mut costs: Vec<i64> = (0..100)
        .map(|_| {
            let start = Instant::now();
            publisher.health.publish(&Health::default()).expect("health");
            start.elapsed().as_nanos() as i64
        })
        .collect();
    line("health, no reader", &mut costs);
    let mut costs: Vec<i64> = (0..1000)
        .map(|_| {
            let start = Instant::now();
            publisher.commands.receive().expect("poll");
            start.elapsed().as_nanos() as i64
        })
        .collect();
    line("polling for commands", &mut costs);
}

/// The whole way of a simulated camera's frames, to a planner in this process.
fn demo(root: &Path) {
    let name = root.file_name().expect("name").to_string_lossy().into_owned();
    let output = root.join("demo");
    let mut daemon = Command::new(env!("CARGO_BIN_EXE_cairn"))
        .args(["demo", "--quiet", "--seconds", &DEMO.as_secs().to_string(), "--output"])
        .arg(&output)
        .env("CAIRN_PREFIX", "bench")
        .env("CAIRN_IPC_ROOT", root)
        .env("CAIRN_IPC_PREFIX", format!("{name}_"))
        .stdout(Stdio::null())
        .spawn()
        .expect("cairn demo");
    let mut poses = Client::with_endpoint(endpoint(root)).expect("client").poses();
    let (mut whole, mut wire, mut tracked) = (Vec::new(), Vec::new(), 0);
    let end = Instant::now() + DEMO + Duration::from_secs(20);
    while Instant::now() < end && daemon.try_wait().expect("wait").is_none() {
        if let Some(pose) = poses.wait(Duration::from_millis(200)).expect("wait") {
            let now = monotonic_ns();
            whole.push(now - pose.arrival_ns);
            wire.push(now - pose.published_ns);
            tracked += u32::from(pose.is_tracking());
        }
    }
    let _ = daemon.kill();
    let _ = daemon.wait();
    let ((p50, p99), (w50, w99)) = (percentiles(&mut whole), percentiles(&mut wire));
    println!("\n### From a simulated frame to the planner\n");
    println!("`cairn demo`, {} poses, {tracked} of them tracked.\n", whole.len());
    println!("| span | p50 ms | p99 ms |\n|---|---:|---:|");
    println!("| frame's arrival in the daemon to its pose in the planner | {:.1} | {:.1} |", p50 * 1e-3, p99 * 1e-3);
    println!("| of which from publishing | {:.3} | {:.3} |", w50 * 1e-3, w99 * 1e-3);
}

/// Apparent and resident size of this bench's objects in /dev/shm, MB.
fn shared_memory(name: &str) -> [f64; 2] {
    use std::os::unix::fs::MetadataExt;
    let objects = std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten();
    let sizes = objects.filter(|e| e.file_name().to_string_lossy().starts_with(name)).filter_map(|e| e.metadata().ok());
    let (apparent, resident) = sizes.fold((0, 0), |(a, r), m| (a + m.len(), r + m.blocks() * 512));
    [apparent, resident].map(|bytes| bytes as f64 * 1e-6)
}

fn clean(root: &Path, name: &str) {
    let _ = std::fs::remove_dir_all(root);
    for entry in std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten() {
        if entry.file_name().to_string_lossy().starts_with(name) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

fn endpoint(root: &Path) -> Endpoint {
    let name = root.file_name().expect("name").to_string_lossy().into_owned();
    let endpoint = Endpoint::new("bench").and_then(|e| e.with_root(root));
    endpoint.and_then(|e| e.with_ipc_prefix(&format!("{name}_"))).expect("endpoint")
}

type BarePublisher = (
    wire_readers::BareService,
    iceoryx2::port::publisher::Publisher<ipc::Service, Bare, ()>,
    iceoryx2::port::notifier::Notifier<ipc::Service>,
);

fn bare_publisher(endpoint: &Endpoint) -> BarePublisher {
    let node = bare_node(endpoint);
    let service = bare_service(&node);
    let publisher = service.publisher_builder().create().expect("publisher");
    let events = node.service_builder(&"bare".try_into().expect("name")).event().open_or_create().expect("events");
    let notifier = events.notifier_builder().create().expect("notifier");
    (service, publisher, notifier)
}

fn estimate(sequence: u64) -> PoseEstimate {
    PoseEstimate {
        sequence,
        timestamp_ns: monotonic_ns(),
        arrival_ns: monotonic_ns(),
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
    }
}

fn snapshot(landmarks: u32) -> MapSnapshot {
    let landmark = |i: u32| LandmarkView {
        id: LandmarkId(i),
        position_world: Vector3::new(f64::from(i), 0.0, 1.0),
        sigma: 0.01,
        observations: 3,
    };
    let keyframe = |i: u32| KeyframeView { id: KeyframeId(i), timestamp_ns: 0, world_from_camera: Se3::identity() };
    MapSnapshot {
        map: MapId(0),
        scale: Default::default(),
        revision: 0,
        landmarks: (0..landmarks).map(landmark).collect(),
        keyframes: (0..landmarks / 50).map(keyframe).collect(),
        around: Default::default(),
        left_out: [0; 2],
    }
}
