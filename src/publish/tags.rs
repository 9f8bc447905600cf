//! `PREFIX/tags`: the tags of the map and where they are, made only while somebody subscribes.

use crate::frame::monotonic_ns;
use crate::geometry::frames::Body;
use crate::geometry::{Se3, ros_from_optical};
use crate::map::MapSnapshot;
use crate::messages::{MAX_TAGS, Tag, Tags};
use crate::motion::tag::edge_length::PlacedTag;
use crate::motion::tag::{TagConfig, TagView};

use super::convert::{self, Map};
use super::ports::Port;
use super::{Conversion, MapContext, PublishError, count};

/// See module.
#[derive(Debug)]
pub struct TagsPublisher {
    pub(super) port: Port<Tags, ()>,
    pub(super) run_id: u64,
}

impl TagsPublisher {
    /// Somebody wants to know.
    pub fn is_wanted(&self) -> bool {
        self.port.subscribers() > 0
    }

    /// Sends the tags of the map that `snapshot` is of, at most [`MAX_TAGS`]. To be called before that snapshot is sent: who
    /// wakes by the map finds its tags.
    pub fn publish(
        &mut self,
        tags: &[TagView],
        config: &TagConfig,
        snapshot: &MapSnapshot,
        conversion: &Conversion,
        context: &MapContext,
    ) -> Result<(), PublishError> {
        let message = message(tags, config, conversion);
        self.port
            .send(Tags {
                run_id: self.run_id,
                content_revision: snapshot.revision,
                timestamp_ns: context.timestamp_ns,
                published_ns: monotonic_ns(),
                map_id: snapshot.map.0,
                reset_counter: context.reset_counter,
                map_revision: context.map_revision,
                map_mode: context.map_mode,
                ..message
            })
            .map(|_| ())
    }
}

/// A tag in the map as published. Its axes are those of a body that looks straight at it.
pub fn map_from_tag(placed: &PlacedTag, conversion: &Conversion) -> Se3<Map, Body> {
    let body_from_optical = Se3::new(ros_from_optical(), nalgebra::Vector3::zeros());
    conversion.map_from_optical() * placed.world_from_tag * body_from_optical.inverse()
}

/// Without what only the sender and the map know.
fn message(tags: &[TagView], config: &TagConfig, conversion: &Conversion) -> Tags {
    let (scale, scale_sigma, scale_source) = conversion.scale.to_wire();
    let mut message = Tags {
        count: count(tags.len().min(MAX_TAGS)),
        scale,
        scale_sigma,
        scale_source,
        clock: convert::clock(conversion.clock),
        ..Tags::default()
    };
    for (place, tag) in message.tags.iter_mut().zip(tags) {
        *place = Tag {
            id: tag.id.into(),
            sightings: count(tag.sightings),
            size: config.size_m as f32,
            is_dock: u8::from(config.dock.enabled && config.dock.id == tag.id),
            ..Tag::default()
        };
        if let Some(placed) = &tag.placed {
            (place.position, place.orientation) = convert::to_wire(&map_from_tag(placed, conversion));
            place.edge = placed.log_edge.exp() as f32;
            (place.position_sigma, place.orientation_sigma) = (placed.place_sigma as f32, placed.turn_sigma as f32);
        }
    }
    message
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::geometry::frames::{Camera, World};
    use crate::motion::tag::dock::DockConfig;
    use crate::publish::ScaleEstimate;

    fn placed(world_from_tag: Se3<World, Camera>) -> PlacedTag {
        PlacedTag {
            world_from_tag,
            log_edge: 0.149f64.ln(),
            corner_variance: 0.0,
            view_variance: 0.0,
            place_sigma: 0.004,
            turn_sigma: 0.02,
            residual_px: 0.1,
            corner_px: 0.15,
            views: 5,
        }
    }

    #[test]
    fn a_tag_that_the_first_keyframe_looks_straight_at_has_that_ones_orientation() {
        let straight = TagView {
            id: 7,
            sightings: 9,
            placed: Some(placed(Se3::new(UnitQuaternion::identity(), Vector3::new(0.5, -0.2, 3.0)))),
        };
        // To the right of the camera, on a wall that it would have to turn right to look at.
        let right = UnitQuaternion::from_scaled_axis(Vector3::y() * std::f64::consts::FRAC_PI_2);
        let aside = TagView { id: 8, placed: Some(placed(Se3::new(right, Vector3::new(2.0, 0.0, 1.0)))), ..straight };
        let waits = TagView { id: 9, sightings: 1, placed: None };
        let scale = ScaleEstimate::Metric { sigma: 0.01, source: 4 };
        let dock = DockConfig { enabled: true, id: 8, ..DockConfig::default() };
        let config = TagConfig { size_m: 0.15, dock, ..TagConfig::default() };
        let told = message(&[straight, aside, waits], &config, &Conversion { scale, ..Conversion::default() });
        let close = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        let [first, second, third] = told.seen() else { panic!("three tags") };
        assert!(
            close(&first.position, &[3.0, -0.5, 0.2]) && close(&first.orientation, &[0.0, 0.0, 0.0, 1.0]),
            "{first:?}"
        );
        let half = std::f64::consts::FRAC_1_SQRT_2;
        assert!(close(&second.position, &[1.0, -2.0, 0.0]) && close(&second.orientation, &[0.0, 0.0, -half, half]));
        assert_eq!((first.size, first.edge, first.sightings), (0.15, 0.149, 9));
        assert_eq!(told.seen().iter().map(|t| t.is_dock).collect::<Vec<_>>(), [0, 1, 0]);
        assert_eq!((first.position_sigma, first.orientation_sigma), (0.004, 0.02));
        assert!(third.id == 9 && third.sightings == 1 && third.size == 0.15 && !third.is_placed());
        assert!(third.edge.is_nan() && third.position_sigma.is_nan() && third.orientation_sigma.is_nan());
        assert!(first.is_placed() && told.scale_source == 4 && told.scale_sigma == 0.01);
    }

    #[test]
    fn a_map_that_was_put_elsewhere_takes_its_tags_along() {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * std::f64::consts::FRAC_PI_2);
        let map_from_world = Some(Se3::new(turn, Vector3::new(10.0, 0.0, 0.0)));
        let tag = placed(Se3::new(UnitQuaternion::identity(), Vector3::new(0.0, 0.0, 3.0)));
        let there = map_from_tag(&tag, &Conversion { map_from_world, ..Conversion::default() });
        assert!((there.translation - Vector3::new(10.0, 3.0, 0.0)).norm() < 1e-12);
        assert!(there.rotation.angle_to(&turn) < 1e-12);
    }
}
