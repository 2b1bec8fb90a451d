"""A preparation that is interrupted anywhere and resumed leaves the same store as an undisturbed one, in one process
and on workers.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import random
import shutil
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import dask
import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster

from services.core.errors import FencedError
from services.core.placement import STAGES, UNLIMITED
from services.core.records import JobSpec
from services.core.stage import LocalContext, StageEvent
from services.core.store import StageWriter, write_atomic
from services.preprocess.quality.images import write_picture
from services.preprocess.stage import run
from services.preprocess.tasks import attempt_files, blocks
from services.preprocess.views.scratch import write_array
from services.tasks import record_files
from tests.support.folder_captures import write_folder, write_tree

KILLS = 50
IMPORTED = tuple(f"services.preprocess.{name}" for name in ("opening", "tasks.blocks", "tasks.plan", "tasks.summary"))
"""Modules that an attempt imports after it has begun."""


class KilledError(BaseException):
    """Exception that stands for a kill, because nothing catches it."""


def contents(root: Path) -> dict[str, Any]:
    """Every file of the published store, and its manifest without the number of the attempt."""
    folder = root / "prepared"
    files: dict[str, Any] = {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }
    manifest = json.loads(files.pop("manifest.json"))
    del manifest["attempt"]
    return {**files, "manifest": manifest}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A folder capture and the contents of its store after an undisturbed preparation."""
    capture, root = tmp_path_factory.mktemp("capture"), tmp_path_factory.mktemp("whole")
    write_folder(capture)
    run(JobSpec(capture=capture), LocalContext(root))
    return capture, contents(root)


