//! Wheel odometry of an MCAP recording: the twists of a topic of nav_msgs/Odometry or geometry_msgs/TwistWithCovarianceStamped.
//!
//! Input: the recording's topics, and the messages of one. Output: [`WheelMessage`]s in the file's order, up to a frame's timestamp. Of an Odometry the twist
//! alone is used, which is in the base's axes (`child_frame_id`); its pose is what somebody else made of it. Each is taken as the mean since the
//! message before. Variances are those of x, y and yaw in the covariance; zero and below, as drivers write that know none, are unknown.
//!
//! A topic is taken by itself where there is one alone. What Cairn wrote (`odom` beside a `cairn_msgs/msg/Pose`) is what a camera has seen, and never
//! taken for wheels.

use std::path::PathBuf;

use tracing::warn;

use super::super::SourceError;
use super::picture::stamp_ns;
use super::stream::Stream;
use super::survey::Topic;
use crate::motion::wheel::{WheelFault, WheelMessage};
use crate::ros::Reader;

/// Which message a topic's twists are in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// nav_msgs/Odometry.
    Odometry,
    /// geometry_msgs/TwistWithCovarianceStamped.
    Twist,
}

fn kind(topic: &Topic) -> Option<Kind> {
    let kind = match topic.schema.as_str() {
        "nav_msgs/msg/Odometry" | "nav_msgs/Odometry" => Kind::Odometry,
        "geometry_msgs/msg/TwistWithCovarianceStamped" | "geometry_msgs/TwistWithCovarianceStamped" => Kind::Twist,
        _ => return None,
    };
    (topic.encoding == "cdr").then_some(kind)
}

/// The topic of the wheels: the one that is asked for, else the only one; none where there is none, or no telling which.
fn choose<'a>(topics: &'a [Topic], asked: Option<&str>) -> Result<Option<(&'a Topic, Kind)>, String> {
    let told: Vec<(&Topic, Kind)> = topics.iter().filter_map(|t| Some((t, kind(t)?))).collect();
    let list = |what: &[(&Topic, Kind)]| {
        what.iter()
            .map(|(t, _)| format!("{} ({}, {} messages)", t.name, t.schema, t.messages))
            .collect::<Vec<_>>()
            .join(", ")
    };
    if let Some(asked) = asked {
        let found = told.iter().find(|(t, _)| t.name == asked).copied();
        return found.map(Some).ok_or_else(|| {
            let there = if told.is_empty() { "none".into() } else { list(&told) };
            format!("--wheel-topic {asked}: there is no such topic of Odometry or TwistWithCovarianceStamped in CDR; there are: {there}")
        });
    }
    let is_ours = |topic: &Topic| {
        let pose = topic.name.strip_suffix("/odom").map(|prefix| format!("{prefix}/pose"));
        topics.iter().any(|t| Some(&t.name) == pose.as_ref() && t.schema == "cairn_msgs/msg/Pose")
    };
    let filled: Vec<_> = told.into_iter().filter(|(t, _)| t.messages > 0 && !is_ours(t)).collect();
    match filled.as_slice() {
        [] => Ok(None),
        [only] => Ok(Some(*only)),
        several => {
            let topics = list(several);
            warn!(topics, "several topics may be wheel odometry, none is used: say --wheel-topic");
            Ok(None)
        }
    }
}

/// The twists of one topic, handed out once, in the file's order.
#[derive(Debug)]
pub struct Wheels {
    stream: Stream,
    kind: Kind,
    by_log_time: bool,
    /// Message that was read and is not due yet.
    held: Option<WheelMessage>,
    number: u64,
    message: Vec<u8>,
    ended: bool,
}

impl Wheels {
    /// `asked`: the topic's name, if it is said. `by_log_time`: as the pictures' times are.
    pub fn open(
        files: &[PathBuf],
        topics: &[Topic],
        asked: Option<&str>,
        by_log_time: bool,
    ) -> Result<Option<(Self, String)>, String> {
        let Some((topic, kind)) = choose(topics, asked)? else { return Ok(None) };
        let stream = Stream::new(files.to_vec(), &topic.name);
        let wheels = Self { stream, kind, by_log_time, held: None, number: 0, message: Vec::new(), ended: false };
        Ok(Some((wheels, topic.name.clone())))
    }

