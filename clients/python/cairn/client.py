"""Finds the daemon, reads, sleeps, and finds the next daemon. The twin of `src/client` in Rust.

Nothing is created before the daemon has made its services: a program of another user could lock the daemon's user out.
"""

import ctypes
import hashlib
import os
import pwd
import re
import stat
import threading
import time
from math import cos, sin

import iceoryx2 as iox2

from . import camera, values, wheels
from . import messages as m
from .errors import (
    CairnError,
    IpcError,
    NoDaemon,
    NoReply,
    OtherOwner,
    Refused,
    TooManyHeld,
    TooManySubscribers,
    VersionMismatch,
)

# iceoryx2 tells its errors to its log as well; IOX2_LOG_LEVEL brings the log back.
iox2.set_log_level_from_env_or(iox2.LogLevel.Fatal)

LOOK_EVERY = 0.05  # s between two looks for a daemon that is not there
SILENCE = 1.0  # s after which it is checked whether the daemon has died
GRACE = 0.5  # s in which a restarted daemon finds its services as they were
PATIENCE = 10.0  # s after which something half made is an error
NAP = 0.2  # s of sleep at most, so that Ctrl-C is noticed
FIRST = 0.4  # s to wait for the last message of a daemon that is there

_PUBLISH_SUBSCRIBE = 0
_COUNTER = ".global_mgmt"


def _user(uid):
    try:
        return f"{pwd.getpwuid(uid).pw_name} ({uid})"
    except KeyError:
        return str(uid)


