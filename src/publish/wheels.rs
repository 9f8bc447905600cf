//! `PREFIX/wheel`, the one service that the daemon reads: what the driver of the robot's base tells.
//!
//! One driver at a time: the first one that speaks, until it has gone or been silent for as long as makes a gap. Whatever another one says
//! meanwhile is handed on as [`WheelFault::SecondPublisher`]. (Two places, so that a second one is seen at all; our clients refuse to be it.)

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{CallbackProgression, MessagingPattern, Node, PayloadHeader as _, PortFactory as _};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::PublishError;
use super::opening::{Ipc, open_patiently};
use crate::messages::services::{self, topic};
use crate::messages::{Endpoint, UNKNOWN_NS, WheelOdometry};
use crate::motion::wheel::{GAP_NS, WheelFault, WheelMessage};

/// A stamp further ahead of now than this is not CLOCK_MONOTONIC, ns: there is no message from the future.
const AHEAD_NS: i64 = 100_000_000;
/// Nor is one as far behind, ns: no queue of a driver's holds as much.
const BEHIND_NS: i64 = 5_000_000_000;

/// The driver that is believed.
#[derive(Debug, Clone, Copy)]
struct Driver {
    id: UniquePublisherId,
    next_sequence: u64,
    /// CLOCK_MONOTONIC when it was heard last.
    heard_ns: i64,
}

/// See module. Its fields are dropped in this order.
#[derive(Debug)]
pub struct WheelInbox {
    subscriber: Subscriber<Ipc, WheelOdometry, ()>,
    service: PortFactory<Ipc, WheelOdometry, ()>,
    driver: Option<Driver>,
}

/// What a look into the inbox came to, besides messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WheelNews {
    /// Messages there were, believed or not.
    pub messages: u64,
    /// Messages that never arrived, by the driver's numbers.
    pub missing: u64,
    /// Process id of a driver that was heard for the first time (0: not known).
    pub driver: Option<u32>,
    /// Process id of another one that spoke meanwhile (0: not known).
    pub second: Option<u32>,
}

impl WheelInbox {
    pub(super) fn open(node: &Node<Ipc>, endpoint: &Endpoint) -> Result<Self, PublishError> {
        let name = endpoint.service(topic::WHEEL)?;
        let qos = services::WHEEL;
        let service = open_patiently(endpoint, &name, MessagingPattern::PublishSubscribe, || {
            node.service_builder(&name)
                .publish_subscribe::<WheelOdometry>()
                .max_publishers(services::MAX_WHEEL_PUBLISHERS)
                .max_subscribers(qos.subscribers)
                .max_nodes(services::MAX_NODES)
                .history_size(qos.history)
                .subscriber_max_buffer_size(qos.buffer)
                .subscriber_max_borrowed_samples(qos.borrowed)
                .enable_safe_overflow(true)
                .open_or_create()
        })?;
        let subscriber = service.subscriber_builder().create().map_err(|e| PublishError::Ipc {
            service: name.to_string(),
            doing: "subscribing",
            reason: e.to_string(),
        })?;
        Ok(Self { subscriber, service, driver: None })
    }

    /// Hands on everything that has come, oldest first, with what is wrong with it as far as it shows here. Never waits. `now_ns`:
    /// CLOCK_MONOTONIC.
    pub fn read(
        &mut self,
        now_ns: i64,
        to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>),
    ) -> Result<WheelNews, PublishError> {
        let mut news = WheelNews::default();
        // A driver that sends without end holds nobody here.
        for _ in 0..services::MAX_WHEEL_PUBLISHERS * services::WHEEL.buffer {
            let Some(sample) = self.subscriber.receive().map_err(|e| self.failed(e.to_string()))? else { break };
            let (message, id, node) = (*sample.payload(), sample.header().publisher_id(), sample.header().node_id());
            drop(sample);
            news.messages += 1;
            let pid = || node.pid::<Ipc>().ok().and_then(|pid| u32::try_from(pid.value()).ok()).unwrap_or(0);
            if self.driver.is_some_and(|d| d.id != id && now_ns - d.heard_ns < GAP_NS && self.is_there(d.id)) {
                news.second = Some(pid());
                to(&internal(&message), Some(WheelFault::SecondPublisher));
                continue;
            }
            let known = self.driver.filter(|driver| driver.id == id);
            if known.is_none() {
                news.driver = Some(pid());
            }
            news.missing += known.map_or(0, |driver| message.sequence.saturating_sub(driver.next_sequence));
            self.driver = Some(Driver { id, next_sequence: message.sequence.saturating_add(1), heard_ns: now_ns });
            let ahead_ns = message.timestamp_ns.saturating_sub(now_ns);
            let of_now = (-BEHIND_NS..=AHEAD_NS).contains(&ahead_ns);
            to(&internal(&message), (!of_now).then_some(WheelFault::WrongClock { ahead_ns }));
        }
        Ok(news)
    }

    fn is_there(&self, id: UniquePublisherId) -> bool {
        let mut found = false;
        self.service.dynamic_config().list_publishers(|publisher| {
            found |= publisher.publisher_id == id;
            CallbackProgression::Continue
        });
        found
    }

    fn failed(&self, reason: String) -> PublishError {
        PublishError::Ipc { service: topic::WHEEL.into(), doing: "receiving", reason }
    }
}

fn internal(m: &WheelOdometry) -> WheelMessage {
    WheelMessage {
        number: m.sequence,
        from_ns: (m.interval_start_ns != UNKNOWN_NS).then_some(m.interval_start_ns),
        timestamp_ns: m.timestamp_ns,
        linear_x_mps: m.linear_x_mps,
        linear_y_mps: m.linear_y_mps,
        angular_z_radps: m.angular_z_radps,
        variance: m.variance,
    }
}
