"""The demonstration is a job that makes the mouth that it captures, so that it needs no files on any host."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest
from typer.testing import CliRunner

from services.api.jobs.admission import DEMO_CAPTURE_BYTES, DISK_PER_CAPTURE, MIN_DISK_BYTES, predict
from services.api.jobs.size import size_of
from services.api.presets import find_preset
from services.cli.app import build_app
from services.core.errors import CrashError, JobCancelledError, SettingsError
from services.core.records import DEMO_MOUTH, FolderCapture, JobSpec
from services.core.settings import job_from_tree, read_job
from services.core.stage import LocalContext, StageEvent
from services.core.store import open_stage
from services.phantom import demo as demo_mouth
from services.phantom.stage import run as phantom
from services.pipeline.stages import run_stages, stages_of
from tests.support.live_server import toy_server
from tests.support.toy_stages import DOORS

ROOT = Path(__file__).parents[2]
DEMO = JobSpec.model_validate(find_preset("demo").options)
SMALL: Mapping[str, str] = MappingProxyType({"pixel-mm": "2", "cameras": "1", "lights": "2", "samples": "16"})


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the demonstration's mouth small enough to be rendered in seconds."""
    monkeypatch.setattr(demo_mouth, "OPTIONS", SMALL)
    monkeypatch.setattr(demo_mouth, "NAME", "small")


def stage_spec(kept: Path) -> JobSpec:
    assert DEMO.rig is not None
    return DEMO.model_copy(update={"rig": DEMO.rig.model_copy(update={"mouth": kept})})


def test_the_example_is_the_preset_and_begins_with_its_mouth() -> None:
    assert read_job(ROOT / "deploy" / "examples" / "demo.toml") == DEMO
    assert DEMO.is_demo
    assert stages_of(DEMO) == ("phantom", "capture", "prepare", "fit", "export")


def test_another_folder_called_demo_is_named_by_a_longer_path(tmp_path: Path) -> None:
    spec = job_from_tree({"rig": {"mouth": f"../{tmp_path.name}/demo"}}, tmp_path, "job")
    assert spec.rig is not None
    assert spec.rig.mouth == tmp_path / "demo"
    assert not spec.is_demo


def test_little_disk_is_predicted_and_its_size_is_known() -> None:
    assert predict(DEMO).disk_bytes == MIN_DISK_BYTES + round(DISK_PER_CAPTURE * DEMO_CAPTURE_BYTES)
    size = size_of(DEMO)
    assert size is not None
    assert 10_000 < size.pixels < 100_000


@pytest.mark.usefixtures("small")
def test_the_mouth_is_rendered_once_and_published_for_each_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[StageEvent] = []
    for number in (1, 2):
        phantom(stage_spec(tmp_path / "kept"), LocalContext(tmp_path / f"{number}", listener=told.append))
    assert [event.message for event in told if event.kind == "finished"] == [
        "A virtual incisor was rendered.",
        "A virtual incisor was taken from an earlier demonstration.",
    ]
    assert [path.name for path in (tmp_path / "kept").iterdir()] == ["small"]
    first, second = (open_stage(tmp_path / f"{number}", "phantom", FolderCapture) for number in (1, 2))
    assert first[1] == second[1]
    assert len(first[1].images) == 2
    for path in first[0].rglob("*.npy"):
        assert (second[0] / path.relative_to(first[0])).read_bytes() == path.read_bytes()
    assert (first[0] / "teeth" / "11" / "outer.ply").is_file()

    # A mouth that was kept in part is made again.
    (tmp_path / "kept" / "small" / "capture.json").unlink()
    monkeypatch.setattr(
        demo_mouth, "_render", lambda folder, _report: shutil.copytree(first[0], folder, dirs_exist_ok=True)
    )
    phantom(stage_spec(tmp_path / "kept"), LocalContext(tmp_path / "3", listener=told.append))
    assert told[-1].message == "A virtual incisor was rendered."
    assert open_stage(tmp_path / "3", "phantom", FolderCapture)[1].images


