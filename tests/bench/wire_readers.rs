//! Readers of the wire's bench, each a process of its own: this binary again, told its role by the environment.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cairn::client::{Client, monotonic_ns};
use cairn::messages::{Endpoint, Landmark};
use iceoryx2::prelude::*;

use super::{MESSAGES, endpoint};

const ROLE: &str = "CAIRN_BENCH_ROLE";
const ROOT: &str = "CAIRN_BENCH_ROOT";
/// Readers end by themselves after this time,
const LIFE: Duration = Duration::from_secs(60);
/// or when nothing has come for this long.
const QUIET: Duration = Duration::from_millis(600);

/// As large as a pose.
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[repr(C)]
#[type_name("bench.Bare.v1")]
pub struct Bare {
    pub published_ns: i64,
    pub filler: [u64; 55],
}
const _: () = assert!(size_of::<Bare>() == size_of::<cairn::messages::Pose>());

/// Of a bare slice.
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[repr(C)]
#[type_name("bench.BareHeader.v1")]
pub struct BareHeader {
    pub published_ns: i64,
}

/// A reader in another process; killed when dropped.
pub struct Reader {
    child: Child,
}

impl Reader {
    pub fn start(role: &str, root: &Path) -> Self {
        let child = Command::new(std::env::current_exe().expect("own path"))
            .env(ROLE, role)
            .env(ROOT, root)
            .stdout(Stdio::piped())
            .spawn()
            .expect("reader");
        Self { child }
    }

    pub fn wait_for(&self, mut there: impl FnMut() -> bool) {
        let start = Instant::now();
        while !there() {
            assert!(start.elapsed() < Duration::from_secs(10), "the reader does not come");
            std::thread::sleep(Duration::from_millis(5));
        }
        // Its listener comes after its subscriber.
        std::thread::sleep(Duration::from_millis(100));
    }

    /// SIGSTOP: the reader is stuck.
    pub fn stop(&self) {
        let status = Command::new("kill").args(["-STOP", &self.child.id().to_string()]).status();
        assert!(status.expect("kill").success());
    }

    /// Until it reads no more; its numbers wait.
    pub fn wait_for_end(&mut self) {
        let _ = self.child.wait();
    }

    /// The numbers that the reader prints at its end.
    pub fn result(mut self) -> Vec<f64> {
        let mut line = String::new();
        BufReader::new(self.child.stdout.take().expect("stdout")).read_line(&mut line).expect("line");
        let numbers: Vec<f64> = line.split_whitespace().map(|n| n.parse().expect("number")).collect();
        assert_eq!(numbers.len(), 3, "{line}");
        numbers
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Median and 99th percentile, us.
pub fn percentiles(ns: &mut [i64]) -> (f64, f64) {
    ns.sort_unstable();
    let at = |p: f64| ns.get(((ns.len() as f64 - 1.0) * p) as usize).map_or(f64::NAN, |v| *v as f64 * 1e-3);
    (at(0.5), at(0.99))
}

/// Plays the role that the environment names, if it does.
pub fn played_a_role() -> bool {
    let (Ok(role), Some(root)) = (std::env::var(ROLE), std::env::var_os(ROOT)) else { return false };
    let endpoint = endpoint(&PathBuf::from(root));
    match role.as_str() {
        "bare" | "bare-poll" => read_bare(&endpoint, role == "bare-poll"),
        "bare-map" => read_bare_slices(&endpoint),
        _ => read(&endpoint, &role),
    }
    true
}

/// Latencies of one reader.
#[derive(Default)]
struct Log {
    latencies: Vec<i64>,
    last: Option<u64>,
    lost: u64,
}

impl Log {
    fn wants_more(&self, started: Instant) -> bool {
        started.elapsed() < LIFE && self.latencies.len() < MESSAGES as usize
    }

    fn message(&mut self, published_ns: i64, sequence: Option<u64>) {
        self.latencies.push(monotonic_ns() - published_ns);
        if let (Some(last), Some(now)) = (self.last, sequence)
            && now > last
        {
            self.lost += now - last - 1;
        }
        self.last = sequence;
    }

    /// Prints median, 99th percentile and number lost; the first few messages are warming up.
    fn end(mut self, warm: usize) {
        self.latencies.drain(..self.latencies.len().min(warm));
        let (p50, p99) = percentiles(&mut self.latencies);
        println!("{p50} {p99} {}", self.lost);
    }
}

/// Reads with the client.
fn read(endpoint: &Endpoint, role: &str) {
    let client = Client::with_endpoint(endpoint.clone()).expect("client");
    let (mut log, started) = (Log::default(), Instant::now());
    match role {
        "poses" => {
            let mut poses = client.poses();
            while log.wants_more(started) {
                match poses.wait(QUIET).expect("wait") {
                    Some(pose) => log.message(pose.published_ns, Some(pose.sequence)),
                    None if log.latencies.is_empty() => {}
                    None => break,
                }
            }
        }
        "poses-poll" => {
            let (mut poses, mut heard) = (client.poses(), Instant::now());
            while log.wants_more(started) && (log.latencies.is_empty() || heard.elapsed() < QUIET) {
                if let Some(pose) = poses.try_next().expect("try_next") {
                    log.message(pose.published_ns, Some(pose.sequence));
                    heard = Instant::now();
                }
            }
        }
        "map" => {
            let mut map = client.map();
            while log.wants_more(started) {
                match map.wait(QUIET).expect("wait") {
                    Some(map) => log.message(map.header().published_ns, None),
                    None if log.latencies.is_empty() => {}
                    None => break,
                }
            }
            // What was there before belongs to another measurement.
            return log.end(1);
        }
        "idle" => {
            let mut poses = client.poses();
            let _ = poses.wait(QUIET);
            let (cpu, wall) = (cpu_seconds(), Instant::now());
            let _ = poses.wait(Duration::from_secs(5));
            println!("{} 0 0", 100.0 * (cpu_seconds() - cpu) / wall.elapsed().as_secs_f64());
            return;
        }
        other => panic!("no role {other}"),
    }
    log.end(10);
}

/// CPU time of this process, seconds.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/schedstat").expect("schedstat");
    stat.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).expect("ns") * 1e-9
}

