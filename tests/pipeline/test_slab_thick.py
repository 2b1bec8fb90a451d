"""A thick cell, whose fit starts far from the true sigma_s at nearly the true sigma_s'."""

from __future__ import annotations

import numpy as np
import pytest

from services.bench.slab.cell import near_beam_folder
from services.slab.cell.dictionary import ANGLES_RAD, Material, tent_solid_angles
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.read.images import Measurements, shot_noise
from services.slab.solve.budget import Budget
from services.slab.solve.coordinates import Knots
from services.slab.solve.gauss_newton import GaussNewton
from services.slab.solve.start import start
from services.slab.solve.uncertainty import slopes, uncertainty_of

THICKNESS = 6.0
"""Optical thickness sigma_t w, with a width w of 1 mm."""
NOISE = 0.03
"""Relative noise of the images, three times that of a measurement. The variance of renders with 1.6 million paths per
light is a tenth of it, so they are practically exact."""


def small_spheres() -> Material:
    """Material with Rayleigh's phase function times a forward one, as of spheres of a third of the wavelength; g is
    0.32.
    """
    cosines = np.cos(ANGLES_RAD)
    shape = (1 + cosines**2) * (1 + 0.8 * cosines)
    return Material(THICKNESS * shape / float(shape @ tent_solid_angles()), 0.0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_fit_finds_its_way_from_a_start_that_is_far_off() -> None:
    true, folder = small_spheres(), near_beam_folder()
    rig = rig_of(folder, folder.wavelengths_nm[0])
    exact = render(rig, true, seed=99, step=0, batches=8, paths=200_000, scores=False).mean
    variances = np.stack([shot_noise(image, NOISE) for image in exact])
    values = exact + np.sqrt(variances) * np.random.default_rng(1).normal(size=exact.shape)
    places = tuple((entry.camera, entry.light) for entry in folder.images)
    measured = Measurements(values, variances, np.zeros(len(values), dtype=bool), places, assumed_noise=False)

    guess = start(rig, measured, 1, map)
    assert guess.scattering_per_mm < 0.8 * true.scattering_per_mm
    solution = GaussNewton(rig, measured, 1, Budget().scaled(0.2), map, Knots()).solve(lambda: guess)
    found, uncertainty = solution.material, uncertainty_of(solution)
    # The limits are three standard errors. That of sigma_s is a few per cent, with a fifth of the paths and three times
    # the noise.
    for name, value, truth, largest in (
        ("sigma_s", found.scattering_per_mm, true.scattering_per_mm, 0.12),
        ("sigma_s_reduced", found.reduced_scattering_per_mm, true.reduced_scattering_per_mm, 0.03),
    ):
        error = uncertainty.standard_error(slopes(found)[name])
        assert abs(value - truth) <= 3 * error, (name, value, truth, error)
        assert error <= largest * truth, (name, value, truth, error)
