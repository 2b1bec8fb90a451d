"""Faulty captures from the folder to the asset, with the real engine: the advice for each, and its effect on a fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from services.assets.stage import export
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.fit.stage import run
from services.phantom.tooth import write_phantom
from services.preprocess.stage import run as prepare

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "tooth"
    write_phantom(
        folder,
        pixel_mm=0.8,
        cameras=2,
        lights=5,
        held_out=1,
        channels=1,
        boundary="matched",
        renderer="engine",
        samples=512,
        seed=1,
    )
    return folder


def fit(root: Path, capture: Path, damage: Callable[[Path], None], **options: Any) -> tuple[FitReport, str]:
    """Fit a damaged copy of a capture; returns the report and the text of its page."""
    shutil.copytree(capture, root / "capture")
    damage(root / "capture")
    short: dict[str, Any] = {
        "boundary": "matched",
        "dentin": "known",
        "samples_per_pixel": 16,
        "max_samples_per_pixel": 128,
        "max_steps": 3,
    }
    spec = JobSpec(capture=root / "capture", search_candidates=1000, advise=False, **(short | options))
    for stage in (prepare, run, export):
        stage(spec, LocalContext(root / "job"))
    page = (root / "job" / "report.html").read_text()
    return FitReport.model_validate_json(
        json.dumps(json.loads((root / "job" / "fit" / "manifest.json").read_text())["record"])
    ), page


def move_meshes(offset_mm: tuple[float, float, float]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        for path in folder.glob("teeth/*/*.ply"):
            mesh = trimesh.load_mesh(path, process=False)
            mesh.apply_translation(offset_mm)
            mesh.export(path)

    return damage


def darken_one(folder: Path) -> None:
    image = np.load(folder / "c0_l1.npy")
    np.save(folder / "c0_l1.npy", np.zeros_like(image))


def test_meshes_beside_their_images_are_noticed_and_measured(capture: Path, tmp_path: Path) -> None:
    report, page = fit(tmp_path, capture, move_meshes((2.0, 0.0, 0.0)))
    assert not report.converged
    first = report.advice.split(". ")[0]
    assert "recalibrate the camera or register the mesh again" in first
    # Both cameras look nearly along y, so they see the shift of 2 mm in x; the tolerance is one pixel of 0.8 mm.
    assert float(first.split("about ")[1].split(" mm")[0]) == pytest.approx(2.0, abs=0.8)
    assert page.index("recalibrate the camera") < page.index("Error on held-out images")
    assert (tmp_path / "job" / "asset" / "NOT-CONVERGED.txt").is_file()


def test_meshes_in_place_are_not_suspected(capture: Path, tmp_path: Path) -> None:
    report, page = fit(tmp_path, capture, lambda _: None)
    assert "register" not in report.advice + page


def test_a_boundary_that_is_not_the_captures_is_not_blamed_on_the_pose(capture: Path, tmp_path: Path) -> None:
    report, _ = fit(tmp_path, capture, lambda _: None, boundary="thin")
    assert "register" not in report.advice


def test_a_dark_image_does_not_bend_the_fit(capture: Path, tmp_path: Path) -> None:
    report, page = fit(tmp_path, capture, darken_one)
    assert any(note.startswith("Dark and left out: camera c0 under light l1") for note in report.notes)
    assert page.index("Dark and left out") < page.index("Error on held-out images")
    assert report.held_out_error["green"] < 0.15
