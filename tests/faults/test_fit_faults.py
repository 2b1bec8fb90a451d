"""The fit on a Dask cluster: passes for images and Jacobians run at once on two workers, and the result is the same
after a worker or a rendering process is killed.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client, LocalCluster

from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.stage import run
from services.tasks.executors import DaskExecutor, executor
from services.tasks.journal import read_entries as read_entries_of
from tests.support.prepared import FAKE, without_time, write_prepared
from tests.support.small_jaw import jaw_spec, write_prepared_jaw

pytestmark = pytest.mark.timeout(3600)
PATIENCE_S = 1200.0
"""Time limit of every wait, long enough for a busy machine; on an idle one, each test takes seconds."""
SLOW = "tests.support.fake_engine:SlowFakeEngine"
SLOW_MOUTH = "tests.support.fake_mouth:SlowFakeMouthEngine"


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with (
        dask.config.set({"distributed.worker.daemon": False}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def spec_for(root: Path) -> JobSpec:
    # One step a stage. That is six in all, with all passes but the advice, in four blocks for two workers.
    return JobSpec(
        capture=root, boundary="matched", dentin="known", samples_per_pixel=64, max_samples_per_pixel=128, max_steps=1,
        search_candidates=500, advise=False
    )  # fmt: skip


def fit_once(root: Path, engine: str, **options: Any) -> None:
    """Run the fit as the pipeline's stage task does, with a higher attempt number each time."""
    lease = root / "fit.lease"
    attempt = int(lease.read_text()) + 1 if lease.exists() else 1
    (root / "driver.pid").write_text(str(os.getpid()))
    run(spec_for(root).model_copy(update=options), LocalContext(root, attempt), engine=engine)


def answer(root: Path) -> dict[str, Any]:
    return without_time(open_stage(root, "fit", FitReport)[1])


def trace(root: Path) -> list[dict[str, Any]]:
    return list(json.loads((root / "fit" / "trace.json").read_text()))


def echo(_host: object, number: int) -> int:
    return number


def wait_for(_host: object, path: Path) -> str:
    until = time.monotonic() + PATIENCE_S
    while not path.exists() and time.monotonic() < until:
        time.sleep(0.01)
    return "waited" if path.exists() else "in vain"


def test_results_are_given_as_tasks_end(client: Client, tmp_path: Path) -> None:
    run_on = DaskExecutor(client, FAKE, "ends", tmp_path / "never")
    told = tmp_path / "told"
    ended = run_on.as_completed([("late", wait_for, (told,)), ("early", echo, (7,))])
    assert next(ended) == 7  # though it was the second, and the first waits for this line
    told.touch()
    assert list(ended) == ["waited"]


def test_tasks_of_one_name_are_not_taken_for_each_other(client: Client) -> None:
    run_on = DaskExecutor(client, FAKE, "names", Path("never"))
    assert run_on.gather([run_on.submit("same", echo, number) for number in range(5)]) == list(range(5))


def process(_host: object) -> int:
    return os.getpid()


def processes_of_tasks(root: Path) -> set[int]:
    with executor(root / "never", FAKE) as run_on:
        return set(run_on.gather([run_on.submit("process", process) for _ in range(20)]))


def test_blocks_run_only_where_their_stage_may(client: Client, tmp_path: Path) -> None:
    able = next(iter(client.scheduler_info()["workers"]))
    client.run(_claim, workers=[able])
    future = client.submit(processes_of_tasks, tmp_path, pure=False, resources={"STAGES": 1})
    (pid,) = client.run(os.getpid, workers=[able]).values()
    assert future.result(timeout=PATIENCE_S) == {pid}


