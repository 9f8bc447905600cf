//! A place of its own for each test, and processes to play with.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use cairn::client::{Client, Subscription, Topic};
use cairn::frame::monotonic_ns;
use cairn::geometry::Se3;
use cairn::map::{KeyframeId, KeyframeView, LandmarkId, LandmarkView, MapId, MapSnapshot};
use cairn::messages::{CommandReply, Endpoint, Health, reply_code};
use cairn::publish::{Conversion, Limits, MapContext, PublishError, Publisher};
use cairn::reconstruction::{PoseEstimate, TrackingState};
use nalgebra::{Matrix6, UnitQuaternion, Vector3};

/// Every wait in these tests ends after this time.
pub const PATIENCE: Duration = Duration::from_secs(10);
/// No test takes as long.
const LONGEST_TEST: Duration = Duration::from_secs(300);
/// A helper ends by itself after this time, whatever happens to its test.
const HELPER_LIFE: Duration = Duration::from_secs(60);

const ROOT: &str = "CAIRN_TEST_ROOT";
const ROLE: &str = "CAIRN_TEST_ROLE";

/// An iceoryx2 root and prefix of one test.
pub struct Place {
    root: PathBuf,
    ipc_prefix: String,
    /// Held as long as the test runs.
    _running: Sender<()>,
}

/// Ends this process when a test that uses a place has not ended: a call that never comes back would hold the whole run.
fn watch_over(test: String) -> Sender<()> {
    let (running, ended) = channel();
    std::thread::spawn(move || {
        if ended.recv_timeout(LONGEST_TEST) == Err(RecvTimeoutError::Timeout) {
            eprintln!("{test} has not ended within {LONGEST_TEST:?}");
            std::process::abort();
        }
    });
    running
}

impl Place {
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!("cw{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let test = std::thread::current().name().unwrap_or("a test").to_owned();
        Self { root: Path::new("/tmp").join(&name), ipc_prefix: format!("{name}_"), _running: watch_over(test) }
    }

    pub fn endpoint(&self) -> Endpoint {
        endpoint(&self.root)
    }

    /// Another daemon's services in the same place.
    pub fn endpoint_of(&self, prefix: &str) -> Endpoint {
        named_endpoint(prefix, &self.root)
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    pub fn client(&self) -> Client {
        Client::with_endpoint(self.endpoint()).expect("client")
    }

    pub fn publisher(&self) -> Publisher {
        Publisher::open(&self.endpoint(), &small()).expect("publisher")
    }

    pub fn spawn(&self, role: Role) -> Helper {
        Helper { child: self.command(role).stdout(Stdio::null()).spawn().expect("helper") }
    }

    /// This test binary in a role. Terse, so that the test harness writes nothing into the middle of a line.
    pub fn command(&self, role: Role) -> Command {
        let mut command = Command::new(std::env::current_exe().expect("own path"));
        command
            .args(["--ignored", "--exact", "support::helper", "--nocapture", "--quiet"])
            .env(ROOT, &self.root)
            .env(ROLE, role.name())
            .env("CAIRN_IPC_ROOT", &self.root)
            .env("CAIRN_IPC_PREFIX", &self.ipc_prefix)
            .env("CAIRN_PREFIX", "robot")
            .stdin(Stdio::null());
        command
    }

    /// Objects in /dev/shm and files under the root. Not counted: iceoryx2's one object that outlives everything.
    pub fn files(&self) -> (usize, usize) {
        (self.objects("").len() - self.objects(".global_mgmt").len(), count(&self.root))
    }

    /// Listeners of all services.
    pub fn listeners(&self) -> usize {
        self.objects(".event_mgmt").len()
    }

    /// Objects in /dev/shm whose names end so.
    pub fn objects(&self, end: &str) -> Vec<PathBuf> {
        let paths = std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten().map(|e| e.path());
        let name = |path: &Path| path.file_name().and_then(|n| n.to_str()).map(String::from);
        paths.filter(|p| name(p).is_some_and(|n| n.starts_with(&self.ipc_prefix) && n.ends_with(end))).collect()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.root);
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.ipc_prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

pub fn endpoint(root: &Path) -> Endpoint {
    named_endpoint("robot", root)
}

fn named_endpoint(prefix: &str, root: &Path) -> Endpoint {
    let name = root.file_name().expect("name").to_string_lossy();
    Endpoint::new(prefix)
        .and_then(|e| e.with_root(root))
        .and_then(|e| e.with_ipc_prefix(&format!("{name}_")))
        .expect("endpoint")
}

fn count(folder: &Path) -> usize {
    std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .map(|e| if e.path().is_dir() { count(&e.path()) } else { 1 })
        .sum()
}

/// Limits that keep the tests' memory small.
pub fn small() -> Limits {
    Limits { landmarks: 100, keyframes: 20, frame_bytes: 64 * 48 }
}

/// What a helper process does.
#[derive(Clone, Copy)]
pub enum Role {
    /// Publishes at 200 Hz.
    Publisher,
    /// Reads poses.
    Subscriber,
    /// Asks for the latest pose and health, one line of code each.
    Latest,
    /// `cairn watch` with the arguments in the environment variable `CAIRN_TEST_WATCH`.
    Watch,
    /// Tells of wheels at 100 Hz.
    Driver,
}

impl Role {
    fn name(self) -> &'static str {
        match self {
            Self::Publisher => "publisher",
            Self::Subscriber => "subscriber",
            Self::Latest => "latest",
            Self::Watch => "watch",
            Self::Driver => "driver",
        }
    }
}

/// A helper process, killed when dropped.
pub struct Helper {
    child: Child,
}

impl Helper {
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// SIGKILL, and waits for the end.
    pub fn kill(mut self) {
        self.end();
    }

