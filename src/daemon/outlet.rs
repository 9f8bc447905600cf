//! The reconstruction stage's part of the wire: poses, pictures, map and keyframes of one run.

use crate::config::MountConfig;
use crate::features::FrameFeatures;
use crate::frame::{Clock, monotonic_ns};
use crate::geometry::Se3;
use crate::geometry::frames::{Body, Camera, World};
use crate::map::graph::MapGraph;
use crate::map::scale::MapScale;
use crate::map::{LandmarkId, MapId, MapSnapshot};
use crate::messages::Pose;
use crate::messages::services::MAX_EDGES;
use crate::motion::hand_eye::Robot;
use crate::motion::obstacles::Scan;
use crate::motion::tag::edge_length::PlacedTag;
use crate::motion::tag::{TagConfig, TagView};
use crate::publish::convert::{self, Map};
use crate::publish::{
    Conversion, EncodedPublisher, FeaturesPublisher, FramePublisher, FrameStamp, GraphPublisher, MapContext,
    MapPublisher, ObstaclesPublisher, PosePublisher, PublishError, ScaleEstimate, ScanContext, TagsPublisher,
    WheelInbox, map_from_tag,
};
use crate::reconstruction::{PoseEstimate, Reconstruction};

/// A pose that is older than this is not where the robot is now.
const NOW_NS: i64 = 1_000_000_000;

/// A mount is taken from the motion once it is known to this: rotation, rad; translation, m.
const FOUND_RAD: f64 = 0.03;
const FOUND_M: f64 = 0.05;

/// Where a planner or the dock has put a map.
#[derive(Debug, Clone, Copy)]
struct Placement {
    map: MapId,
    map_from_world: Se3<Map, World>,
}

/// Sends without ever waiting for a reader.
#[derive(Debug)]
pub struct Outlet {
    poses: PosePublisher,
    map: MapPublisher,
    frames: FramePublisher,
    graph: Option<GraphPublisher>,
    /// As sent last.
    edges: MapGraph,
    tags: Option<TagsPublisher>,
    /// As sent last.
    told: Vec<TagView>,
    features: Option<FeaturesPublisher>,
    obstacles: Option<ObstaclesPublisher>,
    /// For the capture stage, which takes it.
    encoded: Option<EncodedPublisher>,
    /// For the reconstruction step, which takes it.
    wheels: Option<WheelInbox>,
    conversion: Conversion,
    placement: Option<Placement>,
    /// As published.
    last: Option<Pose>,
}

impl Outlet {
    /// `clock`: what the source's timestamps count from.
    pub fn new(
        poses: PosePublisher,
        map: MapPublisher,
        frames: FramePublisher,
        mount: &MountConfig,
        clock: Clock,
    ) -> Self {
        let conversion = Conversion {
            body_from_camera: mount.body_from_camera(),
            scale: ScaleEstimate::Unknown,
            clock,
            map_from_world: None,
        };
        Self {
            poses,
            map,
            frames,
            graph: None,
            edges: MapGraph::default(),
            tags: None,
            told: Vec::new(),
            features: None,
            obstacles: None,
            encoded: None,
            wheels: None,
            conversion,
            placement: None,
            last: None,
        }
    }

    /// Tells what holds the map together, too.
    pub fn with_graph(mut self, graph: GraphPublisher) -> Self {
        self.graph = Some(graph);
        self
    }

    /// Tells where tags are, too.
    pub fn with_tags(mut self, tags: TagsPublisher) -> Self {
        self.tags = Some(tags);
        self
    }

    /// Tells what is found in the pictures, too.
    pub fn with_features(mut self, features: FeaturesPublisher) -> Self {
        self.features = Some(features);
        self
    }

    /// Tells what stands around the robot, too.
    pub fn with_obstacles(mut self, obstacles: ObstaclesPublisher) -> Self {
        self.obstacles = Some(obstacles);
        self
    }

    /// With the camera's own bytes, too.
    pub fn with_encoded(mut self, mut encoded: EncodedPublisher) -> Self {
        encoded.describe(&self.conversion.body_from_camera, self.conversion.clock);
        self.encoded = Some(encoded);
        self
    }

