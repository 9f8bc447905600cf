//! One publish/subscribe service with its events, as a publisher sees it.

use std::fmt::Debug;
use std::mem::MaybeUninit;
use std::sync::Arc;
use std::time::Duration;

use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, CallbackProgression, EventId, MessagingPattern, Node, PortFactory as _,
    ServiceName, ZeroCopySend,
};
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::PublishError;
use super::opening::Ipc;
use super::opening::open_patiently;
use crate::messages::Endpoint;
use crate::messages::services::{self, Qos};

/// See module. Dropped in this order, so that listeners that hear of the publisher's going find it gone.
#[derive(Debug)]
pub(super) struct Port<P, H>
where
    P: iceoryx2::prelude::IceoryxSend + Debug + ?Sized + 'static,
    H: Default + Debug + ZeroCopySend + 'static,
{
    pub publisher: Arc<Publisher<Ipc, P, H>>,
    notifier: Notifier<Ipc>,
    service: PortFactory<Ipc, P, H>,
    name: ServiceName,
}

/// Memory for one message of single values.
pub(super) type Loan<T> = SampleMutUninit<Ipc, MaybeUninit<T>, ()>;

/// A slice written into shared memory and not sent yet.
pub(super) type Filled<T, H> = SampleMut<Ipc, [T], H>;

/// The builder calls that slices and single values have in common; their types differ.
macro_rules! service {
    ($node:expr, $name:expr, $payload:ty, $header:ty, $qos:expr) => {
        $node
            .service_builder($name)
            .publish_subscribe::<$payload>()
            .user_header::<$header>()
            .max_publishers(services::MAX_PUBLISHERS)
            .max_subscribers($qos.subscribers)
            .max_nodes(services::MAX_NODES)
            .history_size($qos.history)
            .subscriber_max_buffer_size($qos.buffer)
            .subscriber_max_borrowed_samples($qos.borrowed)
            .enable_safe_overflow(true)
            .open_or_create()
    };
}

impl<T> Port<T, ()>
where
    T: ZeroCopySend + Debug + 'static,
{
    /// Makes a service of single values.
    pub fn open(node: &Node<Ipc>, endpoint: &Endpoint, topic: &str, qos: Qos) -> Result<Self, PublishError> {
        let name = endpoint.service(topic)?;
        let notifier = notifier(node, endpoint, &name)?;
        let service =
            open_patiently(endpoint, &name, MessagingPattern::PublishSubscribe, || service!(node, &name, T, (), qos))?;
        refuse_company(node, endpoint, &service)?;
        let publisher = service
            .publisher_builder()
            .max_loaned_samples(services::PUBLISHER_LOANS)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| publisher_failed(endpoint, &service, e))?;
        Ok(Self { publisher: Arc::new(publisher), notifier, service, name })
    }

    /// Memory for the next value. iceoryx2 0.10 makes one small heap allocation here.
    pub fn loan(&self) -> Result<Loan<T>, PublishError> {
        self.publisher.loan_uninit().map_err(|e| self.failed("taking memory", e))
    }

    /// Sends one value and wakes its readers.
    pub fn send(&self, value: T) -> Result<(), PublishError> {
        self.send_in(self.loan()?, value)
    }

    /// Sends one value in memory that was taken before, and wakes its readers.
    pub fn send_in(&self, memory: Loan<T>, value: T) -> Result<(), PublishError> {
        memory.write_payload(value).send().map_err(|e| self.failed("sending", e))?;
        self.wake();
        Ok(())
    }
}

impl<T, H> Port<[T], H>
where
    T: ZeroCopySend + Debug + Copy + Default + 'static,
    H: ZeroCopySend + Debug + Default + 'static,
{
    /// Makes a service of slices of at most `max_len` elements.
    pub fn open_slices(
        node: &Node<Ipc>,
        endpoint: &Endpoint,
        topic: &str,
        qos: Qos,
        max_len: usize,
    ) -> Result<Self, PublishError> {
        let name = endpoint.service(topic)?;
        let notifier = notifier(node, endpoint, &name)?;
        let service =
            open_patiently(endpoint, &name, MessagingPattern::PublishSubscribe, || service!(node, &name, [T], H, qos))?;
        refuse_company(node, endpoint, &service)?;
        let publisher = service
            .publisher_builder()
            .max_loaned_samples(services::PUBLISHER_LOANS)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .initial_max_slice_len(max_len.max(1))
            .allocation_strategy(AllocationStrategy::Static)
            .create()
            .map_err(|e| publisher_failed(endpoint, &service, e))?;
        Ok(Self { publisher: Arc::new(publisher), notifier, service, name })
    }

    /// A message in the making: each element written into shared memory by `convert`. Takes time with the slice's length;
    /// [`Self::send_filled`] does not.
    pub fn fill<S>(&self, source: &[S], convert: impl Fn(&S) -> T) -> Result<Filled<T, H>, PublishError> {
        let sample = self.publisher.loan_slice_uninit(source.len()).map_err(|e| self.failed("taking memory", e))?;
        // There are as many slots as elements, so the default is never used.
        Ok(sample.write_from_fn(|i| source.get(i).map(&convert).unwrap_or_default()))
    }

    /// Sends what was filled and wakes its readers.
    pub fn send_filled(&self, mut filled: Filled<T, H>, header: H) -> Result<(), PublishError> {
        *filled.user_header_mut() = header;
        filled.send().map_err(|e| self.failed("sending", e))?;
        self.wake();
        Ok(())
    }

    /// Sends a copy of a slice and wakes its readers.
    pub fn send_copy(&self, header: H, source: &[T]) -> Result<(), PublishError> {
        let mut sample = self.publisher.loan_slice_uninit(source.len()).map_err(|e| self.failed("taking memory", e))?;
        *sample.user_header_mut() = header;
        sample.write_from_slice(source).send().map_err(|e| self.failed("sending", e))?;
        self.wake();
        Ok(())
    }
}

