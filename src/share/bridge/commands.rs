//! What ROS 2 asks of the daemon: services and the initial pose, as commands like any client's.
//!
//! Input: requests, as Zenoh's threads put them into a bounded queue. One that finds the queue full is dropped, and its client hears nothing but
//! the end of its request. Output: commands to the daemon and their answers. A map may take seconds to be stored, so this is a thread of its own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use tracing::{info, warn};
use zenoh::Wait;
use zenoh::query::Query;

use super::attachment::Attachment;
use crate::client::{Client, ClientError};
use crate::messages::{CommandReply, Transform};
use crate::ros::{CdrError, Field, Reader, Writer};
use crate::share::frames::frames;

/// Requests that wait.
const QUEUE: usize = 8;
/// The daemon's answer comes between two frames; a large map takes a slow disk seconds.
const TIMEOUT: Duration = Duration::from_secs(30);
/// How late the end is noticed.
const TURN: Duration = Duration::from_millis(100);

/// Services, each a `std_srvs/srv/Trigger`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Service {
    /// Drops the map and starts over.
    Reset,
    /// Stores the map in its file.
    Save,
}

impl Service {
    pub const ALL: [Self; 2] = [Self::Reset, Self::Save];

    /// Below the robot's namespace.
    pub fn word(self) -> &'static str {
        match self {
            Self::Reset => "reset",
            Self::Save => "save",
        }
    }
}

/// See module.
pub enum Request {
    Service(Service, Query),
    /// A PoseWithCovarianceStamped's bytes.
    InitialPose(Vec<u8>),
}

/// The end of the queue that Zenoh's threads have.
#[derive(Clone)]
pub struct Inbox {
    requests: Sender<Request>,
}

impl Inbox {
    pub fn push(&self, request: Request) {
        if self.requests.try_send(request).is_err() {
            warn!("too many requests from ROS 2 at once, one is not answered");
        }
    }
}

/// See module.
pub struct Commands {
    requests: Receiver<Request>,
    client: Client,
    is_metric: Arc<AtomicBool>,
}

impl Commands {
    /// `is_metric`: whether lengths of the map are metres, as the other half hears it.
    pub(super) fn new(client: Client, is_metric: Arc<AtomicBool>) -> (Inbox, Self) {
        let (sender, requests) = bounded(QUEUE);
        (Inbox { requests: sender }, Self { requests, client, is_metric })
    }

    /// Until it is told to stop, or nobody can ask any more.
    pub fn serve(self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            match self.requests.recv_timeout(TURN) {
                Ok(Request::Service(service, query)) => self.answer(service, &query),
                Ok(Request::InitialPose(message)) => self.set_pose(&message),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn answer(&self, service: Service, query: &Query) {
        let outcome = match service {
            Service::Reset => self.client.reset(TIMEOUT),
            Service::Save => self.client.store_map(None, TIMEOUT),
        };
        let (success, message) = told(outcome);
        info!(service = service.word(), success, answer = message, "asked by ROS 2");
        let asked = query.attachment().and_then(|bytes| Attachment::from_bytes(&bytes.to_bytes()));
        let reply = query.reply(query.key_expr().clone(), trigger_response(success, &message));
        // Whoever asks without ROS 2 has no number and no id.
        let reply = match asked {
            Some(asked) => reply.attachment(Attachment { time_ns: unix_ns(), ..asked }.to_bytes()),
            None => reply,
        };
        if let Err(error) = reply.wait() {
            warn!(service = service.word(), %error, "answer to ROS 2 not sent");
        }
    }

    fn set_pose(&self, message: &[u8]) {
        let is_metric = self.is_metric.load(Ordering::Relaxed);
        let (success, answer) = match initial_pose(message, is_metric) {
            Ok(map_from_body) => told(self.client.set_pose(&map_from_body, TIMEOUT)),
            Err(reason) => (false, reason),
        };
        if success {
            info!(service = "initialpose", success, answer, "asked by ROS 2");
        } else {
            // Nobody is answered here: the log is where it can be seen.
            warn!(reason = answer, "initial pose of ROS 2 refused");
        }
    }
}

/// Now. Before 1970 there is no ROS 2.
pub fn unix_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| i64::try_from(t.as_nanos()).unwrap_or(i64::MAX))
}

