//! What there is in a recording, and which topic holds the pictures.
//!
//! A file's summary tells its topics and their messages; one without it (its recorder was killed) is read through once.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use mcap::records::Record;

use super::picture::Kind;
use super::records::{Records, Step};

/// One topic of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    pub name: String,
    /// `sensor_msgs/msg/Image`.
    pub schema: String,
    /// `cdr`.
    pub encoding: String,
    pub messages: u64,
}

impl Topic {
    /// What kind of pictures it holds, if it does.
    pub fn kind(&self) -> Option<Kind> {
        let kind = match self.schema.as_str() {
            "sensor_msgs/msg/Image" | "sensor_msgs/Image" => Kind::Raw,
            "sensor_msgs/msg/CompressedImage" | "sensor_msgs/CompressedImage" => Kind::Compressed,
            _ => return None,
        };
        (self.encoding == "cdr").then_some(kind)
    }

    pub fn is_camera_info(&self) -> bool {
        matches!(self.schema.as_str(), "sensor_msgs/msg/CameraInfo" | "sensor_msgs/CameraInfo")
            && self.encoding == "cdr"
            && self.messages > 0
    }
}

/// All topics of all files, by name. An error names its file.
pub fn survey(files: &[PathBuf]) -> Result<Vec<Topic>, (PathBuf, String)> {
    let mut all = BTreeMap::<String, Topic>::new();
    for file in files {
        for topic in survey_file(file).map_err(|reason| (file.clone(), reason))? {
            all.entry(topic.name.clone())
                .and_modify(|t| t.messages = t.messages.saturating_add(topic.messages))
                .or_insert(topic);
        }
    }
    Ok(all.into_values().collect())
}

fn survey_file(path: &Path) -> Result<Vec<Topic>, String> {
    // Opened first: it tells what is no MCAP file at all.
    let records = Records::open(path)?;
    match records.summary().map(scan) {
        Some((topics, true)) => Ok(topics),
        // It does not count messages.
        _ => Ok(scan(records).0),
    }
}

/// Counts what can be read, and whether statistics have told the counts; damage ends it, and is told when the pictures before it are used up.
fn scan(mut records: Records) -> (Vec<Topic>, bool) {
    let (mut schemas, mut topics) = (BTreeMap::<u16, String>::new(), BTreeMap::<u16, Topic>::new());
    let mut statistics = None;
    let mut note = |record: &Record| match record {
        Record::Statistics(found) => statistics = Some(found.channel_message_counts.clone()),
        Record::Schema { header, .. } => {
            schemas.insert(header.id, header.name.clone());
        }
        Record::Channel(channel) => {
            topics.entry(channel.id).or_insert_with(|| Topic {
                name: channel.topic.clone(),
                schema: schemas.get(&channel.schema_id).cloned().unwrap_or_default(),
                encoding: channel.message_encoding.clone(),
                messages: 0,
            });
        }
        Record::Message { header, .. } => {
            if let Some(topic) = topics.get_mut(&header.channel_id) {
                topic.messages += 1;
            }
        }
        _ => {}
    };
    while records.step(&mut note) == Ok(Step::Record) {}
    // A summary that leaves its channels out says nothing.
    let counts = statistics.filter(|counts| counts.is_empty() || !topics.is_empty());
    for (id, count) in counts.iter().flatten() {
        topics.entry(*id).and_modify(|topic| topic.messages = *count);
    }
    (topics.into_values().collect(), counts.is_some())
}

/// The topic of the pictures: the one that is asked for, else the only one, else the raw one of those that show the same.
pub fn choose<'a>(topics: &'a [Topic], asked: Option<&str>) -> Result<(&'a Topic, Kind), String> {
    let pictures: Vec<(&Topic, Kind)> = topics.iter().filter_map(|t| Some((t, t.kind()?))).collect();
    let list = |what: &[(&Topic, Kind)]| {
        let lines: Vec<String> =
            what.iter().map(|(t, _)| format!("{} ({}, {} messages)", t.name, t.schema, t.messages)).collect();
        lines.join(", ")
    };
    if let Some(asked) = asked {
        return match pictures.iter().find(|(t, _)| t.name == asked) {
            Some(found) => Ok(*found),
            None if topics.iter().any(|t| t.name == asked) => Err(format!(
                "--topic {asked} holds no sensor_msgs Image or CompressedImage in CDR; there are: {}",
                list(&pictures)
            )),
            None => Err(format!("there is no topic {asked} with pictures; there are: {}", list(&pictures))),
        };
    }
    let filled: Vec<(&Topic, Kind)> = pictures.into_iter().filter(|(t, _)| t.messages > 0).collect();
    match filled.as_slice() {
        [] => {
            let others: Vec<String> =
                topics.iter().map(|t| format!("{} ({}, {})", t.name, t.schema, t.encoding)).collect();
            let others = if others.is_empty() { "nothing at all".into() } else { others.join(", ") };
            Err(format!("holds no pictures (sensor_msgs Image or CompressedImage in CDR), but {others}"))
        }
        [only] => Ok(*only),
        several => {
            let first = base(&several[0].0.name);
            let raw = several.iter().find(|(_, kind)| *kind == Kind::Raw);
            match raw {
                Some(raw) if several.len() == 2 && several.iter().all(|(t, _)| base(&t.name) == first) => Ok(*raw),
                _ => Err(format!("holds several topics with pictures, say --topic: {}", list(several))),
            }
        }
    }
}

