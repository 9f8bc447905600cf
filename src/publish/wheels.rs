//! `PREFIX/wheel`, the one service that the daemon reads: what the driver of the robot's base tells.
//!
//! One driver at a time: the first one that speaks, until it has gone or been silent for as long as makes a gap. (All that has come is looked at
//! before that is decided: who reads late must not take it for the driver's silence.) Whatever another one says
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
const AHEAD_NS: i64 = 5_000_000;
/// A larger jump of a driver's numbers is a driver that has started anew, and no loss.
const MOST_MISSING: u64 = 10_000;
/// Messages that are looked at together: all that there can be, so that a driver that sends without end holds nobody here.
const MOST_MESSAGES: usize = services::MAX_WHEEL_PUBLISHERS * services::WHEEL.buffer;
/// Nor is one as far behind, ns: no queue of a driver's holds as much.
const BEHIND_NS: i64 = 5_000_000_000;

/// The driver that is believed.
#[derive(Debug, Clone, Copy)]
struct Driver {
    id: UniquePublisherId,
    /// After the last message that came.
    next_sequence: Option<u64>,
    /// CLOCK_MONOTONIC when it was heard last.
    heard_ns: i64,
}

/// See module. Its fields are dropped in this order.
#[derive(Debug)]
pub struct WheelInbox {
    subscriber: Subscriber<Ipc, WheelOdometry, ()>,
    service: PortFactory<Ipc, WheelOdometry, ()>,
    driver: Option<Driver>,
    /// Read and not yet judged; empty in between.
    batch: Vec<(WheelOdometry, UniquePublisherId, u32)>,
}

/// What a look into the inbox came to, besides messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WheelNews {
    /// Messages there were, believed or not.
    pub messages: u64,
    /// Those of them that were believed.
    pub believed: u64,
    /// Messages that never arrived, by the numbers of those that were believed.
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
        Ok(Self { subscriber, service, driver: None, batch: Vec::with_capacity(MOST_MESSAGES) })
    }

    /// Hands on everything that has come, oldest first, with what is wrong with it as far as it shows here; `to` says whether it believes a message.
    /// Never waits. `now_ns`: CLOCK_MONOTONIC.
    pub fn read(
        &mut self,
        now_ns: i64,
        to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>) -> bool,
    ) -> Result<WheelNews, PublishError> {
        while self.batch.len() < MOST_MESSAGES {
            let Some(sample) = self.subscriber.receive().map_err(|e| self.failed(e.to_string()))? else { break };
            let (message, id, node) = (*sample.payload(), sample.header().publisher_id(), sample.header().node_id());
            drop(sample);
            let is_new = self.driver.is_none_or(|driver| driver.id != id);
            let pid = || node.pid::<Ipc>().ok().and_then(|pid| u32::try_from(pid.value()).ok()).unwrap_or(0);
            self.batch.push((message, id, if is_new { pid() } else { 0 }));
        }
        if let Some(driver) = self.driver.as_mut().filter(|driver| self.batch.iter().any(|(_, id, _)| *id == driver.id))
        {
            driver.heard_ns = now_ns;
        }
        let mut news = WheelNews { messages: self.batch.len() as u64, ..WheelNews::default() };
        for i in 0..self.batch.len() {
            let (message, id, pid) = self.batch[i];
            if self.driver.is_some_and(|d| d.id != id && now_ns - d.heard_ns < GAP_NS && self.is_there(d.id)) {
                news.second = Some(pid);
                to(&internal(&message), Some(WheelFault::SecondPublisher));
                continue;
            }
            let driver = match self.driver.filter(|driver| driver.id == id) {
                Some(driver) => driver,
                None => {
                    news.driver = Some(pid);
                    Driver { id, next_sequence: None, heard_ns: now_ns }
                }
            };
            let ahead_ns = message.timestamp_ns.saturating_sub(now_ns);
            let of_now = (-BEHIND_NS..=AHEAD_NS).contains(&ahead_ns);
            if to(&internal(&message), (!of_now).then_some(WheelFault::WrongClock { ahead_ns })) {
                news.believed += 1;
                news.missing += missing(driver.next_sequence, message.sequence);
            }
            // What came and is not believed is not missing either.
            let next_sequence = Some(message.sequence.wrapping_add(1));
            self.driver = Some(Driver { id, next_sequence, heard_ns: now_ns });
        }
        self.batch.clear();
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

/// Messages between the one that was expected and this one.
fn missing(expected: Option<u64>, sequence: u64) -> u64 {
    expected.map(|expected| sequence.wrapping_sub(expected)).filter(|jump| *jump <= MOST_MISSING).unwrap_or(0)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_no_driver_counts_to_lose_nothing() {
        let lost = |expected, sequence| missing(Some(expected), sequence);
        assert_eq!((missing(None, 7), lost(5, 5), lost(5, 8), lost(u64::MAX, 1)), (0, 0, 3, 2));
        assert_eq!((lost(5, u64::MAX), lost(1, 0), lost(0, 10_000), lost(0, 10_001)), (0, 0, 10_000, 0));
    }
}