    /// Gives what the recording has up to `until_ns`, each message once.
    pub fn give(&mut self, until_ns: i64, to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {
        while let Some(message) = self.next_message() {
            if message.timestamp_ns > until_ns {
                self.held = Some(message);
                return;
            }
            to(&message, None);
        }
    }

    fn next_message(&mut self) -> Option<WheelMessage> {
        if let Some(held) = self.held.take() {
            return Some(held);
        }
        // Ends with the file: each turn reads a message of it.
        while !self.ended {
            let log_time_ns = match self.stream.next(&mut self.message) {
                Ok(Some(log_time_ns)) => log_time_ns,
                Ok(None) => {
                    self.ended = true;
                    break;
                }
                Err(error) => {
                    self.give_up(&error);
                    break;
                }
            };
            self.number += 1;
            match read(self.kind, self.number, &self.message) {
                Ok(message) if self.by_log_time => return Some(WheelMessage { timestamp_ns: log_time_ns, ..message }),
                Ok(message) => return Some(message),
                Err(reason) => warn!(number = self.number, reason, "wheel message cannot be read"),
            }
        }
        None
    }

    /// The pictures' own reading tells the same damage, and ends there.
    fn give_up(&mut self, error: &SourceError) {
        warn!(%error, "no more wheel messages can be read");
        self.ended = true;
    }
}

/// A message's twist; `number`: which of the topic's it is.
fn read(kind: Kind, number: u64, message: &[u8]) -> Result<WheelMessage, String> {
    let mut reader = Reader::new(message).map_err(|e| e.to_string())?;
    let timestamp_ns = stamp_ns(&mut reader)?;
    let mut parts = || -> Result<_, crate::ros::CdrError> {
        if kind == Kind::Odometry {
            // Child frame, pose and its covariance.
            reader.text()?;
            reader.f64_array::<7>()?;
            reader.f64_array::<36>()?;
        }
        Ok((reader.f64_array::<6>()?, reader.f64_array::<36>()?))
    };
    let ([x, y, _, _, _, yaw], covariance) = parts().map_err(|e| e.to_string())?;
    let variance = [0, 7, 35].map(|i| Some(covariance[i]).filter(|v| *v > 0.0 && v.is_finite()).unwrap_or(f64::NAN));
    Ok(WheelMessage { variance, ..WheelMessage::new(number, timestamp_ns, [x, y, yaw]) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::{Writer, standard as ros};

    fn topic(name: &str, schema: &str, messages: u64) -> Topic {
        Topic { name: name.into(), schema: schema.into(), encoding: "cdr".into(), messages }
    }

    #[test]
    fn the_only_topic_is_taken_and_never_what_a_camera_has_seen() {
        let odometry = "nav_msgs/msg/Odometry";
        let (base, other) = (topic("/odom", odometry, 9), topic("/rear/odom", odometry, 9));
        let twist = topic("/twist", "geometry_msgs/msg/TwistWithCovarianceStamped", 9);
        let ours = [topic("/cairn/odom", odometry, 9), topic("/cairn/pose", "cairn_msgs/msg/Pose", 9)];
        let name = |topics: &[Topic], asked| choose(topics, asked).map(|t| t.map(|(t, _)| t.name.clone()));
        assert_eq!(name(std::slice::from_ref(&base), None), Ok(Some("/odom".into())));
        assert_eq!(name(&[twist.clone(), topic("/empty/odom", odometry, 0)], None), Ok(Some("/twist".into())));
        assert_eq!(name(&ours, None), Ok(None), "what Cairn wrote");
        assert_eq!(name(&[ours.to_vec(), vec![base.clone()]].concat(), None), Ok(Some("/odom".into())));
        assert_eq!(name(&[base.clone(), other.clone()], None), Ok(None), "no telling which");
        assert_eq!(name(&[base.clone(), other], Some("/rear/odom")), Ok(Some("/rear/odom".into())));
        let error = name(&[base], Some("/wheels")).expect_err("not there");
        assert!(error.contains("--wheel-topic /wheels") && error.contains("/odom (nav_msgs"), "{error}");
        assert!(name(&[], Some("/wheels")).is_err_and(|e| e.contains("none")));
    }

    #[test]
    fn a_twist_is_read_with_the_variances_that_its_driver_knows() {
        let mut covariance = [0.0; 36];
        (covariance[0], covariance[7], covariance[35]) = (0.01, 0.0, 0.04);
        let vector = |x: f64, y: f64, z: f64| ros::Vector3 { x, y, z };
        let twist = || ros::TwistWithCovariance {
            twist: ros::Twist { linear: vector(0.4, -0.1, 9.0), angular: vector(8.0, 7.0, 0.3) },
            covariance,
        };
        let header = || ros::Header { stamp: ros::Time { sec: 5, nanosec: 7 }, frame_id: "odom" };
        let pose = ros::PoseWithCovariance {
            pose: ros::Pose { position: [1.0; 3].into(), orientation: [0.0, 0.0, 0.0, 1.0].into() },
            covariance: [3.0; 36],
        };
        use crate::ros::Message;
        let odometry = ros::Odometry { header: header(), child_frame_id: "base", pose, twist: twist() }.to_cdr();
        let found = read(Kind::Odometry, 3, &odometry).expect("read");
        assert_eq!((found.number, found.timestamp_ns, found.from_ns), (3, 5_000_000_007, None));
        assert_eq!([found.linear_x_mps, found.linear_y_mps, found.angular_z_radps], [0.4, -0.1, 0.3]);
        assert!(found.variance[0] == 0.01 && found.variance[1].is_nan() && found.variance[2] == 0.04);
        assert!(read(Kind::Odometry, 0, &odometry[..90]).is_err_and(|e| e.contains("byte")));
        assert!(read(Kind::Twist, 0, &Writer::default().into_bytes()).is_err());
    }
}
