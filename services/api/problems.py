"""Errors as RFC 9457 problem documents; ``code`` is the DentineError's own."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING, Self

from pydantic import Field

from services.core.errors import (
    BodyTooLargeError,
    CaptureStateError,
    ChecksumError,
    DentineError,
    DiskFullError,
    ExpiredError,
    InputError,
    JobStateError,
    JobTooLargeError,
    LockedError,
    OffsetError,
    PlatformError,
    RateError,
    ScopeError,
    TooLargeError,
    UnauthenticatedError,
    UnknownCaptureError,
    UnknownJobError,
    UnknownPresetError,
    UnknownTokenError,
    UnknownWebhookError,
)
from services.core.geometry import Record
from services.core.redaction import redacted

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from fastapi import FastAPI, Request, Response

MEDIA_TYPE = "application/problem+json"
CHECKSUM_MISMATCH = 460
"""Of the tus protocol, no registered status."""


class Problem(Record):
    """A problem document."""

    type: str = Field(description="urn:dentine:problem:<code>")
    title: str
    status: int
    detail: str = Field(description="one sentence that names the thing and the remedy")
    instance: str = Field(description="path of the request")
    code: str = Field(description="stable and machine-readable")

    @classmethod
    def of(cls, status: int, code: str, detail: str, instance: str, **more: object) -> Self:
        """The document for a status and one of our codes; ``more`` are the members of a subclass."""
        title = "Checksum Mismatch" if status == CHECKSUM_MISMATCH else HTTPStatus(status).phrase
        fields = {"detail": redacted(detail), "instance": redacted(instance), "code": code}
        return cls.model_validate({"type": f"urn:dentine:problem:{code}", "title": title, "status": status} | fields | more)


_STATUS: dict[type[DentineError], int] = {
    UnknownJobError: HTTPStatus.NOT_FOUND,
    UnknownPresetError: HTTPStatus.NOT_FOUND,
    UnknownTokenError: HTTPStatus.NOT_FOUND,
    UnknownWebhookError: HTTPStatus.NOT_FOUND,
    JobStateError: HTTPStatus.CONFLICT,
    JobTooLargeError: HTTPStatus.INSUFFICIENT_STORAGE,
    BodyTooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    UnauthenticatedError: HTTPStatus.UNAUTHORIZED,
    ScopeError: HTTPStatus.FORBIDDEN,
    RateError: HTTPStatus.TOO_MANY_REQUESTS,
    UnknownCaptureError: HTTPStatus.NOT_FOUND,
    CaptureStateError: HTTPStatus.CONFLICT,
    TooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    OffsetError: HTTPStatus.CONFLICT,
    ChecksumError: CHECKSUM_MISMATCH,
    LockedError: HTTPStatus.LOCKED,
    ExpiredError: HTTPStatus.GONE,
    InputError: HTTPStatus.UNPROCESSABLE_ENTITY,
    DiskFullError: HTTPStatus.INSUFFICIENT_STORAGE,
    PlatformError: HTTPStatus.SERVICE_UNAVAILABLE,
    DentineError: HTTPStatus.INTERNAL_SERVER_ERROR,
}


def status_of(problem: DentineError) -> int:
    """The HTTP status that an error means."""
    return next(status for kind, status in _STATUS.items() if isinstance(problem, kind))


def response_of(problem: DentineError, path: str, headers: dict[str, str] | None = None) -> Response:
    """The answer to a request that raised an error outside the application."""
    from starlette.responses import Response

    status = status_of(problem)
    return Response(Problem.of(status, problem.code, problem.message, path).model_dump_json(), status, headers, MEDIA_TYPE)


def refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What the description says of routes that may answer so, besides what the gate and a lost database answer everywhere."""
    return {status: {"model": Problem, "content": {MEDIA_TYPE: {}}} for status in sorted({401, 403, 429, 503, *statuses})}


def install(app: FastAPI) -> None:
    """Answer every error of the application with a problem document."""
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import Response
    from sqlalchemy.exc import DBAPIError
    from starlette.exceptions import HTTPException

    def answer(request: Request, status: int, code: str, detail: str, headers: Any = None) -> Response:
        return Response(Problem.of(status, code, detail, request.url.path).model_dump_json(), status, headers, MEDIA_TYPE)

    @app.exception_handler(DentineError)
    def _dentine(request: Request, problem: DentineError) -> Response:
        return answer(request, status_of(problem), problem.code, problem.message)

    @app.exception_handler(DBAPIError)
    def _database(request: Request, _problem: DBAPIError) -> Response:
        return answer(request, HTTPStatus.SERVICE_UNAVAILABLE, "database-lost", "The database does not answer; what is stored is kept, try again later.")

    @app.exception_handler(RequestValidationError)
    def _request(request: Request, problem: RequestValidationError) -> Response:
        return answer(request, HTTPStatus.UNPROCESSABLE_ENTITY, "bad-settings", _sentence(problem.errors()))

    @app.exception_handler(HTTPException)
    def _http(request: Request, problem: HTTPException) -> Response:
        status = HTTPStatus(problem.status_code)
        return answer(request, status, status.phrase.lower().replace(" ", "-"), f"{problem.detail}.", problem.headers)

    @app.exception_handler(Exception)
    def _unexpected(request: Request, _problem: Exception) -> Response:
        request_id = getattr(request.state, "request_id", "")
        detail = f"The server failed on this request; its log says why, under request {request_id}."
        return answer(request, HTTPStatus.INTERNAL_SERVER_ERROR, "internal-error", detail, {"X-Request-ID": request_id})


def _sentence(errors: Sequence[Any]) -> str:
    """The first validation error, by the option's name."""
    first = errors[0]
    name = ".".join(str(part) for part in first["loc"][1:]) or str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        return f"Unknown option '{name}'; GET /v1/options lists the known ones."
    return f"'{name}': {first['msg'].removeprefix('Value error, ')}; correct it."