def test_a_cancel_ends_the_rendering_in_mid_kernel(tmp_path: Path) -> None:
    context = LocalContext(tmp_path / "job")
    context.root.mkdir()
    seen: list[float] = []

    def cancel_at_the_first_look(fraction: float) -> None:
        seen.append(fraction)
        if len(seen) == 3:
            raise JobCancelledError("cancelled")

    with pytest.raises(JobCancelledError):
        demo_mouth.make_demo_mouth(tmp_path / "draft", tmp_path / "kept", cancel_at_the_first_look)
    assert seen == [0.0, 0.0, 0.0]
    assert not (tmp_path / "kept").exists()
    time.sleep(1)
    assert not list(tmp_path.rglob("*_var.npy"))


def test_a_rendering_that_fails_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_mouth, "OPTIONS", dict(SMALL) | {"samples": "1"})
    with pytest.raises(
        CrashError, match="could not be rendered: A phantom needs at least one camera, one light, 16 samples"
    ):
        demo_mouth.make_demo_mouth(tmp_path / "draft", tmp_path / "kept", lambda _fraction: None)
    assert [path.name for path in tmp_path.iterdir()] in ([], ["draft"])


def test_each_stage_sees_the_mouth_where_it_is(tmp_path: Path) -> None:
    seen: list[str] = []
    doors = DOORS | {"phantom": "tests.pipeline.test_demo:tell_mouth", "capture": "tests.pipeline.test_demo:tell_mouth"}
    run_stages(
        DEMO,
        tmp_path / "job",
        ("phantom", "capture"),
        lambda event: seen.append(event.message),
        doors=doors,
        phantoms=tmp_path / "kept",
        workers=1,
    )
    assert [line for line in seen if line.startswith("/")] == [
        str(tmp_path / "kept"),
        str(tmp_path / "job" / "phantom"),
    ]
    assert json.loads((tmp_path / "job" / "job.json").read_text())["rig"]["mouth"] == str(DEMO_MOUTH)


def tell_mouth(spec: JobSpec, context: LocalContext) -> None:
    """A stage that records the path of the rig's mouth."""
    assert spec.rig is not None
    context.report(StageEvent(stage="capture", kind="log", message=str(spec.rig.mouth)))


@pytest.mark.dear("A server runs two jobs of five stages each, with workers of their own.")
def test_one_command_runs_it_on_a_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with toy_server(tmp_path / "data") as (client, _):
        server = str(client.base_url).rstrip("/")
        ran = CliRunner().invoke(build_app(), ["demo", "--server", server])
        assert ran.exit_code == 0, ran.output
        (job,) = client.get("/v1/jobs").json()["jobs"]
        assert (job["state"], job["name"], job["spec"]["rig"]["mouth"]) == ("SUCCEEDED", "Demonstration", "demo")
        assert ran.stdout.splitlines()[-1] == f"report: {server}/v1/jobs/{job['id']}/artifacts/report.html"
        stages = client.get(f"/v1/jobs/{job['id']}").json()["stages"]
        assert [(stage["stage"], stage["state"]) for stage in stages] == [
            (name, "finished") for name in stages_of(DEMO)
        ]
        example = ["submit", str(ROOT / "deploy" / "examples" / "demo.toml"), "--watch", "--server", server]
        assert CliRunner().invoke(build_app(), example).exit_code == 0
    assert list(tmp_path.iterdir()) == [tmp_path / "data"]


def test_a_demonstration_has_one_source() -> None:
    with pytest.raises(SettingsError, match="give exactly one of 'capture'"):
        job_from_tree({"capture": "x", "rig": {"mouth": "demo"}}, Path("/"), "job")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_demonstration_finds_the_optics_of_its_mouth(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "services", "demo", "--out", str(tmp_path / "demo"), "--json"]
    ran = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert told["converged"]
    assert [(one["tissue"], one["channel"]) for one in told["reduced_scattering"]] == [
        (tissue, channel) for tissue in ("enamel", "dentin") for channel in ("red", "green", "blue")
    ]
    for one in told["reduced_scattering"]:
        # four standard errors; with a correct ± one run in 2,600 fails by one of six values
        assert abs(one["found"] - one["simulated"]) < 4 * one["se"]
    picture = (tmp_path / "demo" / "asset" / "render_beside_photograph.png").read_bytes()
    assert base64.b64encode(picture).decode() in (tmp_path / "demo" / "report.html").read_text()
