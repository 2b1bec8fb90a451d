"""A typed client of the REST API, as the command line uses it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pydantic import SecretStr

from services.api.events import JobEvent
from services.core.errors import DentineError, InputError, JobStateError, PlatformError, RateError, ScopeError, UnauthenticatedError, UnknownJobError, error_of
from services.core.records import JobSpec

if TYPE_CHECKING:
    from services.api.uploader import UploadProgress, UploadResult

RECONNECT_S = 1.0
RECONNECT_TRIES = 30


class Client:
    """Speaks to one server; a context manager."""

    def __init__(self, server: str, token: SecretStr | None = None) -> None:
        try:
            import httpx
        except ModuleNotFoundError as problem:
            raise PlatformError("The client's packages are not installed; install dentine[api].") from problem
        self._server = server
        headers = {} if token is None else {"Authorization": f"Bearer {token.get_secret_value()}"}
        self._http = httpx.Client(base_url=f"{server.rstrip('/')}/v1", headers=headers, timeout=httpx.Timeout(10.0, read=60.0), trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None) -> None:
        self._http.close()

    def submit(self, spec: JobSpec, key: str | None = None) -> dict[str, Any]:
        """Submit a job; the same key and options give the same job."""
        headers = {"Idempotency-Key": key} if key is not None else {}
        return self._ask("POST", "/jobs", json=spec.model_dump(mode="json", exclude_none=True), headers=headers)

    def upload(self, folder: Path, progress: Callable[[UploadProgress], None] | None = None, subject: str | None = None) -> UploadResult:
        """Upload a folder capture and commit it. Files that the server knows are not sent; a broken upload resumes, also in a new process.

        Args:
            progress: called as files are hashed and sent.
            subject: pseudonymous label of the person.
        """
        from services.api.uploader import Uploader

        return Uploader(self._http, self._ask, progress).upload(folder, subject)

    def get(self, job_id: str) -> dict[str, Any]:
        """One job with its stages."""
        return self._ask("GET", f"/jobs/{job_id}")

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Ask a job to stop."""
        return self._ask("POST", f"/jobs/{job_id}/cancel")

    def retry(self, job_id: str) -> dict[str, Any]:
        """Queue a failed or cancelled job again."""
        return self._ask("POST", f"/jobs/{job_id}/retry")

    def events(self, job_id: str, after: int = 0) -> Iterator[JobEvent]:
        """A job's events until it ends; survives a restart of the server without loss or repetition."""
        import httpx

        tries = 0
        while True:
            try:
                for event in self._stream(job_id, after):
                    if event is None:
                        return
                    after, tries = event.id, 0
                    yield event
            except httpx.TransportError as problem:
                tries += 1
                if tries > RECONNECT_TRIES:
                    raise PlatformError(f"Server {self._server} no longer answers; start it again, the job is kept.") from problem
            time.sleep(RECONNECT_S)

    def _stream(self, job_id: str, after: int) -> Iterator[JobEvent | None]:
        """Events of one connection; None when the job has ended."""
        with self._http.stream("GET", f"/jobs/{job_id}/events", headers={"Last-Event-ID": str(after)}) as response:
            if response.is_error:
                response.read()
                raise error_in(response)
            is_end = False
            for line in response.iter_lines():
                field, _, value = line.partition(": ")
                if field == "event":
                    is_end = value == "end"
                elif field == "data":
                    yield None if is_end else JobEvent.model_validate_json(value)

    def _ask(self, method: str, path: str, **options: Any) -> dict[str, Any]:
        import httpx

        try:
            response = self._http.request(method, path, **options)
        except httpx.HTTPError as problem:
            raise PlatformError(f"Server {self._server} does not answer ({problem}); start it with dentine serve or give --server.") from problem
        if response.is_error:
            raise error_in(response)
        answer: dict[str, Any] = response.json()
        return answer


def error_in(response: Any) -> DentineError:
    """The error that a problem document tells of."""
    try:
        problem = response.json()
        detail, code = str(problem["detail"]), str(problem["code"])
    except (ValueError, KeyError):
        detail, code = f"The server answered {response.status_code}; is it a dentine server?", ""
    if response.status_code == 401:
        detail += " The command line reads it from the variable DENTINE__CLIENT__TOKEN."
    if (known := error_of(code, detail)) is not None:
        return known
    kinds = {401: UnauthenticatedError, 403: ScopeError, 404: UnknownJobError, 409: JobStateError, 422: InputError, 429: RateError}
    return kinds.get(response.status_code, DentineError)(detail)
