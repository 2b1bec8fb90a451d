"""The exception tree: errors that more than one package raises. Those of the server are in ``services.client.errors``.

::

    DentineError              .code, .exit_status
    ├── InputError            bad input: names the thing and the remedy
    │   ├── SettingsError     unknown option, wrong type, impossible combination
    │   ├── MeshError         open, inside-out or wrongly scaled geometry
    │   ├── CaptureInputError a frame or file is missing or malformed
    │   ├── ConsentError      the person has not agreed to what is asked for
    │   └── DomeBusyError     a capture or a preflight has the dome
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
"""Measured values that belong to an error, by name; the name of a quantity ends in its unit."""


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
        """Values measured when the error happened; empty where there are none."""
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


class ConsentError(InputError):
    """The photographed person has not agreed to an export, or no longer does."""

    code = "no-consent"


class DomeBusyError(InputError):
    """A capture or a preflight has the dome."""

    code = "dome-busy"


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
    """The dome or a camera misbehaves. The code that raises this error has already switched the lights off."""

    code = "rig-fault"
    exit_status = 5


class RigUnreachableError(RigError):
    """The dome's controller does not answer. Its last command may stay in effect until its watchdog expires."""

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
