"""Errors as RFC 9457 problem documents; ``code`` is that of the ``DentineError``."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING, Self
from urllib.parse import quote

from pydantic import Field

from services.client.errors import (
    BodyTooLargeError,
    CalibrationTakenError,
    CaptureStateError,
    ChecksumError,
    ExpiredError,
    JobStateError,
    JobTooLargeError,
    LockedError,
    OffsetError,
    RangeError,
    RateError,
    ScopeError,
    SetupLinkError,
    TooLargeError,
    UnauthenticatedError,
    UnknownCalibrationError,
    UnknownCaptureError,
    UnknownDomeError,
    UnknownJobError,
    UnknownMaskError,
    UnknownPresetError,
    UnknownTokenError,
    UnknownWebhookError,
)
from services.core.errors import (
    ConsentError,
    DentineError,
    DiskFullError,
    DomeBusyError,
    ExposureLimitError,
    InputError,
    InterlockError,
    PlatformError,
    RigError,
    RigStoppedError,
    RigUnreachableError,
)
from services.core.files.validation import remedied
from services.core.geometry import Record
from services.core.redaction import redacted
from services.pipeline.database import is_full

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from fastapi import FastAPI, Request, Response

MEDIA_TYPE = "application/problem+json"
_PATH_CHARACTERS = "/:@!$&'()*+,;=~"
"""Characters that a URI's path may hold unescaped, besides letters and digits (RFC 3986, 3.3)."""
CHECKSUM_MISMATCH = 460
"""HTTP status of the tus protocol for a wrong checksum; it is not registered."""
_PHRASES = {
    413: "Request Entity Too Large",
    414: "Request-URI Too Long",
    416: "Requested Range Not Satisfiable",
    422: "Unprocessable Entity",
    CHECKSUM_MISMATCH: "Checksum Mismatch",
}
"""Reason phrases that Python 3.13 renames after RFC 9110, in their older form, and the one of tus. So the title and
code of a problem do not depend on the version of Python."""


def phrase_of(status: int) -> str:
    """Return the reason phrase of an HTTP status, the same on every version of Python."""
    return _PHRASES.get(status) or HTTPStatus(status).phrase


class Problem(Record):
    """A problem document."""

    type: str = Field(description="urn:dentine:problem:<code>")
    title: str
    status: int
    detail: str = Field(description="one sentence that names the thing and the remedy")
    instance: str = Field(description="path of the request, percent-encoded")
    code: str = Field(description="stable and machine-readable")

    @classmethod
    def of(cls, status: int, code: str, detail: str, path: str, **more: object) -> Self:
        """Build the document from a status, an error code and a decoded path; ``more`` are the fields of a subclass."""
        title = phrase_of(status)
        fields = {
            "detail": redacted(detail).encode(errors="backslashreplace").decode(),
            "instance": quote(redacted(path), safe=_PATH_CHARACTERS),
            "code": code,
        }
        return cls.model_validate(
            {"type": f"urn:dentine:problem:{code}", "title": title, "status": status} | fields | more
        )


_STATUS: dict[type[DentineError], int] = {
    UnknownJobError: HTTPStatus.NOT_FOUND,
    UnknownPresetError: HTTPStatus.NOT_FOUND,
    UnknownTokenError: HTTPStatus.NOT_FOUND,
    UnknownWebhookError: HTTPStatus.NOT_FOUND,
    UnknownDomeError: HTTPStatus.NOT_FOUND,
    UnknownCalibrationError: HTTPStatus.NOT_FOUND,
    UnknownMaskError: HTTPStatus.NOT_FOUND,
    CalibrationTakenError: HTTPStatus.CONFLICT,
    DomeBusyError: HTTPStatus.CONFLICT,
    JobStateError: HTTPStatus.CONFLICT,
    JobTooLargeError: HTTPStatus.INSUFFICIENT_STORAGE,
    BodyTooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    UnauthenticatedError: HTTPStatus.UNAUTHORIZED,
    ScopeError: HTTPStatus.FORBIDDEN,
    ConsentError: HTTPStatus.FORBIDDEN,
    SetupLinkError: HTTPStatus.FORBIDDEN,
    RateError: HTTPStatus.TOO_MANY_REQUESTS,
    UnknownCaptureError: HTTPStatus.NOT_FOUND,
    CaptureStateError: HTTPStatus.CONFLICT,
    TooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    OffsetError: HTTPStatus.CONFLICT,
    RangeError: HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
    ChecksumError: CHECKSUM_MISMATCH,
    LockedError: HTTPStatus.LOCKED,
    ExpiredError: HTTPStatus.GONE,
    InputError: HTTPStatus.UNPROCESSABLE_ENTITY,
    DiskFullError: HTTPStatus.INSUFFICIENT_STORAGE,
    InterlockError: HTTPStatus.CONFLICT,
    RigStoppedError: HTTPStatus.CONFLICT,
    ExposureLimitError: HTTPStatus.UNPROCESSABLE_ENTITY,
    RigUnreachableError: HTTPStatus.SERVICE_UNAVAILABLE,
    RigError: HTTPStatus.BAD_GATEWAY,
    PlatformError: HTTPStatus.SERVICE_UNAVAILABLE,
    DentineError: HTTPStatus.INTERNAL_SERVER_ERROR,
}


