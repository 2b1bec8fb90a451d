"""The REST API in process, with toy stages on real workers where a job must run."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from httpx import Client

from services.api.app import create_app
from services.core.errors import CaptureInputError, DentineError, DiskFullError, MemoryKillError
from services.core.records import JobSpec
from services.core.settings import DATABASE_FILE, ServerSettings
from services.pipeline.database import open_database, sqlite_url
from services.pipeline.event_log import EventAddress
from tests.support.live_server import serving


def write_results(_spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Do the least that a job does: write an event and files."""
    with events.open() as log:
        log.begin_stage("fit")
    (folder / "asset").mkdir(parents=True)
    (folder / "asset" / "scene.xml").write_bytes(bytes(range(100)))
    (folder / "report.html").write_text("<!doctype html>")
    for hidden in (".lock", "cancel", "fit.lease"):
        (folder / hidden).touch()
    (folder / "prepared.zarr").mkdir()
    (folder / "prepared.zarr" / "zarr.json").write_text("{}")


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Client]]:
    with ExitStack() as stack:
        yield lambda run=write_results: stack.enter_context(
            serving(create_app(ServerSettings(data=tmp_path / "data"), run))
        )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def shared(data: Path) -> Iterator[Client]:
    """A server that tests share which change nothing, or only what they make themselves."""
    with serving(create_app(ServerSettings(data=data), write_results)) as client:
        yield client


@pytest.fixture(scope="module")
def done(shared: Client) -> str:
    """A job of the shared server that has ended."""
    job_id = str(submit(shared, "/").json()["id"])
    finish(shared, job_id)
    return job_id


@pytest.fixture
def capture_folder(tmp_path: Path) -> str:
    folder = tmp_path / "capture"
    folder.mkdir()
    return str(folder)


def submit(client: Client, capture: str, key: str | None = None, **options: Any) -> Any:
    return client.post(
        "/v1/jobs", json={"capture": capture, **options}, headers={"Idempotency-Key": key} if key else {}
    )


def finish(client: Client, job_id: str) -> str:
    """Read a job's event stream to its end; returns its text."""
    return client.get(f"/v1/jobs/{job_id}/events").text


def test_a_job_is_created_runs_and_tells_its_events(shared: Client, capture_folder: str) -> None:
    client = shared
    answer = submit(client, capture_folder)
    assert answer.status_code == 201
    job_id = answer.json()["id"]
    assert answer.headers["location"] == f"/v1/jobs/{job_id}"
    stream = finish(client, job_id)
    assert stream.count('event: end\ndata: "SUCCEEDED"') == 1
    job = client.get(f"/v1/jobs/{job_id}").json()
    assert job["state"] == "SUCCEEDED"
    assert [stage["stage"] for stage in job["stages"]] == ["prepare", "fit", "export"]
    ids = [line.removeprefix("id: ") for line in stream.splitlines() if line.startswith("id: ")]
    replayed = client.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": ids[-2]}).text
    assert [line for line in replayed.splitlines() if line.startswith("id: ")] == [f"id: {ids[-1]}"]


def test_an_idempotency_key_makes_one_job(shared: Client, capture_folder: str) -> None:
    client = shared
    first, second = (submit(client, capture_folder, key="k1") for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json()["id"] == second.json()["id"]
    other = submit(client, capture_folder, key="k1", seed=2)
    assert other.status_code == 409
    assert other.json()["code"] == "job-state"


def test_pages_follow_each_other(serve: Any, capture_folder: str) -> None:
    client = serve()
    ids = [submit(client, capture_folder, seed=seed).json()["id"] for seed in range(5)]
    seen, before = [], None
    while True:
        page = client.get("/v1/jobs", params={"limit": 2} | ({"before": before} if before else {})).json()
        seen += [job["id"] for job in page["jobs"]]
        before = page["next_before"]
        if before is None:
            break
    assert seen == ids[::-1]


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ({"capture": "relative/folder"}, "'capture': relative/folder is relative"),
        ({"capture": "/no/such/folder"}, "/no/such/folder does not exist"),
        ({"capture": "/", "sead": 1}, "Unknown option 'sead'"),
        ({"capture": "/", "ior": 9}, "'ior'"),
        ({}, "give exactly one of 'capture'"),
    ],
)
def test_bad_options_are_a_problem_document_that_names_them(shared: Client, body: dict[str, Any], named: str) -> None:
    answer = shared.post("/v1/jobs", json=body)
    problem = answer.json()
    assert answer.status_code == problem["status"] == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert problem["type"] == "urn:dentine:problem:bad-settings"
    assert named in problem["detail"]


