"""Several teeth, gums and the wall of the mouth: images compared to stock Mitsuba's ``prbvolpath``, pixel by pixel.

The rule for images is that of ``tests.support.pictures``; a correct engine fails one run in 500, and seeds are fixed.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from services.assets.mitsuba.scene import load_scene, render_batches
from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.lighting.mouth_maps import MouthMaps
from services.transport.platform import prepare_device
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.small_mouth import LIGHTS_MM, MOUTH, mouth_recipe, stock_mouth
from tests.support.small_tooth import camera_at, whole_view


@pytest.mark.parametrize(
    ("boundary", "size"),
    [
        ("thin", 10),
        pytest.param("thin", 20, marks=pytest.mark.slow),
        pytest.param("matched", 20, marks=pytest.mark.slow),
    ],
)
def test_the_small_mouth_looks_as_in_mitsuba(boundary: Boundary, size: int, tmp_path: Path) -> None:
    prepare_device()
    # The thin boundary's plug-in shares no code with the engine.
    importlib.import_module("services.assets.mitsuba.shipped.thin_boundary").register()
    camera = camera_at((0.1, 1, 0.2), size=size, span_mm=15.0)
    ours = Engine(mouth_recipe(boundary)).images(MOUTH, whole_view(camera), samples=2048, seed=61, batches=BATCHES)
    scores = []
    for number in range(len(LIGHTS_MM)):
        stock = load_scene(stock_mouth(tmp_path, camera, number, boundary, samples=128))
        mean, variance = render_batches(stock, 0, samples=2048, seed=71 + number, batches=BATCHES)
        scores.append(
            pixel_scores(
                [ours.mean[number].reshape(mean.shape), mean], [ours.variance[number].reshape(mean.shape), variance]
            )
        )
    require_same_pictures(np.stack(scores), least=5 * size**2 // 4)


def test_coarser_tables_of_larger_scenes_change_the_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    view = whole_view(camera_at((0.1, 1, 0.2), size=12, span_mm=15.0))
    fine = Engine(mouth_recipe("thin")).images(MOUTH, view, samples=1024, seed=5, batches=BATCHES)
    monkeypatch.setattr(MouthMaps, "MAX_BYTES", 2**14)
    monkeypatch.setattr("services.transport.scene.clearance.MAX_CELLS", 2000)
    coarse = Engine(mouth_recipe("thin")).images(MOUTH, view, samples=1024, seed=6, batches=BATCHES)
    # Pixels are independent of each other, but the two lights of a pixel are not.
    spread = np.sqrt(sum(image.variance.sum(axis=1) for image in (fine, coarse)))
    assert (np.abs(fine.mean.sum(axis=1) - coarse.mean.sum(axis=1)) < 4 * spread).all()
    assert (spread < 0.01 * fine.mean.sum(axis=1)).all()
    assert coarse.variance.sum() > fine.variance.sum()