pub type BareService = iceoryx2::service::port_factory::publish_subscribe::PortFactory<ipc::Service, Bare, ()>;
pub type BareSlices =
    iceoryx2::service::port_factory::publish_subscribe::PortFactory<ipc::Service, [Landmark], BareHeader>;

pub fn bare_node(endpoint: &Endpoint) -> Node<ipc::Service> {
    let node = NodeBuilder::new().config(endpoint.config()).signal_handling_mode(SignalHandlingMode::Disabled);
    node.create::<ipc::Service>().expect("node")
}

pub fn bare_service(node: &Node<ipc::Service>) -> BareService {
    let name = "bare".try_into().expect("name");
    node.service_builder(&name).publish_subscribe::<Bare>().open_or_create().expect("service")
}

pub fn bare_slices(node: &Node<ipc::Service>) -> BareSlices {
    let name = "bare-map".try_into().expect("name");
    let service = node.service_builder(&name).publish_subscribe::<[Landmark]>().user_header::<BareHeader>();
    service.open_or_create().expect("service")
}

fn listener(node: &Node<ipc::Service>, name: &str) -> iceoryx2::port::listener::Listener<ipc::Service> {
    let events = node.service_builder(&name.try_into().expect("name")).event().open_or_create().expect("events");
    events.listener_builder().create().expect("listener")
}

fn read_bare(endpoint: &Endpoint, poll: bool) {
    let node = bare_node(endpoint);
    let listener = listener(&node, "bare");
    let service = bare_service(&node);
    let subscriber = service.subscriber_builder().create().expect("subscriber");
    let (mut log, started, mut heard) = (Log::default(), Instant::now(), Instant::now());
    while log.wants_more(started) && (log.latencies.is_empty() || heard.elapsed() < QUIET) {
        if !poll {
            listener.timed_wait(|_| (), QUIET).expect("wait");
        }
        while let Some(sample) = subscriber.receive().expect("receive") {
            // As the client: the message is copied out.
            let message = *sample;
            log.message(message.published_ns, None);
            heard = Instant::now();
        }
    }
    log.end(10);
}

fn read_bare_slices(endpoint: &Endpoint) {
    let node = bare_node(endpoint);
    let listener = listener(&node, "bare-map");
    let service = bare_slices(&node);
    let subscriber = service.subscriber_builder().create().expect("subscriber");
    let (mut log, started, mut heard) = (Log::default(), Instant::now(), Instant::now());
    while log.wants_more(started) && (log.latencies.is_empty() || heard.elapsed() < QUIET) {
        listener.timed_wait(|_| (), QUIET).expect("wait");
        while let Some(sample) = subscriber.receive().expect("receive") {
            log.message(sample.user_header().published_ns, None);
            heard = Instant::now();
        }
    }
    log.end(1);
}
