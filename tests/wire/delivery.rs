//! What is sent arrives, to whom and as what it should.

use std::time::Duration;

use cairn::client::{Client, ClientError};
use cairn::image::GreyImage;
use cairn::map::graph::{EdgeView, MapGraph, Tie};
use cairn::map::{KeyframeId, MapId};
use cairn::messages::{
    Clock, Command, CommandReply, EDGE_COVISIBLE, EDGE_JOIN, EDGE_LOOP, Health, MAX_TAGS, NO_MAP, State, Transform,
    command_kind, error, reply_code,
};
use cairn::motion::tag::{TagConfig, TagView};
use cairn::publish::{Conversion, FrameStamp, MapContext, PublishError, Publisher};
use iceoryx2::prelude::*;

use crate::support::{Place, Role, connect, estimate, next, small, snapshot};

const NOW: Duration = Duration::from_millis(1);

#[test]
fn poses_arrive_in_order_and_complete() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut poses = place.client().poses();
    connect(&mut poses);
    for sequence in 0..20 {
        let sent = publisher.poses.publish(&estimate(sequence), &Conversion::default(), 3).unwrap();
        assert!(sent.latency_arrival_ns >= 0 && sent.latency_capture_ns >= sent.latency_arrival_ns);
    }
    for sequence in 0..20 {
        let pose = next(&mut poses);
        assert_eq!((pose.sequence, pose.frames_dropped), (sequence, 3));
        assert_eq!(pose.position, [sequence as f64, 0.0, 0.0], "forward is x on the wire");
        assert_eq!((pose.state(), pose.run_id), (State::Tracking, publisher.health.run_id()));
        assert!(pose.age_ns(cairn::client::monotonic_ns()) >= 0);
    }
    assert!(poses.wait(NOW).unwrap().is_none());
}

#[test]
fn a_reader_that_polls_hears_the_same_and_has_no_listener() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let client = place.client();
    let mut polled = client.poses().polled(Duration::from_millis(5));
    let mut woken = client.poses();
    connect(&mut polled);
    connect(&mut woken);
    let endpoint = place.endpoint();
    let node = NodeBuilder::new().config(endpoint.config()).create::<ipc::Service>().expect("node");
    let events = node.service_builder(&endpoint.service("pose").expect("name")).event().open().expect("events");
    assert_eq!(events.dynamic_config().number_of_listeners(), 1);
    for sequence in 0..3 {
        publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
    }
    for sequence in 0..3 {
        assert_eq!((next(&mut polled).sequence, next(&mut woken).sequence), (sequence, sequence));
    }
    assert!(polled.wait(NOW).unwrap().is_none());
}

#[test]
fn a_slow_reader_loses_its_oldest_poses_and_no_other() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut poses = place.client().poses();
    connect(&mut poses);
    for sequence in 0..100 {
        publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
    }
    let mut got = Vec::new();
    while let Some(pose) = poses.wait(NOW).unwrap() {
        got.push(pose.sequence);
    }
    assert_eq!(got, (68..100).collect::<Vec<_>>(), "the newest 32");
}

#[test]
fn a_late_joiner_gets_the_last_pose_map_keyframes_and_health_at_once() {
    let place = Place::new();
    let mut publisher = place.publisher();
    for sequence in 0..6 {
        publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
    }
    publisher.map.publish(&snapshot(41, 10), &Conversion::default(), &MapContext::default()).unwrap();
    publisher.map.publish(&snapshot(42, 10), &Conversion::default(), &MapContext::default()).unwrap();
    publisher.health.publish(&Health { errors: error::LOST, ..Health::default() }).unwrap();

    let client = place.client();
    let (mut poses, mut map, mut keyframes, mut health) =
        (client.poses(), client.map(), client.keyframes(), client.health());
    connect(&mut poses);
    connect(&mut map);
    connect(&mut keyframes);
    connect(&mut health);
    // The next health message lets them all have what they missed; nothing else is sent.
    publisher.health.publish(&Health { errors: error::NO_CAMERA, ..Health::default() }).unwrap();

    assert_eq!(poses.latest().unwrap().expect("pose").sequence, 5);
    assert_eq!(next(&mut map).header().content_revision, 42);
    assert_eq!(next(&mut keyframes).header().content_revision, 42);
    assert_eq!(next(&mut health).errors, error::LOST);
    assert_eq!(next(&mut health).errors, error::NO_CAMERA);
}

