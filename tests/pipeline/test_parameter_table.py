"""A job's measured parameters as a table for spreadsheets."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.core.records import JobSpec
from services.core.results import Estimate
from services.core.settings import ServerSettings
from tests.support.live_server import serving

THIRD = Estimate(value=1 / 3, se=0.25, unit="1/mm", determined=True)
HELD = Estimate(value=0.9, se=None, unit="1", determined=False)
MEASURED = {"green, left": {"enamel.sigma": THIRD, "11.enamel.g": HELD}, "=1+1": {"enamel.sigma": THIRD}}
FILES = {
    1: json.dumps({name: {leaf: one.model_dump() for leaf, one in row.items()} for name, row in MEASURED.items()}),
    2: '{"green": {"enamel.sigma": 3}}',
}
"""Contents of the parameter file by the job's seed; jobs with other seeds write none."""


def measure(spec: JobSpec, folder: Path, _events: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if spec.seed in FILES:
        (folder / "parameters.json").write_text(FILES[spec.seed])


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path_factory.mktemp("data")), measure)) as client:
        yield client


def ask_table(client: httpx.Client, **options: Any) -> tuple[str, httpx.Response]:
    """Run a job; returns its id and the answer with its table."""
    job = client.post("/v1/jobs", json={"capture": "/"} | options).json()["id"]
    assert 'data: "SUCCEEDED"' in client.get(f"/v1/jobs/{job}/events").text
    return job, client.get(f"/v1/jobs/{job}/parameters.csv")


def test_a_row_for_each_channel_and_parameter(client: httpx.Client) -> None:
    job, answer = ask_table(client, seed=1)
    assert answer.headers["content-type"] == "text/csv; charset=utf-8"
    assert answer.headers["content-disposition"] == f'attachment; filename="dentine-{job}.csv"'
    head, *rows = csv.reader(answer.text.splitlines())
    assert head == ["job", "channel", "parameter", "value", "se", "unit", "determined"]
    assert rows == [
        [job, "green, left", "enamel.sigma", repr(1 / 3), "0.25", "1/mm", "true"],
        [job, "green, left", "11.enamel.g", "0.9", "", "1", "false"],
        [job, "'=1+1", "enamel.sigma", repr(1 / 3), "0.25", "1/mm", "true"],
    ]


def test_a_job_that_has_measured_nothing_says_so(client: httpx.Client) -> None:
    _, answer = ask_table(client, seed=3)
    assert (answer.status_code, answer.json()["code"]) == (404, "job-unknown")
    assert "has no artifact 'parameters.json'" in answer.json()["detail"]


def test_parameters_that_are_none_are_told(client: httpx.Client) -> None:
    _, answer = ask_table(client, seed=2)
    assert (answer.status_code, answer.json()["code"]) == (409, "job-state")
    assert "cannot be read as a table" in answer.json()["detail"]
