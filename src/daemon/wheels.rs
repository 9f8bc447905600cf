//! The daemon's way in for wheel odometry: from a source or the wire into the queue that the reconstruction step empties.
//!
//! What is not believed is counted (`WheelCounts`) and named in the log, at once and then once a second with a count. Nothing here costs
//! anything while nobody tells of wheels.

use std::sync::Arc;

use tracing::{info, warn};

use super::status::Status;
use crate::frame::monotonic_ns;
use crate::motion::wheel::{WheelFault, WheelMessage, WheelQueue};
use crate::publish::WheelInbox;
use crate::telemetry::RateLimiter;

/// One filler's end of the queue.
#[derive(Debug)]
pub struct WheelIntake {
    queue: Arc<WheelQueue>,
    refused: RateLimiter,
}

impl WheelIntake {
    pub fn new(queue: Arc<WheelQueue>) -> Self {
        Self { queue, refused: RateLimiter::default() }
    }

    /// Takes a message in and says whether it is believed. `known`: what is wrong with it as its source sees it; `origin`: who tells, for the log.
    pub fn take(&mut self, origin: &str, message: &WheelMessage, known: Option<WheelFault>) -> bool {
        let fault = match known {
            Some(fault) => {
                self.queue.counts().refuse(&fault);
                fault
            }
            None => match self.queue.push(message) {
                Ok(()) => return true,
                Err(fault) => fault,
            },
        };
        if let Some(messages) = self.refused.event(monotonic_ns()) {
            let (number, fault, reason) = (message.number, fault.name(), fault.to_string());
            warn!(messages, origin, number, fault, reason, "wheel reading not believed");
        }
        false
    }
}

/// The wire's end of the queue: a driver that comes, goes, or is not alone is told here.
#[derive(Debug)]
pub struct WheelListener {
    inbox: WheelInbox,
    intake: WheelIntake,
    status: Arc<Status>,
    second: RateLimiter,
    failures: RateLimiter,
}

impl WheelListener {
    pub fn new(inbox: WheelInbox, queue: Arc<WheelQueue>, status: Arc<Status>) -> Self {
        let intake = WheelIntake::new(queue);
        Self { inbox, intake, status, second: RateLimiter::default(), failures: RateLimiter::default() }
    }

    /// Takes in everything that has come by now.
    pub fn listen(&mut self) {
        let now_ns = monotonic_ns();
        let intake = &mut self.intake;
        let news = match self.inbox.read(now_ns, &mut |message, fault| intake.take("wire", message, fault)) {
            Ok(news) => news,
            Err(error) => {
                if let Some(times) = self.failures.event(now_ns) {
                    warn!(times, %error, "wheel readings cannot be received");
                }
                return;
            }
        };
        if news.messages == 0 {
            return;
        }
        // Of one that is never believed the robot knows as little as of one that is silent.
        if news.believed > 0 {
            self.status.set_wheels_heard_ns(now_ns);
        }
        self.status.wheels.missing.add(news.missing);
        if let Some(pid) = news.driver {
            info!(pid, "wheel driver heard");
        }
        if let Some(pid) = news.second
            && let Some(times) = self.second.event(now_ns)
        {
            warn!(times, pid, "a second wheel driver is not believed");
        }
    }
}