#[test]
fn the_map_is_a_slice_and_says_what_was_left_out() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut map = place.client().map();
    connect(&mut map);
    let context = MapContext { timestamp_ns: 77, reset_counter: 3, map_revision: 2, map_mode: 2 };
    publisher.map.publish(&snapshot(1, 130), &Conversion::default(), &context).unwrap();
    let first = next(&mut map);
    let header = *first.header();
    assert_eq!((header.count, header.total, header.timestamp_ns), (100, 130, 77));
    assert_eq!((header.reset_counter, header.map_revision, header.content_revision, header.map_mode), (3, 2, 1, 2));
    assert_eq!((first.len(), first[0].id, first[99].id), (100, 30, 129));
    assert_eq!(first[0].position, [1.0, -30.0, 0.0], "right, down, forward became forward, left, up");

    // Two may be held; the first one does not change while the publisher goes on.
    publisher.map.publish(&snapshot(2, 0), &Conversion::default(), &context).unwrap();
    let second = next(&mut map);
    assert!(second.is_empty());
    publisher.map.publish(&snapshot(3, 5), &Conversion::default(), &context).unwrap();
    assert!(matches!(map.try_next(), Err(ClientError::TooManyHeld { limit: 2, .. })));
    assert_eq!((first.header().content_revision, first[99].id), (1, 129));
    drop(second);
    assert_eq!(next(&mut map).header().content_revision, 3);
}

#[test]
fn the_graph_is_sent_only_while_somebody_wants_it() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let edge = |from: u32, tie: Tie| EdgeView { from: KeyframeId(from), to: KeyframeId(9), shared: 40 - from, tie };
    let edges =
        vec![edge(2, Tie::Join(MapId(1))), edge(3, Tie::Loop), edge(4, Tie::Covisible), edge(5, Tie::Covisible)];
    let graph = MapGraph { edges, total: 77 };
    let context = MapContext { timestamp_ns: 6, reset_counter: 3, map_revision: 2, map_mode: 2 };
    let mut publish =
        |graph: &MapGraph| publisher.graph.publish(graph, &snapshot(5, 0), &Conversion::default(), &context);
    assert!(!publish(&graph).unwrap(), "nobody subscribes");
    let mut graphs = place.client().graph();
    connect(&mut graphs);
    assert!(publish(&graph).unwrap());
    let got = next(&mut graphs);
    let header = got.header();
    assert_eq!((header.count, header.total, header.content_revision, header.map_revision), (4, 77, 5, 2));
    assert_eq!((header.reset_counter, header.timestamp_ns, header.map_mode, header.reserved), (3, 6, 2, [0; 10]));
    let told: Vec<_> = got.iter().map(|e| (e.kind, e.from, e.to, e.shared, e.joined_map)).collect();
    let [join, closed, covisible] = [EDGE_JOIN, EDGE_LOOP, EDGE_COVISIBLE];
    assert_eq!(
        told,
        [(join, 2, 9, 38, 1), (closed, 3, 9, 37, NO_MAP), (covisible, 4, 9, 36, NO_MAP), (covisible, 5, 9, 35, NO_MAP)]
    );
    drop((got, graphs));
    assert!(!publish(&graph).unwrap(), "nobody subscribes any more");
}

#[test]
fn tags_are_told_only_while_somebody_wants_them() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let tag = |id| TagView { id, sightings: 2, placed: None };
    let all: Vec<TagView> = (0..20).map(tag).collect();
    let context = MapContext { timestamp_ns: 6, reset_counter: 3, map_revision: 2, map_mode: 2 };
    assert!(!publisher.tags.is_wanted());
    let mut tags = place.client().tags();
    connect(&mut tags);
    assert!(publisher.tags.is_wanted());
    let config = TagConfig { size_m: 0.15, ..TagConfig::default() };
    publisher.tags.publish(&all, &config, &snapshot(5, 0), &Conversion::default(), &context).unwrap();
    let got = next(&mut tags);
    assert_eq!((got.content_revision, got.map_revision, got.reset_counter, got.timestamp_ns), (5, 2, 3, 6));
    assert_eq!((got.seen().len(), got.map_mode, got.run_id), (MAX_TAGS, 2, publisher.health.run_id()));
    assert!(got.seen().iter().zip(0..).all(|(t, id)| t.id == id && t.size == 0.15 && !t.is_placed()));
    drop(tags);
    assert!(!publisher.tags.is_wanted());
}

