//! Listens, and gives each connection a thread.

use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tracing::warn;

use super::calibration::{self, Calibrator, Desk};
use super::door::{self, Door, Stay};
use super::feed::{Source, graph, obstacles, pictures, robot, tags};
use super::guard::{Access, Token};
use super::hub::{Hub, MAX_PAGES, lock};
use super::journal::{self, LogSource};
use super::pair::Pair;
use super::session::{self, Order};
use super::{ConsoleError, assets::Assets, http, jobs};
use crate::client::monotonic_ns;
use crate::messages::Endpoint;
use crate::telemetry::RateLimiter;

/// Connections at a time; others wait to be accepted, for a moment, as strangers give way to each other.
const MAX_CONNECTIONS: usize = MAX_PAGES + door::STRANGERS;
/// How soon the end is noticed while nobody connects.
const NAP: Duration = Duration::from_millis(200);
/// Stack of a connection's thread, bytes: it parses a few kilobytes.
const STACK: usize = 512 * 1024;

/// How the console is run.
#[derive(Debug)]
pub struct Options {
    pub listen: SocketAddr,
    pub token: Option<Token>,
    /// Names of this host besides its addresses.
    pub names: Vec<String>,
    pub endpoint: Endpoint,
    pub log: LogChoice,
    /// What to do about a fault of health, by its name.
    pub advice: fn(&str) -> &'static str,
    /// Who knows how to calibrate.
    pub calibrator: Arc<dyn Calibrator>,
}

/// Where the daemon's log is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LogChoice {
    /// The journal's of this unit.
    Unit(String),
    /// A file of JSON lines.
    File(PathBuf),
}

/// A console that listens.
#[derive(Debug)]
pub struct Console {
    listener: TcpListener,
    address: SocketAddr,
    access: Arc<Access>,
    assets: Arc<Assets>,
    options: Options,
}

impl Console {
    /// Listens; nothing is answered before [`Self::run`].
    pub fn listen(options: Options) -> Result<Self, ConsoleError> {
        let access = Access::new(options.listen, options.token.clone(), &options.names)?;
        let fail = |reason| ConsoleError::Listen { address: options.listen, reason };
        let listener = TcpListener::bind(options.listen).map_err(fail)?;
        let address = listener.local_addr().map_err(fail)?;
        let assets = Assets::load().map_err(ConsoleError::Assets)?;
        Ok(Self { listener, address, access: Arc::new(access), assets: Arc::new(assets), options })
    }

    /// With the port that the system chose for port 0.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Until `stop`. Ends within seconds, whatever pages do.
    pub fn run(&self, stop: &AtomicBool) {
        let (hub, pair, desk) = (Arc::new(Hub::default()), Arc::new(Pair::new()), Arc::new(Desk::default()));
        let source = Arc::new(Source::new(self.options.endpoint.clone()));
        let log = match &self.options.log {
            LogChoice::Unit(unit) => LogSource::journal(unit),
            LogChoice::File(path) => LogSource::File(path.clone()),
        };
        std::thread::scope(|scope| {
            scope.spawn(|| robot::run(&hub, &source, self.options.advice, stop));
            scope.spawn(|| pictures::run(&hub, &source, &desk.tray, stop));
            scope.spawn(|| robot::run_map(&hub, &source, stop));
            scope.spawn(|| graph::run(&hub, &source, stop));
            scope.spawn(|| obstacles::run(&hub, &source, stop));
            scope.spawn(|| tags::run(&hub, &source, stop));
            scope.spawn(|| journal::run(&hub, &log, stop));
            scope.spawn(|| {
                calibration::run(&hub, &source, &desk, &self.options.calibrator, jobs::calibration, stop);
            });
            self.accept(&hub, jobs::start(&source, &pair, &desk), stop);
            hub.close_all();
        });
        pair.clear();
    }