@pytest.fixture(scope="module")
def undisturbed(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("undisturbed")
    write_prepared(root)
    client.submit(fit_once, root, SLOW, pure=False).result(timeout=PATIENCE_S)
    return root


@pytest.mark.dear(
    "It waits for the one undisturbed fit on a cluster, whose two hundred tasks are sent between processes."
)
def test_image_and_jacobian_tasks_run_on_two_workers_at_once(undisturbed: Path) -> None:
    rows = trace(undisturbed)
    together = [
        (a, b)
        for a in rows
        for b in rows
        if a["kind"] == "image" and b["kind"] == "jacobian" and a["step"] == b["step"] and a["worker"] != b["worker"]
        if min(a["end_s"], b["end_s"]) > max(a["start_s"], b["start_s"])
    ]
    assert together
    assert len({row["worker"] for row in rows}) == 2


def test_a_cluster_gives_the_answer_of_one_process(undisturbed: Path, tmp_path: Path) -> None:
    write_prepared(tmp_path)
    run(spec_for(tmp_path), LocalContext(tmp_path), engine=FAKE)
    assert answer(tmp_path) == answer(undisturbed)


@pytest.mark.slow
def test_gradient_descent_gives_a_cluster_the_answer_of_one_process(client: Client, tmp_path: Path) -> None:
    options: dict[str, Any] = {"solver": "adam", "adam_steps": 20}
    for name in ("cluster", "here"):
        write_prepared(tmp_path / name)
    client.submit(fit_once, tmp_path / "cluster", FAKE, pure=False, **options).result(timeout=PATIENCE_S)
    fit_once(tmp_path / "here", FAKE, **options)
    assert answer(tmp_path / "cluster") == answer(tmp_path / "here")
    assert "gradient" in {row["kind"] for row in trace(tmp_path / "cluster")}


@pytest.mark.slow
def test_fits_side_by_side_give_the_answer_that_each_gives_alone(
    client: Client, undisturbed: Path, tmp_path: Path
) -> None:
    roots = [tmp_path / "first", tmp_path / "second"]
    for root in roots:
        write_prepared(root)
    futures = [
        client.submit(_fit_with, root, {"priority": priority}, pure=False)
        for root, priority in zip(roots, ("low", "high"), strict=True)
    ]
    for future in futures:
        future.result(timeout=PATIENCE_S)
    assert [answer(root) for root in roots] == [answer(undisturbed)] * 2
    first, second = (trace(root) for root in roots)
    assert any(
        a["worker"] != b["worker"] and min(a["end_s"], b["end_s"]) > max(a["start_s"], b["start_s"])
        for a in first
        for b in second
    )


def _fit_with(root: Path, options: dict[str, Any]) -> None:
    fit_once(root, SLOW, **options)


async def _claim(dask_worker: Any) -> None:
    await dask_worker.set_resources(STAGES=1000)


@pytest.mark.dear("A worker, its renderer and all that they import start anew in mid-fit, whatever is fitted.")
def test_killed_worker_in_mid_fit_changes_nothing(client: Client, tmp_path: Path) -> None:
    # The driver's own worker dies. Dask runs the stage again on the other worker, as a new attempt that continues from
    # the journal. The photographs are too uneven for media alone, so that stains and robust weights have an effect, and
    # of every second pixel there are two blocks, one for each worker.
    options: dict[str, Any] = {"stains": True, "loss": "robust", "pixel_step": 2}
    killed, here = tmp_path / "killed", tmp_path / "here"
    for root in (killed, here):
        write_prepared(root, uneven=0.2, shadowed=0.05)
    future = client.submit(fit_once, killed, SLOW, pure=False, retries=2, **options)
    entries = await_entries(killed, 12)
    os.kill(int((killed / "driver.pid").read_text()), signal.SIGKILL)
    future.result(timeout=PATIENCE_S)
    fit_once(here, FAKE, **options)
    assert answer(killed) == answer(here)
    assert (killed / "fit.lease").read_text() == "2"
    assert len(read_entries(killed)) > entries
    assert answer(here)["instrument"]["green"], "the instrument's errors are no coordinates"
    # Rows of the trace are of the last attempt alone.
    assert {row["kind"] for row in trace(killed)} >= {"stain", "weights", "image", "jacobian"}


@pytest.mark.slow
def test_killed_helper_worker_changes_nothing(client: Client, undisturbed: Path, tmp_path: Path) -> None:
    # The other worker dies with the blocks it held; the driver goes on.
    write_prepared(tmp_path)
    future = client.submit(fit_once, tmp_path, SLOW, pure=False)
    await_entries(tmp_path, 5)
    driver = int((tmp_path / "driver.pid").read_text())
    os.kill(next(pid for pid in client.run(os.getpid).values() if pid != driver), signal.SIGKILL)
    future.result(timeout=PATIENCE_S)
    assert answer(tmp_path) == answer(undisturbed)
    assert (tmp_path / "fit.lease").read_text() == "1"


@pytest.mark.slow
def test_killed_renderer_is_started_again(client: Client, undisturbed: Path, tmp_path: Path) -> None:
    write_prepared(tmp_path)
    future = client.submit(fit_once, tmp_path, SLOW, pure=False)
    await_entries(tmp_path, 4)
    children = [pid for pid in client.run(_children).values() if pid]
    os.kill(children[0], signal.SIGKILL)
    future.result(timeout=PATIENCE_S)
    assert answer(tmp_path) == answer(undisturbed)


def fit_jaw_once(root: Path) -> None:
    lease = root / "fit.lease"
    attempt = int(lease.read_text()) + 1 if lease.exists() else 1
    (root / "driver.pid").write_text(str(os.getpid()))
    spec = jaw_spec(root, samples_per_pixel=64, max_samples_per_pixel=128, max_steps=2, search_candidates=500)
    run(spec, LocalContext(root, attempt), engine=SLOW_MOUTH)


@pytest.mark.slow
def test_killed_worker_in_mid_jaw_changes_nothing(client: Client, tmp_path: Path) -> None:
    # There are two teeth, one of them hidden. The driver's worker dies during the fits of single teeth, and the next
    # one during the joint fit.
    answers = []
    for name, kills in (("undisturbed", ()), ("killed", (3, 8))):
        root = tmp_path / name
        write_prepared_jaw(root, SLOW_MOUTH, (11, 12), hidden=(12,), samples=64)
        future = client.submit(fit_jaw_once, root, pure=False, retries=len(kills))
        for attempt, count in enumerate(kills, start=1):
            await_attempt(root, attempt)
            await_entries(root, count)
            os.kill(int((root / "driver.pid").read_text()), signal.SIGKILL)
        future.result(timeout=PATIENCE_S)
        assert (root / "fit.lease").read_text() == str(1 + len(kills))
        answers.append(answer(root))
    assert answers[0] == answers[1]
    assert answers[0]["instrument"]["green"], "the instrument's errors are no coordinates"


def test_renderers_end_with_their_worker(tmp_path: Path) -> None:
    from services.tasks.engine_host import ChildHost

    process = ChildHost(FAKE)._start()
    process.pipe.close()
    assert process._process.wait(timeout=PATIENCE_S) == 0


def read_entries(root: Path) -> dict[str, Any]:
    journal = root / "fit-checkpoint" / "journal.jsonl"
    return read_entries_of(journal) if journal.is_file() else {}


def await_entries(root: Path, count: int) -> int:
    deadline, journal = time.monotonic() + PATIENCE_S, root / "fit-checkpoint" / "journal.jsonl"
    while time.monotonic() < deadline:
        # Entries are lines, and are counted without being read: equations are long.
        found = journal.read_bytes().count(b"\n") if journal.is_file() else 0
        if found >= count:
            return found
        time.sleep(0.05)
    pytest.fail("the fit recorded nothing")


def await_attempt(root: Path, attempt: int) -> None:
    deadline, lease = time.monotonic() + PATIENCE_S, root / "fit.lease"
    while time.monotonic() < deadline:
        if lease.exists() and lease.read_text() == str(attempt):
            return
        time.sleep(0.05)
    pytest.fail(f"attempt {attempt} did not begin")


def _children(dask_worker: Any) -> int | None:
    return next(
        (plugin.host.pid for name, plugin in dask_worker.plugins.items() if name.endswith("SlowFakeEngine")), None
    )