#[test]
fn a_map_that_outlives_its_subscription_does_not_change() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut subscription = place.client().map();
    connect(&mut subscription);
    publisher.map.publish(&snapshot(1, 50), &Conversion::default(), &MapContext::default()).unwrap();
    let map = next(&mut subscription);
    let seen = |map: &cairn::client::MapSnapshot| (map.header().content_revision, map.header().count, map.to_vec());
    let before = seen(&map);
    drop(subscription);
    for revision in 2..40 {
        publisher.map.publish(&snapshot(revision, 7), &Conversion::default(), &MapContext::default()).unwrap();
    }
    assert_eq!(seen(&map), before);
}

#[test]
fn pictures_are_sent_only_while_somebody_wants_them() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut image = GreyImage::new(64, 48);
    image.data.iter_mut().zip(0u32..).for_each(|(p, i)| *p = (i % 251) as u8);
    let stamp = FrameStamp { sequence: 9, timestamp_ns: 10, arrival_ns: 11, ..FrameStamp::default() };
    assert!(!publisher.frames.publish(&image, &stamp).unwrap(), "nobody subscribes");
    let mut frames = place.client().frames();
    connect(&mut frames);
    assert!(publisher.frames.publish(&image, &stamp).unwrap());
    let frame = next(&mut frames);
    let header = frame.header();
    assert_eq!((header.sequence, header.width, header.height, header.stride), (9, 64, 48, 64));
    assert_eq!(*frame, image.data[..]);
    let too_large = publisher.frames.publish(&GreyImage::new(65, 48), &stamp);
    assert!(matches!(too_large, Err(PublishError::FrameTooLarge { bytes: 3120, limit: 3072 })), "{too_large:?}");
    drop(frames);
    assert!(publisher.frames.publish(&image, &stamp).unwrap(), "a picture that is held keeps its subscriber");
    drop(frame);
    assert!(!publisher.frames.publish(&image, &stamp).unwrap(), "nobody subscribes any more");
}

#[test]
fn a_recordings_clock_is_told_from_a_cameras() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let (mut poses, mut map) = (place.client().poses(), place.client().map());
    connect(&mut poses);
    connect(&mut map);
    let recorded = Conversion { clock: cairn::frame::Clock::Recording, ..Conversion::default() };
    for conversion in [Conversion::default(), recorded] {
        publisher.poses.publish(&estimate(1), &conversion, 0).unwrap();
        publisher.map.publish(&snapshot(1, 5), &conversion, &MapContext::default()).unwrap();
        let pose = next(&mut poses);
        let live = conversion.clock == cairn::frame::Clock::Monotonic;
        assert_eq!((pose.is_live(), pose.latency_capture_ns != cairn::messages::UNKNOWN_NS), (live, live));
        assert_eq!(Clock::from_wire(next(&mut map).header().clock) == Clock::Monotonic, live);
        // Freshness does not depend on a recording's time.
        assert!(pose.is_usable(Duration::from_secs(5)) && !pose.is_usable(Duration::ZERO));
    }
}

#[test]
fn two_daemons_are_told_apart_by_prefix() {
    let place = Place::new();
    let mut left = place.publisher();
    let mut right = Publisher::open(&place.endpoint_of("other"), &small()).expect("another prefix");
    let mut poses = [place.client().poses(), Client::with_endpoint(place.endpoint_of("other")).unwrap().poses()];
    poses.iter_mut().for_each(connect);
    left.poses.publish(&estimate(1), &Conversion::default(), 0).unwrap();
    right.poses.publish(&estimate(2), &Conversion::default(), 0).unwrap();
    let [one, two] = &mut poses;
    assert_eq!((next(one).sequence, next(two).sequence), (1, 2));
    assert!(one.wait(NOW).unwrap().is_none() && two.wait(NOW).unwrap().is_none());
}

