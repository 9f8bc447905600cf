//! Kills and stops on both sides: the other one goes on, and nothing piles up.

use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use cairn::messages::Health;
use cairn::publish::{Conversion, Publisher};

use crate::support::{PATIENCE, Place, Role, connect, estimate, next, small, until};

const ROUNDS: usize = 10;

#[test]
fn a_subscriber_goes_on_receiving_from_ten_daemons_killed_in_a_row() {
    let place = Place::new();
    let client = place.client();
    let (mut poses, mut map, mut health) = (client.poses(), client.map(), client.health());
    let mut runs = Vec::new();
    let mut files = Vec::new();
    for round in 0..ROUNDS {
        let daemon = place.spawn(Role::Publisher);
        let mut run = None;
        until("poses of a new run come", || {
            run = poses.wait(Duration::from_millis(50)).unwrap().map(|pose| pose.run_id);
            run.is_some_and(|run| !runs.contains(&run))
        });
        runs.extend(run);
        until("map and health of the new run come", || {
            let map = map.try_next().unwrap().is_some_and(|m| Some(m.header().run_id) == run);
            map && next(&mut health).run_id == runs[round]
        });
        next(&mut poses);
        files.push(place.files());
        daemon.kill();
    }
    assert_eq!(runs.len(), ROUNDS);
    // The first round may lack what the clients only make when they see a daemon leave.
    assert!(files[1..].iter().all(|f| f == &files[1]), "shared-memory objects and files: {files:?}");
}

#[test]
fn a_subscriber_notices_a_killed_daemon_and_lets_go_of_its_memory() {
    let place = Place::new();
    let mut poses = place.client().poses();
    let daemon = place.spawn(Role::Publisher);
    next(&mut poses);
    daemon.kill();
    until("the subscription has noticed", || {
        poses.wait(Duration::from_millis(50)).unwrap();
        !poses.is_connected() && place.files().0 == 0
    });
}

#[test]
fn a_publisher_goes_on_while_ten_subscribers_are_killed_in_a_row() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut sequence = 0;
    let mut files = Vec::new();
    let mut witness = place.client().poses();
    connect(&mut witness);
    let mut seen = 0;
    for _ in 0..ROUNDS {
        let subscriber = place.spawn(Role::Subscriber);
        let mut step = |publisher: &mut cairn::publish::Publisher| {
            publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
            sequence += 1;
            while let Some(pose) = witness.try_next().unwrap() {
                assert_eq!(pose.sequence, seen, "the other subscriber loses nothing");
                seen += 1;
            }
        };
        // Its listener is what it makes last. (One that dies while it is just writing one of iceoryx2's tag files leaves
        // that file behind for good: iceoryx2 0.10 does not list half-written tags when it clears away.)
        until("the subscriber is there", || {
            step(&mut publisher);
            place.listeners() == 2
        });
        for _ in 0..20 {
            step(&mut publisher);
            std::thread::sleep(Duration::from_millis(2));
        }
        subscriber.kill();
        until("its remains are cleared away", || {
            step(&mut publisher);
            publisher.health.publish(&Health::default()).unwrap();
            publisher.poses.subscribers() == 1
        });
        files.push(place.files());
    }
    assert_eq!(seen, sequence);
    assert!(files.iter().all(|f| f == &files[0]), "shared-memory objects and files: {files:?}");
}

#[test]
fn a_stuck_subscriber_delays_neither_the_publisher_nor_the_others() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let stuck = place.spawn(Role::Subscriber);
    until("the subscriber is there", || {
        publisher.poses.publish(&estimate(0), &Conversion::default(), 0).unwrap();
        publisher.poses.subscribers() == 1
    });
    stuck.signal("-STOP");
    let mut poses = place.client().poses();
    until("the other subscriber is connected", || {
        poses.latest().unwrap();
        poses.is_connected()
    });
    let mut longest = Duration::ZERO;
    for sequence in 1..=5_000 {
        let start = Instant::now();
        publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
        longest = longest.max(start.elapsed());
        let mut pose = next(&mut poses);
        while pose.sequence == 0 {
            pose = next(&mut poses);
        }
        assert_eq!(pose.sequence, sequence);
    }
    println!("longest publish beside a stopped subscriber: {longest:?}");
    stuck.signal("-CONT");
}

