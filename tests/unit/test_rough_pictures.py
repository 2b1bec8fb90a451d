"""What is rendered of an asset with a rough surface has the surface that its fit held."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.assets.appearance import shade as shade_module
from services.assets.appearance.guide import Guide, Tab
from services.assets.asset import middle_of
from services.assets.colour.beside import Shown, beside
from services.core.geometry import Mesh, Tooth
from services.core.records import JobSpec
from services.core.results import Estimate, PreparedManifest, RoughSurface
from services.core.store import StoredArray, open_stage
from services.transport import engine as engine_module
from services.transport.scene.recipe import SceneRecipe
from tests.support.colour_job import LIGHTS, report, write_job
from tests.support.prepared import camera, sphere

SURFACE = RoughSurface(
    roughness=Estimate(value=0.4, se=0.01, unit="1", determined=True), ior=1.5, multiple_scattering=False
)


class _AskedError(Exception):
    def __init__(self, recipe: SceneRecipe) -> None:
        self.surface = recipe.boundary, recipe.ior, recipe.roughness, recipe.multiple_scattering


def _asked(recipe: SceneRecipe) -> None:
    raise _AskedError(recipe)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_job(tmp_path_factory.mktemp("rough") / "job", 1)


def test_the_first_pictures_renders_have_the_fits_surface(job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "Engine", _asked)
    folder, prepared = open_stage(job, "prepared", PreparedManifest, verify=False)
    radiance, ball = StoredArray(folder / "prepared.zarr" / "radiance"), sphere(4.0)
    tooth = Tooth(11, ball, Mesh(0.8 * ball.vertices_mm, ball.faces))
    shown = Shown((tooth,), (camera("c0"),), LIGHTS, middle_of((tooth,)))
    fitted = report().model_copy(update={"surface": SURFACE})
    with pytest.raises(_AskedError) as asked:
        beside(JobSpec(capture=job, boundary="rough", ior=1.5), fitted, prepared, radiance, shown)
    assert asked.value.surface == ("rough", 1.5, 0.4, False)


def test_a_shade_is_that_of_the_fits_surface(job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shade_module, "Engine", _asked)
    rig = json.loads((job / "asset" / "rig.json").read_text())
    told = {"boundary": "rough", "ior": 1.5, "roughness": 0.4, "multiple_scattering": False}
    (job / "asset" / "rig.json").write_text(json.dumps(rig | told))
    guide = Guide("guide", "45/0", "D65", (Tab("A1", np.array([75.0, 1.0, 15.0]), 0.5),))
    with pytest.raises(_AskedError) as asked:
        shade_module.shade_of(job / "asset", guide)
    assert asked.value.surface == ("rough", 1.5, 0.4, False)
