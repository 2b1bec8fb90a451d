"""The column of a scan's shift against the difference of two bright renders of the shifted scan."""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.dentin_shape import DentinShape
from services.fit.measurements.blocks import BlockInstrument, PixelBlock
from services.fit.measurements.instrument.photographs import error_derivatives, photographed, placed, slope_noise
from services.fit.measurements.slopes import image_slopes, motions_of
from services.fit.measurements.view_stack import ViewStack
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import View, single_tooth
from tests.support.prepared import SIZE, camera, sphere

TISSUE = Tissue(Medium(3.0, 0.99, g1=0.3), Medium(6.0, 0.97, g1=0.3))
SAMPLES = 256
STEP_MM = 0.3


@pytest.mark.slow
def test_a_column_is_the_difference_of_renders() -> None:
    lights_mm = np.array([[200.0, 300.0, -700.0], [-500.0, -200.0, -500.0]])
    dentin = DentinShape(sphere(3.0), np.zeros((0, *sphere(3.0).vertices_mm.shape)))
    recipe = single_tooth(sphere(4.0), dentin, lights_mm, np.full(2, 1e6))
    engine, one = Engine(recipe), camera("c0")
    y, x = (index.reshape(-1) for index in np.mgrid[: SIZE[1], : SIZE[0]])
    every = np.stack([x, y], axis=-1).astype(np.int32)
    bright = engine.images(TISSUE, View(one, every), seed=1, samples=SAMPLES)
    usable = np.ones(SIZE[::-1], dtype=bool)
    slopes = np.array([image_slopes(of.reshape(SIZE[::-1]), usable).reshape(4, -1) for of in bright.mean]).swapaxes(
        0, 1
    )
    # Pixels that the ball covers wholly; it has a radius of 8 px.
    inside = np.hypot(x + 0.5 - SIZE[0] / 2, y + 0.5 - SIZE[1] / 2) < 7.0
    image, variance = bright.mean[:, inside], bright.variance[:, inside]
    whole = np.ones(image.shape, dtype=bool)
    stack = ViewStack(one, every[inside], image, variance, whole, whole[:, 0], slopes=slopes[..., inside])
    (motion,) = motions_of(recipe, (stack,))
    acting = BlockInstrument("gain.green", ("light_gain.a", "light_gain.b"), "flare.c0.green", 1.0)
    view = View(one, stack.pixels)
    block = PixelBlock(view, image, variance, np.ones(image.shape), ~whole, instrument=acting, motion=motion)
    for name in ("teeth.tx", "teeth.ty"):
        seen = []
        for sign in (1, -1):
            errors = {name: sign * STEP_MM}
            render = engine.images(TISSUE, placed(block, errors).view, seed=2, samples=2 * SAMPLES).mean
            seen.append(photographed(render, block, errors))
        difference = (seen[0] - seen[1]).reshape(-1) / (2 * STEP_MM)
        (column,) = error_derivatives(image, block, (name,))
        # The noise of the slopes makes the column longer, by a known amount.
        square = float(column @ column - slope_noise(block, (name,))[0][0, 0])
        slope = float(column @ difference) / square
        left = difference - slope * column
        slope_se = float(np.sqrt((left**2).mean() / square))
        assert slope_se < 0.06
        # Three standard errors, and a tenth by what three pixels of the slopes and 1.2 of the difference smooth apart.
        assert slope == pytest.approx(1.0, abs=0.1 + 3 * slope_se)
