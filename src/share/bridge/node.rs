//! A node of ROS 2 on a Zenoh session: publishers, services and a subscription, each with its key, its liveliness token and its attachments.
//!
//! Input: messages as CDR. Output: the same on the network, numbered. What must be kept for late joiners ("transient local") is in a cache of Zenoh's own
//! that rmw_zenoh's subscribers ask. Zenoh connects, and connects again, by itself; a message that nobody takes is gone.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority, Reliability};
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig, RepliesConfig};

use super::attachment::{Attachment, GID_BYTES, gid};
use super::commands::{Asked, unix_ns};
use super::error::{BridgeError, reason};
use super::inbox::{Inbox, Request, Service};
use super::names::{INITIAL_POSE, Identity, Kind, Qos, Robot, TRIGGER, Type, key, maps_key, subscribers};
use super::session::{self, Link};
use super::topic::Topic;
use crate::share::maps::Requests;

/// How often a cache says up to which number it goes, if that has changed: rmw_zenoh's own period.
const HEARTBEAT: Duration = Duration::from_secs(5);
/// Subscribers of one topic that are told apart; of more, one that goes may be forgotten too early.
const MOST_SUBSCRIBERS: usize = 256;
/// Bytes of a PoseWithCovarianceStamped with a name of a frame that nobody has. What comes is not copied before it is known to be no longer.
const MOST_OF_A_POSE: usize = 4096;
/// Of services, as rmw has it.
const SERVICE_QOS: Qos = Qos::reliable(10);

/// Where the node is.
#[derive(Debug, Clone)]
pub struct Network {
    /// ROS_DOMAIN_ID.
    pub domain: u32,
    pub robot: Robot,
    /// Transforms in the robot's namespace.
    pub own_tf: bool,
    /// Whether it takes anything from the network: services and the initial pose.
    pub takes_commands: bool,
    /// Zenoh's own configuration file.
    pub file: Option<PathBuf>,
}

enum Port {
    Plain(Publisher<'static>),
    Cached(AdvancedPublisher<'static>),
}

struct Output {
    port: Port,
    gid: [u8; GID_BYTES],
    /// Of the last message.
    sequence: i64,
}

/// Tokens of a topic's subscribers.
type Subscribers = Arc<Mutex<BTreeSet<String>>>;

/// See module. What is held only to be there is behind `_`.
pub struct Node {
    /// In [`Topic::ALL`]'s order.
    outputs: Vec<Output>,
    wanted: Vec<(Topic, Subscribers)>,
    endpoints: String,
    _services: Vec<Queryable<()>>,
    _subscribers: Vec<Subscriber<()>>,
    _tokens: Vec<LivelinessToken>,
    session: Session,
}

impl Node {
    /// Opens the session, which need not find anybody yet, and declares everything. `maps`: where it is asked for stored ones.
    pub(super) fn open(network: &Network, inbox: &Inbox, maps: Option<Requests>) -> Result<Self, BridgeError> {
        let (session, endpoints) = session::open(network.file.as_deref())?;
        let identity =
            Identity { domain: network.domain, session: session.zid().to_string(), robot: network.robot.clone() };
        let mut making = Making { session: &session, identity: &identity, tokens: Vec::new() };
        making.token(&identity.node_token())?;
        let (mut outputs, mut wanted) = (Vec::new(), Vec::new());
        let mut watchers = Vec::new();
        for topic in Topic::ALL {
            let name = topic.name(&network.robot, network.own_tf);
            outputs.push(making.output(&name, topic)?);
            if topic.is_on_demand() {
                let (known, watcher) = making.watch(&name)?;
                watchers.push(watcher);
                wanted.push((topic, known));
            }
        }
        let mut services = Vec::new();
        if network.takes_commands {
            for service in Service::ALL {
                services.push(making.service(service, inbox)?);
            }
            watchers.push(making.initial_pose(inbox)?);
            services.extend(maps.map(|maps| making.maps(maps)).transpose()?);
        }
        let tokens = making.tokens;
        let (_services, _subscribers, _tokens) = (services, watchers, tokens);
        Ok(Self { outputs, wanted, endpoints, _services, _subscribers, _tokens, session })
    }

    /// Sends a message of this topic.
    pub(super) fn put(&mut self, topic: Topic, message: Vec<u8>) -> Result<(), String> {
        let output = &mut self.outputs[topic.index()];
        output.sequence += 1;
        let attachment = Attachment { sequence: output.sequence, time_ns: unix_ns(), gid: output.gid }.to_bytes();
        let sent = match &output.port {
            Port::Plain(port) => port.put(message).attachment(attachment).wait(),
            Port::Cached(port) => port.put(message).attachment(attachment).wait(),
        };
        sent.map_err(|e| reason(&e))
    }

    /// Somebody subscribes to it; of a topic that is sent in any case this is not asked.
    pub(super) fn is_wanted(&self, topic: Topic) -> bool {
        let known = self.wanted.iter().find(|(wanted, _)| *wanted == topic);
        known.is_none_or(|(_, known)| !lock(known).is_empty())
    }

    pub(super) fn link(&self) -> Link {
        session::link(&self.session)
    }

    /// Where it connects to, as configured.
    pub(super) fn endpoints(&self) -> &str {
        &self.endpoints
    }

    /// Takes leave of the network, so that the node's tokens are gone at once.
    pub(super) fn close(self) {
        // Whoever closes does not need to know that the network has gone before.
        let _ = self.session.close().wait();
    }
}

fn lock(known: &Subscribers) -> std::sync::MutexGuard<'_, BTreeSet<String>> {
    // A set is whole at any time.
    known.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A node that is being made.
struct Making<'a> {
    session: &'a Session,
    identity: &'a Identity,
    tokens: Vec<LivelinessToken>,
}

impl Making<'_> {
    fn failed(what: &str) -> impl FnOnce(zenoh::Error) -> BridgeError {
        move |e| BridgeError::Declare { what: what.into(), reason: reason(&e) }
    }