def status_of(problem: DentineError) -> int:
    """Return the HTTP status of an error: that of its class, else of the nearest base class in the table."""
    return next(_STATUS[kind] for kind in type(problem).__mro__ if kind in _STATUS)


def response_of(problem: DentineError, path: str, headers: dict[str, str] | None = None) -> Response:
    """Build the answer to a request from an error that does not reach the exception handlers of the application."""
    from starlette.responses import Response

    status = status_of(problem)
    return Response(
        Problem.of(status, problem.code, problem.message, path).model_dump_json(), status, headers, MEDIA_TYPE
    )


def database_lost(path: str) -> Response:
    """Build the answer to a request that cannot be served because the database does not answer."""
    from starlette.responses import Response

    detail = "The database does not answer; what is stored is kept, try again later."
    problem = Problem.of(HTTPStatus.SERVICE_UNAVAILABLE, "database-lost", detail, path)
    return Response(problem.model_dump_json(), problem.status, media_type=MEDIA_TYPE)


def refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of routes that may answer with these statuses. Those of browser protection,
    authentication and a lost database are added, as they may occur on every route.
    """
    chosen = sorted({400, 401, 403, 429, 503, *statuses})
    # Refer to the schema by its name: FastAPI would build a validator for every model of every route.
    content = {MEDIA_TYPE: {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}}
    return {status: {"description": phrase_of(status), "content": content} for status in chosen}


def install(app: FastAPI) -> None:
    """Make the application answer every error with a problem document, and say so in its OpenAPI description."""
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import Response
    from sqlalchemy.exc import DataError, DBAPIError
    from sqlalchemy.exc import TimeoutError as NoConnectionError
    from starlette.exceptions import HTTPException

    describe = app.openapi

    def describe_refusals() -> dict[str, Any]:
        described = describe()
        # Routes name this schema without declaring it. FastAPI gives other models of a problem document the media type
        # of the route; give them their own.
        described["components"]["schemas"][Problem.__name__] = Problem.model_json_schema()
        for operation in (one for path in described["paths"].values() for one in path.values()):
            for content in (response.get("content", {}) for response in operation["responses"].values()):
                for other in [name for name in content if MEDIA_TYPE in content and name != MEDIA_TYPE]:
                    content[MEDIA_TYPE] = content.pop(other)
        return described

    app.openapi = describe_refusals  # type: ignore[method-assign]

    def answer(request: Request, status: int, code: str, detail: str, headers: Any = None) -> Response:
        return Response(
            Problem.of(status, code, detail, request.scope["path"]).model_dump_json(), status, headers, MEDIA_TYPE
        )

    @app.exception_handler(DentineError)
    def _dentine(request: Request, problem: DentineError) -> Response:
        return answer(request, status_of(problem), problem.code, problem.message)

    @app.exception_handler(DataError)
    def _unstorable(request: Request, _problem: DataError) -> Response:
        detail = (
            "The request holds text or a number that the database does not take, such as the character NUL; leave it"
            " out."
        )
        return answer(request, HTTPStatus.UNPROCESSABLE_ENTITY, "bad-settings", detail)

    @app.exception_handler(NoConnectionError)
    @app.exception_handler(DBAPIError)
    def _database(request: Request, problem: DBAPIError | NoConnectionError) -> Response:
        if is_full(problem):
            detail = "The disk of the database is full, so nothing was recorded; free some space, then ask again."
            return answer(request, HTTPStatus.INSUFFICIENT_STORAGE, DiskFullError.code, detail)
        return database_lost(request.scope["path"])

    @app.exception_handler(RequestValidationError)
    def _request(request: Request, problem: RequestValidationError) -> Response:
        return answer(request, HTTPStatus.UNPROCESSABLE_ENTITY, "bad-settings", _sentence(problem.errors()))

    @app.exception_handler(HTTPException)
    def _http(request: Request, problem: HTTPException) -> Response:
        status = HTTPStatus(problem.status_code)
        if (
            status is HTTPStatus.BAD_REQUEST and problem.__cause__ is not None
        ):  # FastAPI answers 400 to a body that is not text, 422 to other malformed ones
            return answer(
                request, HTTPStatus.UNPROCESSABLE_ENTITY, "bad-settings", "The body cannot be read; send JSON in UTF-8."
            )
        return answer(
            request, status, phrase_of(status).lower().replace(" ", "-"), f"{problem.detail}.", problem.headers
        )

    @app.exception_handler(Exception)
    def _unexpected(request: Request, _problem: Exception) -> Response:
        request_id = getattr(request.state, "request_id", "")
        detail = f"The server failed on this request; its log says why, under request {request_id}."
        return answer(request, HTTPStatus.INTERNAL_SERVER_ERROR, "internal-error", detail, {"X-Request-ID": request_id})


def _sentence(errors: Sequence[Any]) -> str:
    """Describe the first validation error in one sentence that names the option."""
    first = errors[0]
    name = ".".join(str(part) for part in first["loc"][1:]) or str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        return f"Unknown option '{name}'; GET /v1/options lists the known ones."
    return f"'{name}': {remedied(first)}."