fn told(outcome: Result<CommandReply, ClientError>) -> (bool, String) {
    match outcome {
        Ok(reply) if reply.is_ok() && reply.message().is_empty() => (true, "done".into()),
        Ok(reply) => (reply.is_ok(), reply.message().into()),
        Err(error) => (false, error.to_string()),
    }
}

/// `std_srvs/srv/Trigger_Response`.
fn trigger_response(success: bool, message: &str) -> Vec<u8> {
    let mut out = Writer::default();
    success.write(&mut out);
    message.write(&mut out);
    out.into_bytes()
}

/// `map_from_body` of a PoseWithCovarianceStamped in the map's frame; what it says of its covariance has no meaning for a map that is moved.
fn initial_pose(message: &[u8], is_metric: bool) -> Result<Transform, String> {
    let read = || -> Result<(String, [f64; 3], [f64; 4]), CdrError> {
        let mut reader = Reader::new(message)?;
        // The stamp: where the robot is, it is now.
        let _ = (reader.i32()?, reader.u32()?);
        Ok((reader.text()?.to_owned(), reader.f64_array()?, reader.f64_array()?))
    };
    let (frame, position, orientation) = read().map_err(|e| format!("the message {e}"))?;
    let map = frames(is_metric).map;
    if frame.trim_start_matches('/') != map {
        return Err(format!("it is in the frame `{frame}`, the map's is `{map}`"));
    }
    let length = orientation.iter().map(|v| v * v).sum::<f64>().sqrt();
    // A quaternion that is all zero, as a message that was not filled in has it, is no orientation.
    let is_place = position.iter().all(|v| v.is_finite()) && length.is_finite() && length > 0.0;
    if !is_place {
        return Err(format!("position {position:?} or orientation {orientation:?} is not finite, or no orientation"));
    }
    Ok(Transform { position, orientation: orientation.map(|v| v / length) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::Message;
    use crate::ros::standard::{self as ros, Header, PoseWithCovariance, PoseWithCovarianceStamped, Time};

    fn message(frame_id: &str, position: [f64; 3], orientation: [f64; 4]) -> Vec<u8> {
        let pose = ros::Pose { position: position.into(), orientation: orientation.into() };
        let pose = PoseWithCovariance { pose, covariance: [0.0; 36] };
        PoseWithCovarianceStamped { header: Header { stamp: Time::from_ns(1), frame_id }, pose }.to_cdr()
    }

    #[test]
    fn an_initial_pose_is_taken_in_the_maps_frame_alone() {
        let bytes = message("map", [1.0, 2.0, 0.0], [0.0, 0.0, 2.0, 0.0]);
        let place = initial_pose(&bytes, true).expect("a pose");
        assert_eq!((place.position, place.orientation), ([1.0, 2.0, 0.0], [0.0, 0.0, 1.0, 0.0]));
        let reason = initial_pose(&bytes, false).expect_err("another frame");
        assert!(reason.contains("`map`") && reason.contains("`map_unscaled`"), "{reason}");
        for (position, orientation) in [([f64::NAN, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]), ([0.0; 3], [0.0; 4])] {
            assert!(initial_pose(&message("map", position, orientation), true).is_err());
        }
        for end in 0..bytes.len() - 8 * 36 {
            assert!(initial_pose(&bytes[..end], true).is_err(), "{end}");
        }
    }

    #[test]
    fn an_answer_is_a_flag_and_a_text() {
        assert_eq!(
            trigger_response(true, "done"),
            [&[0, 1, 0, 0, 1, 0, 0, 0, 5, 0, 0, 0], b"done\0".as_slice()].concat()
        );
    }
}
