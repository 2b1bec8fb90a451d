"""Several teeth, gums and the wall of the mouth: images against stock Mitsuba's ``prbvolpath``, pixel by pixel, and derivatives against differences.

The rule for images is that of ``tests.support.pictures``; an honest engine fails one run in 500, and seeds are fixed.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from services.core.records import Boundary
from services.fit.export.mitsuba_scene import load_scene, render_batches
from services.fit.transport.engine import Engine
from services.fit.transport.platform import prepare_device
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.small_mouth import LIGHTS_MM, MOUTH, mouth_recipe, stock_mouth
from tests.support.small_tooth import camera_at, whole_view


@pytest.mark.parametrize("boundary", ["matched", "thin"])
def test_the_small_mouth_looks_as_in_mitsuba(boundary: Boundary, tmp_path: Path) -> None:
    prepare_device()
    # The thin boundary's plug-in shares no code with the engine.
    importlib.import_module("services.fit.export.shipped.thin_boundary").register()
    camera = camera_at((0.1, 1, 0.2), size=20, span_mm=15.0)
    ours = Engine(mouth_recipe(boundary)).images(MOUTH, whole_view(camera), samples=2048, seed=61, batches=BATCHES)
    scores = []
    for number in range(len(LIGHTS_MM)):
        stock = load_scene(stock_mouth(tmp_path, camera, number, boundary, samples=128))
        mean, variance = render_batches(stock, 0, samples=2048, seed=71 + number, batches=BATCHES)
        scores.append(pixel_scores([ours.mean[number].reshape(mean.shape), mean], [ours.variance[number].reshape(mean.shape), variance]))
    require_same_pictures(np.stack(scores), least=500)
