"""Streams of job events to clients.

One query finds the jobs that have new events, and one read serves all streams of a job that have reached the same
event, however many they are.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import sqlalchemy as sql
from fastapi.responses import Response, StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event

from services.api.http.problems import response_of
from services.api.http.stream_places import StreamPlaces
from services.api.jobs.repository import Repository
from services.api.tables.lifecycle import JobState
from services.client.errors import RateError, UnknownJobError
from services.core.settings import ConnectionLimits

if TYPE_CHECKING:
    from starlette.types import Receive, Scope, Send

PERIOD_S = 0.2
"""Time in s between two looks for new events."""
PING_S = 15.0
"""Time in s after which a stream without events sends a comment, to show that it is alive, and checks whether its job
still exists."""
MAX_EVENTS = 1000
"""Largest number of events that are read and sent at once."""
RETRY_AFTER_S = "10"
"""Time in s after which a client that holds too many streams may ask again."""
MAX_EPOCHS = 64
"""Number of epochs that are remembered. A stream that was stalled for longer reads its events again."""
EVENT_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {
            "text/event-stream": {
                "itemSchema": {
                    "type": "object",
                    "properties": {name: {"type": "string"} for name in ("data", "event", "id")},
                }
            }
        }
    }
}
"""OpenAPI responses of the routes that answer with a stream of events."""


UNBUFFERED = MappingProxyType({"X-Accel-Buffering": "no"})


class EventStream(StreamingResponse):
    """Response with server-sent events. FastAPI's own goes through three tasks per stream, and sends events one by
    one.
    """

    media_type = "text/event-stream"

    def __init__(self, content: AsyncIterator[bytes], places: StreamPlaces) -> None:
        super().__init__(content, headers=UNBUFFERED)
        self._places = places

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the stream, or a refusal where the caller holds as many as it may."""
        try:
            with self._places.taken(scope):
                await super().__call__(scope, receive, send)
        except RateError as problem:
            await response_of(problem, scope["path"], {"Retry-After": RETRY_AFTER_S})(scope, receive, send)


@dataclass(frozen=True)
class EventBatch:
    """Events of a job after some id, encoded as they are sent."""

    text: bytes
    last_id: int
    final_state: JobState | None
    """State in which the job ended, where these are its last events: a final state, or DELETING. Else None."""
    is_full: bool
    """Whether the batch is full, so that there may be more events already."""

    @property
    def text_with_end(self) -> bytes:
        """The batch as a stream of this job alone sends it, with event ``end`` after the last event."""
        if self.final_state is None:
            return self.text
        return self.text + format_sse_event(event="end", data_str=f'"{self.final_state}"')


@dataclass
class Epoch:
    """The period from one growth of the event table to the next.

    Streams walk from epoch to epoch, so that they miss no event while they send.
    """

    number: int
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    jobs: frozenset[str] = frozenset()
    """Jobs that have new events; known once the epoch has ended."""
    reads: dict[tuple[str, int], asyncio.Task[EventBatch]] = field(default_factory=dict)
    """Reads that are under way, by job and the id after which they read."""


