"""The gradient of an L2 loss to both media, compared to the backward pass of stock ``prbvolpath`` on a small tooth
under two lights.

The two share no code. Correct gradients fail one run in 1000 (t-tests with the fewest possible degrees of freedom,
Bonferroni), and seeds are fixed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene
from services.bench.transport.gradient import our_gradient
from services.bench.transport.gradient_rows import of_parts
from services.bench.transport.stock_gradient import StockGradient
from services.core.files.meshes import write_mesh
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import single_tooth
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, whole_view

TISSUE = Tissue(Medium(1.5, 0.9, 0.7, 0.6, -0.3), Medium(0.7, 0.7, g1=0.5))
OTHER = Tissue(Medium(1.0, 0.6, 0.4, 0.8, -0.3), Medium(1.0, 0.5, g1=-0.2))
"""Tissue of the reference images, so different that no component of the gradient is near 0."""
REPEATS, SAMPLES = 16, 128
LARGEST_ERROR = 0.15
"""Largest standard error of the difference, as a fraction of the component. It is 13 % for sigma of dentin and 2 to 6 %
for all others, for which errors of a third would show."""
FALSE_ALARM = 1e-3


@pytest.mark.dear("Stock Mitsuba's adjoint kernels take seconds to compile where none are cached.")
def test_gradients_agree_with_prbvolpath(tmp_path: Path) -> None:
    outer, core = ellipsoid(SEMI_AXES_MM), dentin_shape().vertices_mm((0.5, 0.4))
    dentin = DentinShape.known(type(outer)(core, outer.faces))
    files = tmp_path / "outer.ply", tmp_path / "dentin.ply"
    write_mesh(files[0], outer)
    write_mesh(files[1], dentin.base)
    camera, lights = camera_at((0.2, 1, 0.1)), LIGHTS_MM[[0, 2]]
    engine, view = Engine(single_tooth(outer, dentin, lights, np.full(2, INTENSITY))), whole_view(camera)
    reference = engine.images(OTHER, view, samples=1024, seed=5).mean

    theirs = []
    for number, light in enumerate(lights):
        scene = load_scene(nested_scene({"11": files}, TISSUE, (camera,), light, INTENSITY, ior=1.0))
        stock = StockGradient(scene, TISSUE, view)
        theirs.append(
            [stock(reference[number], samples=SAMPLES, seed=50 * (number + 1) + repeat) for repeat in range(REPEATS)]
        )
    peer = of_parts(np.array(theirs).transpose(1, 2, 0), 0.0)
    ours, _ = our_gradient(engine, TISSUE, view, reference, stock.names, np.arange(2), samples=SAMPLES, repeats=REPEATS)

    error = np.sqrt(peer.mean_variance + ours.mean_variance)
    assert (error <= LARGEST_ERROR * np.abs(peer.mean)).all(), dict(zip(stock.names, error / peer.mean, strict=True))
    limit = stats.t.isf(FALSE_ALARM / (2 * len(error)), REPEATS - 1)
    t = dict(zip(stock.names, (ours.mean - peer.mean) / error, strict=True))
    assert max(map(abs, t.values())) <= limit, t