    /// Hearing the base's driver, too; not in a replay of a recording, whose clock is another one.
    pub fn with_wheels(mut self, wheels: WheelInbox) -> Self {
        self.wheels = Some(wheels).filter(|_| self.conversion.clock == Clock::Monotonic);
        self
    }

    /// What the base's driver tells, for who asks before each frame.
    pub(super) fn take_wheels(&mut self) -> Option<WheelInbox> {
        self.wheels.take()
    }

    /// The part that the capture stage sends: every picture as it came, also those that are dropped because a later one is there.
    pub(super) fn take_encoded(&mut self) -> Option<EncodedPublisher> {
        self.encoded.take()
    }

    /// One frame's pose, or its lack of one. `frames_dropped`: frames of this run that were never looked at.
    pub fn pose(&mut self, estimate: &PoseEstimate, frames_dropped: u64) -> Result<(), PublishError> {
        self.turn_to(estimate.map);
        self.conversion.scale = estimate.scale.into();
        self.last = None;
        self.last = Some(self.poses.publish(estimate, &self.conversion, frames_dropped)?);
        Ok(())
    }

    /// `map` has become a part of `into`, which lies in its frame from now on: where `map` was put, `into` is.
    pub fn follow_join(&mut self, map: MapId, into: MapId) {
        if let Some(placement) = self.placement.as_mut().filter(|placement| placement.map == map) {
            placement.map = into;
            // It was told in the frame before.
            self.last = None;
        }
    }

    /// A placement holds for the map that it was said of.
    fn turn_to(&mut self, map: MapId) {
        self.conversion.map_from_world = self.placement.filter(|p| p.map == map).map(|p| p.map_from_world);
    }

