"""A preparation takes the share of the workers that its priority gives, and its job's cancel ends its blocks."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from services.core.placement import WEIGHTS
from services.core.records import JobSpec
from services.core.stage import CANCEL_FLAG, LocalContext
from services.preprocess.stage import run
from services.tasks import executors
from services.tasks.executors import Executor
from tests.support.folder_captures import write_folder


def test_priority_and_cancel_reach_the_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Path, float]] = []
    original = executors.executor

    def executor(flag: Path, *, prefix: str, weight: float, **options: Any) -> AbstractContextManager[Executor]:
        asked.append((flag, weight))
        return original(flag, prefix=prefix, weight=weight, **options)

    monkeypatch.setattr(executors, "executor", executor)
    (tmp_path / "capture").mkdir()
    write_folder(tmp_path / "capture")
    run(JobSpec(capture=tmp_path / "capture", priority="high"), LocalContext(tmp_path / "job"))
    assert asked == [(tmp_path / "job" / CANCEL_FLAG, WEIGHTS["high"])]
    assert WEIGHTS["low"] < WEIGHTS["normal"] < WEIGHTS["high"]
