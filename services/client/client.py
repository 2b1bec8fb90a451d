"""Typed clients of the REST API: one that blocks, as the command line uses it, and one for asyncio.

Their requests are in ``requests``.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

from pydantic import SecretStr

from services.client.downloads import atomic_file, translated_transport_errors
from services.client.flows import RECONNECT_S, BlockingCall, EventCursor, Flow, HttpRequest, Pause, error_in
from services.client.requests import Requests
from services.core.events import JobEvent
from services.core.light.safety import FlashAcknowledgement
from services.core.records import JobSpec

if TYPE_CHECKING:
    from services.client.uploader import UploadProgress, UploadResult

R = TypeVar("R")


class Client:
    """A client of one server that blocks; a context manager."""

    def __init__(self, server: str, token: SecretStr | None = None) -> None:
        self._requests = Requests(server, token)
        connection = self._requests.connection()
        import httpx

        self._http = httpx.Client(**connection)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def submit(self, spec: JobSpec, key: str | None = None, name: str | None = None) -> dict[str, Any]:
        """Submit a job, with the label ``name`` if that is given; the same key and options give the same job."""
        return self.run(self._requests.submit(spec, key, name))

    def jobs(self, limit: int = 50, before: int | None = None, **only: Any) -> dict[str, Any]:
        """List at most ``limit`` jobs, newest first; ``only`` are the filters of GET /v1/jobs."""
        return self.run(self._requests.jobs(limit, before, **only))

    def delete(self, job_id: str) -> dict[str, Any]:
        """Delete the stored data of a job that has ended; return the receipt."""
        return self.run(self._requests.delete(job_id))

    def download(self, job_id: str, out: Path) -> int:
        """Write all files of a job into one zip; returns its size in bytes. A broken download leaves no file."""
        request = self._requests.archive(job_id)
        with (
            translated_transport_errors(self._requests.server),
            self._http.stream(request.method, request.path) as response,
        ):
            if response.is_error:
                response.read()
                raise error_in(response)
            with atomic_file(out) as stream:
                for piece in response.iter_bytes():
                    stream.write(piece)
        return out.stat().st_size

    def calibrations(self) -> list[dict[str, Any]]:
        """All stored calibrations with their states, newest first, without their content."""
        return self.run(self._requests.calibrations())

    def calibration(self, name: str) -> dict[str, Any]:
        """A stored calibration; its 'option' is what a job takes."""
        return self.run(self._requests.calibration(name))

    def keep_calibration(self, job_id: str, name: str) -> dict[str, Any]:
        """Store the calibration of a job under a name, which other jobs then use; a repeated call changes nothing."""
        return self.run(self._requests.keep_calibration(job_id, name))

    def upload(
        self, folder: Path, progress: Callable[[UploadProgress], None] | None = None, subject: str | None = None
    ) -> UploadResult:
        """Upload a folder capture and commit it.

        Files that the server knows are not sent; a broken upload resumes, also in a new process.

        Args:
            progress: called as files are hashed and sent.
            subject: pseudonymous label of the person.
        """
        return self.run(self._requests.upload(folder, progress, subject))

    def get(self, job_id: str) -> dict[str, Any]:
        """One job with its stages."""
        return self.run(self._requests.get(job_id))

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Ask a job to stop."""
        return self.run(self._requests.cancel(job_id))

    def retry(self, job_id: str, flashes: FlashAcknowledgement | None = None) -> dict[str, Any]:
        """Queue a failed or cancelled job again; ``flashes`` is its new acknowledgement of faster flashes."""
        return self.run(self._requests.retry(job_id, flashes))

    def workers(self) -> dict[str, Any]:
        """The workers, the present work of each, and the number of jobs that they have finished."""
        return self.run(self._requests.workers())

    def events(self, job_id: str, after: int = 0) -> Iterator[JobEvent]:
        """A job's events until it ends; survives a restart of the server without loss or repetition."""
        import httpx

        cursor = EventCursor(self._requests.server, job_id, after)
        while True:
            try:
                request = cursor.request()
                with self._http.stream(request.method, request.path, **request.options) as response:
                    if response.is_error:
                        response.read()
                        raise error_in(response)
                    for line in response.iter_lines():
                        if (event := cursor.read_line(line)) is not None:
                            yield event
                        if cursor.has_ended:
                            return
            except httpx.TransportError as problem:
                cursor.count_failure(problem)
            time.sleep(RECONNECT_S)

    def run(self, flow: Flow[R]) -> R:
        """Perform the steps of a flow and return its result."""
        with closing(flow):
            try:
                step = next(flow)
                while True:
                    try:
                        outcome = self._perform(step)
                    except Exception as problem:
                        step = flow.throw(problem)
                    else:
                        step = flow.send(outcome)
            except StopIteration as end:
                result: R = end.value
                return result

    def _perform(self, step: HttpRequest | Pause | BlockingCall) -> Any:
        match step:
            case HttpRequest(method, path, options):
                return self._http.request(method, path, **options)
            case Pause(seconds):
                return time.sleep(seconds)
            case BlockingCall(call):
                return call()