impl<P, H> Port<P, H>
where
    P: iceoryx2::prelude::IceoryxSend + Debug + ?Sized + 'static,
    H: Default + Debug + ZeroCopySend + 'static,
{
    /// Subscribers that are registered.
    pub fn subscribers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }

    fn wake(&self) {
        // A listener that cannot be woken has died or will read late; the message is there.
        let _ = self.notifier.notify();
    }

    fn failed(&self, doing: &'static str, reason: impl ToString) -> PublishError {
        PublishError::Ipc { service: self.name.to_string(), doing, reason: reason.to_string() }
    }
}

fn notifier(node: &Node<Ipc>, endpoint: &Endpoint, name: &ServiceName) -> Result<Notifier<Ipc>, PublishError> {
    let events = open_patiently(endpoint, name, MessagingPattern::Event, || {
        node.service_builder(name)
            .event()
            .event_id_max_value(services::EVENT_MAX)
            .max_listeners(services::MAX_SUBSCRIBERS)
            .max_notifiers(services::MAX_NOTIFIERS)
            .max_nodes(services::MAX_NODES)
            .notifier_created_event(EventId::new(services::EVENT_CREATED))
            .notifier_dropped_event(EventId::new(services::EVENT_DROPPED))
            .notifier_dead_event(EventId::new(services::EVENT_DEAD))
            .open_or_create()
    })?;
    events.notifier_builder().default_event_id(EventId::new(services::EVENT_NEW)).create().map_err(|e| {
        PublishError::Ipc { service: name.to_string(), doing: "making its notifier", reason: e.to_string() }
    })
}

/// A publisher that lives is another daemon. (The service's own limit of one publisher does not help when somebody else
/// has made the service with a higher one.)
fn refuse_company<P, H>(
    node: &Node<Ipc>,
    endpoint: &Endpoint,
    service: &PortFactory<Ipc, P, H>,
) -> Result<(), PublishError>
where
    P: iceoryx2::prelude::IceoryxSend + Debug + ?Sized,
    H: Debug + ZeroCopySend,
{
    if service.dynamic_config().number_of_publishers() > 0 {
        node.blocking_cleanup_dead_nodes(Duration::from_secs(1));
    }
    match service.dynamic_config().number_of_publishers() {
        0 => Ok(()),
        _ => Err(already_running(endpoint, service)),
    }
}

fn publisher_failed<P, H>(
    endpoint: &Endpoint,
    service: &PortFactory<Ipc, P, H>,
    error: PublisherCreateError,
) -> PublishError
where
    P: iceoryx2::prelude::IceoryxSend + Debug + ?Sized,
    H: Debug + ZeroCopySend,
{
    match error {
        PublisherCreateError::ExceedsMaxSupportedPublishers => already_running(endpoint, service),
        e => PublishError::Ipc {
            service: service.name().to_string(),
            doing: "making its publisher",
            reason: e.to_string(),
        },
    }
}

fn already_running<P, H>(endpoint: &Endpoint, service: &PortFactory<Ipc, P, H>) -> PublishError
where
    P: iceoryx2::prelude::IceoryxSend + Debug + ?Sized,
    H: Debug + ZeroCopySend,
{
    let mut pid = None;
    service.dynamic_config().list_publishers(|publisher| {
        pid = publisher.node_id.pid::<Ipc>().ok().and_then(|pid| u32::try_from(pid.value()).ok());
        CallbackProgression::Stop
    });
    PublishError::AlreadyRunning { prefix: endpoint.prefix().into(), pid }
}
