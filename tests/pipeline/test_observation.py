"""Observation of jobs over the API: log, loss curve, pictures, archive, presets, and filtered lists."""

from __future__ import annotations

import io
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.api.presets import list_presets
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from tests.support.live_server import serving
from tests.support.telling_job import PICTURE, STEPS, tell


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path_factory.mktemp("data")), tell)) as client:
        yield client


@pytest.fixture(scope="module")
def job(client: httpx.Client) -> str:
    """URL path of a job that has run."""
    return run_job(client)


def run_job(client: httpx.Client, **options: Any) -> str:
    made = client.post("/v1/jobs", json={"capture": "/"} | options)
    assert made.status_code == 201
    assert 'data: "SUCCEEDED"' in client.get(f"/v1/jobs/{made.json()['id']}/events").text
    return f"/v1/jobs/{made.json()['id']}"


def test_log_lines_are_paged_and_filtered(client: httpx.Client, job: str) -> None:
    messages = ["Camera c1 is dark.", "Attempt 1 goes on at step 1.", f"Attempt 2 goes on at step {STEPS // 2}."]
    whole = client.get(f"{job}/logs").json()
    assert ([line["message"] for line in whole["lines"]], whole["is_last"]) == (messages, True)
    read: list[str] = []
    after, is_last = 0, False
    while not is_last:
        page = client.get(f"{job}/logs", params={"after": after, "limit": 1}).json()
        read += [line["message"] for line in page["lines"]]
        after, is_last = page["next_after"], page["is_last"]
    assert read == messages
    assert client.get(f"{job}/logs", params={"after": after}).json() == {
        "lines": [],
        "next_after": after,
        "is_last": True,
    }
    assert [line["message"] for line in client.get(f"{job}/logs", params={"stage": "fit"}).json()["lines"]] == messages[
        1:
    ]
    assert [
        line["message"] for line in client.get(f"{job}/logs", params={"stage": "fit", "attempt": 2}).json()["lines"]
    ] == messages[2:]


def test_history_has_columns_of_every_step(client: httpx.Client, job: str) -> None:
    (series,) = client.get(f"{job}/history").json()["series"]
    assert series["channel"] == "green"
    assert series["step"] == list(range(1, STEPS + 1))
    half = STEPS // 2
    assert series["loss"] == [0.5**step * (1 if step < half else 2) for step in series["step"]]
    assert series["parameters"] == {"enamel.sigma": [4.0] * STEPS}
    thinned = client.get(f"{job}/history", params={"points": 8}).json()["series"][0]
    assert (thinned["step"][0], thinned["step"][-1], len(thinned["step"]) <= 8) == (1, STEPS, True)
    assert client.get(f"{job}/history", params={"channel": "blue"}).json() == {"series": []}


def test_previews_are_listed_and_their_files_read_in_ranges(client: httpx.Client, job: str) -> None:
    page = client.get(f"{job}/previews").json()
    shown = [
        (one["camera"], one["light"], one["channel"], one["step"], one["held_out"], one["attempt"])
        for one in page["previews"]
    ]
    assert shown == [("c0", "l1", "green", 1, False, 1), ("c0", "l1", "green", 11, True, 2)]
    for kind, path in page["previews"][1]["pictures"].items():
        whole = client.get(path)
        assert (whole.content, whole.headers["content-type"]) == (kind.encode() + PICTURE, "image/png")
        assert client.get(path, headers={"Range": "bytes=0-3"}).content == whole.content[:4]
        assert client.get(path, headers={"If-None-Match": whole.headers["etag"]}).status_code == 304
    first = client.get(f"{job}/previews", params={"limit": 1}).json()
    second = client.get(f"{job}/previews", params={"limit": 1, "after": first["next_after"]}).json()
    assert [first["is_last"], second["is_last"]] == [False, True]
    assert first["previews"] + second["previews"] == page["previews"]