@pytest.mark.parametrize("path", ["/v1/jobs/none", "/v1/jobs/none/events", "/v1/jobs/none/artifacts", "/v1/nothing"])
def test_what_is_not_there_is_a_problem_document(shared: Client, path: str) -> None:
    answer = shared.get(path)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("problem", "code"),
    [(CaptureInputError("Frame 3 is missing; copy it."), "bad-capture"), (ZeroDivisionError("x"), "internal-error")],
)
def test_a_failure_is_data_and_a_retry_runs_again(
    serve: Any, capture_folder: str, problem: Exception, code: str
) -> None:
    problems = [problem]

    def run(*_: object) -> None:
        if problems:
            raise problems.pop()

    client = serve(run)
    job_id = submit(client, capture_folder).json()["id"]
    finish(client, job_id)
    failure = client.get(f"/v1/jobs/{job_id}").json()["failure"]
    assert failure["code"] == code
    assert str(problem) in failure["message"]
    assert client.post(f"/v1/jobs/{job_id}/retry").status_code == 202
    finish(client, job_id)
    job = client.get(f"/v1/jobs/{job_id}").json()
    assert (job["state"], job["failure"]) == ("SUCCEEDED", None)
    assert client.post(f"/v1/jobs/{job_id}/cancel").status_code == 409


