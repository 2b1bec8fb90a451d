"""Images compared to stock Mitsuba's ``prbvolpath`` on the same nested scene, pixel by pixel.

The rule is that of ``tests.support.pictures``; a correct engine fails one run in 500, and seeds are fixed. Runs that
are not slow compare a quarter of the pixels, or blocks of four times as many, with as many paths in each; the rule's
bounds follow from the number of values.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches
from services.core.files.meshes import read_teeth, write_mesh
from services.core.records import Boundary, FolderCapture
from services.core.store import read_record
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import single_tooth
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.shared_data import shared_path
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, whole_view

TISSUE = Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4.0, 0.85, 1.0, 0.5))


@pytest.mark.dear("Stock Mitsuba renders the same scene.")
@pytest.mark.parametrize("size", [8, pytest.param(16, marks=pytest.mark.slow)])
@pytest.mark.parametrize("boundary", ["matched", "thin"])
def test_the_small_tooth_looks_as_in_mitsuba(boundary: Boundary, size: int, tmp_path: Path) -> None:
    prepare_device()
    # The thin boundary's plug-in shares no code with the engine.
    importlib.import_module("services.assets.mitsuba.shipped.thin_boundary").register()
    outer, shape = ellipsoid(SEMI_AXES_MM), dentin_shape()
    core = shape.vertices_mm((0.5, 0.4))
    dentin = DentinShape.known(type(outer)(core, outer.faces))
    camera = camera_at((0.2, 1, 0.1), size=size, span_mm=5.0)
    write_mesh(tmp_path / "outer.ply", outer)
    write_mesh(tmp_path / "dentin.ply", dentin.base)
    lights = LIGHTS_MM[[1, 3]]
    scene = single_tooth(outer, dentin, lights, np.full(2, INTENSITY), boundary)
    ours = Engine(scene).images(TISSUE, whole_view(camera), samples=2048, seed=21, batches=BATCHES)
    scores = []
    for number, light in enumerate(lights):
        teeth = {"11": (tmp_path / "outer.ply", tmp_path / "dentin.ply")}
        stock = load_scene(nested_scene(teeth, TISSUE, (camera,), light, INTENSITY, boundary=boundary))
        mean, variance = render_batches(stock, 0, samples=2048, seed=31 + number, batches=BATCHES)
        scores.append(
            pixel_scores(
                [ours.mean[number].reshape(mean.shape), mean], [ours.variance[number].reshape(mean.shape), variance]
            )
        )
    require_same_pictures(np.stack(scores), least=2 * size**2 - 12)


@pytest.mark.dear("Stock Mitsuba renders a real scan as well.")
@pytest.mark.parametrize(
    ("samples", "block", "least"),
    [
        pytest.param(256, 8, 60, id="large-blocks"),
        pytest.param(1024, 4, 250, id="blocks", marks=pytest.mark.slow),
        pytest.param(8192, 2, 800, id="small-blocks", marks=pytest.mark.slow),
    ],
)
def test_the_scanned_incisor_looks_as_in_mitsuba(samples: int, block: int, least: int) -> None:
    # Pixels with few paths have skewed noise, as the truth has with 5,120, and no t-distribution corrects that; sums
    # over blocks of pixels are not skewed.
    root = shared_path("data/tooth-ur1-truth")
    capture, tooth = read_record(root / "capture.json", FolderCapture), read_teeth(root)[0]
    truth = json.loads((root / "truth.json").read_text())
    enamel, inner = truth["enamel"], truth["dentin"]
    tissue = Tissue(
        Medium(enamel["sigma_t"], enamel["albedo"], enamel["beta"], enamel["g1"], enamel["g2"]),
        Medium(inner["sigma_t"], inner["albedo"], g1=inner["g"]),
    )
    assert tooth.dentin is not None
    dentin = DentinShape.known(tooth.dentin)
    lights = np.array([light.position_mm for light in capture.lights])
    engine = Engine(
        single_tooth(tooth.outer, dentin, lights, np.array([light.intensity[0] for light in capture.lights]))
    )
    camera = capture.cameras[0]
    ours = engine.images(tissue, whole_view(camera), samples=samples, seed=41, batches=BATCHES)
    stems = [root / f"{camera.name}_{light.name}" for light in capture.lights]
    stock, variance = (
        np.stack([np.load(f"{stem}{part}.npy").squeeze() for stem in stems]).astype(np.float64) for part in ("", "_var")
    )
    z = pixel_scores([ours.mean.reshape(stock.shape), stock], [ours.variance.reshape(stock.shape), variance], block)
    require_same_pictures(z, least)
