"""The one exception tree.

::

    DentineError              .code, .exit_status
    ├── InputError            bad input: names the thing and the remedy
    │   ├── SettingsError     unknown option, wrong type, impossible combination
    │   ├── MeshError         open, inside-out or wrongly scaled geometry
    │   ├── CaptureInputError a frame or file is missing or malformed
    │   ├── UnknownJobError   no such job or artifact
    │   ├── JobTooLargeError  more disk or memory than the machine has
    │   ├── UnknownPresetError no such set of options
    │   ├── UnknownWebhookError no such webhook or delivery
    │   ├── WebhookAddressError a webhook may not go there
    │   ├── MaskError         a mask by hand does not fit its image
    │   ├── UnknownMaskError  no such mask, camera or light
    │   ├── UnknownCalibrationError no such calibration
    │   ├── CalibrationTakenError a calibration's name means another content
    │   ├── UnknownDomeError  this server has no dome
    │   ├── DomeBusyError     a capture or a preflight has the dome
    │   ├── JobStateError     the job's state does not allow what was asked
    │   ├── UnknownTokenError no such token
    │   ├── BodyTooLargeError a request's body is over the limit
    │   ├── RangeError        a file has no such bytes
    │   ├── UnknownCaptureError no such capture or file of it
    │   ├── CaptureStateError the capture's state does not allow what was asked
    │   │   └── IncompleteCaptureError files are missing, corrupt or refused
    │   └── UploadError       a manifest, or bytes sent for it, cannot be accepted
    │       ├── TooLargeError     over a limit of size or number
    │       ├── CorruptUploadError what was received is not what the manifest says
    │       ├── OffsetError       bytes for another place than the next
    │       ├── ChecksumError     bytes of one request were altered on their way
    │       ├── LockedError       another request sends the same file
    │       └── ExpiredError      the capture was not committed in time
    ├── AccessError           the caller may not do this
    │   ├── UnauthenticatedError no token, or one that is unknown, expired or revoked
    │   ├── ScopeError        the token lacks the scope that the route needs
    │   ├── SetupLinkError    the link that makes the first token is void
    │   └── RateError         too many requests in a short time
    ├── StoreError            what is on disk is not what was published
    │   ├── MissingStageError nothing published where something is expected
    │   ├── CorruptStoreError a shard is missing, truncated or altered
    │   ├── FencedError       a newer attempt owns this stage
    │   └── ReadOnlyStoreError the store takes no write; the job waits for it
    ├── PlatformError         the machine lacks something: a library, a device
    │   └── SchedulerLostError the workers' scheduler does not answer; the job waits for it
    ├── RigError              the dome or a camera misbehaves; lights are dark when it is raised
    │   ├── RigUnreachableError the controller does not answer; its watchdog makes it dark
    │   ├── RigStoppedError   somebody pressed ALL OFF
    │   ├── InterlockError    e-stop or interlock open
    │   ├── ExposureLimitError photobiological limit, refused before anything is sent
    │   └── ReadbackError     the controller does not hold what was written
    ├── ResourceError         the machine ran out of something, or a process broke; evidence in ``evidence``
    │   ├── MemoryKillError   a process grew beyond its share of the memory
    │   ├── DiskFullError     a write found no space; nothing half-written is visible
    │   ├── CrashError        a process was ended by a signal or by itself
    │   └── WorkerLostError   worker processes kept dying on a stage
    ├── NonFiniteError        a kernel produced NaN or Inf; count and place in the message
    └── JobCancelledError          cooperative cancel

Every message is one sentence that names the thing and the remedy. Every error survives pickling.
"""

from __future__ import annotations

from collections.abc import Mapping

Evidence = Mapping[str, str | int | float | None]
"""What was measured when something failed, quantities with their units in the name."""


class DentineError(Exception):
    """Root of the tree; ``code`` is stable and machine-readable."""

    code = "dentine-error"
    exit_status = 1

    def __init__(self, message: str, evidence: Evidence | None = None) -> None:
        super().__init__(message, *(() if evidence is None else (dict(evidence),)))

    def __str__(self) -> str:
        return self.message

    @property
    def message(self) -> str:
        """The sentence for the user."""
        return str(self.args[0])

    @property
    def evidence(self) -> Evidence:
        """What was measured when it happened."""
        return self.args[1] if len(self.args) > 1 else {}


class InputError(DentineError):
    """Something the user gave is wrong."""

    code = "bad-input"
    exit_status = 2


class SettingsError(InputError):
    """An option is unknown, of the wrong type, or contradicts another."""

    code = "bad-settings"


class MeshError(InputError):
    """A mesh cannot bound a medium."""

    code = "bad-mesh"


class CaptureInputError(InputError):
    """A capture lacks a frame or holds one that cannot be read."""

    code = "bad-capture"


class UnknownJobError(InputError):
    """There is no such job, or it has no such artifact."""

    code = "job-unknown"


class JobTooLargeError(InputError):
    """A job needs more disk or memory than the machine has in all."""

    code = "job-too-large"


class UnknownPresetError(InputError):
    """There is no such set of options."""

    code = "preset-unknown"


class UnknownWebhookError(InputError):
    """There is no such webhook, or it has no such delivery."""

    code = "webhook-unknown"


class WebhookAddressError(InputError):
    """A webhook's address is malformed, or leads where the server may not go."""

    code = "webhook-address"


class JobStateError(InputError):
    """The job's state, or an earlier submission, does not allow what was asked."""

    code = "job-state"


class MaskError(InputError):
    """A mask by hand is no image of its camera's size."""

    code = "bad-mask"


