//! Many robots on one Zenoh router: `cargo bench --no-default-features --features bridge --bench fleet [-- ROBOTS SECONDS]`.
//!
//! ```text
//! robots (one process: poses at 30 Hz, health at 10 Hz, in shared memory) ──► `cairn bridge`, a process a robot ──► router ──► listener
//! ```
//!
//! Router and listener are processes of their own, of the crate `zenoh`: a session in router mode is what `zenohd` is. The listener counts by the numbers
//! in the messages' attachments what is lost on the way from a bridge to it. CPU is of one core, from `/proc`, over the time that the listener counts.
//! Everything runs on this machine and over its loopback, so a busy machine shows in every figure but the bytes. Printed as Markdown.
//!
//! Not in it: pictures, scans, maps, radio.

use std::collections::HashMap;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cairn::client::monotonic_ns;
use cairn::geometry::Se3;
use cairn::map::KeyframeId;
use cairn::map::scale::{MapScale, ScaleSource, ScaleSources};
use cairn::messages::{Endpoint, Health};
use cairn::publish::{Conversion, Limits, Publisher};
use cairn::reconstruction::{PoseEstimate, TrackingState};
use nalgebra::{Matrix6, Vector3};
use zenoh::sample::Sample;
use zenoh::{Config, Session, Wait};

const ROLE: &str = "CAIRN_BENCH_ROLE";
const DOMAIN: &str = "7";
const PREFIX: &str = "fleet";
const ROBOTS: usize = 50;
const SECONDS: u64 = 20;
/// Bridges that hear one publisher: a service has places for eight subscribers.
const A_PUBLISHER: usize = 7;
/// Poses a second, and of these every third time the health.
const RATE_HZ: u32 = 30;
/// Until all robots are heard, on a busy machine.
const COMING: Duration = Duration::from_secs(90);
/// A role ends by itself after this time, should nobody end it.
const LIFE: Duration = Duration::from_secs(240);

fn main() {
    let argument = |name: &str| std::env::var(name).unwrap_or_default();
    let count = |name: &str| argument(name).parse::<usize>().expect("a number");
    match argument(ROLE).as_str() {
        "robots" => robots(count("ROBOTS"), Path::new(&argument("ROOT"))),
        "router" => router(&argument("PORT")),
        "listener" => listener(&argument("PORT"), &argument("WHAT"), count("SENDERS"), count("COUNT_S")),
        _ => measure(),
    }
}

fn measure() {
    let numbers: Vec<u64> = std::env::args().filter_map(|word| word.parse().ok()).collect();
    let robots = numbers.first().map_or(ROBOTS, |n| usize::try_from(*n).expect("robots"));
    let seconds = numbers.get(1).copied().unwrap_or(SECONDS);
    let slow: &[&str] = &["--rate", "odom=5", "--rate", "tf=5", "--rate", "pose=0"];
    println!("Odometry, transforms and pose at {RATE_HZ} Hz, diagnostics at 1 Hz, {seconds} s each.\n");
    println!(
        "| robots | the listener hears | messages /s | lost | kB/s a robot | router CPU % | router MB | bridge CPU % | bridge MB | listener CPU % | machine busy % |"
    );
    println!("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|");
    // With how many topics each robot is heard.
    for (robots, told, what, topics, rates) in [
        ((robots / 5).max(1), "everything", "**", 4, &[][..]),
        (robots, "everything", "**", 4, &[]),
        (robots, "everything, at `odom=5`, `tf=5`, `pose=0`", "**", 3, slow),
        (robots, "diagnostics alone, as `cairn fleet`", "diagnostics/**", 1, &[]),
    ] {
        println!("{}", row((robots, topics), (told, what), rates, seconds));
    }
}

