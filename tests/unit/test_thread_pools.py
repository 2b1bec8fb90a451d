"""Threads for short pieces of work, done in order."""

from __future__ import annotations

import asyncio
import threading

import pytest

from services.api.http.thread_pools import ThreadPool


def test_work_that_hangs_does_not_keep_the_server_from_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.api.http.thread_pools.CLOSE_S", 0.01)
    pool, goes_on = ThreadPool(1), threading.Event()

    async def close_while_it_works() -> bool:
        work = asyncio.create_task(pool.run(goes_on.wait, 30))
        await asyncio.sleep(0)
        pool.close()
        assert not work.done()
        goes_on.set()
        return await work

    assert asyncio.run(close_while_it_works())


def test_what_is_under_way_is_awaited() -> None:
    pool, is_done = ThreadPool(1), threading.Event()

    async def close_after_asking() -> None:
        asked = asyncio.create_task(pool.run(is_done.set))
        await asyncio.sleep(0)
        pool.close()
        assert is_done.is_set()
        await asked

    asyncio.run(close_after_asking())
