//! The services as types: what a subscription to each of them yields.

use std::fmt;
use std::ops::Deref;
use std::sync::Arc;

use iceoryx2::port::DegradationAction;
use iceoryx2::port::ReceiveError;
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::prelude::{Node, PortFactory as _, ServiceName, ZeroCopySend};
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::link::Ipc;
use crate::messages::services::topic;
use crate::messages::{
    EncodedHeader, Feature, FeaturesHeader, FrameHeader, GraphEdge, GraphHeader, Health, Keyframe, KeyframesHeader,
    Landmark, MapHeader, Obstacles, Pose, Tags, WheelOdometry,
};

/// The map as it was at one moment: a slice of [`Landmark`] in shared memory.
pub type MapSnapshot = Slice<Landmark, MapHeader>;
/// The keyframes as they were at one moment: a slice of [`Keyframe`] in shared memory.
pub type KeyframesSnapshot = Slice<Keyframe, KeyframesHeader>;
/// What held the map together at one moment: a slice of [`GraphEdge`] in shared memory.
pub type Graph = Slice<GraphEdge, GraphHeader>;
/// A grey picture in shared memory, rows of [`FrameHeader::stride`] bytes.
pub type Frame = Slice<u8, FrameHeader>;
/// A picture's bytes as they came from the camera, in shared memory.
pub type Encoded = Slice<u8, EncodedHeader>;

/// What was found in a picture: a slice of [`Feature`] in shared memory.
pub type Features = Slice<Feature, FeaturesHeader>;

/// A service's port, and the service: the port must be gone when the service is closed.
type SlicePort<T, H> = Arc<(Subscriber<Ipc, [T], H>, PortFactory<Ipc, [T], H>)>;

/// A message with many elements, borrowed from shared memory for as long as it lives. Never changes, also when its subscription
/// has gone.
pub struct Slice<T: ZeroCopySend + fmt::Debug + 'static, H: ZeroCopySend + fmt::Debug + 'static> {
    sample: Sample<Ipc, [T], H>,
    /// With the subscriber gone the publisher would take the memory back and write the next message into it (iceoryx2 0.10).
    _port: SlicePort<T, H>,
}

impl<T: ZeroCopySend + fmt::Debug + 'static, H: ZeroCopySend + fmt::Debug + 'static> Slice<T, H> {
    /// What the elements are a picture of.
    pub fn header(&self) -> &H {
        self.sample.user_header()
    }
}

impl<T: ZeroCopySend + fmt::Debug + 'static, H: ZeroCopySend + fmt::Debug + 'static> Deref for Slice<T, H> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        self.sample.payload()
    }
}

impl<T: ZeroCopySend + fmt::Debug + 'static, H: ZeroCopySend + fmt::Debug + 'static> fmt::Debug for Slice<T, H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Slice").field("header", self.header()).field("len", &self.len()).finish()
    }
}

/// Why ports could not be made; [`super::Subscription`] tells what passes from what stays.
#[derive(Debug)]
pub enum OpenFailure {
    Service(PublishSubscribeOpenError),
    Port(SubscriberCreateError),
    /// All subscribers are there already.
    Full {
        limit: usize,
    },
}

/// A publish/subscribe service. Implemented for those of the daemon.
pub trait Topic {
    /// Last part of the service's name.
    const NAME: &'static str;
    /// Versioned name of the elements' type.
    const TYPE: &'static str;
    /// The items borrow shared memory.
    const BORROWS: bool;
    /// What a subscription yields.
    type Item;
    /// The opened service and its port.
    type Port: Send;

    /// Opens the service, which must exist, as its creator made it.
    #[doc(hidden)]
    fn open(node: &Node<super::link::Ipc>, name: &ServiceName) -> Result<Self::Port, OpenFailure>;
    /// The next message, oldest first.
    #[doc(hidden)]
    fn receive(port: &Self::Port) -> Result<Option<Self::Item>, ReceiveError>;
    /// Publishers that are registered, dead ones included until they are cleared away.
    #[doc(hidden)]
    fn publishers(port: &Self::Port) -> usize;
    /// Messages a subscriber may hold at most.
    #[doc(hidden)]
    fn max_held(port: &Self::Port) -> usize;
}

