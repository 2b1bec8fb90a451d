"""Which wavelengths of a slab run whole on a worker, and which are shared by all."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.slab.options import SlabOptions
from services.slab.schedule import WavelengthTask, run_wavelengths
from tests.support.recording_executor import RecordingExecutor
from tests.support.small_slab import description, write_folder


def test_wavelengths_that_the_workers_do_not_divide_evenly_are_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.slab.schedule.fit_wavelength", lambda task, *_: task.place)
    root = write_folder(tmp_path / "cell", description())
    tasks = [
        WavelengthTask(root, nm, SlabOptions(), tmp_path / f"{nm:g}", tmp_path / "cancelled")
        for nm in (488.0, 532.0, 635.0)
    ]
    run_on = RecordingExecutor(2)
    assert list(run_wavelengths(run_on, tasks, workers=1)) == [task.place for task in tasks]
    assert run_on.ran == ["488", "532"]  # the last one is fitted here, and its blocks are tasks