@pytest.mark.parametrize("at_once", [1000, 5], ids=["at once", "block by block"])
def test_artifacts_are_listed_and_read_in_ranges(
    shared: Client, done: str, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.api.http.artifacts.MAX_BYTES_AT_ONCE", at_once)
    client, base = shared, f"/v1/jobs/{done}/artifacts"
    assert [artifact["path"] for artifact in client.get(base).json()] == ["asset/scene.xml", "report.html"]
    whole = client.get(f"{base}/asset/scene.xml")
    assert whole.content == bytes(range(100))
    part = client.get(f"{base}/asset/scene.xml", headers={"Range": "bytes=10-19"})
    assert (part.status_code, part.content, part.headers["content-range"]) == (
        206,
        bytes(range(10, 20)),
        "bytes 10-19/100",
    )
    assert client.get(f"{base}/asset/scene.xml", headers={"Range": "bytes=-5"}).content == bytes(range(95, 100))
    several = client.get(f"{base}/asset/scene.xml", headers={"Range": "bytes=0-1,90-"})
    assert (several.status_code, several.headers["content-type"].partition(";")[0]) == (206, "multipart/byteranges")
    beyond = client.get(f"{base}/asset/scene.xml", headers={"Range": "bytes=200-"})
    assert (beyond.status_code, beyond.json()["code"], beyond.headers["content-range"]) == (
        416,
        "range-unsatisfiable",
        "bytes */100",
    )
    for unreadable in ("lines=1", "bytes", "bytes=", "bytes=9-1", "bytes=0-1,x", "bytes=--1", "bytes=-"):
        assert client.get(f"{base}/asset/scene.xml", headers={"Range": unreadable}).content == whole.content
    assert client.get(f"{base}/asset/scene.xml", headers={"If-None-Match": whole.headers["etag"]}).status_code == 304
    stale = client.get(f"{base}/asset/scene.xml", headers={"Range": "bytes=0-1", "If-Range": '"old"'})
    assert (stale.status_code, len(stale.content)) == (200, 100)
    assert "sandbox" in client.get(f"{base}/report.html").headers["content-security-policy"]


@pytest.mark.attack("traversal", "an artifact's path that leads out of the job's folder")
def test_no_path_leads_out_of_the_artifacts(shared: Client, capture_folder: str, data: Path) -> None:
    job_id = submit(shared, capture_folder).json()["id"]
    finish(shared, job_id)
    (data / "jobs" / job_id / "link").symlink_to("/etc/passwd")
    (data / "jobs" / job_id / "linked").symlink_to("/etc")
    for path in (
        "..%2f..%2fdentine.sqlite",
        "%2e%2e/%2e%2e/dentine.sqlite",
        "%2fetc%2fpasswd",
        ".lock",
        "cancel",
        "fit.lease",
        "asset",
        "link",
        "linked%2fpasswd",
        "a%00b",
    ):
        assert shared.get(f"/v1/jobs/{job_id}/artifacts/{path}").status_code == 404, path


@pytest.mark.attack("cross-site", "another origin or host name (DNS rebinding)")
def test_other_sites_and_other_hosts_are_refused(shared: Client, capture_folder: str) -> None:
    client = shared
    foreign = client.post("/v1/jobs", json={"capture": capture_folder}, headers={"Origin": "http://elsewhere.example"})
    assert (foreign.status_code, foreign.json()["code"]) == (403, "foreign-origin")
    assert (
        client.post(
            "/v1/jobs", json={"capture": capture_folder}, headers={"Origin": str(client.base_url).rstrip("/")}
        ).status_code
        == 201
    )
    assert client.get("/v1/jobs", headers={"Host": "elsewhere.example"}).status_code == 400


@pytest.mark.attack("cross-site", "a script in the page or in a report")
def test_pages_carry_a_strict_policy(shared: Client) -> None:
    headers = shared.get("/").headers
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


def test_health_and_options(shared: Client) -> None:
    client = shared
    assert client.get("/v1/health/live").json()["status"] == "live"
    assert client.get("/v1/health/ready").json()["status"] == "ready"
    options = client.get("/v1/options").json()
    assert options["properties"]["ior"]["default"] == 1.631
    assert "ior" in options["foreign_options"]["slab"]
    assert "effort" in options["foreign_options"]["tooth"]
    assert "seed" not in options["foreign_options"]["slab"]
    assert set(client.get("/v1/openapi.json").json()["paths"]) >= {"/v1/jobs", "/v1/jobs/{job_id}/events"}


def test_every_error_has_a_status() -> None:
    from services.api.http.problems import status_of

    def below(kind: type[DentineError]) -> Iterator[type[DentineError]]:
        yield kind
        for child in kind.__subclasses__():
            yield from below(child)

    assert {status_of(kind("x")) // 100 for kind in below(DentineError)} == {4, 5}


def test_a_deleted_job_is_gone_and_its_receipt_stays(serve: Any, capture_folder: str, tmp_path: Path) -> None:
    client = serve()
    job_id = submit(client, capture_folder).json()["id"]
    finish(client, job_id)
    files = [path for path in (tmp_path / "data" / "jobs" / job_id).rglob("*") if path.is_file()]
    receipt = client.delete(f"/v1/jobs/{job_id}")
    assert receipt.status_code == 200
    assert receipt.json()["files"] == len(files)
    assert client.get(f"/v1/deletions/{job_id}").json() == receipt.json()
    assert client.get(f"/v1/jobs/{job_id}").status_code == 404
    assert client.delete(f"/v1/jobs/{job_id}").status_code == 404
    assert client.get("/v1/jobs").json()["jobs"] == []
    assert list((tmp_path / "data" / "jobs").iterdir()) == []
    # The database's files do not contain its options either.
    engine = open_database(sqlite_url(tmp_path / "data" / DATABASE_FILE))
    with engine.connect() as connection:
        connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
    engine.dispose()
    assert not [
        path for path in (tmp_path / "data").glob("dentine.sqlite*") if capture_folder.encode() in path.read_bytes()
    ]


def test_a_job_under_way_is_not_deleted(serve: Any, capture_folder: str) -> None:
    hold = threading.Event()
    client = serve(lambda *_: hold.wait(60))
    job_id = submit(client, capture_folder).json()["id"]
    try:
        answer = client.delete(f"/v1/jobs/{job_id}")
        assert (answer.status_code, answer.json()["code"]) == (409, "job-state")
    finally:
        hold.set()
        finish(client, job_id)


def test_what_the_machine_could_never_run_is_refused_with_507(shared: Client, capture_folder: str) -> None:
    answer = submit(shared, capture_folder, workers=64)
    assert (answer.status_code, answer.json()["code"]) == (507, "job-too-large")
    assert "fewer workers" in answer.json()["detail"]


def test_a_full_disk_pauses_a_job_and_it_goes_on(
    serve: Any, capture_folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.api.jobs.admission.RETRY_S", 0.5)
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", 0.1)
    tries: list[int] = []

    def run(*_: object) -> None:
        tries.append(1)
        if len(tries) == 1:
            raise DiskFullError("The disk was full; free some space.", {"free_disk_bytes": 7})

    client = serve(run)
    job_id = submit(client, capture_folder).json()["id"]
    states = [line for line in finish(client, job_id).splitlines() if '"kind":"state"' in line]
    told = [json.loads(line.removeprefix("data: "))["data"]["state"] for line in states]
    assert told == ["SUBMITTED", "QUEUED", "RUNNING", "QUEUED", "RUNNING", "SUCCEEDED"]


def test_failures_say_what_was_measured(serve: Any, capture_folder: str) -> None:
    def run(*_: object) -> None:
        raise MemoryKillError("It grew too large; give it more.", {"peak_memory_bytes": 5, "memory_limit_bytes": 4})

    client = serve(run)
    job_id = submit(client, capture_folder).json()["id"]
    finish(client, job_id)
    failure = client.get(f"/v1/jobs/{job_id}").json()["failure"]
    assert (failure["code"], failure["evidence"]) == (
        "memory-killed",
        {"peak_memory_bytes": 5, "memory_limit_bytes": 4},
    )


def test_a_runner_that_broke_off_loses_the_job_and_runs_it_again(
    serve: Any, capture_folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.api.jobs.runner.LEASE_S", 0.3)
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", 0.1)
    broken = [OSError("The data folder is away.")]

    def withdraw(_folder: Path) -> None:
        if broken:
            raise broken.pop()

    monkeypatch.setattr("services.api.jobs.runner.withdraw_cancel", withdraw)
    client = serve()
    job_id = submit(client, capture_folder).json()["id"]
    states = [
        json.loads(line.removeprefix("data: "))["data"]["state"]
        for line in finish(client, job_id).splitlines()
        if '"kind":"state"' in line
    ]
    assert states == ["SUBMITTED", "QUEUED", "RUNNING", "QUEUED", "RUNNING", "SUCCEEDED"]
