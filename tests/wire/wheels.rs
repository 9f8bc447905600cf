//! The base's driver and the daemon: what is told arrives once, in order, and a driver that is wrong, dead or not alone is known as that.

use std::time::Duration;

use cairn::client::{ClientError, WheelPublisher, monotonic_ns};
use cairn::messages::WheelOdometry;
use cairn::motion::wheel::{WheelFault, WheelMessage, WheelQueue};
use cairn::publish::{WheelInbox, WheelNews};
use iceoryx2::prelude::*;

use crate::support::{Place, Role, until};

type Read = Vec<(WheelMessage, Option<&'static str>)>;

fn read(inbox: &mut WheelInbox) -> (Read, WheelNews) {
    let mut all = Vec::new();
    let now_ns = monotonic_ns();
    let mut take = |m: &WheelMessage, fault: Option<WheelFault>| {
        all.push((*m, fault.map(|f| f.name())));
        fault.is_none()
    };
    let news = inbox.read(now_ns, &mut take).expect("read");
    (all, news)
}

/// Sends until a daemon is there, then drains what came of it.
fn connect(wheels: &mut WheelPublisher, inbox: &mut WheelInbox) {
    until("the driver has found the daemon", || wheels.send(0.0, 0.0, 0.0).expect("no error"));
    read(inbox);
}

#[test]
fn three_lines_tell_of_the_wheels_and_each_message_is_the_mean_since_the_one_before() {
    let place = Place::new();
    let mut wheels = place.client().wheels();
    assert!(!wheels.send(0.1, 0.0, 0.0).expect("no daemon is no error"));
    let mut publisher = place.publisher();
    connect(&mut wheels, &mut publisher.wheels);
    let begin_ns = monotonic_ns();
    for k in 0..10 {
        std::thread::sleep(Duration::from_millis(2));
        assert!(wheels.send(0.5, -0.1, f64::from(k)).expect("sent"));
    }
    let (got, news) = read(&mut publisher.wheels);
    assert_eq!((got.len(), news), (10, WheelNews { messages: 10, believed: 10, ..WheelNews::default() }));
    let queue = WheelQueue::default();
    for (k, (message, fault)) in got.iter().enumerate() {
        assert_eq!((fault, message.linear_x_mps, message.angular_z_radps), (&None, 0.5, k as f64));
        assert!(message.variance.iter().all(|v| v.is_nan()) && message.timestamp_ns > begin_ns);
        queue.push(message).expect("believed");
    }
    let mut last_ns = got[0].0.from_ns.expect("a start");
    queue.take(i64::MAX, |reading| {
        assert_eq!(reading.from_ns, last_ns);
        last_ns = reading.timestamp_ns;
    });
    assert_eq!(last_ns, got[9].0.timestamp_ns);
}

#[test]
fn lost_messages_are_counted_and_another_clock_is_not_believed() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut wheels = place.client().wheels();
    connect(&mut wheels, &mut publisher.wheels);
    // The queue holds 64; the oldest give way.
    for _ in 0..100 {
        wheels.send(0.5, 0.0, 0.0).expect("sent");
    }
    let (got, news) = read(&mut publisher.wheels);
    assert_eq!((got.len(), news.missing, news.driver), (64, 36, None));
    let realtime_ns = std::time::SystemTime::UNIX_EPOCH.elapsed().expect("clock").as_nanos() as i64;
    for timestamp_ns in [realtime_ns, 0] {
        wheels.publish(&WheelOdometry { timestamp_ns, ..WheelOdometry::default() }).expect("sent");
        let (got, news) = read(&mut publisher.wheels);
        assert_eq!(got.iter().map(|(_, fault)| *fault).collect::<Vec<_>>(), [Some("wrong_clock")]);
        assert_eq!((news.believed, news.missing), (0, 0), "nothing is missing");
    }
    wheels.send(0.5, 0.0, 0.0).expect("sent");
    let (_, news) = read(&mut publisher.wheels);
    assert_eq!((news.believed, news.missing), (1, 0), "what is not believed has come all the same");
}