class EventBroadcaster:
    """Follows the event table while ``run`` runs.

    It is created before the first stream, so that no event falls between those that the stream has read and those that
    ``run`` looks for.

    Args:
        run_in_thread: calls a function that reads the database in a thread.
        limits: how many streams a caller may hold.
    """

    def __init__(
        self,
        repository: Repository,
        run_in_thread: Callable[[Callable[[], Any]], Coroutine[Any, Any, Any]] = asyncio.to_thread,
        limits: ConnectionLimits | None = None,
    ) -> None:
        self.places = StreamPlaces(limits or ConnectionLimits())
        self._repository, self._run_in_thread, self._newest = repository, run_in_thread, repository.newest_event()
        self._epochs = deque([Epoch(0)], MAX_EPOCHS)

    async def run(self) -> None:
        """Look for new events until cancelled. Other processes append events too, so that only the table knows them
        all.
        """
        while True:
            newest: dict[str, int] = {}
            with suppress(sql.exc.SQLAlchemyError):  # streams go on after a database was away for a while
                newest = await self._run_in_thread(partial(self._repository.newest_events, self._newest))
            if newest:
                self._newest = max(newest.values())
                current = self._epochs[-1]
                self._epochs.append(Epoch(current.number + 1))
                current.jobs = frozenset(newest)
                current.ended.set()
            await asyncio.sleep(PERIOD_S)

    async def answer(self, job_id: str, after: int) -> Response:
        """Answer with a job's events after an id: with a stream, or with a complete response where the job has ended
        and its remaining events fit into one batch.

        Raises:
            UnknownJobError: there is no such job.
        """
        epoch = self._epochs[-1]
        batch = await self._read(epoch, job_id, after)
        if batch.final_state is not None:
            return Response(batch.text_with_end, headers=UNBUFFERED, media_type=EventStream.media_type)
        return EventStream(self.follow(job_id, after, (epoch, batch)), self.places)

    async def follow(
        self, job_id: str, after: int, first: tuple[Epoch, EventBatch] | None = None
    ) -> AsyncIterator[bytes]:
        """Yield a job's events after an id as server-sent events: first those of the past, then new ones as they come,
        up to the job's final state or its deletion.

        Args:
            first: the epoch and the first batch, where they were read already.
        """
        while True:
            epoch = self._epochs[-1] if first is None else first[0]
            try:
                batch = await self._read(epoch, job_id, after) if first is None else first[1]
            except UnknownJobError:
                return
            except sql.exc.SQLAlchemyError:
                batch = EventBatch(b"", after, final_state=None, is_full=False)  # the next ping's read makes up for it
            first = None
            if text := batch.text_with_end:
                yield text
            if batch.final_state is not None:
                return
            after = batch.last_id
            while not batch.is_full:
                try:
                    async with asyncio.timeout(PING_S):
                        await epoch.ended.wait()
                except TimeoutError:
                    yield KEEPALIVE_COMMENT
                    break
                following = self._next_epoch(epoch)
                if job_id in epoch.jobs or following is None:
                    break
                epoch = following

    async def follow_several(self, after: Mapping[str, int]) -> AsyncIterator[bytes]:
        """Yield the events of several jobs in one stream, each after an id: first those of the past, then new ones as
        they come.

        The stream ends once all jobs have ended or are deleted. A browser has six connections to a server; a stream for
        each job that it shows would leave none for anything else. Each job ends with event ``end``, whose data names
        the job and its final state, null for a job that does not exist.

        Args:
            after: id of the last event that the client knows, by job.
        """
        reached, due, epoch = dict(after), set(after), self._epochs[-1]
        while reached:
            for job_id in sorted(due):
                try:
                    batch = await self._read(epoch, job_id, reached[job_id])
                except UnknownJobError:
                    yield end_of(job_id, None)
                    del reached[job_id]
                    continue
                except sql.exc.SQLAlchemyError:
                    continue  # the next ping's read makes up for it
                if batch.text:
                    yield batch.text
                if batch.final_state is not None:
                    yield end_of(job_id, batch.final_state)
                    del reached[job_id]
                    continue
                reached[job_id] = batch.last_id
                if batch.is_full:
                    break
            else:
                due = set()
            while reached and not due:
                try:
                    async with asyncio.timeout(PING_S):
                        await epoch.ended.wait()
                except TimeoutError:
                    yield KEEPALIVE_COMMENT
                    due = set(reached)
                    break
                following = self._next_epoch(epoch)
                due = reached.keys() & epoch.jobs if following is not None else set(reached)
                epoch = following or self._epochs[-1]
            due &= reached.keys()

    def _next_epoch(self, epoch: Epoch) -> Epoch | None:
        """Return the epoch after one that has ended; None if it is no longer remembered.

        Epochs hold no reference to their successor, because a stalled stream would then keep all later epochs in
        memory.
        """
        distance = self._epochs[-1].number - epoch.number
        return self._epochs[-distance] if distance <= len(self._epochs) else None

    async def _read(self, epoch: Epoch, job_id: str, after: int) -> EventBatch:
        """Read a job's events up to this epoch at least. Callers that ask for the same events in the same epoch share
        one read.
        """
        key = (job_id, after)
        if key not in epoch.reads:
            epoch.reads[key] = asyncio.create_task(self._run_in_thread(partial(_read, self._repository, job_id, after)))
            epoch.reads[key].add_done_callback(lambda _: epoch.reads.pop(key))
        return await asyncio.shield(epoch.reads[key])


def _read(repository: Repository, job_id: str, after: int) -> EventBatch:
    state = repository.get(job_id).state  # read before the events, so that they include that of a final state
    events = repository.events_of(job_id).read(after, MAX_EVENTS)
    text = b"".join(format_sse_event(data_str=event.model_dump_json(), id=str(event.id)) for event in events)
    is_full = len(events) == MAX_EVENTS
    has_ended = (state.is_final or state is JobState.DELETING) and not is_full
    return EventBatch(text, events[-1].id if events else after, state if has_ended else None, is_full)


def end_of(job_id: str, state: JobState | None) -> bytes:
    """Encode event ``end`` of one job in a stream of several; ``state`` is None for a job that does not exist."""
    return format_sse_event(event="end", data_str=json.dumps({"job": job_id, "state": state}))