#[test]
fn a_second_daemon_is_refused_and_told_by_whom() {
    let place = Place::new();
    let publisher = place.publisher();
    let error = Publisher::open(&place.endpoint(), &small()).expect_err("one daemon a prefix");
    assert!(matches!(error, PublishError::AlreadyRunning { .. }), "{error}");
    let message = error.to_string();
    assert!(message.contains("\"robot\"") && message.contains(&std::process::id().to_string()), "{message}");
    drop(publisher);
    place.publisher();
}

#[test]
fn a_daemon_of_another_process_is_named_by_its_process() {
    let place = Place::new();
    let helper = place.spawn(Role::Publisher);
    next(&mut place.client().poses());
    let error = Publisher::open(&place.endpoint(), &small()).expect_err("one daemon a prefix").to_string();
    assert!(error.contains(&format!("(process {})", helper.pid())), "{error}");
}

#[test]
fn commands_are_carried_out_and_answered() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let endpoint = place.endpoint();
    let here = Transform { position: [1.0, -2.0, 3.0], orientation: [0.0, 0.0, 0.6, 0.8] };
    let sender = std::thread::spawn(move || {
        let client = Client::with_endpoint(endpoint).unwrap();
        assert!(client.set_pose(&here, crate::support::PATIENCE).unwrap().is_ok());
        let reset = client.reset(crate::support::PATIENCE).unwrap();
        let save = client.save_map("/tmp/map.ply", crate::support::PATIENCE).unwrap();
        (reset, save)
    });
    let mut seen = Vec::new();
    let mut place_told = None;
    crate::support::until("two commands have come", || {
        while let Some(request) = publisher.commands.receive().unwrap() {
            let command = request.command();
            if command.kind == command_kind::SET_POSE {
                place_told = Some(Transform { position: command.position, orientation: command.orientation });
                request.reply(CommandReply::default());
                continue;
            }
            seen.push((command.kind, command.path().unwrap().to_string()));
            let reply = match command.kind {
                command_kind::RESET => CommandReply::default(),
                _ => CommandReply::new(reply_code::FAILED, "disk full"),
            };
            request.reply(reply);
        }
        seen.len() == 2
    });
    let (reset, save) = sender.join().unwrap();
    assert_eq!(seen, [(command_kind::RESET, String::new()), (command_kind::SAVE_MAP, "/tmp/map.ply".into())]);
    assert!(reset.is_ok());
    assert_eq!(place_told, Some(here));
    assert_eq!((save.code, save.message()), (reply_code::FAILED, "disk full"));
}

#[test]
fn a_command_can_be_answered_later_from_another_thread() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let endpoint = place.endpoint();
    let sender = std::thread::spawn(move || {
        Client::with_endpoint(endpoint).unwrap().command(Command::new(77), crate::support::PATIENCE).unwrap()
    });
    let mut request = None;
    crate::support::until("a command has come", || {
        request = publisher.commands.receive().unwrap();
        request.is_some()
    });
    let request = request.unwrap();
    let worker = std::thread::spawn(move || request.refuse());
    assert!(worker.join().unwrap());
    let reply = sender.join().unwrap();
    assert_eq!(reply.code, reply_code::UNSUPPORTED);
    assert!(reply.message().contains("77"));
}

#[test]
fn a_command_without_daemon_or_without_reply_is_an_error_in_bounded_time() {
    let place = Place::new();
    let client = place.client();
    assert!(matches!(client.reset(NOW), Err(ClientError::NoDaemon { .. })));
    let publisher = place.publisher();
    assert!(matches!(client.reset(NOW), Err(ClientError::NoReply { .. })), "nobody polls");
    drop(publisher);
    assert!(matches!(client.save_map(&"x".repeat(600), NOW), Err(ClientError::PathTooLong { bytes: 600, .. })));
}

#[test]
fn the_ninth_subscriber_is_told_that_the_house_is_full() {
    let place = Place::new();
    let _publisher = place.publisher();
    let client = place.client();
    let mut guests: Vec<_> = (0..8).map(|_| client.poses()).collect();
    guests.iter_mut().for_each(connect);
    let error = client.poses().try_next().expect_err("full");
    assert!(matches!(error, ClientError::TooManySubscribers { limit: 8, .. }), "{error}");
    guests.pop();
    connect(&mut client.poses());
}

