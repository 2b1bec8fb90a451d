"""The errors that only the server and its clients raise: further leaves of the tree in ``services.core.errors``.

::

    InputError
    ├── UnknownJobError          no such job or artifact
    ├── JobTooLargeError         more disk or memory than the machine has
    ├── JobStateError            the job's state does not allow what was asked
    ├── UnknownPresetError       no such set of options
    ├── UnknownWebhookError      no such webhook or delivery
    ├── WebhookAddressError      a webhook may not go there
    ├── MaskError                a mask by hand does not fit its image
    ├── UnknownMaskError         no such mask, camera or light
    ├── UnknownCalibrationError  no such calibration
    ├── CalibrationTakenError    a calibration's name stands for other content
    ├── UnknownDomeError         this server has no dome
    ├── UnknownTokenError        no such token
    ├── BodyTooLargeError        a request's body is over the limit
    ├── RangeError               a file has no such bytes
    ├── UnknownCaptureError      no such capture or file of it
    ├── CaptureStateError        the capture's state does not allow what was asked
    │   └── IncompleteCaptureError   files are missing, corrupt or refused
    └── UploadError              a manifest, or bytes sent for it, cannot be accepted
        ├── TooLargeError            over a limit of size or number
        ├── CorruptUploadError       what was received is not what the manifest says
        ├── OffsetError              bytes for another place than the next
        ├── ChecksumError            bytes of one request were altered on their way
        ├── LockedError              another request sends the same file
        └── ExpiredError             the capture was not committed in time
    AccessError                  the caller may not do this
    ├── UnauthenticatedError     no token, or one that is unknown, expired or revoked
    ├── ScopeError               the token lacks the scope that the route needs
    ├── SetupLinkError           the link that makes the first token is void
    └── RateError                too many requests in a short time
"""

from __future__ import annotations

from services.core.errors import DentineError, InputError


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
    """The name of a calibration already stands for other content."""

    code = "calibration-taken"


class UnknownDomeError(InputError):
    """The server has no dome to work by hand."""

    code = "dome-unknown"


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


def error_of(code: str, message: str) -> DentineError | None:
    """Make the error of the tree that has a code; None if no error has it."""
    kinds: list[type[DentineError]] = [DentineError]
    for kind in kinds:
        if kind.code == code:
            return kind(message)
        kinds.extend(kind.__subclasses__())
    return None
