"""Calibrations by name over the API, and their use by the preparation."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from services.api.app import create_app
from services.client.client import Client
from services.client.errors import UnknownCalibrationError
from services.core.errors import CaptureInputError
from services.core.files.meshes import read_teeth
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.settings import ServerSettings
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.pipeline.event_log import EventAddress
from services.preprocess import stage
from tests.support.calibration_jobs import publish_calibration
from tests.support.command_line import dentine
from tests.support.live_server import serving
from tests.support.mouth import write_mouth
from tests.support.uploading import announce, contents_of, send


def prepare(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Run a job's preparation in this process; a calibration job publishes the calibration in its folder."""
    if spec.kind == "calibration":
        publish_calibration(spec, folder, events)
        return
    with events.open() as log:
        attempt = log.begin_stage("prepare")
        stage.run(spec, LocalContext(folder, attempt, lambda event: log.append(attempt, event)))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def client(data: Path) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=data), prepare)) as client:
        yield client


@pytest.fixture
def mouth(tmp_path: Path) -> Path:
    write_mouth(tmp_path / "mouth", lights=2, sizes=((24, 18),), channels=("green",))
    return tmp_path / "mouth"


@pytest.fixture
def calibration(mouth: Path) -> dict[str, Any]:
    """The calibration of the mouth's own file, with the light l1 moved."""
    tree: dict[str, Any] = json.loads((mouth / "capture.json").read_text())
    del tree["images"]
    tree["lights"][1]["position_mm"] = [40.0, 0.0, -900.0]
    return tree


def renamed(tree: dict[str, Any], part: str, change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    copy: dict[str, Any] = json.loads(json.dumps(tree))
    change(copy[part][-1])
    return copy


def test_a_name_means_one_content_for_ever(client: httpx.Client, calibration: dict[str, Any]) -> None:
    first = client.put("/v1/calibrations/rig-1.2026", json=calibration)
    assert (first.status_code, first.headers["location"]) == (201, "/v1/calibrations/rig-1.2026")
    # Another order of keys or another notation of a number is the same content.
    otherwise = json.dumps(calibration, sort_keys=True).replace("40.0", "4e1")
    again = client.put("/v1/calibrations/rig-1.2026", content=otherwise, headers={"Content-Type": "application/json"})
    assert (again.status_code, again.json()) == (200, first.json())
    assert client.put("/v1/calibrations/same", json=calibration).json()["id"] == first.json()["id"]
    other = client.put(
        "/v1/calibrations/rig-1.2026",
        json=renamed(calibration, "lights", lambda light: light.update(position_mm=[0, 0, -900])),
    )
    assert (other.status_code, other.json()["code"]) == (409, "calibration-taken")
    assert client.get("/v1/calibrations/rig-1.2026").json() == first.json()
    assert [entry["name"] for entry in client.get("/v1/calibrations").json()] == ["same", "rig-1.2026"]
    shown = client.get("/v1/calibrations/same").json()
    assert (shown["option"], shown["calibration"]["lights"][1]["position_mm"]) == (
        f"calibrations/{shown['id']}",
        [40.0, 0.0, -900.0],
    )


@pytest.mark.parametrize(
    ("part", "change", "named"),
    [
        ("lights", lambda light: light.update(name="l0"), "lists light l0 twice"),
        ("lights", lambda light: light.update(intensity=[1.0, 1.0]), "light l1 has 2 intensities for 1 channels"),
        (
            "cameras",
            lambda camera: camera.update(camera_from_world=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 100], [0, 0, 0, 1]]),
            "must be a rotation",
        ),
        ("cameras", lambda camera: camera.update(size=[0, 10]), "cameras.0.size.0"),
        ("cameras", lambda camera: camera.update(lens="50 mm"), "lens"),
    ],
)
def test_what_no_stage_would_take_is_refused_when_it_is_put(
    client: httpx.Client, calibration: dict[str, Any], part: str, change: Any, named: str
) -> None:
    answer = client.put("/v1/calibrations/wrong", json=renamed(calibration, part, change))
    assert answer.status_code == 422
    assert named in answer.json()["detail"]
    assert client.get("/v1/calibrations/wrong").json()["code"] == "calibration-unknown"


@pytest.mark.parametrize("name", ["..", "a" * 61, ".hidden", "a%2fb", "ä"])
def test_a_name_is_no_path(client: httpx.Client, calibration: dict[str, Any], name: str) -> None:
    assert client.put(f"/v1/calibrations/{name}", json=calibration).status_code in {404, 405, 422}


