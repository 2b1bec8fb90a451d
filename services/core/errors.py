"""The one exception tree.

::

    DentineError              .code, .exit_status
    ├── InputError            bad input: names the thing and the remedy
    │   ├── SettingsError     unknown option, wrong type, impossible combination
    │   ├── MeshError         open, inside-out or wrongly scaled geometry
    │   ├── CaptureInputError a frame or file is missing or malformed
    │   ├── UnknownJobError   no such job or artifact
    │   ├── JobStateError     the job's state does not allow what was asked
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
    ├── StoreError            what is on disk is not what was published
    │   ├── MissingStageError nothing published where something is expected
    │   ├── CorruptStoreError a shard is missing, truncated or altered
    │   └── FencedError       a newer attempt owns this stage
    ├── PlatformError         the machine lacks something: a library, a device
    │   └── DiskFullError     too little free disk for what was asked
    ├── RigError              the dome or a camera misbehaves; lights are dark when it is raised
    │   ├── InterlockError    e-stop or interlock open
    │   ├── ExposureLimitError photobiological limit, refused before anything is sent
    │   └── ReadbackError     the controller does not hold what was written
    ├── WorkerLostError       worker processes kept dying on a stage
    ├── NonFiniteError        a kernel produced NaN or Inf; count and place in the message
    └── JobCancelledError          cooperative cancel

Every message is one sentence that names the thing and the remedy. Every error survives pickling.
"""

from __future__ import annotations


class DentineError(Exception):
    """Root of the tree; ``code`` is stable and machine-readable."""

    code = "dentine-error"
    exit_status = 1

    def __init__(self, message: str) -> None:
        super().__init__(message)

    @property
    def message(self) -> str:
        """The sentence for the user."""
        return str(self.args[0])


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


class JobStateError(InputError):
    """The job's state, or an earlier submission, does not allow what was asked."""

    code = "job-state"


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


class PlatformError(DentineError):
    """The machine lacks a library or a device."""

    code = "platform-missing"
    exit_status = 4


class DiskFullError(PlatformError):
    """Too little free disk for what was asked."""

    code = "disk-full"


class RigError(DentineError):
    """The dome or a camera misbehaves. Whoever raises it has already switched the lights off."""

    code = "rig-fault"
    exit_status = 5


class InterlockError(RigError):
    """The interlock is open or the emergency stop is pressed."""

    code = "rig-interlock"


class ExposureLimitError(RigError):
    """A plan exceeds the photobiological limit; nothing was lit."""

    code = "rig-exposure-limit"


class ReadbackError(RigError):
    """The controller does not hold what was written to it."""

    code = "rig-readback"


class WorkerLostError(DentineError):
    """Worker processes kept dying on the same stage."""

    code = "worker-lost"
    exit_status = 7


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