#[test]
fn a_second_driver_is_refused_by_the_client_and_not_believed_by_the_daemon() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut wheels = place.client().wheels();
    connect(&mut wheels, &mut publisher.wheels);
    let error = place.client().wheels().send(9.0, 0.0, 0.0).expect_err("refused");
    assert!(matches!(&error, ClientError::SecondPublisher { pid: Some(pid), .. } if *pid == std::process::id()));
    assert!(error.to_string().contains("only one driver"), "{error}");

    // One that does not ask, with no client of ours.
    let node = NodeBuilder::new().config(place.endpoint().config()).create::<ipc::Service>().expect("node");
    let name = place.endpoint().service("wheel").expect("name");
    let service = node.service_builder(&name).publish_subscribe::<WheelOdometry>().open().expect("service");
    let rude = service.publisher_builder().create().expect("there is a place, so that it is seen");
    let message = |linear_x_mps| {
        let (linear_y_mps, angular_z_radps) = (0.0, 0.0);
        let timestamp_ns = monotonic_ns();
        WheelOdometry { timestamp_ns, linear_x_mps, linear_y_mps, angular_z_radps, ..WheelOdometry::default() }
    };
    wheels.send(0.5, 0.0, 0.0).expect("sent");
    read(&mut publisher.wheels);
    rude.send_copy(message(9.0)).expect("sent");
    let (got, news) = read(&mut publisher.wheels);
    assert_eq!(
        got.iter().map(|(m, fault)| (m.linear_x_mps, *fault)).collect::<Vec<_>>(),
        [(9.0, Some("second_publisher"))]
    );
    assert_eq!((news.second, news.driver), (Some(std::process::id()), None));
    // Nor where both are read late: the first one was not silent.
    std::thread::sleep(Duration::from_millis(600));
    rude.send_copy(message(9.0)).expect("sent");
    wheels.send(0.5, 0.0, 0.0).expect("sent");
    let (mut got, news) = read(&mut publisher.wheels);
    got.sort_by(|a, b| a.0.linear_x_mps.total_cmp(&b.0.linear_x_mps));
    assert_eq!(got.iter().map(|(_, fault)| *fault).collect::<Vec<_>>(), [None, Some("second_publisher")]);
    assert_eq!(news.driver, None);
    // The first one goes: the other is the driver now.
    drop(wheels);
    rude.send_copy(message(8.0)).expect("sent");
    let (got, news) = read(&mut publisher.wheels);
    assert_eq!((got[0].1, news.driver), (None, Some(std::process::id())));
}

#[test]
fn a_driver_that_was_killed_makes_room_for_the_next_and_a_driver_outlives_its_daemon() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let driver = place.spawn(Role::Driver);
    until("the driver is heard", || !read(&mut publisher.wheels).0.is_empty());
    driver.kill();
    let mut wheels = place.client().wheels();
    until("the next one is heard", || {
        // Refused for as long as the dead one's remains are there.
        let _ = wheels.send(0.7, 0.0, 0.0);
        read(&mut publisher.wheels).0.iter().any(|(m, fault)| m.linear_x_mps == 0.7 && fault.is_none())
    });
    drop(publisher);
    until("the daemon has gone", || !wheels.send(0.7, 0.0, 0.0).expect("no error"));
    let mut publisher = place.publisher();
    connect(&mut wheels, &mut publisher.wheels);
    wheels.send(0.8, 0.0, 0.0).expect("sent");
    assert_eq!(read(&mut publisher.wheels).0.last().expect("heard").0.linear_x_mps, 0.8);
}

/// What the helper process runs: a driver at 100 Hz.
pub fn drive(wheels: &mut WheelPublisher) {
    let end = std::time::Instant::now() + Duration::from_secs(60);
    while std::time::Instant::now() < end {
        wheels.send(0.3, 0.0, 0.0).expect("sent");
        std::thread::sleep(Duration::from_millis(10));
    }
}
