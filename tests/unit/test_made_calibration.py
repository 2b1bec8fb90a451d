"""A calibration job whose asset holds no record is told in a sentence that shows no path of the server."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from services.api.calibrations.made import made_by
from services.api.jobs.lifecycle import JobState
from services.client.errors import JobStateError
from services.core.results import AssetManifest
from services.core.store import StageWriter


def test_an_asset_without_a_record(tmp_path: Path) -> None:
    StageWriter(tmp_path, "asset", 1).publish(AssetManifest(files=()))
    job = SimpleNamespace(id="j1", spec=SimpleNamespace(kind="calibration"), state=JobState.SUCCEEDED)
    jobs: Any = SimpleNamespace(repository=SimpleNamespace(get=lambda _id: job), folder=lambda _id: tmp_path)
    with pytest.raises(JobStateError, match=r"^Job j1 published no calibration\.json; submit it again\.$"):
        made_by(jobs, "j1")