    /// `kill -SIGNAL`.
    pub fn signal(&self, signal: &str) {
        let status = Command::new("kill").args([signal, &self.pid().to_string()]).status().expect("kill");
        assert!(status.success());
    }

    fn end(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        self.end();
    }
}

/// Not a test: what a helper process runs.
#[test]
#[ignore = "started by other tests"]
fn helper() {
    let (Some(root), Ok(role)) = (std::env::var_os(ROOT), std::env::var(ROLE)) else { return };
    let root = PathBuf::from(root);
    match role.as_str() {
        "publisher" => publish_until(Instant::now() + HELPER_LIFE, &root),
        "subscriber" => {
            let mut poses = Client::with_endpoint(endpoint(&root)).expect("client").poses();
            let end = Instant::now() + HELPER_LIFE;
            while Instant::now() < end {
                poses.wait(Duration::from_millis(100)).expect("wait");
            }
        }
        "latest" => crate::latest::ask_for_the_latest(),
        "watch" => crate::watching::watch(),
        "driver" => crate::wheels::drive(&mut Client::with_endpoint(endpoint(&root)).expect("client").wheels()),
        other => panic!("no role {other}"),
    }
}

fn publish_until(end: Instant, root: &Path) {
    let mut publisher = match Publisher::open(&endpoint(root), &small()) {
        Ok(publisher) => publisher,
        Err(PublishError::AlreadyRunning { .. }) => std::process::exit(69),
        Err(e) => panic!("{e}"),
    };
    let mut sequence = 0;
    while Instant::now() < end {
        publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).expect("pose");
        if sequence % 20 == 0 {
            publisher.health.publish(&Health::default()).expect("health");
            publisher
                .map
                .publish(&snapshot(sequence, 50), &Conversion::default(), &MapContext::default())
                .expect("map");
        }
        while let Some(request) = publisher.commands.receive().expect("commands") {
            request.reply(CommandReply::new(reply_code::OK, "done"));
        }
        sequence += 1;
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A tracked pose on a line.
pub fn estimate(sequence: u64) -> PoseEstimate {
    let at = Vector3::new(0.0, 0.0, sequence as f64);
    PoseEstimate {
        sequence,
        timestamp_ns: monotonic_ns(),
        arrival_ns: monotonic_ns(),
        state: TrackingState::Tracking,
        world_from_camera: Some(Se3::new(UnitQuaternion::identity(), at)),
        odom_from_camera: Some(Se3::new(UnitQuaternion::identity(), at)),
        anchor: Some(KeyframeId(0)),
        covariance: Matrix6::identity() * 1e-4,
        angular_velocity: Vector3::zeros(),
        linear_velocity: Vector3::z(),
        landmarks: 100,
        landmarks_sought: 120,
        quality: 0.9,
        ..PoseEstimate::default()
    }
}

/// A map of `n` landmarks and a keyframe.
pub fn snapshot(revision: u64, n: u32) -> MapSnapshot {
    let landmark = |i: u32| LandmarkView {
        id: LandmarkId(i),
        position_world: Vector3::new(f64::from(i), 0.0, 1.0),
        sigma: 0.01,
        observations: 3,
    };
    let keyframe = KeyframeView { id: KeyframeId(0), timestamp_ns: 0, world_from_camera: Se3::identity() };
    MapSnapshot {
        map: MapId(0),
        revision,
        scale: Default::default(),
        landmarks: (0..n).map(landmark).collect(),
        keyframes: vec![keyframe],
        around: Default::default(),
        left_out: [0; 2],
    }
}

/// The next message, which must come.
#[track_caller]
pub fn next<T: Topic>(subscription: &mut Subscription<T>) -> T::Item {
    let start = Instant::now();
    // A wait may end early when a signal arrives.
    while start.elapsed() < PATIENCE {
        if let Some(item) = subscription.wait(PATIENCE).expect("wait") {
            return item;
        }
    }
    panic!("nothing came from {} within {PATIENCE:?}", T::NAME);
}

/// Connects a subscription that waits for a service which is there.
#[track_caller]
pub fn connect<T: Topic>(subscription: &mut Subscription<T>) {
    until("a subscription is connected", || {
        let early = subscription.try_next().expect("try_next");
        assert!(early.is_none(), "a message before any was sent");
        subscription.is_connected()
    });
}

/// Waits for a condition.
#[track_caller]
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < PATIENCE, "not within {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}