    fn token(&mut self, token: &str) -> Result<(), BridgeError> {
        let declared = self.session.liveliness().declare_token(token.to_owned()).wait();
        self.tokens.push(declared.map_err(Self::failed(token))?);
        Ok(())
    }

    /// Declares the token of an entity and gives its id. There is one token before: the node's, with the number 0.
    fn entity(&mut self, kind: Kind, topic: &str, of: Type, qos: Qos) -> Result<[u8; GID_BYTES], BridgeError> {
        let number = u32::try_from(self.tokens.len()).unwrap_or(u32::MAX);
        let token = self.identity.token(number, kind, topic, of, qos);
        self.token(&token)?;
        Ok(gid(&token))
    }

    fn output(&mut self, name: &str, topic: Topic) -> Result<Output, BridgeError> {
        let (of, qos) = (topic.of(), topic.qos());
        let key = key(self.identity.domain, name, of);
        let reliability = if qos.is_reliable { Reliability::Reliable } else { Reliability::BestEffort };
        let priority = if topic.is_large() { Priority::DataLow } else { Priority::Data };
        let builder = self.session.declare_publisher(key.clone()).reliability(reliability).priority(priority);
        let port = if qos.is_transient_local {
            // By default an answer waits for whoever asked and does not take it, up to 5 s, and with it the router's other readers of this node and the
            // next message into the cache. Dropped instead, and what is small has a queue that hardly anything else is in.
            let priority = if topic.is_large() { priority } else { Priority::InteractiveHigh };
            let replies = RepliesConfig::default().congestion_control(CongestionControl::Drop).priority(priority);
            let cached = builder
                .cache(CacheConfig::default().max_samples(qos.depth).replies_config(replies))
                .publisher_detection()
                .sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT));
            Port::Cached(cached.wait().map_err(Self::failed(&key))?)
        } else {
            Port::Plain(builder.wait().map_err(Self::failed(&key))?)
        };
        // The token comes last: who sees it finds the publisher.
        let gid = self.entity(Kind::Publisher, name, of, qos)?;
        Ok(Output { port, gid, sequence: 0 })
    }

    /// Who subscribes to a topic, from now on.
    fn watch(&self, topic: &str) -> Result<(Subscribers, Subscriber<()>), BridgeError> {
        let known = Subscribers::default();
        let pattern = subscribers(self.identity.domain, topic);
        let seen = known.clone();
        let watcher = self.session.liveliness().declare_subscriber(pattern.clone()).history(true);
        let watcher = watcher.callback(move |sample| {
            let token = sample.key_expr().as_str();
            let mut seen = lock(&seen);
            match sample.kind() {
                SampleKind::Put if seen.len() < MOST_SUBSCRIBERS => {
                    seen.insert(token.to_owned());
                }
                SampleKind::Put => {}
                SampleKind::Delete => {
                    seen.remove(token);
                }
            }
        });
        Ok((known, watcher.wait().map_err(Self::failed(&pattern))?))
    }

    fn service(&mut self, service: Service, inbox: &Inbox) -> Result<Queryable<()>, BridgeError> {
        let topic = self.identity.robot.topic(service.word());
        let key = key(self.identity.domain, &topic, TRIGGER);
        let inbox = inbox.clone();
        let queryable = self.session.declare_queryable(key.clone()).complete(true);
        let own = key.clone();
        let answer = move |query: Query| {
            let (attachment, payload) =
                (query.attachment().map(ZBytes::to_bytes), query.payload().map(ZBytes::to_bytes));
            let asked = Asked {
                key: query.key_expr().as_str(),
                attachment: attachment.as_deref(),
                payload: payload.as_deref(),
            };
            match asked.trigger(&own) {
                Ok(asked) => inbox.push(Request::Service { service, asked, query: query.clone() }),
                // Without an answer: it is the end of the query.
                Err(reason) => inbox.refuse(asked.key, reason),
            }
        };
        let queryable = queryable.callback(answer).wait().map_err(Self::failed(&key))?;
        self.entity(Kind::Service, &topic, TRIGGER, SERVICE_QOS)?;
        Ok(queryable)
    }

    /// No service of ROS 2's, so it has no token.
    fn maps(&self, requests: Requests) -> Result<Queryable<()>, BridgeError> {
        let Identity { domain, session, robot } = self.identity;
        let key = maps_key(*domain, Some(session), robot);
        let own = key.clone();
        let queryable = self.session.declare_queryable(key.clone()).complete(true);
        queryable.callback(move |query| requests.push(query, &own)).wait().map_err(Self::failed(&key))
    }

    fn initial_pose(&mut self, inbox: &Inbox) -> Result<Subscriber<()>, BridgeError> {
        let topic = self.identity.robot.topic("initialpose");
        let key = key(self.identity.domain, &topic, INITIAL_POSE);
        let inbox = inbox.clone();
        let subscriber = self.session.declare_subscriber(key.clone());
        let own = key.clone();
        let take = move |sample: Sample| {
            let attachment = sample.attachment().map(ZBytes::to_bytes);
            let asked = Asked { key: sample.key_expr().as_str(), attachment: attachment.as_deref(), payload: None };
            match (asked.of_a_node(&own), sample.kind()) {
                (Ok(_), SampleKind::Put) if sample.payload().len() > MOST_OF_A_POSE => {
                    inbox.refuse(asked.key, "it is longer than any pose");
                }
                (Ok(_), SampleKind::Put) => {
                    inbox.push(Request::InitialPose(sample.payload().to_bytes().into_owned()));
                }
                (Ok(_), SampleKind::Delete) => inbox.refuse(asked.key, "it deletes and says nothing"),
                (Err(reason), _) => inbox.refuse(asked.key, reason),
            }
        };
        let subscriber = subscriber.callback(take).wait().map_err(Self::failed(&key))?;
        self.entity(Kind::Subscription, &topic, INITIAL_POSE, Qos::reliable(10))?;
        Ok(subscriber)
    }
}
