//! Tags as a line.

use serde::Serialize;

use super::render::{Object, Render, yaw_rad};
use crate::messages::{Clock, Scale, Tags, map_mode, scale_source};

#[derive(Serialize)]
struct Json {
    position: [f64; 3],
    orientation: [f64; 4],
    size: f32,
    edge: f32,
    position_sigma: f32,
    orientation_sigma: f32,
    id: u32,
    sightings: u32,
    family: &'static str,
    is_dock: u8,
}

impl Render for Tags {
    fn json(&self) -> String {
        let tags = self.seen().iter().map(|t| Json {
            position: t.position,
            orientation: t.orientation,
            size: t.size,
            edge: t.edge,
            position_sigma: t.position_sigma,
            orientation_sigma: t.orientation_sigma,
            id: t.id,
            sightings: t.sightings,
            family: t.family_name(),
            is_dock: t.is_dock,
        });
        Object::new()
            .field("run_id", self.run_id)
            .field("content_revision", self.content_revision)
            .field("timestamp_ns", self.timestamp_ns)
            .field("published_ns", self.published_ns)
            .field("count", self.count)
            .field("map_id", self.map_id)
            .field("reset_counter", self.reset_counter)
            .field("map_revision", self.map_revision)
            .field("scale_sigma", self.scale_sigma)
            .field("scale", Scale::from_wire(self.scale).name())
            .field("scale_source", scale_source::names(self.scale_source).collect::<Vec<_>>())
            .field("clock", Clock::from_wire(self.clock).name())
            .field("map_mode", map_mode::names(self.map_mode).collect::<Vec<_>>())
            .field("tags", tags.collect::<Vec<_>>())
            .end()
    }

    /// `7  x 1.20 y -0.31 z 0.02 +- 0.01 m  yaw -90 deg (9)`: place, its sigma, which way who looks at it looks, keyframes that saw it; `?` not placed yet.
    fn text(&self) -> String {
        let unit = if Scale::from_wire(self.scale) == Scale::Metric { "m" } else { "u" };
        let mut line = format!("map {} revision {}  tags {}", self.map_id, self.map_revision, self.count);
        for tag in self.seen() {
            let dock = if tag.is_dock == 0 { "" } else { " (dock)" };
            line += &format!("  | {}{dock} ", tag.id);
            if tag.is_placed() {
                let ([x, y, z], yaw) = (tag.position, yaw_rad(&tag.orientation).to_degrees());
                line += &format!("x {x:.3} y {y:.3} z {z:.3} +- {:.3} {unit} yaw {yaw:.1} deg", tag.position_sigma);
            } else {
                line.push('?');
            }
            line += &format!(" seen {}", tag.sightings);
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{SCALE_METRIC, Tag};

    #[test]
    fn a_tag_that_is_not_placed_is_a_question_mark_and_null() {
        let mut tags = Tags { count: 2, scale: SCALE_METRIC, ..Tags::default() };
        tags.tags[0] = Tag { id: 7, sightings: 2, ..Tag::default() };
        let (position, orientation) = ([1.0, -0.25, 0.5], [0.0, 0.0, 0.0, 1.0]);
        tags.tags[1] =
            Tag { id: 8, position, orientation, position_sigma: 0.004, sightings: 9, is_dock: 1, ..Tag::default() };
        let text = tags.text();
        assert!(
            text.contains("| 7 ? seen 2") && text.contains("| 8 (dock) x 1.000 y -0.250 z 0.500 +- 0.004 m yaw 0.0"),
            "{text}"
        );
        let json: serde_json::Value = serde_json::from_str(&tags.json()).expect("JSON");
        assert!(json["tags"][0]["position"][0].is_null() && json["tags"][1]["position"][1] == -0.25);
        assert!(json["tags"].as_array().is_some_and(|t| t.len() == 2) && json["tags"][1]["family"] == "36h11");
    }
}
