//! What the wire costs: `cargo bench --bench wire`.
//!
//! Between two processes on this machine: the cost of publishing, the time from publishing to a woken reader, shared
//! memory, and the CPU of a reader that sleeps. Beside it, in the same run, iceoryx2 alone with a message of the same size,
//! so that the ratio holds on any machine.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cairn::client::{Client, monotonic_ns};
use cairn::geometry::Se3;
use cairn::map::{KeyframeId, LandmarkId, MapId};
use cairn::messages::{Endpoint, Health};
use cairn::publish::{Conversion, Limits, MapContext, Publisher};
use cairn::reconstruction::{KeyframeView, LandmarkView, MapSnapshot, PoseEstimate, TrackingState};
use iceoryx2::prelude::*;
use nalgebra::{Matrix6, Vector3};

const ROLE: &str = "CAIRN_BENCH_ROLE";
const ROOT: &str = "CAIRN_BENCH_ROOT";
/// Messages of one measurement, 200 a second.
const MESSAGES: u64 = 1_000;
const PERIOD: Duration = Duration::from_millis(5);
/// Readers end by themselves after this time.
const LIFE: Duration = Duration::from_secs(60);

/// As large as a pose.
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[repr(C)]
#[type_name("bench.Bare.v1")]
struct Bare {
    published_ns: i64,
    filler: [u64; 52],
}
const _: () = assert!(size_of::<Bare>() == size_of::<cairn::messages::Pose>());

fn main() {
    match (std::env::var(ROLE), std::env::var_os(ROOT)) {
        (Ok(role), Some(root)) => play(&role, &PathBuf::from(root)),
        _ => measure(),
    }
}