class UnknownMaskError(InputError):
    """There is no such mask, or the capture has no such camera or light."""

    code = "mask-unknown"


class UnknownCalibrationError(InputError):
    """There is no such calibration."""

    code = "calibration-unknown"


class CalibrationTakenError(InputError):
    """The name of a calibration means another content already."""

    code = "calibration-taken"


class UnknownDomeError(InputError):
    """The server has no dome to work by hand."""

    code = "dome-unknown"


class DomeBusyError(InputError):
    """A capture or a preflight has the dome."""

    code = "dome-busy"


class UnknownTokenError(InputError):
    """There is no such token."""

    code = "token-unknown"


class BodyTooLargeError(InputError):
    """A request's body is longer than the server reads."""

    code = "body-too-large"


class RangeError(InputError):
    """A file does not have the bytes that were asked for."""

    code = "range-unsatisfiable"


class AccessError(DentineError):
    """The caller may not do what was asked."""

    code = "access-denied"
    exit_status = 8


class UnauthenticatedError(AccessError):
    """The caller gave no token, or one that is unknown, expired or revoked."""

    code = "unauthenticated"


class ScopeError(AccessError):
    """The caller's token lacks the scope that the route needs."""

    code = "scope-missing"


class SetupLinkError(AccessError):
    """The link that makes the first token was used, has expired, or never was."""

    code = "setup-link-void"


class RateError(AccessError):
    """The caller asked too often in a short time."""

    code = "rate-limited"


class UnknownCaptureError(InputError):
    """There is no such capture, or no such file in it."""

    code = "capture-unknown"


class CaptureStateError(InputError):
    """The capture's state, or an earlier request, does not allow what was asked."""

    code = "capture-state"


class IncompleteCaptureError(CaptureStateError):
    """A capture cannot be committed: files of it are missing, corrupt or refused."""

    code = "capture-incomplete"


class UploadError(InputError):
    """A manifest, or bytes sent for it, cannot be accepted."""

    code = "upload-refused"


class TooLargeError(UploadError):
    """A file, a capture or the number of files is over its limit."""

    code = "upload-too-large"


class CorruptUploadError(UploadError):
    """A file's received content is not what the manifest says; it was discarded."""

    code = "upload-corrupt"


class OffsetError(UploadError):
    """Bytes were sent for another place than the next one."""

    code = "upload-offset"


class ChecksumError(UploadError):
    """The bytes of one request do not have their stated checksum; they were discarded."""

    code = "upload-checksum"


class LockedError(UploadError):
    """Another request is sending the same file."""

    code = "upload-locked"


class ExpiredError(UploadError):
    """The capture was not committed in time; what was received is gone."""

    code = "upload-expired"


class StoreError(DentineError):
    """Stored data cannot be used."""

    code = "store-error"
    exit_status = 3


class MissingStageError(StoreError):
    """A stage's result is expected and none is published."""

    code = "stage-missing"


class CorruptStoreError(StoreError):
    """A published file is missing, truncated or altered."""

    code = "store-corrupt"


class FencedError(StoreError):
    """A newer attempt owns the stage; this one must not write."""

    code = "attempt-fenced"


class ReadOnlyStoreError(StoreError):
    """The store takes no write; nothing half-written is visible."""

    code = "store-read-only"


class PlatformError(DentineError):
    """The machine lacks a library or a device."""

    code = "platform-missing"
    exit_status = 4


class SchedulerLostError(PlatformError):
    """The scheduler of the workers does not answer, or went away; nothing was lost by it."""

    code = "scheduler-lost"


class RigError(DentineError):
    """The dome or a camera misbehaves. Whoever raises it has already switched the lights off."""

    code = "rig-fault"
    exit_status = 5


class RigUnreachableError(RigError):
    """The dome's controller does not answer. What it was last told may hold until its watchdog runs out."""

    code = "rig-unreachable"


class RigStoppedError(RigError):
    """Somebody pressed ALL OFF; the dome stays dark until it is started anew."""

    code = "rig-stopped"


class InterlockError(RigError):
    """The interlock is open or the emergency stop is pressed."""

    code = "rig-interlock"


class ExposureLimitError(RigError):
    """A plan exceeds the photobiological limit; nothing was lit."""

    code = "rig-exposure-limit"


class ReadbackError(RigError):
    """The controller does not hold what was written to it."""

    code = "rig-readback"


class ResourceError(DentineError):
    """The machine ran out of something, or one of its processes broke."""

    code = "resource-exhausted"
    exit_status = 7


class MemoryKillError(ResourceError):
    """A process grew beyond its share of the memory and was ended."""

    code = "memory-killed"


class DiskFullError(ResourceError):
    """A write found no space on the disk."""

    code = "disk-full"


class CrashError(ResourceError):
    """A process was ended by a signal, or ended by itself."""

    code = "process-crashed"


class WorkerLostError(ResourceError):
    """Worker processes kept dying on the same stage."""

    code = "worker-lost"


class NonFiniteError(DentineError):
    """A computation produced NaN or infinity."""

    code = "non-finite"
    exit_status = 6


class JobCancelledError(DentineError):
    """The job was cancelled between two frames or steps."""

    code = "cancelled"
    exit_status = 130


def error_of(code: str, message: str) -> DentineError | None:
    """The error of the tree that a code means, None if it means none."""
    kinds: list[type[DentineError]] = [DentineError]
    for kind in kinds:
        if kind.code == code:
            return kind(message)
        kinds.extend(kind.__subclasses__())
    return None