#[test]
fn daemons_killed_while_they_open_do_not_lock_the_next_one_out() {
    let place = Place::new();
    let mut poses = place.client().poses();
    for round in 0..40 {
        let daemon = place.spawn(Role::Publisher);
        // Opening takes some 10 ms; the process itself needs as long to start.
        std::thread::sleep(Duration::from_millis(4 + round * 37 % 50));
        poses.try_next().unwrap();
        daemon.kill();
    }
    let _daemon = place.spawn(Role::Publisher);
    let (first, second) = (next(&mut poses), next(&mut poses));
    assert!(first.run_id < second.run_id || first.sequence < second.sequence);
}

#[test]
fn subscribers_killed_while_they_connect_harm_nobody() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut witness = place.client().poses();
    connect(&mut witness);
    let (mut sequence, mut longest) = (0, Duration::ZERO);
    for round in 0..40 {
        let subscriber = place.spawn(Role::Subscriber);
        let start = Instant::now();
        while start.elapsed() < Duration::from_millis(4 + round * 37 % 50) {
            let begin = Instant::now();
            publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
            longest = longest.max(begin.elapsed());
            assert_eq!(next(&mut witness).sequence, sequence);
            sequence += 1;
            std::thread::sleep(Duration::from_millis(1));
        }
        publisher.health.publish(&Health::default()).unwrap();
        subscriber.kill();
    }
    println!("longest publish while subscribers died: {longest:?}");
    until("all places are free again", || {
        publisher.health.publish(&Health::default()).unwrap();
        publisher.poses.subscribers() == 1
    });
}

/// iceoryx2 makes its objects in /dev/shm empty and unreadable, and a daemon may be killed before it fills one.
#[test]
fn what_killed_processes_left_unfilled_holds_nobody() {
    let place = Place::new();
    drop(place.publisher());
    let counter = place.objects(".global_mgmt");
    assert_eq!(counter.len(), 1, "what every process opens, and nobody removes: {counter:?}");
    leave_unfilled(&counter);
    // Long enough to be taken for another user's who keeps everybody out.
    std::thread::sleep(Duration::from_millis(1100));
    let endpoint = place.endpoint();
    within_patience("a daemon opens its services", move || drop(Publisher::open(&endpoint, &small()).unwrap()));
    let daemon = place.spawn(Role::Publisher);
    let mut objects = Vec::new();
    until("a daemon has made its services", || {
        objects = place.objects(".dynamic");
        objects.len() == 11
    });
    daemon.kill();
    leave_unfilled(&objects);
    let client = place.client();
    let mut poses = within_patience("a client is not held", move || {
        let mut poses = client.poses();
        poses.try_next().unwrap();
        poses
    });
    let _daemon = place.spawn(Role::Publisher);
    next(&mut poses);
    assert!(objects.iter().all(|path| !path.exists()), "they were cleared away");
}

/// As if their maker had been killed before it gave them a size.
fn leave_unfilled(objects: &[PathBuf]) {
    for path in objects {
        let file = File::create(path).unwrap();
        file.set_permissions(Permissions::from_mode(0o200)).unwrap();
    }
}

/// What `work` gives; fails if it does not come back.
#[track_caller]
fn within_patience<T: Send + 'static>(what: &str, work: impl FnOnce() -> T + Send + 'static) -> T {
    let (done, result) = std::sync::mpsc::channel();
    std::thread::spawn(move || done.send(work()));
    result.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("not within {PATIENCE:?}: {what}"))
}
