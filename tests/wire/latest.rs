//! The newest message, for whoever asks when it needs it.

use std::time::{Duration, Instant};

use cairn::messages::{Health, Pose};
use cairn::publish::Conversion;

use crate::support::{Place, Role, connect, estimate, next};

#[test]
fn the_latest_pose_stays_and_its_age_grows() {
    let place = Place::new();
    let mut publisher = place.publisher();
    let mut poses = place.client().poses();
    assert!(poses.latest().unwrap().is_none());
    connect(&mut poses);
    for sequence in 0..5 {
        publisher.poses.publish(&estimate(sequence), &Conversion::default(), 0).unwrap();
    }
    let first = *poses.latest().unwrap().expect("pose");
    assert_eq!(first.sequence, 4);
    let again = *poses.latest().unwrap().expect("the same pose again");
    assert_eq!(again.sequence, 4);
    drop(publisher);
    crate::support::until("the subscription has noticed", || {
        poses.latest().unwrap();
        !poses.is_connected()
    });
    assert_eq!(poses.latest().unwrap().expect("the last pose of the daemon that went").sequence, 4);
}

/// What the helper process runs: its environment names the daemon.
pub fn ask_for_the_latest() {
    let pose = Pose::latest().expect("no error").expect("the pose of a daemon that is there");
    let health = Health::latest().expect("no error").expect("its health");
    assert_eq!(pose.run_id, health.run_id);
    crate::support::until("a later pose has come", || {
        let later = Pose::latest().expect("no error").expect("a pose");
        later.sequence > pose.sequence && later.is_usable(Duration::from_secs(5))
    });
}

#[test]
fn the_latest_pose_is_one_line_away() {
    let place = Place::new();
    let _daemon = place.spawn(Role::Publisher);
    next(&mut place.client().poses());
    let asked = place.command(Role::Latest).output().expect("helper");
    assert!(asked.status.success(), "{}", String::from_utf8_lossy(&asked.stderr));
}

#[test]
fn a_daemon_that_has_no_pose_yet_is_waited_for_once() {
    let place = Place::new();
    let _publisher = place.publisher();
    let mut poses = place.client().poses();
    connect(&mut poses);
    let begin = Instant::now();
    let wait = Duration::from_millis(400);
    assert!((0..20).all(|_| poses.latest_within(wait).unwrap().is_none()));
    assert!((wait..4 * wait).contains(&begin.elapsed()), "{:?}", begin.elapsed());
}
