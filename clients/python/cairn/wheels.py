"""A base's driver tells the daemon of its wheels. The twin of `src/client/wheel.rs`."""

import math
import time

import iceoryx2 as iox2

from . import messages as m
from .errors import IpcError, SecondPublisher, TooManySubscribers, VersionMismatch

LOOK_EVERY = 0.05  # s between two looks for a daemon that is not there
GRACE = 0.5  # s in which a restarted daemon finds its service as it was
CLEAN_UP_EVERY = 2.0  # s between two looks for what killed processes left
PATIENCE = 10.0  # s after which something half made is an error
LONGEST_INTERVAL_NS = 500_000_000  # a message is the mean since the one before only if that is no longer ago


class WheelPublisher:
    """Made by `Client.wheels`. The daemon need not run yet, and may be restarted. One driver a daemon, used by one thread at a time.

        wheels = cairn.connect().wheels()
        while True:                                       # 20 to 100 times a second
            wheels.send(speed_mps, 0.0, turn_radps)       # means since the last time
    """

    def __init__(self, client):
        self._client = client
        self._open = None  # service, publisher
        self._looked = self._cleaned = -1e9
        self._alone = self._trouble = self._last_ns = None
        self._sequence = 0

    def send(self, linear_x, linear_y, angular_z, variance=(math.nan,) * 3):
        """The base's mean twist since the last call, up to now (REP-103: forward m/s, to the left m/s, turn to the left rad/s).

        True if a daemon is there. Never waits; raises SecondPublisher where another driver tells of the wheels already.
        """
        now = time.monotonic_ns()
        follows = self._last_ns is not None and now - self._last_ns <= LONGEST_INTERVAL_NS
        start = self._last_ns if follows else m.UNKNOWN_NS
        return self.publish(now, (linear_x, linear_y, angular_z), variance, start)

    def publish(self, timestamp_ns, twist, variance=(math.nan,) * 3, interval_start_ns=m.UNKNOWN_NS):
        """The same with stamps of the driver's own: CLOCK_MONOTONIC (`time.monotonic_ns()`) at the end and the start of the interval."""
        message = m.WheelOdometry(self._sequence, timestamp_ns, interval_start_ns, *twist)
        message.variance[:] = variance
        self._sequence += 1
        self._last_ns = timestamp_ns
        now = time.monotonic()
        if self._open is None:
            if now - self._looked < LOOK_EVERY:
                return False
            self._looked = now
            self._connect()
            if self._open is None:
                return False
        service, publisher = self._open
        try:
            publisher.send_copy(message)
            self._trouble = None
        except (iox2.SendError, iox2.LoanError) as error:
            self.close()
            self._troubled("sending", error)
            return False
        if now - self._cleaned >= CLEAN_UP_EVERY:
            self._cleaned = now
            self._client._shared_node().try_cleanup_dead_nodes()
        if service.dynamic_config.number_of_subscribers > 0:
            self._alone = None
            return True
        self._alone = self._alone or now
        if now - self._alone >= GRACE:
            self.close()
        return False

    def close(self):
        """Tells no more, so that another driver may; the next message connects again."""
        self._open = self._alone = None

    def _name(self):
        return f"{self._client.prefix}/wheel"

    def _connect(self):
        if not self._client._exists("wheel"):
            self._trouble = None
            return
        node = self._client._shared_node()
        try:
            service = node.service_builder(iox2.ServiceName.new(self._name())).publish_subscribe(m.WheelOdometry).open()
        except iox2.PublishSubscribeOpenError as error:
            return self._open_failed(str(error))
        if service.dynamic_config.number_of_publishers > 0:
            # A driver that was killed is none.
            node.try_cleanup_dead_nodes()
        if service.dynamic_config.number_of_publishers > 0:
            self._second()
        try:
            publisher = service.publisher_builder().backpressure_strategy(iox2.BackpressureStrategy.DiscardData).create()
        except iox2.PublisherCreateError as error:
            if "ExceedsMaxSupportedPublishers" in str(error):
                self._second()
            return self._troubled("making its publisher", error)
        self._open, self._alone = (service, publisher), None

    def _second(self):
        raise SecondPublisher(
            f"{self._name()} has a publisher already: only one driver may tell of the wheels, stop the other "
            f"(`iox2 service details {self._name()}` names it)"
        )

    def _open_failed(self, error):
        if error in ("DoesNotExist", "IsMarkedForDestruction", "Interrupt"):
            return
        if error in ("VersionMismatch", "IncompatibleTypes"):
            raise VersionMismatch(
                f"the daemon's {self._name()} carries another type than this program's {m.WheelOdometry.type_name()}, or is of another "
                "version of iceoryx2: install the same version of both"
            )
        if error == "ExceedsMaxNumberOfNodes":
            raise TooManySubscribers(f"{self._name()} is open in as many processes as can be already")
        self._troubled("opening it", error)

    def _troubled(self, doing, error):
        """A failure that should pass; an error when it does not."""
        now = time.monotonic()
        self._trouble = self._trouble or now
        if now - self._trouble >= PATIENCE:
            self._trouble = None
            raise IpcError(f"{self._name()}: {doing} failed: {error}") from None