def test_a_job_is_prepared_with_the_calibration_that_it_names(
    client: httpx.Client, data: Path, mouth: Path, calibration: dict[str, Any]
) -> None:
    # A calibration of the whole rig has more lights than this capture, in another order.
    calibration["lights"] = [
        {"name": "l7", "position_mm": [0, 0, -950], "intensity": [1e6]},
        *calibration["lights"][::-1],
    ]
    option = client.put("/v1/calibrations/whole-rig", json=calibration).json()["option"]
    job = client.post("/v1/jobs", json={"capture": str(mouth), "calibration": option}).json()["id"]
    assert '"SUCCEEDED"' in client.get(f"/v1/jobs/{job}/events").text
    manifest = open_stage(data / "jobs" / job, "prepared", PreparedManifest)[1]
    assert [(light.name, light.position_mm[2]) for light in manifest.lights] == [("l0", -1000.0), ("l1", -900.0)]
    assert f"Cameras and lights are those of calibration {option.partition('/')[2]}" in manifest.notes[0]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda tree: tree["lights"].pop(), "lacks light l1"),
        (lambda tree: tree["cameras"][0].update(name="c9"), "lacks camera c0"),
        (
            lambda tree: tree["cameras"][0].update(size=[18, 24]),
            "18 x 24 pixels of camera c0, but the capture's are 24 x 18",
        ),
        (lambda tree: tree.update(channels=["red"]), "is for channels red, but the capture has green"),
    ],
)
def test_a_calibration_of_another_rig_is_refused(
    tmp_path: Path, mouth: Path, calibration: dict[str, Any], change: Any, named: str
) -> None:
    change(calibration)
    (tmp_path / "other.json").write_text(json.dumps(calibration))
    with pytest.raises(CaptureInputError, match=named):
        stage.run(JobSpec(capture=mouth, calibration=tmp_path / "other.json"), LocalContext(tmp_path / "job"))


OLD = {"made": "2020-01-01T00:00:00+00:00", "valid_days": 30}
BEYOND = {"limits": [{"what": "scatter of corners, camera c0", "value": 1.5, "limit": 1.0, "unit": "px"}]}


def test_a_job_names_a_calibration_by_name_and_keeps_its_content(
    client: httpx.Client, mouth: Path, calibration: dict[str, Any]
) -> None:
    option = client.put("/v1/calibrations/by-name", json=calibration).json()["option"]
    job = client.post("/v1/jobs", json={"capture": str(mouth), "calibration": "calibrations/by-name"}).json()
    assert job["spec"]["calibration"] == option


def test_a_calibration_beyond_its_limits_is_refused_unless_told_otherwise(
    client: httpx.Client, mouth: Path, calibration: dict[str, Any]
) -> None:
    listed = client.put("/v1/calibrations/beyond", json=calibration | BEYOND).json()
    assert listed["state"] == "beyond its limits"
    job = {"capture": str(mouth), "calibration": "calibrations/beyond"}
    answer = client.post("/v1/jobs", json=job)
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-settings")
    told = "Calibration beyond is beyond its limits: scatter of corners, camera c0 is 1.5 px, and 1 px is the limit"
    assert told in answer.json()["detail"]
    accepted = client.post("/v1/jobs", json=job | {"accept_calibration": True})
    assert accepted.status_code == 201


def test_an_old_calibration_is_shown_as_old_and_told_by_the_preparation(
    client: httpx.Client, tmp_path: Path, mouth: Path, calibration: dict[str, Any]
) -> None:
    assert client.put("/v1/calibrations/old", json=calibration | OLD).json()["state"] == "old"
    listed = {entry["name"]: entry["state"] for entry in client.get("/v1/calibrations").json()}
    assert listed["old"] == "old"
    (tmp_path / "rig.json").write_text(json.dumps(calibration | OLD | BEYOND))
    spec = JobSpec(capture=mouth, calibration=tmp_path / "rig.json", accept_calibration=True)
    stage.run(spec, LocalContext(tmp_path / "job"))
    notes = open_stage(tmp_path / "job", "prepared", PreparedManifest)[1].notes
    assert any("days old and was made to hold for 30" in note for note in notes)
    assert any("was accepted beyond its limits: scatter of corners" in note for note in notes)
    with pytest.raises(CaptureInputError, match="Calibration rig is beyond its limits"):
        stage.run(spec.model_copy(update={"accept_calibration": False}), LocalContext(tmp_path / "other"))


def test_a_lobe_is_evaluated_at_the_teeth(tmp_path: Path, mouth: Path, calibration: dict[str, Any]) -> None:
    light = calibration["lights"][1]
    off = np.array([0.6, 0.0, 0.8])
    calibration["lights"][1] = light | {"lobe": {"axis": off.tolist(), "exponent": 2.0}}
    (tmp_path / "rig.json").write_text(json.dumps(calibration))
    spec = JobSpec(capture=mouth, calibration=tmp_path / "rig.json")
    stage.run(spec, LocalContext(tmp_path / "job"))
    prepared = open_stage(tmp_path / "job", "prepared", PreparedManifest)[1].lights[1]
    teeth = np.concatenate([tooth.outer.vertices_mm for tooth in read_teeth(mouth)]).mean(axis=0)
    towards = teeth - np.array(light["position_mm"])
    cosine = towards @ off / np.linalg.norm(towards)
    assert prepared.intensity == pytest.approx([cosine**2 * one for one in light["intensity"]])