macro_rules! topic {
    ($(#[$doc:meta])* $topic:ident, $name:expr, $payload:ty, $element:ty, $header:ty, $borrows:literal, $item:ty, $from:expr) => {
        $(#[$doc])*
        #[derive(Debug)]
        pub struct $topic;

        impl Topic for $topic {
            const NAME: &'static str = $name;
            const TYPE: &'static str = <$element as WireName>::WIRE_NAME;
            const BORROWS: bool = $borrows;
            type Item = $item;
            // The port before the service: it must be gone when the service is closed.
            type Port = Arc<(Subscriber<Ipc, $payload, $header>, PortFactory<Ipc, $payload, $header>)>;

            fn open(node: &Node<Ipc>, name: &ServiceName) -> Result<Self::Port, OpenFailure> {
                let service = node
                    .service_builder(name)
                    .publish_subscribe::<$payload>()
                    .user_header::<$header>()
                    .open()
                    .map_err(OpenFailure::Service)?;
                // A connection that cannot be made must not pass as silence.
                let port = service
                    .subscriber_builder()
                    .set_degradation_handler(|_, _| DegradationAction::DegradeAndFail)
                    .create()
                    .map_err(|e| match e {
                        SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                            OpenFailure::Full { limit: service.static_config().max_subscribers() }
                        }
                        e => OpenFailure::Port(e),
                    })?;
                Ok(Arc::new((port, service)))
            }

            fn receive(port: &Self::Port) -> Result<Option<Self::Item>, ReceiveError> {
                Ok(port.0.receive()?.map(|sample| $from(sample, port)))
            }

            fn publishers(port: &Self::Port) -> usize {
                port.1.dynamic_config().number_of_publishers()
            }

            fn max_held(port: &Self::Port) -> usize {
                port.1.static_config().subscriber_max_borrowed_samples()
            }
        }
    };
}

fn copied<T: ZeroCopySend + fmt::Debug + Copy, P>(sample: Sample<Ipc, T, ()>, _port: &P) -> T {
    *sample.payload()
}

fn held<T, H>(sample: Sample<Ipc, [T], H>, port: &SlicePort<T, H>) -> Slice<T, H>
where
    T: ZeroCopySend + fmt::Debug + 'static,
    H: ZeroCopySend + fmt::Debug + 'static,
{
    Slice { sample, _port: port.clone() }
}

/// Versioned name of an element's type; a plain byte has only iceoryx2's name.
trait WireName {
    const WIRE_NAME: &'static str;
}
impl WireName for Pose {
    const WIRE_NAME: &'static str = Pose::TYPE_NAME;
}
impl WireName for Health {
    const WIRE_NAME: &'static str = Health::TYPE_NAME;
}
impl WireName for Landmark {
    const WIRE_NAME: &'static str = Landmark::TYPE_NAME;
}
impl WireName for Keyframe {
    const WIRE_NAME: &'static str = Keyframe::TYPE_NAME;
}
impl WireName for GraphEdge {
    const WIRE_NAME: &'static str = GraphEdge::TYPE_NAME;
}
impl WireName for Feature {
    const WIRE_NAME: &'static str = Feature::TYPE_NAME;
}
impl WireName for Obstacles {
    const WIRE_NAME: &'static str = Obstacles::TYPE_NAME;
}
impl WireName for Tags {
    const WIRE_NAME: &'static str = Tags::TYPE_NAME;
}
impl WireName for WheelOdometry {
    const WIRE_NAME: &'static str = WheelOdometry::TYPE_NAME;
}
impl WireName for u8 {
    const WIRE_NAME: &'static str = "u8";
}

topic!(
    /// [`Pose`], one a frame.
    PoseTopic, topic::POSE, Pose, Pose, (), false, Pose, copied
);
topic!(
    /// [`Health`], at a steady rate.
    HealthTopic, topic::HEALTH, Health, Health, (), false, Health, copied
);
topic!(
    /// [`MapSnapshot`], at most twice a second.
    MapTopic, topic::MAP, [Landmark], Landmark, MapHeader, true, MapSnapshot, held
);
topic!(
    /// [`KeyframesSnapshot`], with the map.
    KeyframesTopic, topic::KEYFRAMES, [Keyframe], Keyframe, KeyframesHeader, true, KeyframesSnapshot, held
);
topic!(
    /// [`Graph`], just before the map, while somebody subscribes.
    GraphTopic, topic::GRAPH, [GraphEdge], GraphEdge, GraphHeader, true, Graph, held
);
topic!(
    /// [`Frame`], while somebody subscribes.
    FrameTopic, topic::FRAME, [u8], u8, FrameHeader, true, Frame, held
);
topic!(
    /// [`Features`], while somebody subscribes.
    FeaturesTopic, topic::FEATURES, [Feature], Feature, FeaturesHeader, true, Features, held
);
topic!(
    /// [`Encoded`], while somebody subscribes.
    EncodedTopic, topic::ENCODED, [u8], u8, EncodedHeader, true, Encoded, held
);
topic!(
    /// [`Obstacles`], while somebody subscribes.
    ObstaclesTopic, topic::OBSTACLES, Obstacles, Obstacles, (), false, Obstacles, copied
);
topic!(
    /// [`Tags`], just before the map, while somebody subscribes.
    TagsTopic, topic::TAGS, Tags, Tags, (), false, Tags, copied
);
topic!(
    /// [`WheelOdometry`], as the base's driver tells the daemon. No event goes with it: read it polled.
    WheelTopic, topic::WHEEL, WheelOdometry, WheelOdometry, (), false, WheelOdometry, copied
);
