//! Wheel odometry of an MCAP recording: the twists of a topic of nav_msgs/Odometry or geometry_msgs/TwistWithCovarianceStamped.
//!
//! Input: the recording's topics, and the messages of one. Output: [`WheelMessage`]s in the file's order, up to a frame's timestamp. Of an Odometry the twist
//! alone is used, which is in the base's axes (`child_frame_id`); its pose is what somebody else made of it. Each is taken as the mean since the
//! message before. Variances are those of x, y and yaw in the covariance; zero and below, as drivers write that know none, are unknown.
//!
//! A stamp says little by itself: one that is hours ahead would shut out all that follow. When a message was recorded says when it is of, as far as the
//! pictures' stamps and recording times belong together; one that is seconds off that is of another clock, named in the log, counted, and not believed.
//! What ends long before the first picture concerns nobody.
//!
//! A topic is taken by itself where there is one alone. What Cairn wrote (`odom` beside a `cairn_msgs/msg/Pose`) is what a camera has seen, and never
//! taken for wheels.

use std::path::PathBuf;

use tracing::warn;

use super::super::SourceError;
use super::picture::stamp_ns;
use super::stream::Stream;
use super::survey::Topic;
use crate::motion::wheel::{GAP_NS, WheelFault, WheelMessage};
use crate::ros::Reader;

/// A stamp that is further from when its message was recorded is of another clock, ns: as on the wire, no queue of a driver's holds as much.
const OTHER_CLOCK_NS: i64 = 5_000_000_000;

/// What the pictures say of times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureTimes {
    /// Log times take the place of stamps.
    pub by_log_time: bool,
    /// Of the first one, ns.
    pub first_ns: i64,
    /// By how much their times are above their log times, ns.
    pub above_log_ns: i64,
}

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

/// A message, when it is due (ns), and what is wrong with it.
#[derive(Debug)]
struct Told {
    message: WheelMessage,
    due_ns: i64,
    fault: Option<WheelFault>,
}

/// The twists of one topic, handed out once, in the file's order.
#[derive(Debug)]
pub struct Wheels {
    stream: Stream,
    kind: Kind,
    times: PictureTimes,
    /// Message that was read and is not due yet.
    held: Option<Told>,
    number: u64,
    message: Vec<u8>,
    ended: bool,
}

impl Wheels {
    /// `asked`: the topic's name, if it is said.
    pub fn open(
        files: &[PathBuf],
        topics: &[Topic],
        asked: Option<&str>,
        times: PictureTimes,
    ) -> Result<Option<(Self, String)>, String> {
        let Some((topic, kind)) = choose(topics, asked)? else { return Ok(None) };
        let stream = Stream::new(files.to_vec(), &topic.name);
        let wheels = Self { stream, kind, times, held: None, number: 0, message: Vec::new(), ended: false };
        Ok(Some((wheels, topic.name.clone())))
    }

