"""Event streams from a real event table that grows while they are read."""

from __future__ import annotations

import asyncio
import gc
import json
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sql

from services.api.jobs import event_stream
from services.api.jobs.event_stream import Epoch, EventBroadcaster
from services.api.jobs.records import Lease
from services.api.jobs.repository import Repository
from services.api.tables.lifecycle import Trigger
from services.core.records import JobSpec
from services.core.stage import StageEvent
from tests.support.empty_database import empty_database

STREAMS, STEPS = 40, 60


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Repository]:
    monkeypatch.setattr(event_stream, "PERIOD_S", 0.002)
    repository = Repository(empty_database(tmp_path / "jobs.sqlite"))
    yield repository
    repository.close()


def start(repository: Repository, seed: int = 1) -> Lease:
    return repository.lease(repository.create(JobSpec(capture=Path("/"), seed=seed), key=None).job.id, "test", 60.0)


def work(repository: Repository, lease: Lease) -> None:
    log = repository.events_of(lease.job.id)
    for step in range(STEPS):
        log.append(1, StageEvent(stage="fit", kind="step", message=f"Step {step}."))
    repository.settle(lease, Trigger.SUCCEED)


@contextmanager
def working(repository: Repository, *leases: Lease) -> Iterator[None]:
    """Jobs that work during the block.

    All have ended when the block ends; a job still writing would keep a connection open after the repository closes.
    """
    with ThreadPoolExecutor(len(leases)) as threads:
        ends = [threads.submit(work, repository, lease) for lease in leases]
        yield
    for end in ends:
        end.result()


@asynccontextmanager
async def running(repository: Repository) -> AsyncIterator[EventBroadcaster]:
    one = EventBroadcaster(repository)
    task = asyncio.create_task(one.run())
    yield one
    task.cancel()


async def listen(events: AsyncIterator[bytes], pause_s: float) -> str:
    told = b""
    async for text in events:
        told += text
        await asyncio.sleep(pause_s)
    return told.decode()


def ids_of(text: str) -> list[int]:
    return [int(line.removeprefix("id: ")) for line in text.splitlines() if line.startswith("id: ")]


def test_every_stream_is_told_everything_once_and_in_order_however_slow_it_is(repository: Repository) -> None:
    lease, other = start(repository), start(repository, seed=2)

    async def watch() -> list[str]:
        async with running(repository) as one, asyncio.TaskGroup() as group:
            tasks = [
                group.create_task(listen(one.follow(lease.job.id, 0), 0.001 * (number % 7)))
                for number in range(STREAMS)
            ]
        return [task.result() for task in tasks]

    with working(repository, other, lease):
        texts = asyncio.run(watch())
    stored = [event.id for event in repository.events_of(lease.job.id).read()]
    assert len(stored) == STEPS + 4
    assert [ids_of(text) for text in texts] == [stored] * STREAMS
    assert all(text.endswith('event: end\ndata: "SUCCEEDED"\n\n') for text in texts)


def events_in(text: str) -> list[tuple[str, str]]:
    """Kind and data of each event of a stream."""
    told = [
        dict(line.split(": ", 1) for line in one.splitlines() if not line.startswith(":")) for one in text.split("\n\n")
    ]
    return [(one.get("event", "message"), one["data"]) for one in told if "data" in one]


