"""A rendering process that grows, crashes or hangs gives a different error for each, with evidence, and the process
that waits for it survives.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster, get_worker

from services.core.errors import CrashError, JobCancelledError, MemoryKillError, ResourceError, WorkerLostError
from services.core.files.content_files import StoredFile
from services.tasks.engine_host import CancellableHost, ChildHost, EngineHost
from services.tasks.engine_process import memory_kills
from services.tasks.executors import DaskExecutor
from services.transport.scene.recipe import single_tooth
from services.transport.scene.recipe_files import write_recipe
from tests.support.prepared import sphere

BROKEN = "tests.support.broken_engine:BrokenEngine"
MIB = 2**20


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> StoredFile:
    return write_recipe(
        tmp_path_factory.mktemp("recipe"),
        single_tooth(sphere(4.0), None, np.array([[0.0, 0.0, 99.0]]), np.ones(1)),
    )


@pytest.fixture
def host() -> Iterator[ChildHost]:
    child = ChildHost(BROKEN)
    yield child
    child.close()


def test_a_process_that_outgrows_its_share_is_ended_with_evidence(recipe: StoredFile) -> None:
    host = ChildHost(BROKEN, memory_bytes=300 * MIB)
    with pytest.raises(MemoryKillError, match=r"grew beyond its 0\.3 GiB") as failure:
        host.call("grow", recipe, 4 * MIB)
    evidence = failure.value.evidence
    assert evidence["memory_limit_bytes"] == 300 * MIB
    # Memory is checked every quarter of a second and grows by at most 4 MiB in ten milliseconds, so it stays below one
    # and a half times the limit.
    assert 300 * MIB < int(evidence["peak_memory_bytes"] or 0) < 450 * MIB
    assert host.pid is None
    assert host.call("answer", recipe, 3) == 3
    host.close()


def test_an_exception_that_cannot_be_sent_is_told_in_words_and_the_process_stays(
    host: ChildHost, recipe: StoredFile
) -> None:
    assert host.call("answer", recipe, 1) == 1
    child = host.pid
    with pytest.raises(RuntimeError, match="PickyError: refused with code 7"):
        host.call("refuse", recipe)
    assert host.call("answer", recipe, 2) == 2
    assert host.pid == child


def test_closing_does_not_wait_for_a_kernel(recipe: StoredFile, tmp_path: Path) -> None:
    host, raised, started = ChildHost(BROKEN), list[Exception](), tmp_path / "started"

    def render() -> None:
        try:
            host.call("hang", recipe, str(started))
        except Exception as problem:
            raised.append(problem)

    rendering = threading.Thread(target=render, daemon=True)
    rendering.start()
    deadline_s = time.monotonic() + 60
    while not (started.exists() and started.read_text()):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    closing = threading.Thread(target=host.close, daemon=True)
    closing.start()
    closing.join(60)
    assert not closing.is_alive(), "it waits for the kernel, which takes an hour"
    rendering.join(60)
    assert [type(problem) for problem in raised] == [WorkerLostError]
    assert not psutil.pid_exists(int(started.read_text()))


def test_a_crash_is_told_by_its_signal_after_a_second_try(host: ChildHost, recipe: StoredFile) -> None:
    before = memory_kills()
    for number in (signal.SIGSEGV, signal.SIGKILL):  # a kill might also be one for memory
        with pytest.raises(CrashError, match=f"ended by {number.name} twice") as failure:
            host.call("die", recipe, int(number))
        assert failure.value.evidence["exit_status"] == -number
    assert memory_kills() == before
    assert host.call("answer", recipe, 4) == 4


def test_a_kill_that_the_system_counts_as_one_for_memory_is_told_as_that(
    host: ChildHost, recipe: StoredFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Only the system's counter of memory kills shows the cause; the kill itself is like any other.
    counted = iter([7, 8])
    monkeypatch.setattr("services.tasks.engine_process.memory_kills", lambda: next(counted))
    with pytest.raises(MemoryKillError, match="lack of memory"):
        host.call("die", recipe, int(signal.SIGKILL))


def test_evidence_survives_pickling() -> None:
    import pickle

    told = pickle.loads(pickle.dumps(MemoryKillError("Too large; take less.", {"peak_memory_bytes": 5})))
    assert isinstance(told, ResourceError)
    assert (str(told), told.message, dict(told.evidence)) == (
        "Too large; take less.",
        "Too large; take less.",
        {"peak_memory_bytes": 5},
    )


def test_a_cancel_ends_a_kernel_and_nothing_is_started_after_it(
    host: ChildHost, recipe: StoredFile, tmp_path: Path
) -> None:
    flag, started = tmp_path / "cancel", tmp_path / "started"

    def cancel() -> None:
        while not started.exists():
            time.sleep(0.01)
        flag.touch()

    canceller = threading.Thread(target=cancel)
    canceller.start()
    with pytest.raises(JobCancelledError):
        CancellableHost(host, flag).call("hang", recipe, str(started))
    canceller.join()
    assert not psutil.pid_exists(int(started.read_text()))
    with pytest.raises(JobCancelledError):
        CancellableHost(host, flag).call("answer", recipe, 1)
    assert host.pid is None
    assert CancellableHost(host, tmp_path / "other").call("answer", recipe, 1) == 1


def hang(host: EngineHost, recipe: StoredFile, started: str) -> None:
    host.call("hang", recipe, started)


def worker_pid(_host: EngineHost) -> int:
    return os.getpid() if get_worker() else 0


@pytest.mark.timeout(600)
def test_a_cancel_in_mid_kernel_leaves_the_worker_the_same_process(recipe: StoredFile, tmp_path: Path) -> None:
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as cluster,
        Client(cluster) as client,
    ):
        flag, started = tmp_path / "cancel", tmp_path / "started"
        run_on = DaskExecutor(client, BROKEN, "cancelled", flag)
        (before,) = run_on.gather([run_on.submit("pid", worker_pid)])
        with ThreadPoolExecutor(1) as waiting:
            pending = waiting.submit(run_on.gather, [run_on.submit("hang", hang, recipe, str(started))])
            while not started.exists():
                time.sleep(0.01)
            flag.touch()
            with pytest.raises(JobCancelledError):
                pending.result(timeout=300)
        free = DaskExecutor(client, BROKEN, "next", tmp_path / "no")
        assert free.gather([free.submit("pid", worker_pid)]) == [before]