/// One measurement, as a row of the table.
fn row((robots, topics): (usize, usize), (told, what): (&str, &str), rates: &[&str], seconds: u64) -> String {
    let root = PathBuf::from(format!("/tmp/cf{}", std::process::id()));
    std::fs::create_dir_all(&root).expect("folder");
    let port = TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port").port().to_string();
    let file = root.join("zenoh.json5");
    std::fs::write(&file, session(&port, "peer")).expect("file");
    let mut own: Vec<Process> = Vec::new();
    let role = |name: &str| {
        let mut command = Command::new(std::env::current_exe().expect("own path"));
        command
            .env(ROLE, name)
            .env("PORT", &port)
            .env("WHAT", what)
            .env("ROBOTS", robots.to_string())
            .env("ROOT", &root);
        command.env("SENDERS", (robots * topics).to_string()).env("COUNT_S", seconds.to_string());
        command
    };
    own.push(Process::start(role("router")));
    own.push(Process::start(role("robots")));
    let mut counting = Process::start(role("listener"));
    for robot in 0..robots {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
        // Where the camera sits is asked of a service with two places.
        command
            .args(["bridge", "--no-commands", "--rate", "tf_static=0", "--log", "warn", "--domain", DOMAIN])
            .args(rates);
        command.args(["--robot", &format!("r{robot}"), "--zenoh"]).arg(&file).stderr(Stdio::null());
        let (folder, prefix) = place(&root, robot / A_PUBLISHER);
        command.env("CAIRN_PREFIX", PREFIX).env("CAIRN_IPC_ROOT", folder).env("CAIRN_IPC_PREFIX", prefix);
        own.push(Process::start(command));
    }
    let mut lines = counting.lines();
    let ready = lines.next().expect("all robots are heard");
    assert_eq!(ready, "ready");
    let (before, began) = (usage(&own, &counting), Instant::now());
    std::thread::sleep(Duration::from_secs(seconds));
    let counted: Vec<u64> = lines.next().expect("counts").split(' ').map(|n| n.parse().expect("number")).collect();
    let (after, took) = (usage(&own, &counting), began.elapsed().as_secs_f64());
    let (&[messages, bytes, lost, ns], cpu) =
        (&counted[..4].try_into().expect("four"), |i: usize| 100.0 * (after[i].cpu_s - before[i].cpu_s) / took);
    let (listened, bridges) = (ns as f64 / 1e9, 2..2 + robots);
    let mean = |of: &dyn Fn(usize) -> f64| bridges.clone().map(of).sum::<f64>() / robots as f64;
    let busy = 100.0 * (1.0 - (after[robots + 3].cpu_s - before[robots + 3].cpu_s) / took / cores());
    let line = format!(
        "| {robots} | {told} | {:.0} | {lost} | {:.1} | {:.1} | {:.0} | {:.1} | {:.0} | {:.1} | {busy:.0} |",
        messages as f64 / listened,
        bytes as f64 / listened / robots as f64 / 1e3,
        cpu(0),
        after[0].mb,
        mean(&cpu),
        mean(&|i| after[i].mb),
        cpu(robots + 2)
    );
    drop((own, counting));
    clean(&root);
    line
}

/// Shared memory of this run, and of one publisher: on machines of their own robots would not look through each other's files either.
fn place(root: &Path, publisher: usize) -> (PathBuf, String) {
    let name = root.file_name().expect("name").to_string_lossy().into_owned();
    (root.join(publisher.to_string()), format!("{name}_{publisher}_"))
}

/// Killed when dropped.
struct Process {
    child: Child,
}

impl Process {
    fn start(mut command: Command) -> Self {
        Self { child: command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("process") }
    }

