"""Every error Isodyn raises on purpose, drawn as one tree.

* IsodynError
    * InvalidInput              what the caller sent cannot be used; says where and why     (HTTP 422)
        * UnreadableSurvey      a survey file that cannot be read: line, column, reason
        * InvalidWindow         a window of samples that cannot be matched
        * IncompatibleFrames    a map cannot answer this frame or these components
    * NotFound                  no such object, or it belongs to somebody else              (HTTP 404)
    * Conflict                  the object's present state forbids it                       (HTTP 409)
        * QuotaExceeded         the organisation has as many of these as it may
    * PreconditionFailed        it is not what the caller has seen of it                    (HTTP 412)
    * TooLarge                  more bytes or samples than the limit                        (HTTP 413)
    * TooMany                   more requests or tracks than the limit, for now             (HTTP 429)
    * TooSlow                   a body that comes more slowly than can be waited for         (HTTP 408)
    * Unavailable               what Isodyn itself depends on cannot be reached, for now     (HTTP 503)
        * Overloaded            more work than can be done soon
    * JobCancelled              a job was asked to stop, and did
    * CorruptArtefact           stored bytes do not match their hash or their format

`app.api.problems` gives each its RFC 9457 document; nothing below the API knows about HTTP.
"""

from dataclasses import dataclass

__all__ = [
    "Conflict",
    "CorruptArtefact",
    "Fault",
    "IncompatibleFrames",
    "InvalidInput",
    "InvalidWindow",
    "IsodynError",
    "JobCancelled",
    "NotFound",
    "Overloaded",
    "PreconditionFailed",
    "QuotaExceeded",
    "TooLarge",
    "TooMany",
    "TooSlow",
    "Unavailable",
    "UnreadableSurvey",
]


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong: `location` says where (a JSON pointer, or `line 7, column bx_ut`), `reason` says why."""

    location: str
    reason: str


class IsodynError(Exception):
    """The root: `str(error)` is a sentence for a person that says what to do next."""

    def __init__(self, message: str, *faults: Fault) -> None:
        super().__init__(message)
        self.faults = faults


class InvalidInput(IsodynError):
    """What the caller sent cannot be used."""


class UnreadableSurvey(InvalidInput):
    """A survey file that cannot be read."""


class InvalidWindow(InvalidInput):
    """A window of samples that cannot be matched."""


class IncompatibleFrames(InvalidInput):
    """A map cannot answer this frame or these components."""


class NotFound(IsodynError):
    """No such object, or it belongs to somebody else."""


class Conflict(IsodynError):
    """The object's present state forbids it."""


class QuotaExceeded(Conflict):
    """The organisation has as many of these as it may: delete some, or have the limit raised."""


class PreconditionFailed(IsodynError):
    """It is not what the caller has seen of it."""


class TooLarge(IsodynError):
    """More bytes or samples than the limit."""


class TooMany(IsodynError):
    """More than the limit, for now; `retry_after_s` says when it may do, where that is known."""

    def __init__(self, message: str, *faults: Fault, retry_after_s: float | None = None) -> None:
        super().__init__(message, *faults)
        self.retry_after_s = retry_after_s


class Unavailable(IsodynError):
    """What Isodyn itself depends on cannot be reached, for now; `retry_after_s` says when to try again."""

    def __init__(self, message: str, *faults: Fault, retry_after_s: float = 5.0) -> None:
        super().__init__(message, *faults)
        self.retry_after_s = retry_after_s


class Overloaded(Unavailable):
    """More work than can be done soon; `retry_after_s` says when it may be less."""


class TooSlow(IsodynError):
    """A body that comes more slowly than can be waited for."""


class JobCancelled(IsodynError):
    """A job was asked to stop, and did."""


class CorruptArtefact(IsodynError):
    """Stored bytes do not match their hash or their format."""
