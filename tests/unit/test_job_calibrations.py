"""A calibration job that names an asset without a record ends in a sentence that shows no path of the server."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from services.api.jobs.job_calibrations import calibration_of_job
from services.api.tables.lifecycle import JobState
from services.client.errors import JobStateError
from services.core.results import AssetManifest
from services.core.store import StageWriter


def test_an_asset_without_a_record(tmp_path: Path) -> None:
    StageWriter(tmp_path, "asset", 1).publish(AssetManifest(files=()))
    job = SimpleNamespace(id="j1", spec=SimpleNamespace(kind="calibration"), state=JobState.SUCCEEDED)
    jobs: Any = SimpleNamespace(repository=SimpleNamespace(get=lambda _id: job), folder=lambda _id: tmp_path)
    with pytest.raises(JobStateError, match=r"^Job j1 published no calibration\.json; submit it again\.$"):
        calibration_of_job(jobs, "j1")