class Client:
    """The services of one daemon, which need not run yet. Cheap; its subscriptions share one iceoryx2 node.

    `prefix`: which daemon; else CAIRN_PREFIX, else "cairn". CAIRN_IPC_ROOT and CAIRN_IPC_PREFIX are looked at as by the daemon.
    """

    def __init__(self, prefix=None):
        self.prefix = prefix or os.environ.get("CAIRN_PREFIX") or "cairn"
        if not re.fullmatch(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", self.prefix) or len(self.prefix) > 64:
            raise CairnError(
                f"prefix {self.prefix!r} cannot be used: 1 to 64 ASCII letters, digits and _ - . / with something on "
                "both sides of every /"
            )
        # iceoryx2's own configuration files are not read, as the daemon does not: all participants must agree.
        self._config = iox2.config.default()
        root = os.environ.get("CAIRN_IPC_ROOT")
        ipc_prefix = os.environ.get("CAIRN_IPC_PREFIX")
        self._config.global_cfg.creation_timeout = iox2.Duration.from_millis(50)
        if root:
            self._config.global_cfg.root_path = iox2.Path.new(root)
        if ipc_prefix:
            self._config.global_cfg.prefix = iox2.FileName.new(ipc_prefix)
        self._root = root or "/tmp/iceoryx2"
        self._ipc_prefix = ipc_prefix or "iox2_"
        self._node = None
        self._lock = threading.Lock()
        self._exists("pose")

    def poses(self):
        """Every pose, one a frame."""
        return Subscription(self, "pose", m.Pose, None, lambda s, _: values.Pose(_copied(m.Pose, s)))

    def map(self):
        """The sparse map, at most twice a second."""
        return Subscription(self, "map", iox2.Slice[m.Landmark], m.MapHeader, values.Map)

    def keyframes(self):
        """Keyframes, with the map."""
        return Subscription(self, "keyframes", iox2.Slice[m.Keyframe], m.KeyframesHeader, values.Keyframes)

    def graph(self):
        """What holds the map together, before each map. The daemon makes it only while somebody holds such a subscription."""
        return Subscription(self, "graph", iox2.Slice[m.GraphEdge], m.GraphHeader, values.Graph)

    def health(self):
        """The daemon's health, ten times a second."""
        return Subscription(self, "health", m.Health, None, lambda s, _: values.Health(_copied(m.Health, s)))

    def frames(self):
        """Grey pictures. The daemon copies pictures only while somebody holds such a subscription."""
        return Subscription(self, "frame", iox2.Slice[ctypes.c_uint8], m.FrameHeader, values.Frame)

    def features(self):
        """Corners, tracks and matched landmarks of pictures. The daemon makes them only while somebody holds such a subscription."""
        return Subscription(self, "features", iox2.Slice[m.Feature], m.FeaturesHeader, values.Features)

    def obstacles(self):
        """What stands around the robot and where the floor is free. The daemon makes scans only while somebody holds such a subscription."""
        return Subscription(self, "obstacles", m.Obstacles, None, lambda s, _: values.Obstacles(_copied(m.Obstacles, s)))

    def tags(self):
        """Where the map's tags are, before each map. The daemon tells it only while somebody holds such a subscription."""
        return Subscription(self, "tags", m.Tags, None, lambda s, _: values.Tags(_copied(m.Tags, s)))

    def encoded(self):
        """Every picture as it came from the camera, for recorders; a queue of a fifth of a second, two readers at a time."""
        return Subscription(self, "encoded", iox2.Slice[ctypes.c_uint8], m.EncodedHeader, values.Encoded)

    def wheels(self):
        """For the driver of the robot's base: tells the daemon of its wheels (see WheelPublisher)."""
        return wheels.WheelPublisher(self)

    def wait_for_daemon(self, timeout):
        """True once a daemon is there; False after `timeout` seconds."""
        end = time.monotonic() + timeout
        while not self._exists("pose"):
            if time.monotonic() >= end:
                return False
            time.sleep(LOOK_EVERY)
        return True

    def reset(self, timeout=10.0):
        """Drops the map and starts over."""
        return self.command("RESET", timeout=timeout)

    def save_trajectory(self, path, timeout=30.0):
        """Writes the trajectory so far (TUM format), as the daemon's user."""
        return self.command("SAVE_TRAJECTORY", os.path.abspath(path), timeout=timeout)

    def save_map(self, path, timeout=30.0):
        """Writes the sparse map (PLY), as the daemon's user."""
        return self.command("SAVE_MAP", os.path.abspath(path), timeout=timeout)

    def load_map(self, name, timeout=30.0):
        """Goes on in the stored map of this name (never a path); the map before is stored first."""
        return self.command("LOAD_MAP", name, timeout=timeout)

    def store_map(self, name="", timeout=30.0):
        """Stores the map now: in its own file, or a copy of it under a name that no map has yet."""
        return self.command("STORE_MAP", name, timeout=timeout)

    def new_map(self, name, timeout=30.0):
        """Begins a new map, which is kept under this name; the map before is stored first."""
        return self.command("NEW_MAP", name, timeout=timeout)

    def merge_map(self, name, timeout=30.0):
        """Makes what is in the stored map of this name a part of the present one as soon as a place of both is known; the answer comes before that."""
        return self.command("MERGE_MAP", name, timeout=timeout)

    def localise_only(self, on, timeout=10.0):
        """Whether frames are only located in the map, which stays as it is."""
        return self.command("LOCALISE", "on" if on else "off", timeout=timeout)

    def list_maps(self, timeout=10.0):
        """The stored maps, by name: (name, bytes, seconds since 1970 when it was written, whether it is the current one)."""
        maps = []
        for _ in range(100):  # a daemon keeps a hundred maps
            lines = self.command("LIST_MAPS", maps[-1][0] if maps else "", timeout=timeout).splitlines()
            for words in (line.split(" ") for line in lines if line != "..."):
                maps.append((words[0], int(words[1]), int(words[2]), words[3:] == ["current"]))
            if not lines or lines[-1] != "...":
                break
        return maps

    def copy_map(self, timeout=30.0):
        """Has a copy of the map written for the caller, who removes it: its path, and that of the map's own file ("" if it has none)."""
        copy, _, own = self.command("COPY_MAP", timeout=timeout).partition("\n")
        return copy, own

    def camera_controls(self, timeout=15.0):
        """What the camera offers of exposure, gain and focus (see CameraControl); Refused where it is no camera: a recording, the simulator."""
        return camera.controls(self.command("CAMERA_CONTROLS", timeout=timeout))

    def set_camera(self, control, value, timeout=15.0):
        """Sets the control of this name to a value in its unit, or has the camera decide ("auto"). It holds until the camera is opened anew."""
        return self.command("SET_CAMERA", f"{control} {value}", timeout=timeout)

    def camera_identity(self, timeout=15.0):
        """Which camera it is: (identity, as calibrations are found by, device file); Refused where it is no camera: a recording, the simulator."""
        identity, _, device = self.command("CAMERA_IDENTITY", timeout=timeout).partition(" ")
        return identity, device

    def keep_calibration(self, path, timeout=15.0):
        """Has the daemon keep a calibration file, which it must be able to read, for its camera; it is used from the next reset or start on."""
        return self.command("KEEP_CALIBRATION", os.path.abspath(path), timeout=timeout)

    def set_pose(self, x, y, yaw=0.0, z=0.0, timeout=10.0):
        """Says where the robot is now (map units, rad): poses and map are published accordingly from then on."""
        return self.command(
            "SET_POSE", position=(x, y, z), orientation=(0.0, 0.0, sin(yaw / 2), cos(yaw / 2)), timeout=timeout
        )

    def command(self, kind, path="", position=(0.0,) * 3, orientation=(0.0, 0.0, 0.0, 1.0), timeout=10.0):
        """Sends a command and returns the daemon's message; raises Refused, NoDaemon or NoReply."""
        text = path.encode()
        if len(text) > m.TEXT_LEN:
            raise CairnError(f"the path has {len(text)} bytes, a command carries {m.TEXT_LEN}")
        command = m.Command(kind=m.COMMANDS.get(kind, kind), path_len=len(text))
        command.path[: len(text)] = text
        command.position[:] = position
        command.orientation[:] = orientation
        end = time.monotonic() + timeout
        no_daemon = NoDaemon(f"no daemon with prefix {self.prefix!r} takes commands: is it running?")
        if not self._exists("pose"):
            raise no_daemon
        node = self._shared_node()
        # After a kill the old daemon's remains would look like a daemon.
        node.try_cleanup_dead_nodes()
        name = f"{self.prefix}/command"
        try:
            builder = node.service_builder(iox2.ServiceName.new(name))
            service = builder.request_response(m.Command, m.CommandReply).open()
        except iox2.RequestResponseOpenError as error:
            if str(error) in ("DoesNotExist", "IsMarkedForDestruction"):
                raise no_daemon from None
            if str(error) in ("IncompatibleRequestOrResponseType", "VersionMismatch"):
                raise VersionMismatch(
                    f"the daemon's {name} carries other types than this program's "
                    f"{m.Command.type_name()} and {m.CommandReply.type_name()}: install the same version of both"
                ) from None
            raise IpcError(f"{name}: opening it failed: {error}") from None
        if service.dynamic_config.number_of_servers == 0:
            raise no_daemon
        try:
            pending = service.client_builder().create().send_copy(command)
        except iox2.ClientCreateError as error:
            if "ExceedsMaxSupportedClients" in str(error):
                limit = service.static_config.max_clients
                raise TooManySubscribers(f"{name}: {limit} programs send commands already: try again") from None
            raise IpcError(f"{name}: sending the command failed: {error}") from None
        except (iox2.RequestSendError, iox2.LoanError) as error:
            raise IpcError(f"{name}: sending the command failed: {error}") from None
        while True:
            # In this order: the reply of a daemon that ends right after it is still there.
            connected = pending.is_connected
            try:
                reply = pending.receive()
            except iox2.ReceiveError as error:
                raise IpcError(
                    f"{name}: receiving the reply failed: {error}; the daemon may still carry the command out: look at health, then send it again"
                ) from None
            if reply is not None:
                break
            if not connected or time.monotonic() >= end:
                raise NoReply(f"the daemon with prefix {self.prefix!r} gave no reply in {timeout} s; it may still do it")
            time.sleep(0.002)
        reply = _copied(m.CommandReply, reply)
        message = bytes(reply.message[: min(reply.message_len, m.TEXT_LEN)]).decode("utf-8", "replace")
        if reply.code != 0:
            raise Refused(m.word(m.REPLIES, reply.code), message)
        return message

    def _exists(self, topic):
        """Whether the daemon has made a service; whose it is, too."""
        name = f"{_PUBLISH_SUBSCRIBE}{self.prefix}/{topic}".encode()
        file = f"{self._ipc_prefix}{hashlib.sha1(name).hexdigest()}.service"
        path = os.path.join(self._root, "services", file)
        us = os.geteuid()
        try:
            owner = os.stat(path).st_uid
        except PermissionError:
            path, owner = self._nearest(path)
        except OSError:
            return False
        if owner == us:
            return True
        raise OtherOwner(
            f"{path} belongs to user {_user(owner)} and this process runs as {_user(us)}, so nothing would arrive: "
            "run both as the same user (for instance `sudo -u` it)"
        )

    @staticmethod
    def _nearest(path):
        """The nearest parent that can be looked at, and its owner."""
        while path != "/":
            path = os.path.dirname(path)
            try:
                info = os.stat(path)
            except OSError:
                continue
            if stat.S_ISDIR(info.st_mode):
                return path, info.st_uid
        return path, 0

    def _shared_node(self):
        """Made once a daemon's service was seen: a node creates folders."""
        with self._lock:
            if self._node is None:
                builder = iox2.NodeBuilder.new().config(self._config).name(iox2.NodeName.new("cairn-client"))
                builder = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled)
                try:
                    self._node = builder.create(iox2.ServiceType.Ipc)
                except iox2.NodeCreationFailure as error:
                    why = self._squatter() or f"{error} (may this user write to {self._root} and /dev/shm, and is there room?)"
                    raise IpcError(f"{self._root}: creating an iceoryx2 node failed: {why}") from None
            return self._node

    def _squatter(self):
        """What lies in the place of iceoryx2's common counter in shared memory, after a node could not be made; with the cure. None where nothing does.

        It is the one file there whose name can be known beforehand: all users share it, and who made it first owns it.
        """
        us = os.geteuid()
        for entry in os.scandir("/dev/shm"):
            if not (entry.name.startswith(self._ipc_prefix) and entry.name.endswith(_COUNTER)):
                continue
            try:
                info = entry.stat(follow_symlinks=False)
            except OSError:
                continue
            if not stat.S_ISREG(info.st_mode):
                fault = "is no file"
            elif us not in (0, info.st_uid) and info.st_mode & 0o006 != 0o006:
                fault = "may not be written by others"
            else:
                fault = "does not hold what it should"
            return (
                f"{entry.path} belongs to user {_user(info.st_uid)} and {fault}, so nothing can use iceoryx2: end what uses iceoryx2, "
                f"`sudo rm -r {entry.path}`, start again (or give daemon and planners another CAIRN_IPC_PREFIX)"
            )
        return None