fn measure() {
    let name = format!("cb{}", std::process::id());
    let root = Path::new("/tmp").join(&name);
    let endpoint = endpoint(&root);
    println!("{} messages at {} Hz, medians and 99th percentiles in us", MESSAGES, 1.0 / PERIOD.as_secs_f64());

    let bare = bare_publisher(&endpoint);
    let mut publisher = Publisher::open(&endpoint, &Limits::default()).expect("publisher");
    println!("shared memory after opening: {}", shared_memory(&name));
    let pose = |publisher: &mut Publisher, sequence: u64| {
        publisher.poses.prepare();
        let estimate = estimate(sequence);
        std::thread::sleep(PERIOD);
        let start = Instant::now();
        publisher.poses.publish(&estimate, &Conversion::default(), 0).expect("pose");
        start.elapsed().as_nanos() as i64
    };
    let mut costs: Vec<i64> = (0..MESSAGES).map(|i| pose(&mut publisher, i)).collect();
    row("pose, no reader", &mut costs, (f64::NAN, f64::NAN));

    // Turn by turn, so that both meet the same load of the machine.
    let (plain, ours) = (Reader::start("bare", &root), Reader::start("poses", &root));
    plain.wait_for(|| bare.0.dynamic_config().number_of_subscribers() > 0);
    ours.wait_for(|| publisher.poses.subscribers() == 1);
    let (mut plain_costs, mut our_costs) = (Vec::new(), Vec::new());
    for sequence in 0..MESSAGES {
        std::thread::sleep(PERIOD);
        let start = Instant::now();
        bare.1.send_copy(Bare { published_ns: monotonic_ns(), filler: [0; 52] }).expect("send");
        bare.2.notify().expect("notify");
        plain_costs.push(start.elapsed().as_nanos() as i64);
        our_costs.push(pose(&mut publisher, sequence));
    }
    let (plain, ours) = (plain.result(), ours.result());
    row("iceoryx2 alone, 424 bytes", &mut plain_costs, plain);
    row("pose, 1 reader", &mut our_costs, ours);
    println!("    ratio of the medians to the reader: {:.2}", ours.0 / plain.0);

    for readers in [4, 8] {
        let all: Vec<Reader> = (0..readers).map(|_| Reader::start("poses", &root)).collect();
        all[0].wait_for(|| {
            publisher.health.publish(&Health::default()).expect("health");
            publisher.poses.subscribers() == readers
        });
        let mut costs: Vec<i64> = (0..MESSAGES).map(|i| pose(&mut publisher, i)).collect();
        // The median reader: the first one woken is not the last.
        let mut latencies: Vec<(f64, f64)> = all.into_iter().map(Reader::result).collect();
        latencies.sort_by(|a, b| a.0.total_cmp(&b.0));
        row(&format!("pose, {readers} readers"), &mut costs, latencies[readers / 2]);
        std::thread::sleep(Duration::from_millis(50));
    }

    for landmarks in [1_000, 10_000, 20_000] {
        let snapshot = snapshot(landmarks);
        let reader = Reader::start("map", &root);
        std::thread::sleep(Duration::from_millis(300));
        let mut costs = Vec::new();
        for _ in 0..MESSAGES / 10 {
            std::thread::sleep(PERIOD * 4);
            let start = Instant::now();
            publisher.map.publish(&snapshot, &Conversion::default(), &MapContext::default()).expect("map");
            costs.push(start.elapsed().as_nanos() as i64);
        }
        row(&format!("map of {landmarks} landmarks"), &mut costs, reader.result());
    }

    let mut costs: Vec<i64> = (0..100)
        .map(|_| {
            let start = Instant::now();
            publisher.health.publish(&Health::default()).expect("health");
            start.elapsed().as_nanos() as i64
        })
        .collect();
    row("health, no reader", &mut costs, (f64::NAN, f64::NAN));
    let mut costs: Vec<i64> = (0..1000)
        .map(|_| {
            let start = Instant::now();
            publisher.commands.poll_commands(|_| Default::default()).expect("poll");
            start.elapsed().as_nanos() as i64
        })
        .collect();
    row("polling for commands", &mut costs, (f64::NAN, f64::NAN));

    let reader = Reader::start("idle", &root);
    println!("CPU of a reader while nothing comes: {:.3} %", reader.result().0);
    println!("shared memory at the end: {}", shared_memory(&name));
    drop((publisher, bare));
    let _ = std::fs::remove_dir_all(&root);
    for entry in std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten() {
        if entry.file_name().to_string_lossy().starts_with(&name) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

fn row(what: &str, costs: &mut [i64], latency: (f64, f64)) {
    let (p50, p99) = percentiles(costs);
    println!("{what:28} publishing {p50:7.1} {p99:7.1}   to the reader {:7.1} {:7.1}", latency.0, latency.1);
}

fn percentiles(ns: &mut [i64]) -> (f64, f64) {
    ns.sort_unstable();
    let at = |p: f64| ns.get(((ns.len() as f64 - 1.0) * p) as usize).map_or(f64::NAN, |v| *v as f64 * 1e-3);
    (at(0.5), at(0.99))
}

/// Apparent and resident size of this bench's objects in /dev/shm.
fn shared_memory(name: &str) -> String {
    use std::os::unix::fs::MetadataExt;
    let objects = std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten();
    let sizes = objects.filter(|e| e.file_name().to_string_lossy().starts_with(name)).filter_map(|e| e.metadata().ok());
    let (n, apparent, resident) = sizes.fold((0, 0, 0), |(n, a, r), m| (n + 1, a + m.len(), r + m.blocks() * 512));
    format!("{n} objects, {:.1} MB reserved, {:.2} MB in use", apparent as f64 * 1e-6, resident as f64 * 1e-6)
}

/// A reader in another process; killed when dropped.
struct Reader {
    child: Child,
}

impl Reader {
    fn start(role: &str, root: &Path) -> Self {
        let child = Command::new(std::env::current_exe().expect("own path"))
            .env(ROLE, role)
            .env(ROOT, root)
            .stdout(Stdio::piped())
            .spawn()
            .expect("reader");
        Self { child }
    }

    fn wait_for(&self, mut there: impl FnMut() -> bool) {
        let start = Instant::now();
        while !there() {
            assert!(start.elapsed() < Duration::from_secs(10), "the reader does not come");
            std::thread::sleep(Duration::from_millis(5));
        }
        // Its listener comes after its subscriber.
        std::thread::sleep(Duration::from_millis(100));
    }

    /// Two numbers that the reader prints at its end.
    fn result(mut self) -> (f64, f64) {
        let mut line = String::new();
        BufReader::new(self.child.stdout.take().expect("stdout")).read_line(&mut line).expect("line");
        let mut numbers = line.split_whitespace().map(|n| n.parse().expect("number"));
        (numbers.next().expect("median"), numbers.next().expect("tail"))
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn endpoint(root: &Path) -> Endpoint {
    let name = root.file_name().expect("name").to_string_lossy().into_owned();
    let endpoint = Endpoint::new("bench").and_then(|e| e.with_root(root));
    endpoint.and_then(|e| e.with_ipc_prefix(&format!("{name}_"))).expect("endpoint")
}

/// What a reader process does: reads until it has enough or nothing comes any more, and prints its latencies.
fn play(role: &str, root: &Path) {
    let client = Client::with_endpoint(endpoint(root)).expect("client");
    let mut latencies = Vec::new();
    let end = Instant::now() + LIFE;
    let silence = Duration::from_millis(600);
    let more = |latencies: &[i64]| Instant::now() < end && latencies.len() < MESSAGES as usize;
    match role {
        "bare" => read_bare(&endpoint(root), &mut latencies),
        "poses" => {
            let mut poses = client.poses();
            while more(&latencies) {
                match poses.wait(silence).expect("wait") {
                    Some(pose) => latencies.push(monotonic_ns() - pose.published_ns),
                    None if latencies.is_empty() => {}
                    None => break,
                }
            }
            latencies.drain(..latencies.len().min(10));
        }
        "map" => {
            let mut map = client.map();
            while more(&latencies) {
                match map.wait(silence).expect("wait") {
                    Some(map) => latencies.push(monotonic_ns() - map.header().published_ns),
                    None if latencies.is_empty() => {}
                    None => break,
                }
            }
            // What was there before belongs to another measurement.
            latencies.drain(..latencies.len().min(1));
        }
        _ => {
            let mut poses = client.poses();
            let _ = poses.wait(silence);
            let (cpu, wall) = (cpu_seconds(), Instant::now());
            let _ = poses.wait(Duration::from_secs(5));
            println!("{} 0", 100.0 * (cpu_seconds() - cpu) / wall.elapsed().as_secs_f64());
            return;
        }
    }
    let (p50, p99) = percentiles(&mut latencies);
    println!("{p50} {p99}");
}

/// CPU time of this process, seconds (clock ticks are 10 ms).
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/schedstat").expect("schedstat");
    stat.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).expect("ns") * 1e-9
}

type BareService = iceoryx2::service::port_factory::publish_subscribe::PortFactory<ipc::Service, Bare, ()>;

fn bare_node(endpoint: &Endpoint) -> Node<ipc::Service> {
    let node = NodeBuilder::new().config(endpoint.config()).signal_handling_mode(SignalHandlingMode::Disabled);
    node.create::<ipc::Service>().expect("node")
}

fn bare_service(node: &Node<ipc::Service>) -> BareService {
    let name = "bare".try_into().expect("name");
    node.service_builder(&name).publish_subscribe::<Bare>().open_or_create().expect("service")
}

type BarePublisher = (
    BareService,
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

fn read_bare(endpoint: &Endpoint, latencies: &mut Vec<i64>) {
    let node = bare_node(endpoint);
    let events = node.service_builder(&"bare".try_into().expect("name")).event().open_or_create().expect("events");
    let listener = events.listener_builder().create().expect("listener");
    let service = bare_service(&node);
    let subscriber = service.subscriber_builder().create().expect("subscriber");
    let end = Instant::now() + LIFE;
    let mut heard = Instant::now();
    while Instant::now() < end && latencies.len() < MESSAGES as usize {
        listener.timed_wait(|_| (), Duration::from_millis(600)).expect("wait");
        while let Some(sample) = subscriber.receive().expect("receive") {
            latencies.push(monotonic_ns() - sample.published_ns);
            heard = Instant::now();
        }
        if !latencies.is_empty() && heard.elapsed() > Duration::from_millis(500) {
            break;
        }
    }
    latencies.drain(..latencies.len().min(10));
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
        map: MapId(0),
        reset_counter: 0,
        keyframe: false,
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
        revision: 0,
        landmarks: (0..landmarks).map(landmark).collect(),
        keyframes: (0..landmarks / 50).map(keyframe).collect(),
    }
}
