"""Data of version 0.1 can still be read: its data folder, its database, and the store of a job that succeeded."""

from __future__ import annotations

import hashlib
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.api.auth.tokens import Scope
from services.core.records import JobSpec
from services.core.results import AssetManifest, FitReport, PreparedManifest
from services.core.settings import ServerSettings
from services.core.store import open_stage, read_record
from tests.support.guarded_server import make_token
from tests.support.live_server import serving

ARCHIVE = Path(__file__).parents[1] / "data" / "0.1" / "data.tar.xz"
LARGEST_BYTES = 300_000
SUCCEEDED, CANCELLED = "24511ac8078a", "f953d5a22fe3"
CAPTURE = "484b114ab782e1c2"
TOKEN = "dentine_934c742644a2_Xh2jmxrD-aiH_yEkV72DqltIhKmt7WHW-bxCT2BcyY8"
"""Token of the server that wrote the data. That server was never reachable for others, so the token is no secret."""
PARAMETERS_SHA256 = "62a06638e6210319869dbceda2206d220b251a5a50b8b27a4e7dc595d1ab610e"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    # Python 3.11 has extraction filters from 3.11.4 on, Debian 12 has 3.11.2, and later versions warn without a filter.
    safely: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, **safely)
    return tmp_path


@pytest.fixture
def client(data: Path) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=data, access="tokens"), lambda *_: None)) as client:
        client.headers["Authorization"] = f"Bearer {TOKEN}"
        yield client


def test_the_archive_is_small() -> None:
    assert ARCHIVE.stat().st_size < LARGEST_BYTES


def test_its_jobs_captures_and_names_are_listed(client: httpx.Client) -> None:
    jobs = client.get("/v1/jobs").json()["jobs"]
    assert [(job["number"], job["id"], job["state"]) for job in jobs] == [
        (2, CANCELLED, "CANCELLED"),
        (1, SUCCEEDED, "SUCCEEDED"),
    ]
    assert jobs[1]["spec"]["capture"] == f"captures/{CAPTURE}"
    assert [capture["id"] for capture in client.get("/v1/captures").json()["captures"]] == [CAPTURE]
    assert [one["name"] for one in client.get("/v1/calibrations").json()] == ["first"]
    assert [hook["url"] for hook in client.get("/v1/webhooks").json()] == ["https://example.org/hook"]
    assert [token["name"] for token in client.get("/v1/tokens").json()] == ["laboratory"]
    assert client.get("/v1/audit").json()["entries"]


def test_a_finished_job_is_shown_with_its_files(client: httpx.Client) -> None:
    job = client.get(f"/v1/jobs/{SUCCEEDED}").json()
    assert [(stage["stage"], stage["state"]) for stage in job["stages"]] == [
        ("prepare", "finished"),
        ("fit", "finished"),
        ("export", "finished"),
    ]
    parameters = client.get(f"/v1/jobs/{SUCCEEDED}/artifacts/parameters.json")
    assert hashlib.sha256(parameters.content).hexdigest() == PARAMETERS_SHA256
    assert "Tooth" in client.get(f"/v1/jobs/{SUCCEEDED}/artifacts/report.html").text
    history = client.get(f"/v1/jobs/{SUCCEEDED}/history").json()
    assert len(history["series"][0]["fit_error"]) == 6
    preview = client.get(f"/v1/jobs/{SUCCEEDED}/previews").json()["previews"][0]
    assert client.get(f"/v1/jobs/{SUCCEEDED}/previews/{preview['id']}/render").content.startswith(b"\x89PNG")
    events = client.get(f"/v1/jobs/{SUCCEEDED}/events").text
    assert events.rstrip().endswith('event: end\ndata: "SUCCEEDED"')


def test_the_store_of_a_finished_job_is_whole(data: Path) -> None:
    folder = data / "jobs" / SUCCEEDED
    assert read_record(folder / "job.json", JobSpec).dentin == "known"
    assert open_stage(folder, "prepared", PreparedManifest)[1].cameras
    assert open_stage(folder, "fit", FitReport)[1].steps == 6
    assert open_stage(folder, "asset", AssetManifest)[1].files
    assert json.loads((folder / "errors.json").read_text())


def test_what_it_stored_belongs_to_the_default_group(data: Path) -> None:
    members, others = (
        make_token(data, name, Scope.SUBMIT, group=group) for name, group in (("member", "default"), ("other", None))
    )
    with serving(create_app(ServerSettings(data=data, access="tokens"), lambda *_: None)) as client:
        paths = (
            "/v1/jobs",
            "/v1/captures",
            "/v1/calibrations",
            f"/v1/jobs/{SUCCEEDED}",
            f"/v1/captures/{CAPTURE}",
            "/v1/calibrations/first",
        )
        seen, hidden = (
            [client.get(path, headers={"Authorization": f"Bearer {token}"}) for path in paths]
            for token in (members, others)
        )
        assert all(answer.status_code == 200 and "owner" in answer.text for answer in seen), [
            answer.text for answer in seen
        ]
        assert [answer.status_code for answer in hidden] == [200] * 3 + [404] * 3
        assert (hidden[0].json()["jobs"], hidden[1].json()["captures"], hidden[2].json()) == ([], [], [])