/// The layout of another version: 424 bytes as those of the first one, which older programs send.
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[repr(C)]
#[type_name("cairn.Pose.v1")]
struct EarlierPose {
    anything: [u64; 53],
}

#[test]
fn another_version_is_told_so_on_both_sides() {
    let place = Place::new();
    let endpoint = place.endpoint();
    let node = NodeBuilder::new()
        .config(endpoint.config())
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .unwrap();
    let service = node.service_builder(&endpoint.service("pose").unwrap()).publish_subscribe::<EarlierPose>();
    let _service = service.create().unwrap();

    let error = place.client().poses().try_next().expect_err("another version").to_string();
    assert!(error.contains("cairn.Pose.v1 of 424 bytes") && error.contains("cairn.Pose.v2"), "{error}");

    let error = Publisher::open(&endpoint, &small()).expect_err("another version");
    assert!(matches!(&error, PublishError::Incompatible { pids, .. } if *pids == [std::process::id()]), "{error}");
}

#[test]
fn a_program_of_the_version_before_is_refused_by_this_daemons_service() {
    let place = Place::new();
    let _publisher = place.publisher();
    let endpoint = place.endpoint();
    let node = NodeBuilder::new()
        .config(endpoint.config())
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .unwrap();
    // What a client of the first version asks iceoryx2 for; its own check names both versions before it comes so far.
    let service = node.service_builder(&endpoint.service("pose").unwrap()).publish_subscribe::<EarlierPose>();
    let refused = service.open().expect_err("another version");
    assert_eq!(format!("{refused:?}"), "IncompatibleTypes");
    // And it has broken nothing for others.
    assert!(place.client().poses().try_next().unwrap().is_none());
}

#[test]
fn another_version_of_iceoryx2_is_told_so() {
    let place = Place::new();
    let _publisher = place.publisher();
    let services = std::fs::read_dir(place.root().join("services")).unwrap().flatten();
    for path in services.map(|entry| entry.path()) {
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains("minor = 10"), "{text}");
        // Read-only, so it is made anew.
        std::fs::remove_file(&path).unwrap();
        std::fs::write(&path, text.replace("minor = 10", "minor = 99")).unwrap();
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o400)).unwrap();
    }
    let error = place.client().poses().try_next().expect_err("another iceoryx2");
    assert!(matches!(error, ClientError::IpcVersionMismatch { .. }), "{error}");
    assert!(error.to_string().contains("robot/pose") && error.to_string().contains("same"), "{error}");
    let error = place.client().reset(NOW).expect_err("another iceoryx2");
    assert!(matches!(error, ClientError::IpcVersionMismatch { .. }), "{error}");
}

#[test]
fn a_client_that_comes_first_leaves_nothing_behind_and_finds_the_daemon() {
    let place = Place::new();
    let client = place.client();
    let mut poses = client.poses();
    assert!(poses.wait(Duration::from_millis(100)).unwrap().is_none());
    assert!(!client.wait_for_daemon(NOW).unwrap());
    assert_eq!(place.files(), (0, 0));
    assert!(!place.root().exists());

    let mut publisher = place.publisher();
    assert!(client.wait_for_daemon(NOW).unwrap());
    publisher.poses.publish(&estimate(1), &Conversion::default(), 0).unwrap();
    connect_and_read(&mut publisher, &mut poses);
}

/// The history is handed over when the publisher next looks after its connections.
fn connect_and_read(publisher: &mut Publisher, poses: &mut cairn::client::Poses) {
    crate::support::until("the pose of before has come", || {
        publisher.health.publish(&Health::default()).unwrap();
        poses.try_next().unwrap().is_some_and(|pose| pose.sequence == 1)
    });
}

#[test]
fn everything_is_gone_when_daemon_and_clients_have_left() {
    let place = Place::new();
    {
        let mut publisher = place.publisher();
        let client = place.client();
        let (mut poses, mut map) = (client.poses(), client.map());
        connect(&mut poses);
        connect(&mut map);
        publisher.poses.publish(&estimate(1), &Conversion::default(), 0).unwrap();
        publisher.health.publish(&Health::default()).unwrap();
        next(&mut poses);
    }
    assert_eq!(place.files().0, 0, "objects in /dev/shm");
}
