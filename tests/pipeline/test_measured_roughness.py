"""A fit that measures the roughness of its surface first, from photographs with highlights to what it hands on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.job_report import facts_of_fit
from services.assets.stage import export
from services.core.errors import CaptureInputError
from services.core.files.meshes import write_mesh
from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.fit.measurements.observations import read_observations
from services.fit.measurements.surface import held_surface
from services.fit.stage import run
from services.preprocess.stage import run_object
from tests.support.computed_once import folder_once
from tests.support.glossy_bodies import CAMERAS, IOR, LIGHTS, body, photographed, render
from tests.support.prepared import FAKE

ROUGHNESS = 0.2


def write_capture(folder: Path, roughness: float | None) -> None:
    """A folder capture of the glossy body in two channels, the second at half the light; without a roughness, matte."""
    write_mesh(folder / "object" / "outer.ply", body(4))
    images = render(None) + (0 if roughness is None else render(roughness))
    tree: dict[str, Any] = {
        "units": "mm",
        "channels": ["green", "blue"],
        "cameras": [one.model_dump(mode="json") for one in CAMERAS],
        "lights": [
            one.model_dump(mode="json") | {"intensity": [one.intensity[0], one.intensity[0] / 2]} for one in LIGHTS
        ],
        "images": [],
    }
    for photograph in photographed(images, seed=4):
        camera, light = photograph.camera.name, photograph.light.name
        radiance, variance = (
            np.stack([one * scale, one * (scale / 2) ** power], axis=-1)
            for one, scale, power in (
                (photograph.radiance * photograph.light.intensity[0], 1.0, 1),
                (photograph.variance * photograph.light.intensity[0] ** 2, 1.0, 2),
            )
        )
        np.save(folder / f"{camera}_{light}.npy", radiance.astype(np.float32))
        np.save(folder / f"{camera}_{light}_var.npy", variance.astype(np.float32))
        tree["images"].append(
            {"camera": camera, "light": light, "file": f"{camera}_{light}.npy",
             "variance_file": f"{camera}_{light}_var.npy"}
        )  # fmt: skip
    (folder / "capture.json").write_text(json.dumps(tree))


def job_of(capture: Path) -> JobSpec:
    return JobSpec(
        kind="object", capture=capture, boundary="rough", ior=IOR, instrument="off", max_steps=1, pixel_step=8,
        search_candidates=800, samples_per_pixel=32, channels=("green",),
    )  # fmt: skip


def make(folder: Path) -> None:
    capture = folder / "capture"
    capture.mkdir(parents=True)
    write_capture(capture, ROUGHNESS)
    run_object(job_of(capture), LocalContext(folder / "job"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture and its prepared job; nobody may change the capture."""
    return folder_once(tmp_path_factory, "measured-roughness", make)


def test_a_fit_measures_the_roughness_holds_it_and_says_by_what(made: Path) -> None:
    spec, job = job_of(made / "capture"), made / "job"
    report = run(spec, LocalContext(job), engine=FAKE)
    surface = report.surface
    assert surface is not None
    assert surface.highlights is not None
    estimate, seen = surface.roughness, surface.highlights
    assert estimate.se is not None
    assert estimate.determined
    # Within a tenth and three standard errors; the scan's facets are 0.4 mm wide
    assert abs(estimate.value - ROUGHNESS) < min(0.1 * ROUGHNESS, 3 * estimate.se)
    assert 2 <= seen.photographs <= 4
    assert seen.lights == 2  # the third light is held out
    assert report.notes == seen.warnings
    assert f"{seen.photographs} photographs under 2 lights tell the roughness" in facts_of_fit(report)["highlights"]

    # The roughness is measured once: a fit that goes on holds the same to the last digit
    said: list[str] = []
    observations = read_observations(job, spec)
    assert held_surface(spec, observations, job / "fit-checkpoint" / "inputs", said.append) == surface
    assert said == []
    export(spec, LocalContext(job))
    table = json.loads((job / "parameters.json").read_text())["green"]
    assert table["surface.roughness"]["value"] == estimate.value
    assert table["surface.roughness"]["se"] == estimate.se


def test_a_matte_object_is_refused_with_the_remedy(tmp_path: Path) -> None:
    capture, job = tmp_path / "capture", tmp_path / "job"
    capture.mkdir()
    write_capture(capture, None)
    spec = job_of(capture)
    run_object(spec, LocalContext(job))
    with pytest.raises(CaptureInputError, match=r"No photograph shows a highlight.*give roughness a number"):
        held_surface(spec, read_observations(job, spec), tmp_path, print)