def calls(monkeypatch: pytest.MonkeyPatch, at: int) -> Iterator[None]:
    """Raise ``KilledError`` at the n-th write; every write begins or ends with one of the patched calls."""
    count = 0

    def counted(original: Any, *, after: bool) -> Any:
        def wrapped(*args: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count == at and not after:
                raise KilledError
            made = original(*args, **options)
            if count == at:
                raise KilledError
            return made

        return wrapped

    with monkeypatch.context() as patch:
        patch.setattr(record_files, "write_atomic", counted(write_atomic, after=False))
        patch.setattr(attempt_files, "write_array", counted(write_array, after=True))
        patch.setattr(attempt_files.AttemptFiles, "array", counted(attempt_files.AttemptFiles.array, after=False))
        patch.setattr(blocks, "write_picture", counted(write_picture, after=True))
        patch.setattr(StageWriter, "publish", counted(StageWriter.publish, after=False))
        yield


def test_killed_at_any_write(
    undisturbed: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Every attempt is killed after a few writes until one ends; finding the view of one camera takes seven writes."""
    capture, expected = undisturbed
    attempts = 0
    for attempt in range(1, 20):
        attempts = attempt
        killing = calls(monkeypatch, at=8 + attempt % 2)
        next(killing)
        try:
            run(JobSpec(capture=capture), LocalContext(tmp_path, attempt))
        except KilledError:
            continue
        finally:
            next(killing, None)
        break
    assert attempts > 4
    assert contents(tmp_path) == expected
    assert not (tmp_path / attempt_files.WORK).exists()


@pytest.mark.parametrize("at", [1, 6, 12, 17])
def test_killed_once(
    undisturbed: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, at: int
) -> None:
    capture, expected = undisturbed
    killing = calls(monkeypatch, at)
    next(killing)
    with pytest.raises(KilledError):
        run(JobSpec(capture=capture), LocalContext(tmp_path, 1))
    next(killing, None)
    run(JobSpec(capture=capture), LocalContext(tmp_path, 2))
    assert contents(tmp_path) == expected


def test_what_was_made_of_other_images_is_made_anew(undisturbed: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    write_folder(tmp_path / "capture")
    told: list[StageEvent] = []

    def cut_off(event: StageEvent) -> None:
        told.append(event)
        if event.kind == "progress":
            raise KilledError

    with pytest.raises(KilledError):
        run(JobSpec(capture=tmp_path / "capture"), LocalContext(tmp_path / "job", 1, cut_off))
    image = tmp_path / "capture" / "front_left.npy"
    np.save(image, 2 * np.load(image))
    os.utime(image, ns=(0, 0))
    told.clear()
    run(JobSpec(capture=tmp_path / "capture"), LocalContext(tmp_path / "job", 2, told.append))
    assert sum(event.kind == "progress" for event in told) == 4
    assert not [event for event in told if "already" in event.message]
    run(JobSpec(capture=tmp_path / "capture"), LocalContext(tmp_path / "other", 1))
    assert contents(tmp_path / "job") == contents(tmp_path / "other")


def test_a_damaged_record_is_set_aside_with_a_word_and_its_image_made_again(
    undisturbed: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    capture, expected = undisturbed

    def cut_off(event: StageEvent) -> None:
        if event.kind == "progress":
            raise KilledError

    with pytest.raises(KilledError):
        run(JobSpec(capture=capture), LocalContext(tmp_path, 1, cut_off))
    (record,) = (tmp_path / attempt_files.WORK).glob("*/image-*.json")
    record.write_bytes(record.read_bytes()[:-9])
    told: list[str] = []
    run(JobSpec(capture=capture), LocalContext(tmp_path, 2, lambda event: told.append(event.message)))
    (note,) = [message for message in told if "damaged" in message]
    assert note.startswith(f"The record {record.parent.name}/{record.name} is damaged: it is kept as ")
    assert not [message for message in told if "already" in message]
    assert contents(tmp_path) == expected


def test_an_attempt_that_was_overtaken_records_nothing(
    undisturbed: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    capture, expected = undisturbed

    def overtake(event: StageEvent) -> None:
        if event.kind == "progress":
            run(JobSpec(capture=capture), LocalContext(tmp_path, 2))

    with pytest.raises(FencedError):
        run(JobSpec(capture=capture), LocalContext(tmp_path, 1, overtake))
    assert contents(tmp_path) == expected


def test_on_workers(undisturbed: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """The blocks of a stage that runs as a Dask task are tasks of the same cluster, and the store is the same."""
    capture, expected = undisturbed
    with (
        # Reset the settings of workers as separate processes, which earlier tests may have made in this process.
        dask.config.set({"distributed.worker.preload": []}),
        LocalCluster(
            n_workers=1,
            threads_per_worker=2,
            processes=False,
            dashboard_address=None,
            resources={STAGES: UNLIMITED},
        ) as cluster,
        Client(cluster) as client,
    ):
        stage = client.submit(
            run, JobSpec(capture=capture), LocalContext(tmp_path), key="prepare-1", resources={STAGES: 1}
        )
        stage.result(timeout=60)
        made = {str(row[0]) for row in cluster.scheduler.transition_log if str(row[0]).startswith("prepare-1-block-")}
    # There is one task per camera for its view, for two cameras, and then at least two blocks.
    assert len(made) >= 4
    assert contents(tmp_path) == expected


def prepare(capture: Path, root: Path, attempt: int) -> None:
    """Run one attempt; called in a process of its own."""
    run(JobSpec(capture=capture), LocalContext(root, attempt))


def start(capture: Path, root: Path, attempt: int) -> BaseProcess:
    """Start an attempt in a fork of a process that has imported all modules, so that kills strike work, not imports."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["distributed", "services.preprocess.stage", *IMPORTED, __name__])
    child = context.Process(target=prepare, args=(capture, root, attempt))
    child.start()
    return child


def ended(child: BaseProcess, within_s: float = math.inf) -> tuple[bool, float]:
    """Let a child run for a limited processor time, then kill it; returns whether it had ended, and the time it took.

    Processor time is used because it is the same on a busy machine. A child that failed fails the test.
    """
    process, used_s = psutil.Process(child.pid), 0.0
    while child.exitcode is None:
        with suppress(psutil.NoSuchProcess):
            used_s = max(used_s, sum(process.cpu_times()[:2]))
        if used_s >= within_s:
            child.kill()
            child.join()
            return False, used_s
        child.join(0.01)
    assert child.exitcode == 0
    return True, used_s


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_killed_at_random(tmp_path: Path) -> None:
    """With 12 frames of 2 megapixels, processes are killed by SIGKILL at random moments, 50 times in all."""
    rng, capture = random.Random(7), tmp_path / "capture"
    capture.mkdir()
    tree = write_folder(capture)
    size = (1632, 1224)
    tree["images"] = []
    tree["cameras"] = [{**tree["cameras"][0], "size": size, "K": [[120_000, 0, 816], [0, 120_000, 612], [0, 0, 1]]}]
    tree["lights"] = [{**tree["lights"][0], "name": f"l{k}"} for k in range(12)]
    noise = np.random.default_rng(1)
    for light in tree["lights"]:
        file = f"{light['name']}.npy"
        np.save(capture / file, noise.uniform(0.5, 1, (size[1], size[0], 2)).astype(np.float32))
        tree["images"].append({"camera": tree["cameras"][0]["name"], "light": light["name"], "file": file})
    write_tree(capture, tree)
    is_whole, whole_s = ended(start(capture, tmp_path / "whole", 1))
    assert is_whole
    expected = contents(tmp_path / "whole")
    kills, root = 0, tmp_path / "killed"
    while kills < KILLS:
        for attempt in range(1, 1000):
            is_whole, _ = ended(start(capture, root, attempt), rng.uniform(0, whole_s))
            if is_whole:
                break
            kills += 1
        assert contents(root) == expected
        shutil.rmtree(root)
