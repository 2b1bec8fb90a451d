"""The asynchronous client behaves like the blocking one: the same answers, errors and retries."""

from __future__ import annotations

import asyncio
import inspect
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from services.api.app import create_app
from services.client.client import AsyncClient, Client
from services.client.errors import JobStateError, UnknownJobError
from services.core.errors import CaptureInputError, PlatformError
from services.core.events import JobEvent
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from services.pipeline.event_log import EventAddress
from tests.support.cutting_proxy import cutting
from tests.support.live_server import serving
from tests.support.uploading import contents_of, write_capture

STEPS = 200
CUTS_BYTES = (100, 20_000, 20_500, 90_000, 150_001)
"""Positions at which an event stream of about 240 kB is cut."""


class Telling:
    """A job that reports some steps and ends when the test releases it; it fails while ``fails`` is set."""

    def __init__(self) -> None:
        self.ends, self.fails = threading.Event(), False

    def __call__(self, _spec: JobSpec, _folder: Path, events: EventAddress) -> None:
        with events.open() as log:
            attempt = log.begin_stage("fit")
            for step in range(STEPS):
                log.append(attempt, StageEvent(stage="fit", kind="step", message="x" * 1000, data={"step": step}))
        self.ends.wait()
        if self.fails:
            raise CaptureInputError("Frame c0_l3.npy is missing; copy it there.")


@pytest.fixture
def job() -> Telling:
    return Telling()


@pytest.fixture
def server(tmp_path: Path, job: Telling) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path / "data"), job)) as client:
        yield client
        job.ends.set()


async def followed(client: AsyncClient, job_id: str, after: int = 0) -> list[JobEvent]:
    return [event async for event in client.events(job_id, after)]


def test_both_clients_can_do_the_same() -> None:
    def signatures(kind: type[Any]) -> dict[str, list[str]]:
        return {
            name: list(inspect.signature(one).parameters)
            for name, one in inspect.getmembers(kind, inspect.isfunction)
            if not name.startswith("_")
        }

    assert signatures(AsyncClient) == signatures(Client)


def test_a_job_is_submitted_followed_and_retried(server: httpx.Client, job: Telling) -> None:
    job.fails = True
    job.ends.set()

    async def use() -> None:
        async with AsyncClient(str(server.base_url)) as client:
            spec = JobSpec(capture=Path("/"))
            created = await client.submit(spec, "once")
            assert (await client.submit(spec, "once"))["id"] == created["id"]
            with pytest.raises(JobStateError, match="other options"):
                await client.submit(JobSpec(capture=Path("/"), seed=7), "once")
            events = await followed(client, created["id"])
            assert [event.data["step"] for event in events if event.kind == "step"] == list(range(STEPS))
            detail = await client.get(created["id"])
            assert (detail["state"], detail["failure"]["code"]) == ("FAILED", "bad-capture")
            job.fails = False
            assert (await client.retry(created["id"]))["id"] == created["id"]
            more = await followed(client, created["id"], events[-1].id)
            assert more[0].id > events[-1].id
            assert [event.data["state"] for event in more if event.kind == "state"] == [
                "QUEUED",
                "RUNNING",
                "SUCCEEDED",
            ]
            assert (await client.get(created["id"]))["state"] == "SUCCEEDED"
            with pytest.raises(JobStateError):
                await client.cancel(created["id"])
            with pytest.raises(UnknownJobError, match="There is no job none"):
                await followed(client, "none")

    asyncio.run(use())


def test_several_jobs_are_followed_at_once(server: httpx.Client, job: Telling) -> None:
    async def use() -> None:
        async with AsyncClient(str(server.base_url)) as client:
            ids = [(await client.submit(JobSpec(capture=Path("/"), seed=seed)))["id"] for seed in range(3)]
            following = [asyncio.create_task(followed(client, one)) for one in ids]
            await asyncio.sleep(0)
            job.ends.set()
            for one, events in zip(ids, await asyncio.gather(*following), strict=True):
                assert {event.job for event in events} == {one}
                assert events[-1].data["state"] == "SUCCEEDED"

    asyncio.run(use())


@pytest.mark.parametrize("is_async", [True, False])
def test_events_survive_a_cut_connection_without_loss_or_repetition(
    server: httpx.Client, job: Telling, monkeypatch: pytest.MonkeyPatch, *, is_async: bool
) -> None:
    monkeypatch.setattr("services.client.client.RECONNECT_S", 0.01)
    job.ends.set()
    created = server.post("/v1/jobs", json={"capture": "/"}).json()["id"]

    async def follow(address: str) -> list[JobEvent]:
        async with AsyncClient(address) as client:
            return await followed(client, created)

    assert server.base_url.port is not None
    with Client(str(server.base_url)) as client:
        told = list(client.events(created))
    assert len([event for event in told if event.kind == "step"]) == STEPS
    with cutting(server.base_url.port, answer_cuts_bytes=CUTS_BYTES) as proxy:
        if is_async:
            assert asyncio.run(follow(proxy.address)) == told
        else:
            with Client(proxy.address) as client:
                assert list(client.events(created)) == told
        assert proxy.cut_count == len(CUTS_BYTES)


def test_a_folder_is_uploaded_through_cuts(server: httpx.Client, tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "mine")
    np.save(folder / "large.npy", np.random.default_rng(1).integers(0, 255, (10, 2**20), dtype=np.uint8))
    phases: list[str] = []

    async def upload(address: str) -> Any:
        async with AsyncClient(address) as client:
            return await client.upload(folder, lambda progress: phases.append(progress.phase), "p-1")

    assert server.base_url.port is not None
    with cutting(server.base_url.port, [3 * 2**20, 7 * 2**20]) as proxy:
        uploaded = asyncio.run(upload(proxy.address))
        assert proxy.cut_count == 2
    assert contents_of(tmp_path / "data" / uploaded.path) == contents_of(folder)
    assert set(phases) == {"hashing", "sending"}
    assert asyncio.run(upload(str(server.base_url))).sent_bytes == 0


def test_the_loop_is_free_while_a_folder_is_hashed(server: httpx.Client, tmp_path: Path) -> None:
    """Hashing waits for an event that only the event loop can set."""
    folder, is_free, was_free = write_capture(tmp_path / "mine"), threading.Event(), list[bool]()

    async def use() -> None:
        async with AsyncClient(str(server.base_url)) as client:
            uploading = asyncio.create_task(client.upload(folder, lambda _: was_free.append(is_free.wait(30))))
            await asyncio.sleep(0)
            is_free.set()
            await uploading

    asyncio.run(use())
    assert was_free
    assert all(was_free)


def test_no_server_is_the_same_sentence() -> None:
    async def ask() -> None:
        async with AsyncClient("http://127.0.0.1:9") as client:
            await client.get("x")

    with pytest.raises(PlatformError, match=r"http://127\.0\.0\.1:9 does not answer"):
        asyncio.run(ask())
