//! What ROS 2 asks of the daemon: services and the initial pose, as commands like any client's.
//!
//! Input: requests, as Zenoh's threads put them into the [`Inbox`]. One that has waited too long there is refused and not carried out late. Output:
//! commands to the daemon and their answers. A map may take seconds to be stored, so this is a thread of its own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use tracing::{info, warn};
use zenoh::Wait;
use zenoh::query::Query;

use super::attachment::Attachment;
use super::inbox::{Inbox, OLDEST, Request, Service};
use crate::client::{Client, ClientError};
use crate::messages::{CommandReply, Transform};
use crate::ros::{CdrError, Field, Reader, Writer};
use crate::share::frames::frames;

/// The daemon's answer comes between two frames; a large map takes a slow disk seconds.
const TIMEOUT: Duration = Duration::from_secs(30);
/// How late the end is noticed.
const TURN: Duration = Duration::from_millis(100);

/// See module.
pub struct Commands {
    inbox: Inbox,
    client: Client,
    is_metric: Arc<AtomicBool>,
}

impl Commands {
    /// `is_metric`: whether lengths of the map are metres, as the other half hears it.
    pub(super) fn new(inbox: Inbox, client: Client, is_metric: Arc<AtomicBool>) -> Self {
        Self { inbox, client, is_metric }
    }

    /// Until it is told to stop.
    pub fn serve(self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            let Some(taken) = self.inbox.pop(TURN) else { continue };
            let late = taken.is_stale().then(|| {
                format!("too late: it waited {:.1} s, {} s at most", taken.age.as_secs_f64(), OLDEST.as_secs())
            });
            match taken.request {
                Request::Service { service, asked, query } => self.answer(service, asked, &query, late),
                Request::InitialPose(message) => self.set_pose(&message, late),
            }
        }
    }

    /// `late`: why it is refused.
    fn answer(&self, service: Service, asked: Attachment, query: &Query, late: Option<String>) {
        let (success, message) = match (late, service) {
            (Some(late), _) => (false, late),
            (None, Service::Reset) => told(self.client.reset(TIMEOUT)),
            (None, Service::Save) => told(self.client.store_map(None, TIMEOUT)),
        };
        info!(service = service.word(), success, answer = message, "asked by ROS 2");
        let attachment = Attachment { time_ns: unix_ns(), ..asked }.to_bytes();
        let reply = query.reply(query.key_expr().clone(), trigger_response(success, &message)).attachment(attachment);
        if let Err(error) = reply.wait() {
            warn!(service = service.word(), %error, "answer to ROS 2 not sent");
        }
    }

    fn set_pose(&self, message: &[u8], late: Option<String>) {
        let is_metric = self.is_metric.load(Ordering::Relaxed);
        let asked = late.map_or_else(|| initial_pose(message, is_metric), Err);
        let (success, answer) = match asked {
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

/// What came over Zenoh, as far as it tells who asks for what.
#[derive(Debug, Clone, Copy)]
pub(super) struct Asked<'a> {
    /// To which it was sent: it may be a pattern, such as `**`.
    pub key: &'a str,
    pub attachment: Option<&'a [u8]>,
    pub payload: Option<&'a [u8]>,
}

impl Asked<'_> {
    /// Sent to `key` itself by one of rmw_zenoh's nodes; else why it is nothing that a node sends. Whoever looks around by `**` wants nothing done.
    pub fn of_a_node(&self, key: &str) -> Result<Attachment, &'static str> {
        if self.key != key {
            return Err("it was sent to a pattern of keys and not to this one");
        }
        self.attachment.and_then(Attachment::from_bytes).ok_or("it has no attachment of rmw_zenoh's")
    }

    /// A request to a service that is a `std_srvs/srv/Trigger`.
    pub fn trigger(&self, key: &str) -> Result<Attachment, &'static str> {
        let attachment = self.of_a_node(key)?;
        let is_empty =
            self.payload.is_some_and(|payload| payload.len() <= MOST_OF_EMPTY && Reader::new(payload).is_ok());
        if is_empty { Ok(attachment) } else { Err("it holds no Trigger_Request in CDR") }
    }
}

/// `std_srvs/srv/Trigger_Request` is empty, which is a byte (`structure_needs_at_least_one_member`) behind CDR's header of four; some pad it to four.
const MOST_OF_EMPTY: usize = 8;

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
    fn a_request_is_sent_to_its_service_by_a_node() {
        let bytes = Attachment { sequence: 3, time_ns: 4, gid: [5; 16] }.to_bytes();
        let right = Asked { key: "7/r/reset/T", attachment: Some(&bytes), payload: Some(&[0, 1, 0, 0, 0]) };
        assert_eq!(right.trigger("7/r/reset/T").map(|asked| asked.sequence), Ok(3));
        for payload in [&[0, 1, 0, 0][..], &[0, 1, 0, 0, 0, 0, 0, 0]] {
            assert!(Asked { payload: Some(payload), ..right }.trigger(right.key).is_ok(), "{payload:?}");
        }
        for key in ["**", "7/**", "7/r/*/T", "7/r/save/T"] {
            assert!(Asked { key, ..right }.trigger(right.key).is_err_and(|e| e.contains("pattern")), "{key}");
        }
        for attachment in [None, Some(&bytes[..32])] {
            assert!(Asked { attachment, ..right }.trigger(right.key).is_err_and(|e| e.contains("attachment")));
        }
        for payload in [None, Some(&[][..]), Some(b"{}"), Some(&[9, 9, 0, 0, 0]), Some(&[0, 1, 0, 0, 0, 0, 0, 0, 0])] {
            assert!(Asked { payload, ..right }.trigger(right.key).is_err_and(|e| e.contains("Trigger")), "{payload:?}");
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