    fn lines(&mut self) -> impl Iterator<Item = String> + use<> {
        let out: ChildStdout = self.child.stdout.take().expect("stdout");
        BufReader::new(out).lines().map_while(Result::ok)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Of a process; of the whole machine the idle time.
struct Usage {
    cpu_s: f64,
    mb: f64,
}

/// Of all in their order, the listener's, and the machine's.
fn usage(own: &[Process], counting: &Process) -> Vec<Usage> {
    let mut all: Vec<Usage> = own.iter().chain([counting]).map(|process| of_process(process.child.id())).collect();
    let machine = std::fs::read_to_string("/proc/stat").expect("/proc/stat");
    let idle: u64 = machine.lines().next().expect("cpu").split_whitespace().skip(4).take(2).map(number).sum();
    all.push(Usage { cpu_s: idle as f64 / TICKS, mb: 0.0 });
    all
}

/// USER_HZ of Linux.
const TICKS: f64 = 100.0;

fn number(word: &str) -> u64 {
    word.parse().expect("number")
}

fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}

fn of_process(pid: u32) -> Usage {
    let read = |what: &str| std::fs::read_to_string(format!("/proc/{pid}/{what}")).expect("it lives");
    let stat = read("stat");
    let fields: Vec<&str> = stat.rsplit(')').next().expect("fields").split_whitespace().collect();
    let rollup = read("smaps_rollup");
    // What is shared (the program itself) is divided among those who have it.
    let pss = rollup.lines().find_map(|line| line.strip_prefix("Pss:")).expect("Pss");
    let kb = number(pss.split_whitespace().next().expect("kB"));
    Usage { cpu_s: (number(fields[11]) + number(fields[12])) as f64 / TICKS, mb: kb as f64 / 1e3 }
}

/// Zenoh's configuration; a router listens where others connect to.
fn session(port: &str, mode: &str) -> String {
    let ends = match mode {
        "router" => format!(r#"listen: {{ endpoints: ["tcp/127.0.0.1:{port}"] }}"#),
        _ => format!(
            r#"connect: {{ endpoints: ["tcp/127.0.0.1:{port}"], timeout_ms: -1, exit_on_failure: false }},
               listen: {{ endpoints: [] }}"#
        ),
    };
    format!(
        r#"{{ mode: "{mode}", {ends}, scouting: {{ multicast: {{ enabled: false }}, gossip: {{ enabled: false }} }} }}"#
    )
}

fn opened(port: &str, mode: &str) -> Session {
    zenoh::open(Config::from_json5(&session(port, mode)).expect("configuration")).wait().expect("session")
}

fn router(port: &str) {
    let _session = opened(port, "router");
    std::thread::sleep(LIFE);
}

/// As many publishers as the robots need.
fn robots(count: usize, root: &Path) {
    let endpoint = |publisher: usize| {
        let (folder, prefix) = place(root, publisher);
        std::fs::create_dir_all(&folder).expect("folder");
        let endpoint = Endpoint::new(PREFIX).and_then(|e| e.with_root(&folder));
        endpoint.and_then(|e| e.with_ipc_prefix(&prefix)).expect("endpoint")
    };
    let small = Limits { landmarks: 100, keyframes: 100, frame_bytes: 64 };
    let open = |i: usize| Publisher::open(&endpoint(i), &small).expect("publisher");
    let mut publishers: Vec<Publisher> = (0..count.div_ceil(A_PUBLISHER)).map(open).collect();
    // Without metres there are no transforms.
    let scale = MapScale::Metric { sigma: 0.01, sources: ScaleSources::default().with(ScaleSource::Wheels) };
    let conversion = Conversion { scale: scale.into(), ..Conversion::default() };
    let begin = Instant::now();
    for sequence in 0.. {
        let due = begin + Duration::from_secs(1) * u32::try_from(sequence).expect("frames") / RATE_HZ;
        if begin.elapsed() > LIFE {
            return;
        }
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        for publisher in &mut publishers {
            publisher.poses.prepare();
            publisher.poses.publish(&estimate(sequence), &conversion, 0).expect("pose");
            if sequence % 3 == 0 {
                publisher.health.publish(&Health { state: 1, ..Health::default() }).expect("health");
            }
        }
    }
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

/// Of one publisher, by the numbers in its attachments.
#[derive(Default)]
struct Heard {
    first: i64,
    last: i64,
    messages: i64,
    bytes: usize,
}

/// Counts for so many seconds once it hears as many senders as there are; messages, bytes, lost ones, and the time, ns.
fn listener(port: &str, what: &str, senders: usize, seconds: usize) {
    let heard = Arc::new(Mutex::new(HashMap::<Vec<u8>, Heard>::new()));
    let session = opened(port, "client");
    let own = heard.clone();
    let count = move |sample: Sample| {
        let attachment = sample.attachment().map(|a| a.to_bytes().into_owned()).unwrap_or_default();
        let Some((sequence, _)) = attachment.split_first_chunk() else { return };
        let number = i64::from_le_bytes(*sequence);
        let mut own = own.lock().expect("lock");
        // The sender's id ends it.
        let sender = own.entry(attachment[17..].to_vec()).or_insert(Heard { first: number, ..Heard::default() });
        sender.last = number;
        sender.messages += 1;
        sender.bytes += sample.payload().len() + attachment.len() + sample.key_expr().as_str().len();
    };
    let _subscriber =
        session.declare_subscriber(format!("{DOMAIN}/{what}")).callback(count).wait().expect("subscriber");
    let begin = Instant::now();
    loop {
        std::thread::sleep(Duration::from_millis(100));
        let now = heard.lock().expect("lock").len();
        if now >= senders {
            break;
        }
        assert!(begin.elapsed() < COMING, "{now} of {senders} senders are heard");
    }
    // What comes with their beginning is over then.
    std::thread::sleep(Duration::from_secs(5));
    heard.lock().expect("lock").clear();
    println!("ready");
    let begin = Instant::now();
    std::thread::sleep(Duration::from_secs(seconds as u64));
    let heard = heard.lock().expect("lock");
    let took = begin.elapsed().as_nanos();
    let sum = |of: fn(&Heard) -> i64| heard.values().map(of).sum::<i64>();
    let lost = sum(|h| h.last - h.first + 1 - h.messages);
    println!("{} {} {lost} {took}", sum(|h| h.messages), sum(|h| h.bytes as i64));
    // Until it is ended: its use of the machine is looked at.
    std::thread::sleep(LIFE);
}

fn clean(root: &Path) {
    let name = root.file_name().expect("name").to_string_lossy().into_owned();
    let _ = std::fs::remove_dir_all(root);
    for entry in std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten() {
        if entry.file_name().to_string_lossy().starts_with(&name) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