def _copied(structure, sample):
    return structure.from_buffer_copy(ctypes.string_at(sample.payload_ptr, ctypes.sizeof(structure)))


class Subscription:
    """Messages of one service in the order in which they were sent. Iterating sleeps until the next one and never ends by itself.

    Used by one thread at a time. Errors stay: waiting longer does not cure them.
    """

    def __init__(self, client, topic, payload, header, convert):
        self._client, self._topic, self._convert = client, topic, convert
        self._payload, self._header = payload, header
        self._open = None  # service, subscriber, listener
        self._waited = False  # for a first message, since it was opened
        self._latest = None
        self._looked = -1e9
        self._trouble = self._alone = None
        self._heard = 0.0

    @property
    def connected(self):
        """A daemon is there (it may still be silent: see the age of its messages)."""
        return self._open is not None and self._publishers() > 0

    def wait(self, timeout):
        """The oldest message not read yet, waiting for it up to `timeout` seconds; else None."""
        end = time.monotonic() + timeout
        while True:
            item = self.try_next()
            if item is not None:
                return item
            left = end - time.monotonic()
            if left <= 0:
                return None
            if self._open is None:
                time.sleep(min(left, LOOK_EVERY))
                continue
            nap = min(left, LOOK_EVERY if self._alone else NAP)
            try:
                self._open[2].timed_wait(iox2.Duration.from_secs_f64(nap))
            except iox2.ListenerWaitError as error:
                if "Interrupt" not in str(error):
                    self.close()
                    self._troubled("waiting", error)

    def latest(self):
        """The newest message there is; the same one again while no newer has come (look at its age), None while there is none.

        A subscription that has had none yet waits up to 0.4 s, once, for the last message of a daemon that is there.
        """
        self._drain()
        if self._latest is None and self.connected and not self._waited:
            self._waited = True
            self._latest = self.wait(FIRST)
            self._drain()
        return self._latest

    def _drain(self):
        while True:
            item = self.try_next()
            if item is None:
                return
            self._latest = item

    def __iter__(self):
        while True:
            item = self.wait(60.0)
            if item is not None:
                yield item
                del item  # what was yielded is the caller's

    def try_next(self):
        """The oldest message not read yet, without waiting, or None."""
        if self._open is None:
            now = time.monotonic()
            if now - self._looked < LOOK_EVERY:
                return None
            self._looked = now
            self._connect()
            if self._open is None:
                return None
        service, subscriber, _ = self._open
        try:
            sample = subscriber.receive()
        except iox2.ReceiveError as error:
            if "ExceedsMaxBorrows" in str(error):
                limit = service.static_config.subscriber_max_borrowed_samples
                raise TooManyHeld(
                    f"{limit} messages of {self._name()} are held already: drop one, or copy what is to be kept"
                ) from None
            self.close()
            self._troubled("receiving", error)
            return None
        if sample is None:
            self._tend()
            return None
        self._heard, self._alone, self._trouble = time.monotonic(), None, None
        return self._convert(sample, self._open)

    def close(self):
        """Lets go of the service; the next read connects again."""
        if self._header is not None:
            self._latest = None
        self._open = None  # what arrays still need lives on with them
        self._looked = time.monotonic()

    def _name(self):
        return f"{self._client.prefix}/{self._topic}"

    def _publishers(self):
        return self._open[0].dynamic_config.number_of_publishers

    def _tend(self):
        """Nothing was there to read: is the daemon still alive?"""
        now = time.monotonic()
        if self._publishers() > 0:
            self._alone = None
            if now - self._heard < SILENCE:
                return
            # Silent: if it was killed, somebody has to clear its remains away.
            self._heard = now
            self._client._shared_node().try_cleanup_dead_nodes()
            if self._publishers() > 0:
                return
        self._alone = self._alone or now
        if now - self._alone >= GRACE:
            self._alone = None
            self.close()

    def _connect(self):
        if not self._client._exists(self._topic):
            self._trouble = None
            return
        node = self._client._shared_node()
        name = iox2.ServiceName.new(self._name())
        builder = node.service_builder(name).publish_subscribe(self._payload)
        if self._header is not None:
            builder = builder.user_header(self._header)
        try:
            service = builder.open()
        except iox2.PublishSubscribeOpenError as error:
            return self._open_failed(str(error))
        try:
            subscriber = service.subscriber_builder().create()
        except iox2.SubscriberCreateError as error:
            if "ExceedsMaxSupportedSubscribers" in str(error):
                self._full(service.static_config.max_subscribers)
            return self._troubled("subscribing", error)
        try:
            listener = node.service_builder(name).event().open().listener_builder().create()
        except iox2.ListenerCreateError as error:
            if "ExceedsMaxSupportedListeners" in str(error):
                self._full(service.static_config.max_subscribers)
            return self._troubled("listening for its events", error)
        except iox2.EventOpenError as error:
            return self._troubled("opening its events", error)
        self._open = (service, subscriber, listener)
        self._waited = False
        self._heard, self._alone = time.monotonic(), None

    def _full(self, limit):
        raise TooManySubscribers(
            f"{self._name()} has its {limit} subscribers already: stop one of them "
            f"(`iox2 service details {self._name()}` lists them)"
        )

    def _open_failed(self, error):
        if error in ("DoesNotExist", "IsMarkedForDestruction", "Interrupt"):
            return
        if error == "VersionMismatch":
            raise VersionMismatch(
                f"the daemon's {self._name()} was made by another version of iceoryx2: install the same one as the daemon's"
            )
        if error == "IncompatibleTypes":
            element = self._payload if self._header is None else self._payload.__args__[0]
            ours = element.type_name() if hasattr(element, "type_name") else "u8"
            raise VersionMismatch(
                f"the daemon's {self._name()} carries {self._type_on_the_wire()}, this program was made for {ours}: "
                "install the same version of both"
            )
        if error == "ExceedsMaxNumberOfNodes":
            self._full(24)
        self._troubled("opening it", error)

    def _type_on_the_wire(self):
        details = iox2.Service.details(
            iox2.ServiceName.new(self._name()),
            self._client._config,
            iox2.MessagingPattern.PublishSubscribe,
            iox2.ServiceType.Ipc,
        )
        found = re.search(r'payload: TypeDetail \{.*?data: "([^"]*)".*?size: (\d+)', str(details), re.DOTALL)
        return f"{found[1]} of {found[2]} bytes" if found else "another type"

    def _troubled(self, doing, error):
        """A failure that should pass, because somebody is just making or clearing away things; an error when it does not."""
        now = time.monotonic()
        self._trouble = self._trouble or now
        if now - self._trouble >= PATIENCE:
            self._trouble = None
            raise IpcError(f"{self._name()}: {doing} failed: {error}") from None
