"""``dentine reproduce`` runs an asset's job again from its inputs: the same numbers, or a list of what differs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from services.assets.stage import export
from services.cli.app import build_app
from services.core.errors import CorruptStoreError, MissingStageError, SettingsError
from services.core.provenance.hash_list import write_hash_list
from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.core.store import write_record
from services.fit.stage import run as fit
from services.preprocess.stage import run as prepare
from tests.support.folder_captures import write_folder
from tests.support.prepared import FAKE

OPTIONS: dict[str, Any] = {
    "boundary": "matched", "dentin": "none", "samples_per_pixel": 4, "max_samples_per_pixel": 8, "max_steps": 1,
    "search_candidates": 200, "instrument": "off", "advise": False, "channels": ("green",),
}  # fmt: skip


def run_here(spec: JobSpec, root: Path, *_: object) -> None:
    """All stages in this process, with an engine that needs no renderer."""
    write_record(root / "job.json", spec)
    context = LocalContext(root)
    prepare(spec, context)
    fit(spec, context, engine=FAKE)
    export(spec, context)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a capture and the job that was made from it."""
    root = tmp_path_factory.mktemp("made")
    write_folder(root / "capture")
    (root / "job").mkdir()
    run_here(JobSpec(capture=root / "capture", **OPTIONS), root / "job")
    return root


@pytest.fixture
def copied(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy that a test may alter, with its job's options pointing at its capture; stages run in this process."""
    root = tmp_path / "copied"
    shutil.copytree(made, root)
    write_record(root / "job" / "job.json", JobSpec(capture=root / "capture", **OPTIONS))
    monkeypatch.setattr("services.pipeline.stages.run_job", run_here)
    return root


def reproduce(*words: str | Path) -> Result:
    return CliRunner().invoke(build_app(), ["reproduce", *map(str, words)])


def test_the_same_inputs_give_the_same_numbers(copied: Path) -> None:
    done = reproduce(copied / "job")
    assert done.exit_code == 0, done.output
    assert "numbers and surfaces are equal to the last digit." in done.output


@pytest.mark.parametrize("digit", [12, 3])
def test_a_number_that_differs_in_its_last_digit_is_told(copied: Path, digit: int) -> None:
    asset = copied / "job" / "asset"
    tables = json.loads((asset / "parameters.json").read_text())
    name = "enamel.sigma"
    value = tables["green"][name]["value"]
    tables["green"][name]["value"] = value * (1 + 10.0**-digit)
    (asset / "parameters.json").write_text(json.dumps(tables))
    write_hash_list(asset, "asset")  # as if an earlier version had found this number
    done = reproduce(copied / "job")
    assert done.exit_code == 1
    assert f"parameters.json green {name} value: {value * (1 + 10.0**-digit)} then, {value} now" in done.output
    assert "1 of" in done.output


def test_inputs_that_differ_are_listed_and_nothing_is_run(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.pipeline.stages.run_job", lambda *_: pytest.fail("it was run"))
    np.save(copied / "capture" / "front_left.npy", np.ones((16, 20, 2), dtype=np.float32))
    shutil.copy(copied / "capture" / "teeth" / "11" / "outer.ply", copied / "capture" / "gums.ply")
    done = reproduce(copied / "job")
    assert done.exit_code == 1
    assert done.output.splitlines() == [
        "Input front_left.npy is another file.", "Input gums.ply was not there.",
        "The inputs differ, so nothing was run.",
    ]  # fmt: skip


def test_an_asset_that_was_copied_elsewhere_needs_its_capture_named(copied: Path, tmp_path: Path) -> None:
    shutil.copytree(copied / "job" / "asset", tmp_path / "given")
    found = reproduce(tmp_path / "given")
    assert isinstance(found.exception, SettingsError)
    assert "is not found; name its folder by --capture." in found.exception.message
    assert reproduce(tmp_path / "given", "--capture", copied / "capture").exit_code == 0


def test_another_version_is_told(copied: Path) -> None:
    path = copied / "job" / "asset" / "provenance.json"
    told = json.loads(path.read_text())
    told["versions"]["numpy"] = "1.0"
    path.write_text(json.dumps(told))
    write_hash_list(path.parent, "asset")
    done = reproduce(copied / "job")
    assert done.output.startswith("Version of numpy: 1.0 then, ")
    assert done.exit_code == 0


def test_an_asset_edited_by_hand_or_without_provenance_is_one_sentence(copied: Path) -> None:
    path = copied / "job" / "asset" / "parameters.json"
    path.write_text(path.read_text().replace("enamel", "Enamel"))
    assert isinstance(reproduce(copied / "job").exception, CorruptStoreError)
    (path.parent / "provenance.json").unlink()
    found = reproduce(copied / "job").exception
    assert isinstance(found, MissingStageError)
    assert found.message.endswith("write it again with dentine export.")