/// `/camera/image_raw` of `/camera/image_raw/compressed`.
fn base(topic: &str) -> &str {
    topic.strip_suffix("/compressed").unwrap_or(topic)
}

/// Its pictures are rectified, so that a CameraInfo's distortion is not in them (REP 104's `image_rect`, `image_rect_color`).
pub fn is_rectified(pictures: &str) -> bool {
    base(pictures).rsplit('/').next().is_some_and(|name| name.contains("_rect"))
}

/// The topic of the calibration that belongs to a topic of pictures: its neighbour, else the only one.
pub fn camera_info<'a>(topics: &'a [Topic], pictures: &str) -> Option<&'a Topic> {
    let parent = base(pictures).rsplit_once('/').map_or("", |(parent, _)| parent);
    let neighbour = format!("{parent}/camera_info");
    let mut infos = topics.iter().filter(|t| t.is_camera_info());
    if let Some(found) = infos.clone().find(|t| t.name == neighbour) {
        return Some(found);
    }
    match (infos.next(), infos.next()) {
        (Some(only), None) => Some(only),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &str, schema: &str, messages: u64) -> Topic {
        Topic { name: name.into(), schema: format!("sensor_msgs/msg/{schema}"), encoding: "cdr".into(), messages }
    }

    #[test]
    fn the_topic_is_chosen_where_it_is_plain_and_listed_where_it_is_not() {
        let raw = topic("/cam/image_raw", "Image", 9);
        let compressed = topic("/cam/image_raw/compressed", "CompressedImage", 9);
        let other = topic("/rear/image", "Image", 3);
        let empty = topic("/front/image", "Image", 0);
        let imu = topic("/imu", "Imu", 100);
        let name = |topics: &[Topic], asked| choose(topics, asked).map(|(t, _)| t.name.clone());
        assert_eq!(name(&[imu.clone(), compressed.clone(), empty.clone()], None), Ok(compressed.name.clone()));
        assert_eq!(name(&[compressed.clone(), raw.clone()], None), Ok(raw.name.clone()));
        let several = [raw.clone(), other.clone()];
        let error = name(&several, None).expect_err("not plain");
        assert!(
            error.contains("--topic") && error.contains("/cam/image_raw (") && error.contains("/rear/image"),
            "{error}"
        );
        assert_eq!(name(&several, Some("/rear/image")), Ok(other.name.clone()));
        assert!(name(&several, Some("/rear")).is_err_and(|e| e.contains("/rear/image")));
        assert!(name(&[imu.clone(), other.clone()], Some("/imu")).is_err_and(|e| e.contains("holds no sensor_msgs")));
        assert!(name(&[imu], None).is_err_and(|e| e.contains("/imu (sensor_msgs/msg/Imu, cdr)")));
        assert!(name(&[], None).is_err_and(|e| e.contains("nothing at all")));
        let ros1 = Topic { encoding: "ros1".into(), ..other };
        assert!(name(&[ros1], None).is_err());
    }

    #[test]
    fn a_calibration_is_the_neighbour_or_the_only_one() {
        let infos = [topic("/front/camera_info", "CameraInfo", 5), topic("/rear/camera_info", "CameraInfo", 5)];
        let name = |topics, pictures| camera_info(topics, pictures).map(|t: &Topic| t.name.as_str());
        assert_eq!(name(&infos, "/rear/image/compressed"), Some("/rear/camera_info"));
        assert_eq!(name(&infos, "/left/image"), None);
        assert_eq!(name(&infos[..1], "/left/image"), Some("/front/camera_info"));
        assert_eq!(name(&[topic("/camera_info", "CameraInfo", 1)], "/image"), Some("/camera_info"));
    }
}