    /// From now on poses, map and keyframes are published such that the robot's pose of now is this one. The error is a
    /// person's: without a pose of now there is nothing to move.
    pub fn set_pose(&mut self, map_from_body: &Se3<Map, Body>) -> Result<(), &'static str> {
        let fresh = |pose: &&Pose| pose.is_tracking() && pose.age_ns(monotonic_ns()) < NOW_NS;
        let last = self.last.as_ref().filter(fresh).ok_or("the robot has no pose in its map just now")?;
        let was = convert::from_wire(&last.position, &last.orientation).ok_or("the last pose is not finite")?;
        let map = MapId(last.map_id);
        let map_from_world = convert::place(map_from_body, &was, self.conversion.map_from_world);
        self.placement = Some(Placement { map, map_from_world });
        self.turn_to(map);
        Ok(())
    }

    /// Where the configuration does not say how the camera sits on the base, its motion has: from the next pose on that is the mount, as far as it
    /// is known well. A height above the base does not show in it. Returns the mount.
    pub fn found_mount(&mut self, robot: &Robot) -> Se3<Body, Camera> {
        let mount = &mut self.conversion.body_from_camera;
        if robot.sigma[..3].iter().all(|s| *s < FOUND_RAD) {
            mount.rotation = robot.base_from_camera;
        }
        if robot.sigma[3..5].iter().all(|s| *s < FOUND_M) {
            (mount.translation.x, mount.translation.y) = (robot.lever_m.x, robot.lever_m.y);
        }
        *mount
    }

    /// A tag of this map as it is published now.
    pub fn map_from_tag(&mut self, map: MapId, placed: &PlacedTag) -> Se3<Map, Body> {
        self.turn_to(map);
        map_from_tag(placed, &self.conversion)
    }

    /// From the coordinates that files have to those that this map is published in.
    pub fn map_from_optical(&mut self, map: MapId) -> Se3<Map, World> {
        self.turn_to(map);
        self.conversion.map_from_optical()
    }

    /// From the next pose on this map is published such that what was at `was` is at `now`. Returns how far that moves the robot and turns it, rad; 0 where it
    /// has no pose.
    pub fn put(&mut self, map: MapId, was: &Se3<Map, Body>, now: &Se3<Map, Body>) -> (f64, f64) {
        self.turn_to(map);
        let new_from_old: Se3<Map, Map> = *now * was.inverse();
        let map_from_world = convert::place(now, was, self.conversion.map_from_world);
        self.placement = Some(Placement { map, map_from_world });
        self.turn_to(map);
        let last = self.last.as_ref().filter(|pose| pose.map_id == map.0 && pose.is_tracking());
        let body = last.and_then(|pose| convert::from_wire(&pose.position, &pose.orientation));
        body.map_or((0.0, 0.0), |body| {
            ((new_from_old.transform(&body.translation) - body.translation).norm(), new_from_old.rotation.angle())
        })
    }

    /// Takes the next pose's memory in advance, so that publishing it allocates nothing.
    pub fn prepare(&mut self) {
        self.poses.prepare();
    }

    /// The frame's grey picture, if anybody subscribes to it.
    pub fn frame(&mut self, features: &FrameFeatures) -> Result<(), PublishError> {
        let Some(picture) = features.pyramid.levels.first() else { return Ok(()) };
        self.frames.publish(picture, &self.stamp(features)).map(|_| ())
    }

    /// What was found in the frame's picture, if anybody subscribes to it.
    pub fn features(
        &mut self,
        features: &FrameFeatures,
        matches: impl Iterator<Item = (LandmarkId, [f32; 2])>,
    ) -> Result<(), PublishError> {
        let stamp = self.stamp(features);
        let Some(publisher) = &mut self.features else { return Ok(()) };
        let tracks = features.tracks.iter().map(|t| (t.id, [t.position.x, t.position.y], t.age));
        publisher.publish(matches, tracks, features.pyramid.size(), &stamp).map(|_| ())
    }

    fn stamp(&self, features: &FrameFeatures) -> FrameStamp {
        FrameStamp {
            sequence: features.sequence,
            timestamp_ns: features.timestamp_ns,
            arrival_ns: features.arrival_ns,
            clock: self.conversion.clock,
        }
    }

    /// Somebody wants to know what stands around the robot.
    pub fn obstacles_wanted(&self) -> bool {
        self.obstacles.as_ref().is_some_and(ObstaclesPublisher::is_wanted)
    }

    /// It is time for another scan of it.
    pub fn obstacles_due(&self) -> bool {
        self.obstacles.as_ref().is_some_and(ObstaclesPublisher::is_due)
    }

    /// Where the camera sits on the robot, as poses are published.
    pub fn body_from_camera(&self) -> Se3<Body, Camera> {
        self.conversion.body_from_camera
    }

    /// A scan, or that there is none.
    pub fn obstacles(
        &mut self,
        scan: Option<&Scan>,
        map: MapId,
        scale: MapScale,
        context: &ScanContext,
    ) -> Result<(), PublishError> {
        self.turn_to(map);
        self.conversion.scale = scale.into();
        let Some(publisher) = &mut self.obstacles else { return Ok(()) };
        publisher.publish(scan, &self.conversion, context)
    }

    /// It is time for another map message.
    pub fn map_is_due(&self, now_ns: i64) -> bool {
        self.map.is_due(now_ns)
    }

    /// Landmarks and keyframes that a map message takes, at the most.
    pub fn most_of_map(&self) -> [usize; 2] {
        self.map.most()
    }

    /// What ties the map together and where its tags are, if anybody subscribes to these; then the map and its keyframes. `map` is of this
    /// reconstruction.
    pub fn map(
        &mut self,
        reconstruction: &Reconstruction,
        map: &MapSnapshot,
        context: &MapContext,
        tags_of: &TagConfig,
    ) -> Result<(), PublishError> {
        self.turn_to(map.map);
        self.conversion.scale = map.scale.into();
        let mut graph = Ok(false);
        if let Some(publisher) = self.graph.as_mut().filter(|graph| graph.is_wanted()) {
            // Who draws it has the keyframes of this message and no older ones.
            let oldest = map.keyframes.first().map_or_else(Default::default, |k| k.id);
            reconstruction.graph(&mut self.edges, oldest, MAX_EDGES);
            graph = publisher.publish(&self.edges, map, &self.conversion, context);
        }
        let mut tags = Ok(());
        if let Some(publisher) = self.tags.as_mut().filter(|tags| tags.is_wanted()) {
            reconstruction.tags(&mut self.told);
            tags = publisher.publish(&self.told, tags_of, map, &self.conversion, context);
        }
        self.map.publish(map, &self.conversion, context).and(graph.map(|_| ())).and(tags)
    }
}