@pytest.mark.parametrize("most", [1000, 7])
def test_one_stream_tells_of_several_jobs_everything_once_and_in_order(
    repository: Repository, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(event_stream, "MAX_EVENTS", most)
    monkeypatch.setattr(event_stream, "PING_S", 0.05)
    leases = [start(repository, seed) for seed in range(3)]
    known = repository.events_of(leases[2].job.id).read()[0].id
    places = {leases[0].job.id: 0, leases[2].job.id: known, "absent": 0}

    async def watch() -> str:
        async with running(repository) as one, asyncio.TaskGroup() as group:
            task = group.create_task(listen(one.follow_several(places), 0.001))
        return task.result()

    with working(repository, *leases):
        told = events_in(asyncio.run(watch()))
    for lease, after in ((leases[0], 0), (leases[2], known)):
        events = [json.loads(data) for kind, data in told if kind == "message"]
        assert [event["id"] for event in events if event["job"] == lease.job.id] == [
            one.id for one in repository.events_of(lease.job.id).read(after)
        ]
    ends = {json.loads(data)["job"]: json.loads(data)["state"] for kind, data in told if kind == "end"}
    assert ends == {leases[0].job.id: "SUCCEEDED", leases[2].job.id: "SUCCEEDED", "absent": None}
    assert leases[1].job.id not in {json.loads(data)["job"] for _, data in told}


def test_streams_that_are_equally_far_share_a_read(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    lease, read = start(repository), event_stream._read
    reads: list[Any] = []

    def counted(*arguments: Any) -> Any:
        reads.append(arguments)
        return read(*arguments)

    monkeypatch.setattr(event_stream, "_read", counted)
    work(repository, lease)

    async def watch() -> list[str]:
        async with running(repository) as one:
            return await asyncio.gather(*(listen(one.follow(lease.job.id, 0), 0.0) for _ in range(STREAMS)))

    assert len(set(asyncio.run(watch()))) == 1
    assert len(reads) == 1


def test_what_does_not_fit_into_one_read_follows_in_others(
    repository: Repository, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "MAX_EVENTS", 16)
    lease = start(repository)
    work(repository, lease)

    async def watch() -> str:
        async with running(repository) as one:
            return await listen(one.follow(lease.job.id, 0), 0.0)

    assert len(ids_of(asyncio.run(watch()))) == STEPS + 4 == 4 * 16


def test_a_silent_stream_says_that_it_lives(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_stream, "PING_S", 0.01)
    lease = start(repository)

    async def watch() -> bytes:
        async with running(repository) as one:
            events = one.follow(lease.job.id, repository.newest_event())
            return await anext(events) + await anext(events)

    assert asyncio.run(watch()) == b": ping\n\n: ping\n\n"


def test_a_stream_of_a_job_that_is_deleted_ends(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_stream, "PING_S", 0.01)
    leases = start(repository), start(repository, seed=2)

    async def watch() -> list[str]:
        one, after = EventBroadcaster(repository), repository.newest_event()
        streams = [one.follow(lease.job.id, after) for lease in leases]
        assert [await anext(stream) for stream in streams] == [b": ping\n\n"] * 2
        for lease in leases:
            repository.settle(lease, Trigger.SUCCEED)
            repository.apply(lease.job.id, Trigger.DELETE)
        repository.forget(leases[1].job.id, 0, 0, "")
        async with asyncio.timeout(10):
            return [await listen(stream, 0.0) for stream in streams]

    deleting, forgotten = asyncio.run(watch())
    assert deleting.endswith('event: end\ndata: "DELETING"\n\n')
    assert forgotten == ""


def test_a_stalled_stream_keeps_little_and_is_told_everything_later(
    repository: Repository, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "PERIOD_S", 0.0)
    monkeypatch.setattr(event_stream, "MAX_EPOCHS", 4)
    lease = start(repository)
    log = repository.events_of(lease.job.id)

    def count_epochs() -> int:
        gc.collect()
        return sum(isinstance(thing, Epoch) for thing in gc.get_objects())

    before = count_epochs()

    async def stall() -> str:
        async with running(repository) as one:
            stalled = one.follow(lease.job.id, 0)
            told = await anext(stalled)
            for step in range(20):
                log.append(1, StageEvent(stage="fit", kind="step", message=f"Step {step}."))
                while one._newest < repository.newest_event():
                    await asyncio.sleep(0.001)
            assert count_epochs() - before <= 4 + 1
            repository.settle(lease, Trigger.SUCCEED)
            return told.decode() + await listen(stalled, 0.0)

    assert ids_of(asyncio.run(stall())) == [event.id for event in log.read()]


def test_a_stream_outlasts_a_database_that_is_away_for_a_while(
    repository: Repository, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "PING_S", 0.01)
    lease, read, answers = start(repository), event_stream._read, iter([True, False, False])

    def read_or_fail(*arguments: Any) -> event_stream.EventBatch:
        if not next(answers, True):
            raise sql.exc.OperationalError("SELECT", None, OSError("away"))
        return read(*arguments)

    monkeypatch.setattr(event_stream, "_read", read_or_fail)

    async def watch() -> str:
        async with running(repository) as one, asyncio.timeout(10):
            stream = one.follow(lease.job.id, 0)
            told = await anext(stream)
            repository.settle(lease, Trigger.SUCCEED)
            return told.decode() + await listen(stream, 0.0)

    text = asyncio.run(watch())
    assert ids_of(text) == [event.id for event in repository.events_of(lease.job.id).read()]
    assert text.endswith('event: end\ndata: "SUCCEEDED"\n\n')
