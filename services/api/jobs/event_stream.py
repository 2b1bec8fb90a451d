"""Event streams: one query finds which jobs have new events, and one read serves all streams that are equally far,
however many there are.
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
from typing import Any

import sqlalchemy as sql
from fastapi.responses import Response, StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event

from services.api.jobs.lifecycle import JobState
from services.api.jobs.repository import Repository
from services.client.errors import UnknownJobError

PERIOD_S = 0.2
PING_S = 15.0
"""A silent stream says that it lives this often, and looks whether its job still does."""
MAX_EVENTS = 1000
"""Read and sent at once."""
MAX_EPOCHS = 64
"""Remembered; a stream that was stalled for longer reads again."""
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
"""What the API's description says of a stream."""


UNBUFFERED = MappingProxyType({"X-Accel-Buffering": "no"})


class EventStream(StreamingResponse):
    """Server-sent events. FastAPI's own goes through three tasks per stream, and sends events one by one."""

    media_type = "text/event-stream"


@dataclass(frozen=True)
class EventBatch:
    """Events of a job after some id, as they are sent."""

    text: bytes
    last_id: int
    ended: JobState | None
    """The state in which the job ended, where these are its last events: a final one, or that it is being deleted."""
    is_full: bool
    """Whether more may have happened already."""

    @property
    def text_with_end(self) -> bytes:
        """As a stream of this job alone sends it."""
        if self.ended is None:
            return self.text
        return self.text + format_sse_event(event="end", data_str=f'"{self.ended}"')


@dataclass
class Epoch:
    """From one growth of the event table to the next.

    Streams walk from epoch to epoch, so that they miss none while they send.
    """

    number: int
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    jobs: frozenset[str] = frozenset()
    """Those that have new events, once it has ended."""
    reads: dict[tuple[str, int], asyncio.Task[EventBatch]] = field(default_factory=dict)
    """Under way, by job and the id after which they read."""


class EventFeed:
    """Follows the event table while ``run`` runs.

    Made before the first stream, so that no event falls between what that has read and what is looked for.

    Args:
        ask: calls a reader in a thread.
    """

    def __init__(
        self, repository: Repository, ask: Callable[[Callable[[], Any]], Coroutine[Any, Any, Any]] = asyncio.to_thread
    ) -> None:
        self._repository, self._ask, self._newest = repository, ask, repository.newest_event()
        self._epochs = deque([Epoch(0)], MAX_EPOCHS)

    async def run(self) -> None:
        """Look for growth until cancelled. Events come from other processes too, so only the table knows."""
        while True:
            newest: dict[str, int] = {}
            with suppress(sql.exc.SQLAlchemyError):  # streams outlast a database that is away for a while
                newest = await self._ask(partial(self._repository.newest_events, self._newest))
            if newest:
                self._newest = max(newest.values())
                ended = self._epochs[-1]
                self._epochs.append(Epoch(ended.number + 1))
                ended.jobs = frozenset(newest)
                ended.ended.set()
            await asyncio.sleep(PERIOD_S)

    async def answer(self, job_id: str, after: int) -> Response:
        """A job's events after an id as a response: a stream, or at once where the job has ended and few are left to
        tell.

        Raises:
            UnknownJobError: there is no such job.
        """
        epoch = self._epochs[-1]
        batch = await self._read(epoch, job_id, after)
        if batch.ended is not None:
            return Response(batch.text_with_end, headers=UNBUFFERED, media_type=EventStream.media_type)
        return EventStream(self.follow(job_id, after, (epoch, batch)), headers=UNBUFFERED)

    async def follow(
        self, job_id: str, after: int, opening: tuple[Epoch, EventBatch] | None = None
    ) -> AsyncIterator[bytes]:
        """A job's events after an id as server-sent events, replayed and then live, to the one with its final state or
        the job's deletion.

        Args:
            opening: was read already.
        """
        while True:
            epoch = self._epochs[-1] if opening is None else opening[0]
            try:
                batch = await self._read(epoch, job_id, after) if opening is None else opening[1]
            except UnknownJobError:
                return
            except sql.exc.SQLAlchemyError:
                batch = EventBatch(b"", after, ended=None, is_full=False)  # the next ping's look makes up for it
            opening = None
            if told := batch.text_with_end:
                yield told
            if batch.ended is not None:
                return
            after = batch.last_id
            while not batch.is_full:
                try:
                    async with asyncio.timeout(PING_S):
                        await epoch.ended.wait()
                except TimeoutError:
                    yield KEEPALIVE_COMMENT
                    break
                following = self._after(epoch)
                if job_id in epoch.jobs or following is None:
                    break
                epoch = following

    async def follow_several(self, after: Mapping[str, int]) -> AsyncIterator[bytes]:
        """Events of several jobs in one stream, each after an id, replayed and then live.

        The stream ends once all of them have ended or are deleted. A browser has six connections to a server; a stream
        for each job that it shows would leave none for anything else. Each job ends with event 'end', whose data names
        it and its final state, null for a job that is not there.
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
                    continue  # the next ping's look makes up for it
                if batch.text:
                    yield batch.text
                if batch.ended is not None:
                    yield end_of(job_id, batch.ended)
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
                following = self._after(epoch)
                due = reached.keys() & epoch.jobs if following is not None else set(reached)
                epoch = following or self._epochs[-1]
            due &= reached.keys()

    def _after(self, epoch: Epoch) -> Epoch | None:
        """The epoch after one that has ended; None if it is not remembered.

        Epochs do not know it, or a stalled stream would keep all that came after.
        """
        back = self._epochs[-1].number - epoch.number
        return self._epochs[-back] if back <= len(self._epochs) else None

    async def _read(self, epoch: Epoch, job_id: str, after: int) -> EventBatch:
        """Read what happened up to this epoch at least; whoever asks the same in the same epoch shares the read."""
        key = (job_id, after)
        if key not in epoch.reads:
            epoch.reads[key] = asyncio.create_task(self._ask(partial(_read, self._repository, job_id, after)))
            epoch.reads[key].add_done_callback(lambda _: epoch.reads.pop(key))
        return await asyncio.shield(epoch.reads[key])


def _read(repository: Repository, job_id: str, after: int) -> EventBatch:
    state = repository.get(job_id).state  # before its events: those of a final state are then among them
    events = repository.events_of(job_id).read(after, MAX_EVENTS)
    told = b"".join(format_sse_event(data_str=event.model_dump_json(), id=str(event.id)) for event in events)
    is_full = len(events) == MAX_EVENTS
    has_ended = (state.is_final or state is JobState.DELETING) and not is_full
    return EventBatch(told, events[-1].id if events else after, state if has_ended else None, is_full)


def end_of(job_id: str, state: JobState | None) -> bytes:
    """What a stream of several jobs tells of one that has ended, with no state of one that is not there."""
    return format_sse_event(event="end", data_str=json.dumps({"job": job_id, "state": state}))
