"""The fit of one tooth in its gums among other teeth, of photographs that light from all of them reached."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import MANIFEST
from services.fit.stage import export, run
from tests.support.small_jaw import jaw_spec, write_prepared_jaw

FITTED = 11
ENGINE = "services.fit.transport.engine:Engine"


def fit(photographed: Path, root: Path, *, surroundings: bool, max_steps: int) -> FitReport:
    shutil.copytree(photographed, root, dirs_exist_ok=True)
    if not surroundings:
        manifest = json.loads((root / "prepared" / MANIFEST).read_text())
        manifest["record"]["surroundings"] = False
        (root / "prepared" / MANIFEST).write_text(json.dumps(manifest))
    spec = jaw_spec(root, kind="tooth", instrument="off", advise=False, max_steps=max_steps)
    report = run(spec, LocalContext(root, 1))
    export(spec, LocalContext(root, 1))
    return report


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("photographed")
    write_prepared_jaw(root, ENGINE, only=FITTED)
    return root


@pytest.fixture(scope="module")
def around(photographed: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FitReport]:
    root = tmp_path_factory.mktemp("around")
    return root, fit(photographed, root, surroundings=True, max_steps=6)


def test_a_fit_among_other_teeth_converges(around: tuple[Path, FitReport]) -> None:
    # These few coarse pixels hardly determine the media; tests.benchmarks.surroundings compares them with the truth.
    # Without surroundings, as in the slow test below, the held-out error was 0.28 with at most 64 paths a pixel.
    assert around[1].converged
    assert around[1].held_out_error["green"] < 0.1


@pytest.mark.slow
def test_light_from_gums_and_other_teeth_is_explained(
    photographed: Path, around: tuple[Path, FitReport], tmp_path: Path
) -> None:
    _, with_them = around
    alone = fit(photographed, tmp_path, surroundings=False, max_steps=2)
    assert alone.held_out_error["green"] > 3 * with_them.held_out_error["green"]


def test_the_gums_are_reported_beside_the_tooth(around: tuple[Path, FitReport]) -> None:
    root, report = around
    table = report.parameters["green"]
    assert table["gums.alpha"].se is not None
    assert table["gums.sigma"].se is None
    assert ">Gums<" in (root / "report.html").read_text()
    told = json.loads((root / "parameters.json").read_text())["green"]
    assert told["gums.sigma_a"]["value"] > 0
