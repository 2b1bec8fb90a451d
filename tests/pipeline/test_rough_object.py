"""A job of kind object with a rough surface: from a virtual capture to numbers, scenes and report that name it."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.stage import export
from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.fit.stage import run
from services.phantom.object import write_object_phantom
from services.preprocess.stage import run_object
from services.transport.platform import prepare_device
from tests.support.command_line import dentine
from tests.support.computed_once import folder_once
from tests.support.prepared import FAKE

SURFACE: dict[str, Any] = {"boundary": "rough", "roughness": 0.3, "ior": 1.4}


def make(folder: Path) -> None:
    capture, job = folder / "capture", folder / "job"
    write_object_phantom(
        capture, pixel_mm=1.6, cameras=1, lights=1, samples=512, held_out=0, multiple_scattering=False, **SURFACE
    )
    spec = JobSpec(
        kind="object", capture=capture, multiple_scattering="off", instrument="off", max_steps=1,
        search_candidates=800, samples_per_pixel=32, **SURFACE,
    )  # fmt: skip
    run_object(spec, LocalContext(job))
    run(spec, LocalContext(job), engine=FAKE)
    export(spec, LocalContext(job))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere's capture and job; nobody may change them."""
    return folder_once(tmp_path_factory, "rough-object", make)


def test_the_truth_names_the_surface(made: Path) -> None:
    truth = json.loads((made / "capture" / "truth.json").read_text())
    told = {"boundary": "rough", "roughness": 0.3, "ior": 1.4, "multiple_scattering": False}
    assert {name: truth[name] for name in told} == told


def test_numbers_say_which_surface_was_held(made: Path) -> None:
    for folder in (made / "job", made / "job" / "asset"):
        table = json.loads((folder / "parameters.json").read_text())["green"]
        values = {name: table[f"surface.{name}"]["value"] for name in ("roughness", "ior", "multiple_scattering")}
        assert values == {"roughness": 0.3, "ior": 1.4, "multiple_scattering": 0}
        assert table["surface.roughness"]["se"] is None
    rig = json.loads((made / "job" / "asset" / "rig.json").read_text())
    told = {"boundary": "rough", "roughness": 0.3, "ior": 1.4, "multiple_scattering": False}
    assert {name: rig[name] for name in told} == told


def test_the_report_says_it_in_words(made: Path) -> None:
    page = (made / "job" / "report.html").read_text()
    assert "rough dielectric, index 1.4, GGX roughness 0.3; light that meets several facets is lost" in page


def test_scenes_have_mitsubas_own_surface(made: Path) -> None:
    asset = made / "job" / "asset"
    for name in ("scene.xml", "scene_green.xml"):
        surface = re.search(r'<bsdf type="roughdielectric".*?</bsdf>', (asset / name).read_text(), re.DOTALL)
        assert surface is not None
        values = dict(re.findall(r'name="([a-z_]+)" value="([^"]+)"', surface[0]))
        assert values == {"distribution": "ggx", "alpha": "0.3", "int_ior": "1.4", "ext_ior": "1.0"}
    assert not (asset / "thin_boundary.py").exists()


def test_the_assets_own_script_renders_it(made: Path) -> None:
    prepare_device()
    render = runpy.run_path(str(made / "job" / "asset" / "render.py"))["render"]
    image = render(made / "job" / "asset", "c0", "l0", 64, integrator="prbvolpath")
    photo = np.load(made / "capture" / "c0_l0.npy")
    assert image.shape == photo.shape
    # The photograph lacks the highlight, and the fake engine's media are not the ball's; both shine where the ball is.
    shown = photo > 0.2 * photo.max()
    assert np.isfinite(image).all()
    assert image[shown].min() > 0
    assert image[photo == 0].max() < 0.2 * image.max()


def test_a_phantom_takes_its_surface_from_the_command_line(tmp_path: Path) -> None:
    sizes = ("--pixel-mm", "3", "--cameras", "1", "--lights", "1", "--held-out", "0", "--samples", "16")
    surface = ("--boundary", "rough", "--roughness", "0.2", "--ior", "1.33", "--multiple-scattering", "off")
    ran = dentine("phantom", "--out", str(tmp_path), "--object", "cube", "--renderer", "mitsuba", *surface, *sizes)
    assert ran.returncode == 0, ran.stderr
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert (truth["renderer"], truth["roughness"], truth["ior"]) == ("mitsuba", 0.2, 1.33)
    image = np.load(tmp_path / "c0_l0.npy")
    assert np.isfinite(image).all()
    assert image.max() > 0
