"""Wakes event streams when the event table has grown: one query for all of them, however many there are."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import suppress

import sqlalchemy as sql

from services.api.events import JobEvent
from services.api.lifecycle import JobState
from services.api.repository import Repository

PERIOD_S = 0.2


class EventFeed:
    """Follows the newest event's id while ``run`` runs."""

    def __init__(self, newest_event: Callable[[], int]) -> None:
        self._newest_event = newest_event
        self._grown = asyncio.Condition()
        self.newest = 0

    async def run(self) -> None:
        """Look for growth until cancelled. Events come from other processes too, so only the table knows."""
        while True:
            newest = self.newest
            with suppress(sql.exc.SQLAlchemyError):  # streams outlast a database that is away for a while
                newest = await asyncio.to_thread(self._newest_event)
            if newest > self.newest:
                async with self._grown:
                    self.newest = newest
                    self._grown.notify_all()
            await asyncio.sleep(PERIOD_S)

    async def beyond(self, event_id: int) -> None:
        """Wait until some event is newer than this one."""
        async with self._grown:
            await self._grown.wait_for(lambda: self.newest > event_id)


async def follow(repository: Repository, feed: EventFeed, job_id: str, after: int) -> AsyncIterator[JobEvent | JobState]:
    """A job's events after an id, replayed and then live, and its final state once it has ended and all is told."""
    log = repository.events_of(job_id)
    while True:
        seen = feed.newest
        state = (await asyncio.to_thread(repository.get, job_id)).state
        while events := await asyncio.to_thread(log.read, after):
            for event in events:
                yield event
            after = events[-1].id
        if state.is_final:
            yield state
            return
        await feed.beyond(seen)
