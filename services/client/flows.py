"""The exchanges between client and server as flows, which have no connection: a client performs each step and sends its
result back into the flow.

A flow is a generator. It yields an ``HttpRequest``, a ``Pause`` or a ``BlockingCall``, is sent the answer or has the
error thrown into it, and returns the result. So the blocking and the asynchronous client share every request, retry
and error, and differ only in how they perform a step.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from services.client.errors import JobStateError, RateError, ScopeError, UnauthenticatedError, UnknownJobError, error_of
from services.core.errors import DentineError, InputError, PlatformError
from services.core.events import JobEvent

R = TypeVar("R")
RECONNECT_S = 1.0
RECONNECT_TRIES = 30


@dataclass(frozen=True)
class HttpRequest:
    """A request to be made; its answer is an ``httpx.Response``, whatever its status."""

    method: str
    path: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of ``httpx.Client.request``."""


@dataclass(frozen=True)
class Pause:
    """Time to let pass."""

    seconds: float


@dataclass(frozen=True)
class BlockingCall:
    """A call that takes a while, because it reads files."""

    call: Callable[[], Any]


Flow = Generator[HttpRequest | Pause | BlockingCall, Any, R]


def answer(server: str, request: HttpRequest) -> Flow[Any]:
    """Make a request and return the JSON of the answer.

    A GET request is repeated once if its connection breaks, because servers close idle connections.

    Raises:
        PlatformError: no server answers. DentineError: the error that the answer states.
    """
    import httpx

    try:
        try:
            response = yield request
        except (httpx.ReadError, httpx.RemoteProtocolError):
            if request.method != "GET":
                raise
            response = yield request
    except httpx.HTTPError as problem:
        raise PlatformError(
            f"Server {server} does not answer ({problem}); start it with dentine serve or give --server."
        ) from problem
    if response.is_error:
        raise error_in(response)
    document: dict[str, Any] = response.json()
    return document


class EventCursor:
    """Reads a job's event stream line by line, over as many connections as it takes, without loss or repetition."""

    def __init__(self, server: str, job_id: str, after: int) -> None:
        self._server, self._path, self._after = server, f"/jobs/{job_id}/events", after
        self._tries, self._ends = 0, False
        self.has_ended = False

    def request(self) -> HttpRequest:
        """The request for another connection, for the events that were not read yet."""
        self._ends = False
        return HttpRequest("GET", self._path, {"headers": {"Last-Event-ID": str(self._after)}})

    def read_line(self, line: str) -> JobEvent | None:
        """Read a line; return an event if the line completes one."""
        name, _, value = line.partition(": ")
        if name == "event":
            self._ends = value == "end"
        elif name == "data" and self._ends:
            self.has_ended = True
        elif name == "data":
            event = JobEvent.model_validate_json(value)
            self._after, self._tries = event.id, 0
            return event
        return None

    def count_failure(self, problem: Exception) -> None:
        """Count a broken connection.

        Raises:
            PlatformError: connections have broken too often in a row.
        """
        self._tries += 1
        if self._tries > RECONNECT_TRIES:
            raise PlatformError(
                f"Server {self._server} no longer answers; start it again, the job is kept."
            ) from problem


def error_in(response: Any) -> DentineError:
    """The error that the problem document in a response states."""
    try:
        problem = response.json()
        detail, code = str(problem["detail"]), str(problem["code"])
    except (ValueError, KeyError):
        detail, code = f"The server answered {response.status_code}; is it a dentine server?", ""
    if response.status_code == 401:
        detail += " The command line reads it from the variable DENTINE__CLIENT__TOKEN."
    if (known := error_of(code, detail)) is not None:
        return known
    kinds = {
        401: UnauthenticatedError,
        403: ScopeError,
        404: UnknownJobError,
        409: JobStateError,
        422: InputError,
        429: RateError,
    }
    return kinds.get(response.status_code, DentineError)(detail)