    /// Gives what the recording has up to `until_ns`, each message once.
    pub fn give(&mut self, until_ns: i64, to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {
        while let Some(told) = self.next_message() {
            if told.due_ns > until_ns {
                self.held = Some(told);
                return;
            }
            to(&told.message, told.fault);
        }
    }

    fn next_message(&mut self) -> Option<Told> {
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
                Ok(message) => {
                    let told = self.judge(message, log_time_ns);
                    let begin_ns = self.times.first_ns.saturating_sub(GAP_NS);
                    if told.fault.is_some() || told.message.timestamp_ns >= begin_ns {
                        return Some(told);
                    }
                }
                Err(reason) => warn!(number = self.number, reason, "wheel message cannot be read"),
            }
        }
        None
    }

    fn judge(&self, mut message: WheelMessage, log_time_ns: i64) -> Told {
        if self.times.by_log_time {
            message.timestamp_ns = log_time_ns;
        }
        let recorded_ns = log_time_ns.saturating_add(self.times.above_log_ns);
        let ahead_ns = message.timestamp_ns.saturating_sub(recorded_ns);
        let is_of_another = !(-OTHER_CLOCK_NS..=OTHER_CLOCK_NS).contains(&ahead_ns);
        let fault = is_of_another.then_some(WheelFault::WrongClock { ahead_ns });
        let due_ns = if is_of_another { recorded_ns } else { message.timestamp_ns };
        Told { message, due_ns, fault }
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
    use std::borrow::Cow;
    use std::collections::BTreeMap;
    use std::sync::Arc;

    use super::*;
    use crate::ros::{Message as _, Writer, standard as ros};

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
        let odometry = ros::Odometry { header: header(), child_frame_id: "base", pose, twist: twist() }.to_cdr();
        let found = read(Kind::Odometry, 3, &odometry).expect("read");
        assert_eq!((found.number, found.timestamp_ns, found.from_ns), (3, 5_000_000_007, None));
        assert_eq!([found.linear_x_mps, found.linear_y_mps, found.angular_z_radps], [0.4, -0.1, 0.3]);
        assert!(found.variance[0] == 0.01 && found.variance[1].is_nan() && found.variance[2] == 0.04);
        assert!(read(Kind::Odometry, 0, &odometry[..90]).is_err_and(|e| e.contains("byte")));
        assert!(read(Kind::Twist, 0, &Writer::default().into_bytes()).is_err());
    }

    /// A file of twists: recording times and stamps, ms.
    fn recorded(path: &std::path::Path, messages: &[(i64, i64)]) {
        let schema = mcap::Schema {
            id: 1,
            name: ros::Odometry::NAME.into(),
            encoding: "ros2msg".into(),
            data: Cow::Owned(ros::Odometry::schema().into_bytes()),
        };
        let channel = Arc::new(mcap::Channel {
            id: 1,
            topic: "/odom".into(),
            schema: Some(Arc::new(schema)),
            message_encoding: "cdr".into(),
            metadata: BTreeMap::new(),
        });
        let mut writer = mcap::Writer::new(std::fs::File::create(path).expect("file")).expect("writer");
        for (log_ms, stamp_ms) in messages {
            let zero = || ros::Vector3 { x: 0.0, y: 0.0, z: 0.0 };
            let twist = ros::Twist { linear: zero(), angular: zero() };
            let pose = ros::Pose { position: [0.0; 3].into(), orientation: [0.0, 0.0, 0.0, 1.0].into() };
            let message = ros::Odometry {
                header: ros::Header { stamp: ros::Time::from_ns(stamp_ms * 1_000_000), frame_id: "odom" },
                child_frame_id: "base",
                pose: ros::PoseWithCovariance { pose, covariance: [0.0; 36] },
                twist: ros::TwistWithCovariance { twist, covariance: [0.0; 36] },
            };
            let (time, data) = ((log_ms * 1_000_000) as u64, Cow::Owned(message.to_cdr()));
            let channel = channel.clone();
            writer
                .write(&mcap::Message { channel, sequence: 0, log_time: time, publish_time: time, data })
                .expect("sent");
        }
        writer.finish().expect("whole");
    }

    #[test]
    fn stamps_of_another_clock_are_counted_and_shut_out_nothing() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.mcap");
        // Recorded at 1,000 s and later, stamped in a clock that began 990 s before; the pictures began at 12 s of it.
        let mut messages: Vec<(i64, i64)> = (0..200).map(|i| (1_000_000 + 50 * i, 10_000 + 50 * i)).collect();
        for (i, stamp_ms) in [(60, 9_000_000), (61, 9_000_050), (62, 9_000_100), (70, 0), (80, 1_008_000)] {
            messages[i].1 = stamp_ms;
        }
        recorded(&path, &messages);
        let times = PictureTimes { by_log_time: false, first_ns: 12_000_000_000, above_log_ns: -990_000_000_000 };
        let open = |times| {
            let topics = [topic("/odom", "nav_msgs/msg/Odometry", 200)];
            Wheels::open(std::slice::from_ref(&path), &topics, None, times).expect("opens").expect("wheels").0
        };
        let mut wheels = open(times);
        let mut given = |until_ms: i64| {
            let mut all = Vec::new();
            wheels.give(until_ms * 1_000_000, &mut |message, fault| all.push((message.number - 1, fault.is_some())));
            all
        };
        // What ended before 11.5 s is left out.
        assert_eq!(given(12_000).first(), Some(&(30, false)));
        assert_eq!(given(12_990), (41..60).map(|i| (i, false)).collect::<Vec<_>>());
        let rest: Vec<_> = (60..200).map(|i| (i, [60, 61, 62, 70, 80].contains(&i))).collect();
        assert_eq!(given(20_000), rest);
        // By log times no stamp counts.
        let mut wheels = open(PictureTimes { by_log_time: true, first_ns: 0, above_log_ns: 0 });
        let mut count = 0;
        wheels.give(i64::MAX, &mut |_, fault| count += u32::from(fault.is_none()));
        assert_eq!(count, 200);
    }
}
