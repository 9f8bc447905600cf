//! A scan as a line.

use super::render::{Object, Render};
use crate::messages::{Clock, OBSTACLE_BEARINGS, Obstacles};

/// Sectors that a person is shown, from the right behind over forward to the left behind.
const SECTORS: usize = 12;

impl Render for Obstacles {
    fn json(&self) -> String {
        Object::new()
            .field("run_id", self.run_id)
            .field("sequence", self.sequence)
            .field("timestamp_ns", self.timestamp_ns)
            .field("published_ns", self.published_ns)
            .field("position", self.position)
            .field("orientation", self.orientation)
            .field("angle_min", self.angle_min)
            .field("angle_increment", self.angle_increment)
            .field("range_min", self.range_min)
            .field("range_max", self.range_max)
            .field("robot_height", self.robot_height)
            .field("scale_sigma", self.scale_sigma)
            .field("map_id", self.map_id)
            .field("reset_counter", self.reset_counter)
            .field("map_revision", self.map_revision)
            .field("count", self.count)
            .field("total", self.total)
            .field("told", self.told_name())
            .field("clock", Clock::from_wire(self.clock).name())
            .field("range", &self.range[..])
            .field("sigma", &self.sigma[..])
            .field("free_from", &self.free_from[..])
            .field("free", &self.free[..])
            .field("points", self.in_the_way())
            .end()
    }

    /// By sector of 30 degrees, forward in the middle: `0.82` the nearest thing, m; `>1.4` nothing known, the floor seen free that far in
    /// some direction; `?` nothing known.
    fn text(&self) -> String {
        let mut line = format!("{:>7} {:10}", self.sequence, self.told_name());
        if !self.is_told() {
            return line;
        }
        for sector in 0..SECTORS {
            let width = OBSTACLE_BEARINGS / SECTORS;
            let bearings = sector * width..(sector + 1) * width;
            let nearest = self.range[bearings.clone()].iter().copied().fold(f32::NAN, f32::min);
            let free = self.free[bearings].iter().copied().fold(0.0, f32::max);
            line += &match (nearest.is_nan(), free > 0.0) {
                (false, _) => format!(" {nearest:5.2}"),
                (true, true) => format!(" >{free:4.1}"),
                (true, false) => "     ?".into(),
            };
        }
        line + &format!(" m  points {:3}/{:3}", self.count, self.total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::OBSTACLES_TOLD;

    #[test]
    fn unknown_is_a_question_mark_and_null_and_never_free() {
        let mut scan = Obstacles { told: OBSTACLES_TOLD, ..Obstacles::default() };
        assert_eq!(scan.text().matches('?').count(), SECTORS);
        assert!(!scan.text().contains('>'));
        (scan.range[95], scan.free[95], scan.free[70]) = (0.82, 0.5, 1.4);
        let text = scan.text();
        assert!(text.contains(" 0.82") && text.contains("> 1.4") && text.matches('?').count() == SECTORS - 2, "{text}");
        let json: serde_json::Value = serde_json::from_str(&scan.json()).expect("JSON");
        assert!(json["range"][0].is_null() && json["free"][0] == 0.0 && json["told"] == "TOLD");
        assert!(Obstacles::default().text().contains("NO_POSE"));
    }
}