class AsyncClient:
    """A client of one server for asyncio; an asynchronous context manager. Files are hashed and read in threads."""

    def __init__(self, server: str, token: SecretStr | None = None) -> None:
        self._requests = Requests(server, token)
        connection = self._requests.connection()
        import httpx

        self._http = httpx.AsyncClient(**connection)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._http.aclose()

    async def submit(self, spec: JobSpec, key: str | None = None, name: str | None = None) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.submit(spec, key, name))

    async def jobs(self, limit: int = 50, before: int | None = None, **only: Any) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.jobs(limit, before, **only))

    async def delete(self, job_id: str) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.delete(job_id))

    async def download(self, job_id: str, out: Path) -> int:
        """See ``Client``."""
        request = self._requests.archive(job_id)
        with translated_transport_errors(self._requests.server):
            async with self._http.stream(request.method, request.path) as response:
                if response.is_error:
                    await response.aread()
                    raise error_in(response)
                with atomic_file(out) as stream:
                    async for piece in response.aiter_bytes():
                        stream.write(piece)
        return out.stat().st_size

    async def calibrations(self) -> list[dict[str, Any]]:
        """See ``Client``."""
        return await self.run(self._requests.calibrations())

    async def calibration(self, name: str) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.calibration(name))

    async def keep_calibration(self, job_id: str, name: str) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.keep_calibration(job_id, name))

    async def upload(
        self, folder: Path, progress: Callable[[UploadProgress], None] | None = None, subject: str | None = None
    ) -> UploadResult:
        """See ``Client``. ``progress`` may be called in another thread."""
        return await self.run(self._requests.upload(folder, progress, subject))

    async def get(self, job_id: str) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.get(job_id))

    async def cancel(self, job_id: str) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.cancel(job_id))

    async def retry(self, job_id: str, flashes: FlashAcknowledgement | None = None) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.retry(job_id, flashes))

    async def workers(self) -> dict[str, Any]:
        """See ``Client``."""
        return await self.run(self._requests.workers())

    async def events(self, job_id: str, after: int = 0) -> AsyncIterator[JobEvent]:
        """See ``Client``."""
        import httpx

        cursor = EventCursor(self._requests.server, job_id, after)
        while True:
            try:
                request = cursor.request()
                async with self._http.stream(request.method, request.path, **request.options) as response:
                    if response.is_error:
                        await response.aread()
                        raise error_in(response)
                    async for line in response.aiter_lines():
                        if (event := cursor.read_line(line)) is not None:
                            yield event
                        if cursor.has_ended:
                            return
            except httpx.TransportError as problem:
                cursor.count_failure(problem)
            await asyncio.sleep(RECONNECT_S)

    async def run(self, flow: Flow[R]) -> R:
        """See ``Client``."""
        with closing(flow):
            try:
                step = next(flow)
                while True:
                    try:
                        outcome = await self._perform(step)
                    except Exception as problem:
                        step = flow.throw(problem)
                    else:
                        step = flow.send(outcome)
            except StopIteration as end:
                result: R = end.value
                return result

    async def _perform(self, step: HttpRequest | Pause | BlockingCall) -> Any:
        match step:
            case HttpRequest(method, path, options):
                return await self._http.request(method, path, **options)
            case Pause(seconds):
                return await asyncio.sleep(seconds)
            case BlockingCall(call):
                return await asyncio.to_thread(call)
