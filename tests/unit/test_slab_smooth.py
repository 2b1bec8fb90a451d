"""Smoothing the derivatives of a slab's images over pixels."""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.cell.forward import Batches
from services.slab.cell.rig import Grid
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.smooth import smoother_of

GRID = Grid(x_from_mm=-4, y_from_mm=0, pitch_x_mm=0.5, pitch_y_mm=0.5, columns=16, rows=8, folded=True)
X_MM, Y_MM = (one.ravel() for one in np.meshgrid(np.arange(-3.75, 4, 0.5), np.arange(0.25, 4, 0.5)))
DISTANCE = np.sqrt(X_MM**2 + Y_MM**2 + 0.25)
IMAGE = np.exp(-2 * np.hypot(X_MM, Y_MM))
"""Diffuse light falls by a factor of e every half millimetre, to 1e-5 over these pixels."""
VARIANCE = 1e-4 * np.maximum(IMAGE, 0.01 * IMAGE.mean())
FUNCTIONS = 6
BATCHES = 20


def batches(relative: np.ndarray, single: np.ndarray) -> Batches:
    """Batches of one image; ``relative`` (B, pixels, UNKNOWNS) is its derivatives over the light scattered twice and
    more.
    """
    images = np.tile(IMAGE, (len(relative), 1, 1))
    return Batches(images, (single + IMAGE[:, None] * relative)[:, None], np.zeros((1, GRID.pixels)), single[None])


def test_what_varies_slowly_stays_and_single_scattering_too() -> None:
    rng = np.random.default_rng(1)
    # The relative derivative of diffuse light by its rate of fall is the distance; a slanted beam adds a part that is
    # odd in x.
    slow = rng.standard_normal(UNKNOWNS) * DISTANCE[:, None] + rng.standard_normal(UNKNOWNS) * X_MM[:, None]
    given = batches(slow[None], rng.standard_normal((GRID.pixels, UNKNOWNS)))
    smooth = smoother_of(GRID, 1.0, IMAGE[None], VARIANCE[None]).of(given)
    assert smooth.images is given.images
    # Rounding of numbers that the smoothing multiplies and divides by the image's range of 1e5.
    np.testing.assert_allclose(smooth.rows, given.rows, rtol=1e-8, atol=1e-10)


def test_noise_is_left_in_six_functions_alone() -> None:
    rng = np.random.default_rng(2)
    noise = np.zeros((BATCHES, GRID.pixels, UNKNOWNS))
    # Noise in proportion to that of the pixels, so that all have equal weight.
    noise[..., :50] = rng.standard_normal((BATCHES, GRID.pixels, 50)) * (np.sqrt(VARIANCE) / IMAGE)[:, None]
    given = batches(noise, np.zeros((GRID.pixels, UNKNOWNS)))
    smooth = smoother_of(GRID, 1.0, IMAGE[None], VARIANCE[None]).of(given)
    power = [float((one.rows**2 / VARIANCE[:, None]).sum()) for one in (given, smooth)]
    # The ratio is that of 6 functions to 128 pixels; 1,000 draws of six squares have a mean known to 1.8 %.
    assert power[1] / power[0] == pytest.approx(FUNCTIONS / GRID.pixels, rel=0.07)


def test_pixels_that_do_not_weigh_take_no_part() -> None:
    rng = np.random.default_rng(3)
    variance = np.where(X_MM > 2, np.inf, VARIANCE)
    smoother = smoother_of(GRID, 1.0, IMAGE[None], variance[None])
    single, relative = np.zeros((GRID.pixels, UNKNOWNS)), rng.standard_normal((1, GRID.pixels, UNKNOWNS))
    first = smoother.of(batches(relative, single)).rows
    relative[:, np.isinf(variance)] = 1e6
    np.testing.assert_array_equal(smoother.of(batches(relative, single)).rows, first)
    assert not first[0, 0, np.isinf(variance)].any()
    nothing = smoother_of(GRID, 1.0, np.zeros((1, GRID.pixels)), np.full((1, GRID.pixels), np.inf))
    assert not nothing.of(batches(relative, single)).rows.any()