@pytest.mark.parametrize(
    "path",
    ["previews/1/render", "previews/999999/render", "previews/0/render", "previews/1/mask", f"previews/{2**70}/photo"],
)
def test_what_is_no_preview_is_refused(client: httpx.Client, job: str, path: str) -> None:
    answer = client.get(f"{job}/{path}")
    assert answer.status_code in {404, 422}
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_preview_of_another_job_is_not_shown(client: httpx.Client, job: str) -> None:
    theirs = client.get(f"{run_job(client)}/previews").json()["previews"][0]["id"]
    assert client.get(f"{job}/previews/{theirs}/render").status_code == 404


def test_a_preview_cannot_name_a_file_outside_the_job(tmp_path: Path) -> None:
    from services.core.stage import StageEvent

    def escape(_spec: JobSpec, _folder: Path, events: Any) -> None:
        with events.open() as log:
            log.append(
                log.begin_stage("fit"), StageEvent(stage="fit", kind="preview", data={"render": "../../dentine.sqlite"})
            )

    with serving(create_app(ServerSettings(data=tmp_path), escape)) as client:
        job = run_job(client)
        path = client.get(f"{job}/previews").json()["previews"][0]["pictures"]["render"]
        assert client.get(path).status_code == 404


def test_the_archive_holds_what_the_list_names(client: httpx.Client, job: str) -> None:
    answer = client.get(f"{job}/artifacts.zip")
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"] == f'attachment; filename="dentine-{job.rpartition("/")[2]}.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == [artifact["path"] for artifact in client.get(f"{job}/artifacts").json()]
        assert archive.read("previews/green-001-c0-l1-photo.png") == b"photo" + PICTURE


@pytest.mark.parametrize("name", [preset.name for preset in list_presets()])
def test_a_preset_makes_a_job(client: httpx.Client, name: str) -> None:
    preset = client.get(f"/v1/presets/{name}").json()
    source = {} if "rig" in preset["options"] else {"capture": "/"}
    spec = JobSpec.model_validate(source | preset["options"])
    assert (spec == JobSpec(capture=Path("/"))) is (name == "standard")
    assert preset["summary"].endswith(".")


def test_presets_are_listed_by_name(client: httpx.Client) -> None:
    names = [preset["name"] for preset in client.get("/v1/presets").json()]
    assert names == sorted(names)
    assert {"quick", "standard", "accurate", "paper"} <= set(names)
    unknown = client.get("/v1/presets/none")
    assert (unknown.status_code, unknown.json()["code"]) == (404, "preset-unknown")


def test_jobs_are_listed_by_state_kind_time_and_capture(tmp_path: Path) -> None:
    from services.core.errors import CaptureInputError

    def run(spec: JobSpec, *_: object) -> None:
        if spec.seed == 13:
            raise CaptureInputError("Frame 3 is missing; copy it.")

    for name in ("North_1", "south%"):
        (tmp_path / name).mkdir()
    with serving(create_app(ServerSettings(data=tmp_path / "data"), run)) as client:

        def submit(**options: Any) -> str:
            made = client.post("/v1/jobs", json=options).json()
            client.get(f"/v1/jobs/{made['id']}/events")
            return str(made["id"])

        def found(**asked: Any) -> set[str]:
            answer = client.get("/v1/jobs", params=asked)
            assert answer.status_code == 200, answer.text
            return {job["id"] for job in answer.json()["jobs"]}

        tooth = submit(capture=str(tmp_path / "North_1"))
        jaw = submit(capture=str(tmp_path / "south%"), kind="jaw")
        between_s = time.time()
        failed = submit(rig={"mouth": str(tmp_path / "North_1")}, seed=13)
        assert found() == {tooth, jaw, failed}
        assert found(state="FAILED") == {failed}
        assert found(state=["FAILED", "SUCCEEDED"]) == {tooth, jaw, failed}
        assert found(state=["QUEUED", "CANCELLED"]) == set()
        assert found(kind="jaw") == {jaw}
        assert found(created_after_s=between_s) == {failed}
        assert found(created_before_s=between_s) == {tooth, jaw}
        assert found(capture="north") == {tooth, failed}
        assert found(capture="h%") == {jaw}
        assert found(capture="_1", kind="tooth", state="SUCCEEDED") == {tooth}
        for bad in ({"state": "DONE"}, {"kind": "crown"}, {"created_after_s": "nan"}, {"created_after_s": "soon"}):
            assert client.get("/v1/jobs", params=bad).status_code == 422
