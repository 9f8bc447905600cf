//! A base's driver tells the daemon of its wheels.
//!
//! The only service that a client writes. The daemon makes it; a driver that is there before the daemon, or outlives it, sends into the void
//! until it finds the next one. One driver a daemon: a second one is refused here, by the process that is there already.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::prelude::{BackpressureStrategy, CallbackProgression, Node, PortFactory as _};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::link::Ipc;
use super::search::Search;
use super::{Client, ClientError, monotonic_ns};
use crate::messages::services::topic;
use crate::messages::{UNKNOWN_NS, WheelOdometry};

/// A daemon that is restarted within this time finds the service as it was; then it is let go, so that one of another version can make its own.
const GRACE: Duration = Duration::from_millis(500);
/// How often the remains of killed processes are cleared away, a killed daemon's among them.
const CLEAN_UP_EVERY: Duration = Duration::from_secs(2);
/// A message is the mean over the time since the one before only if that is no longer ago, ns.
const LONGEST_INTERVAL_NS: i64 = 500_000_000;

/// `PREFIX/wheel`, from the driver's side; made by [`Client::wheels`].
#[derive(Debug)]
pub struct WheelPublisher {
    search: Search,
    open: Option<Open>,
    sequence: u64,
    last_ns: Option<i64>,
}

/// Ports of a connected publisher, dropped in this order.
#[derive(Debug)]
struct Open {
    port: Publisher<Ipc, WheelOdometry, ()>,
    service: PortFactory<Ipc, WheelOdometry, ()>,
    node: Arc<Node<Ipc>>,
    /// Since when nobody reads.
    alone: Option<Instant>,
    cleaned: Instant,
}

impl Client {
    /// For the driver of the robot's base: tells the daemon of its wheels.
    ///
    /// ```no_run
    /// # fn read_encoders() -> (f64, f64) { (0.0, 0.0) }
    /// # fn main() -> Result<(), cairn::client::ClientError> {
    /// let mut wheels = cairn::client::Client::from_environment()?.wheels();
    /// loop {
    ///     let (speed_mps, turn_radps) = read_encoders(); // means since the last time, 20 to 100 times a second
    ///     wheels.send(speed_mps, 0.0, turn_radps)?;
    /// }
    /// # }
    /// ```
    pub fn wheels(&self) -> WheelPublisher {
        let search = Search::new(self.link.clone(), topic::WHEEL);
        WheelPublisher { search, open: None, sequence: 0, last_ns: None }
    }
}

impl WheelPublisher {
    /// The base's mean twist since the last call, up to now (REP-103: forward, to the left, turn to the left; m/s, m/s, rad/s). `true` if a daemon
    /// is there. Never waits; an error is one that waiting does not cure.
    pub fn send(&mut self, linear_x_mps: f64, linear_y_mps: f64, angular_z_radps: f64) -> Result<bool, ClientError> {
        let timestamp_ns = monotonic_ns();
        let since = self.last_ns.filter(|last| timestamp_ns.saturating_sub(*last) <= LONGEST_INTERVAL_NS);
        let interval_start_ns = since.unwrap_or(UNKNOWN_NS);
        let twist = WheelOdometry { linear_x_mps, linear_y_mps, angular_z_radps, ..WheelOdometry::default() };
        self.publish(&WheelOdometry { timestamp_ns, interval_start_ns, ..twist })
    }

    /// A message with stamps and variances of the driver's own; `sequence` is filled in here. `true` if a daemon is there.
    pub fn publish(&mut self, message: &WheelOdometry) -> Result<bool, ClientError> {
        let message = WheelOdometry { sequence: self.sequence, ..*message };
        self.sequence += 1;
        self.last_ns = Some(message.timestamp_ns);
        if self.open.is_none() {
            if !self.search.is_due() {
                return Ok(false);
            }
            self.connect()?;
        }
        let Some(open) = &mut self.open else { return Ok(false) };
        let sent = open.port.send_copy(message).map_err(|e| e.to_string());
        if open.cleaned.elapsed() >= CLEAN_UP_EVERY && self.search.link.clear_unfilled().is_ok() {
            self.search.link.clear_after_daemon(&open.node);
            open.cleaned = Instant::now();
        }
        if open.service.dynamic_config().number_of_subscribers() > 0 {
            open.alone = None;
        } else if open.alone.get_or_insert_with(Instant::now).elapsed() >= GRACE {
            self.open = None;
            return Ok(false);
        }
        let heard = open.alone.is_none();
        match sent {
            Ok(_) => {
                self.search.works();
                Ok(heard)
            }
            Err(reason) => {
                // The daemon may have died meanwhile. Start over, and give up only if that goes on.
                self.open = None;
                self.search.troubled("sending", reason).map(|()| false)
            }
        }
    }

    /// A daemon is there to read.
    pub fn is_connected(&self) -> bool {
        self.open.as_ref().is_some_and(|open| open.service.dynamic_config().number_of_subscribers() > 0)
    }

    /// Opens the service if a daemon has made it.
    fn connect(&mut self) -> Result<(), ClientError> {
        let Some((node, name)) = self.search.look()? else { return Ok(()) };
        let service = match node.service_builder(&name).publish_subscribe::<WheelOdometry>().open() {
            Ok(service) => service,
            Err(error) => return self.search.open_failed(error, WheelOdometry::TYPE_NAME),
        };
        if service.dynamic_config().number_of_publishers() > 0 {
            // A driver that was killed is none.
            node.try_cleanup_dead_nodes();
        }
        if service.dynamic_config().number_of_publishers() > 0 {
            return Err(second(&service));
        }
        let builder = service.publisher_builder().backpressure_strategy(BackpressureStrategy::DiscardData);
        let port = match builder.create() {
            Ok(port) => port,
            Err(PublisherCreateError::ExceedsMaxSupportedPublishers) => return Err(second(&service)),
            Err(e) => return self.search.troubled("making its publisher", e.to_string()),
        };
        self.open = Some(Open { port, service, node, alone: None, cleaned: Instant::now() });
        Ok(())
    }
}

fn second(service: &PortFactory<Ipc, WheelOdometry, ()>) -> ClientError {
    let mut pid = None;
    service.dynamic_config().list_publishers(|publisher| {
        pid = publisher.node_id.pid::<Ipc>().ok().and_then(|pid| u32::try_from(pid.value()).ok());
        CallbackProgression::Stop
    });
    ClientError::SecondPublisher { service: service.name().to_string(), pid }
}
