"""Why a client cannot go on, and what to do about it. A daemon that is not there is no error, except for commands."""


class CairnError(Exception):
    """Waiting does not cure it."""


class VersionMismatch(CairnError):
    """Daemon and program were built for different versions of a message, or of iceoryx2."""


class TooManySubscribers(CairnError):
    """All places at this service are taken."""


class TooManyHeld(CairnError):
    """More maps or pictures are held than the service allows."""


class OtherOwner(CairnError):
    """The daemon's files belong to another user: nothing would ever arrive."""


class SecondPublisher(CairnError):
    """Another process tells of the wheels already."""


class NoDaemon(CairnError):
    """No daemon took the command."""


class NoReply(CairnError):
    """The daemon did not answer in time; it may still carry the command out."""


class Refused(CairnError):
    """The daemon answered that it did not do it. `reply` says why: UNSUPPORTED, INVALID, FAILED or BUSY."""

    def __init__(self, reply, message):
        super().__init__(f"{reply}: {message}")
        self.reply = reply


class IpcError(CairnError):
    """iceoryx2 failed in a way that has no better name here."""