def test_the_command_line_names_a_stored_calibration(
    client: httpx.Client, tmp_path: Path, mouth: Path, calibration: dict[str, Any]
) -> None:
    option = client.put("/v1/calibrations/this-rig", json=calibration).json()["option"]
    (tmp_path / "job.toml").write_text('capture = "mouth"')
    command = [
        sys.executable,
        "-m",
        "services",
        "submit",
        str(tmp_path / "job.toml"),
        "--server",
        str(client.base_url),
        "--calibration",
    ]
    submitted = subprocess.run([*command, "this-rig"], capture_output=True, text=True, check=True)
    assert client.get(f"/v1/jobs/{submitted.stdout.strip()}").json()["spec"]["calibration"] == option
    with (
        Client(str(client.base_url)) as typed,
        pytest.raises(UnknownCalibrationError, match="There is no calibration other-rig"),
    ):
        typed.calibration("other-rig")


def test_what_a_calibration_job_made_is_put_under_a_name(
    client: httpx.Client, mouth: Path, calibration: dict[str, Any]
) -> None:
    def ended(**options: str) -> str:
        job = str(client.post("/v1/jobs", json={"capture": str(mouth)} | options).json()["id"])
        client.get(f"/v1/jobs/{job}/events")
        return job

    failed = ended(kind="calibration")
    refused = client.put(f"/v1/jobs/{failed}/calibration/by-job")
    assert (refused.status_code, refused.json()["code"]) == (409, "job-state")
    assert "is FAILED and has no calibration to keep" in refused.json()["detail"]
    (mouth / "calibration.json").write_text(json.dumps(calibration | BEYOND))
    made = ended(kind="calibration")
    kept = client.put(f"/v1/jobs/{made}/calibration/by-job")
    assert (kept.status_code, kept.headers["location"]) == (201, "/v1/calibrations/by-job"), kept.text
    assert kept.json()["state"] == "beyond its limits", "kept, and refused by jobs as any other"
    told = dentine("keep-calibration", made, "by-job", "--server", str(client.base_url)).stdout
    assert told == "calibrations/by-job: beyond its limits\n"
    told = dentine("calibrations", "--server", str(client.base_url)).stdout
    assert told.startswith("calibrations/by-job  beyond its limits: ")
    assert client.put(f"/v1/jobs/{made}/calibration/by-job").status_code == 200
    assert client.put("/v1/calibrations/by-hand", json=calibration | BEYOND).json()["id"] == kept.json()["id"]
    # Jobs can use the calibration by its name after the job that made it is deleted.
    client.delete(f"/v1/jobs/{made}").raise_for_status()
    assert client.get("/v1/calibrations/by-job").json() == kept.json()
    assert client.put(f"/v1/jobs/{made}/calibration/again").json()["code"] == "job-unknown"


def test_names_that_are_taken_and_jobs_that_make_no_calibration(
    client: httpx.Client, mouth: Path, calibration: dict[str, Any]
) -> None:
    client.put("/v1/calibrations/taken", json=calibration | BEYOND).raise_for_status()
    (mouth / "calibration.json").write_text(json.dumps(calibration))
    jobs = {}
    for kind in ("calibration", "tooth"):
        jobs[kind] = client.post("/v1/jobs", json={"capture": str(mouth), "kind": kind}).json()["id"]
        client.get(f"/v1/jobs/{jobs[kind]}/events")
    taken = client.put(f"/v1/jobs/{jobs['calibration']}/calibration/taken")
    assert (taken.status_code, taken.json()["code"]) == (409, "calibration-taken")
    other = client.put(f"/v1/jobs/{jobs['tooth']}/calibration/new")
    assert (other.status_code, other.json()["code"]) == (409, "job-state")
    assert "is of kind tooth and makes no calibration" in other.json()["detail"]
    assert client.put(f"/v1/jobs/{jobs['calibration']}/calibration/.hidden").status_code == 422


@pytest.mark.parametrize("option", ["calibrations/none", "calibrations/" + 64 * "0", "relative.json", "/no/such.json"])
def test_a_job_with_no_such_calibration_is_refused(client: httpx.Client, mouth: Path, option: str) -> None:
    answer = client.post("/v1/jobs", json={"capture": str(mouth), "calibration": option})
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-settings")
    assert "Option 'calibration'" in answer.json()["detail"]


def test_a_capture_shows_the_calibration_that_it_brings_along(client: httpx.Client, mouth: Path) -> None:
    contents = contents_of(mouth)
    capture = announce(client, contents)["id"]
    assert client.get(f"/v1/captures/{capture}/calibration").json()["code"] == "capture-state"
    for path, content in contents.items():
        send(client, capture, path, content)
    client.post(f"/v1/captures/{capture}/commit").raise_for_status()
    described = json.loads((mouth / "capture.json").read_text())
    del described["images"]
    assert client.get(f"/v1/captures/{capture}/calibration").json() == described
    assert client.get("/v1/captures/none/calibration").json()["code"] == "capture-unknown"