    fn accept(&self, hub: &Arc<Hub>, order: Order, stop: &AtomicBool) {
        let order = Arc::new(order);
        let connections = Arc::new(AtomicUsize::new(0));
        let (door, refusals) = (Arc::new(Door::default()), Arc::new(Refusals::default()));
        let nap = Timespec { tv_sec: 0, tv_nsec: NAP.as_nanos() as i64 };
        while !stop.load(Ordering::Relaxed) {
            if connections.load(Ordering::Relaxed) >= MAX_CONNECTIONS || !door.is_open(Instant::now()) {
                std::thread::sleep(Duration::from_millis(20));
                continue;
            }
            let mut waiting = [PollFd::new(&self.listener, PollFlags::IN)];
            if !matches!(poll(&mut waiting, Some(&nap)), Ok(1..)) {
                continue;
            }
            // The second one is the door's, to end it by.
            let accepted = self.listener.accept().and_then(|(stream, peer)| Ok((stream.try_clone()?, stream, peer)));
            let (end, stream, peer) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    // Of one connection that has gone, or too many files are open: neither ends the console.
                    warn!(%error, "console: connection not accepted");
                    std::thread::sleep(NAP);
                    continue;
                }
            };
            let stay = door.enter(peer.ip(), end, Instant::now(), &|peer, why| refusals.tell(peer, why));
            let place = Place::take(&connections);
            let visit = Visit {
                hub: hub.clone(),
                access: self.access.clone(),
                assets: self.assets.clone(),
                order: order.clone(),
                refusals: refusals.clone(),
                stay,
            };
            let spawned = std::thread::Builder::new().name("console-page".into()).stack_size(STACK).spawn(move || {
                let _place = place;
                visit.serve(stream);
            });
            if let Err(error) = spawned {
                warn!(%error, "console: no thread for a connection");
            }
        }
    }
}

/// One of the connections that there may be.
struct Place(Arc<AtomicUsize>);

impl Place {
    fn take(count: &Arc<AtomicUsize>) -> Self {
        count.fetch_add(1, Ordering::Relaxed);
        Self(count.clone())
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What a connection's thread needs.
struct Visit {
    hub: Arc<Hub>,
    access: Arc<Access>,
    assets: Arc<Assets>,
    order: Arc<Order>,
    refusals: Arc<Refusals>,
    stay: Stay,
}

/// The log of what is refused: of each reason at most a line a second, so that a storm of one hides no other. Reasons are this program's own words,
/// so they are few.
#[derive(Default)]
struct Refusals(Mutex<BTreeMap<&'static str, RateLimiter>>);

impl Refusals {
    fn tell(&self, peer: Option<SocketAddr>, why: &'static str) {
        if let Some(requests) = lock(&self.0).entry(why).or_default().event(monotonic_ns()) {
            warn!(requests, why, ?peer, "console: request refused");
        }
    }
}

impl Visit {
    /// Errors of a connection are its own.
    fn serve(&self, mut stream: TcpStream) {
        if stream.set_nonblocking(false).is_err() {
            return;
        }
        let request = match http::read(&mut stream) {
            Ok(request) => request,
            Err(http::Bad::Refuse(status, sentence)) => {
                self.refusals.tell(stream.peer_addr().ok(), status);
                if http::say(&mut stream, status, sentence).is_ok() {
                    http::linger(&mut stream);
                }
                return;
            }
            Err(http::Bad::Gone) => return,
        };
        if let Err(refused) = self.access.judge(&request.host, request.origin.as_deref()) {
            self.refusals.tell(stream.peer_addr().ok(), refused.name());
            let _ = http::say(&mut stream, "403 Forbidden", refused.sentence());
            return;
        }
        let _ = match (request.path.as_str(), &request.websocket_key) {
            ("/ws", Some(key)) => http::upgrade(&mut stream, key).and_then(|()| {
                let peer = stream.peer_addr().ok();
                let refuse = |why: &'static str| self.refusals.tell(peer, why);
                session::run(stream, request.rest, &self.hub, &self.access, &self.order, &self.stay, &refuse)
            }),
            ("/ws", None) => {
                self.refusals.tell(stream.peer_addr().ok(), "426 Upgrade Required");
                http::say(&mut stream, "426 Upgrade Required", "Here is a WebSocket.")
            }
            ("/access", _) => {
                http::say(&mut stream, "200 OK", if self.access.needs_token() { "token" } else { "open" })
            }
            _ => http::serve(&mut stream, &request, &self.assets),
        };
    }
}
