"""An external package adds a kind of job by an entry point, and the job runs on spawned workers, which find it so."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = '''
"""Weighs a capture: how many bytes its folder holds."""

from pathlib import Path

from services.core.job_kinds import JobKind
from services.core.results import AssetManifest
from services.core.store import StageWriter

KIND = JobKind("weight of a capture in bytes", ("export",), {"export": "weighing:export"}, frozenset())


def export(spec, context):
    writer = StageWriter(context.root, "asset", context.attempt)
    total = sum(path.stat().st_size for path in Path(spec.capture).rglob("*") if path.is_file())
    (writer.folder / "weight.txt").write_text(str(total))
    manifest = AssetManifest(files=("weight.txt",), held_out_error=0.0)
    writer.publish(manifest)
    return manifest
'''


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Environment in which the package is installed in a folder of its own."""
    site = tmp_path / "site"
    described = site / "weighing-1.dist-info"
    described.mkdir(parents=True)
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: weighing\nVersion: 1\n")
    (described / "entry_points.txt").write_text("[dentine.job_kinds]\nweight = weighing:KIND\n")
    (site / "weighing.py").write_text(PACKAGE)
    return os.environ | {"PYTHONPATH": os.pathsep.join((str(site), str(ROOT)))}


def job_file(folder: Path, kind: str = "weight", extra: str = "") -> Path:
    (folder / "capture").mkdir()
    (folder / "capture" / "capture.json").write_text("{}")
    (folder / "job.toml").write_text(f'kind = "{kind}"\ncapture = "capture"\n{extra}')
    return folder / "job.toml"


def test_an_added_kind_is_known_beside_the_others(tmp_path: Path, environment: dict[str, str]) -> None:
    code = (
        "from services.core.settings import read_job; from pathlib import Path;"
        f" print(read_job(Path({str(job_file(tmp_path))!r})).kind)"
    )
    answer = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "weight"


def test_without_its_package_the_kind_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "services", "run", str(job_file(tmp_path)), "--out", str(tmp_path / "out")]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert answer.returncode != 0
    assert "there is no kind of job 'weight'; the kinds are tooth, jaw, object, slab, calibration" in answer.stderr


def test_an_option_of_another_kind_is_refused(tmp_path: Path, environment: dict[str, str]) -> None:
    command = [
        sys.executable,
        "-m",
        "services",
        "run",
        str(job_file(tmp_path, extra="lobes = 2")),
        "--out",
        str(tmp_path / "out"),
    ]
    answer = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode != 0
    assert "a job of kind weight has no option 'lobes'" in answer.stderr


@pytest.mark.slow
def test_an_added_kind_runs_on_two_workers(tmp_path: Path, environment: dict[str, str]) -> None:
    command = [
        sys.executable,
        "-m",
        "services",
        "run",
        str(job_file(tmp_path)),
        "--out",
        str(tmp_path / "out"),
        "--workers",
        "2",
        "--json",
    ]
    answer = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout)["files"] == ["weight.txt"]
    assert (tmp_path / "out" / "asset" / "weight.txt").read_text() == "2"
