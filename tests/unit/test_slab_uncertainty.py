"""The standard errors of a slab's fit: from the observed noise of the gradient, and from the distance to the minimum
where a fit ended early.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.slab.cell.dictionary import ANGLES_RAD, KNOTS, henyey_greenstein
from services.slab.dictionaries.through_beam import Index
from services.slab.results.result import Errors, parameters_of, phase_of, with_believable_flags
from services.slab.solve.coordinates import Knots
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.prior import Quadratic
from services.slab.solve.solution import Solution
from services.slab.solve.uncertainty import Uncertainty, largest_move, resolution_deg, uncertainty_of
from tests.support.small_slab import made_up_fit

MATERIAL = henyey_greenstein(2.0, 0.5, 0.1)
CURVATURE = 1e4
"""Curvature of every unknown, so large that no prior matters: an unknown's variance is that of its gradient over the
square of this."""


def solution(short: np.ndarray, rendering: float) -> Solution:
    """A fit that ended ``short`` (U,) of its minimum.

    Args:
        rendering: variance of each part of the gradient by the paths, in units of that by the measurements.
    """
    x = Knots().unknowns(MATERIAL)
    matrix, nothing = CURVATURE * np.eye(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS))
    quadratic = Quadratic(matrix, -matrix @ (x + short), nothing, np.zeros(UNKNOWNS), nothing)
    return Solution(
        MATERIAL, quadratic, rendering * matrix, 30.0, used=1, steps=1, converged=True, paths=1, coordinates=Knots(),
        misfit=0.0, misfit_se=0.0, data_noise=matrix, matrix_error_gradient=np.zeros(UNKNOWNS), path_variance=0.0,
    )  # fmt: skip


def standard_error(one: Solution) -> float:
    """Standard error of the mean of ln f, which the smoothness prior does not affect."""
    return uncertainty_of(one).standard_error(np.append(np.full(KNOTS, 1 / KNOTS), 0.0))


def test_images_that_know_each_knot_resolve_its_spacing_and_others_less() -> None:
    fine, coarse = (resolution_deg(kernels(curvature)) for curvature in (1e9, 100.0))
    np.testing.assert_allclose(fine, 180 / (KNOTS - 1), rtol=0.01)
    assert np.median(coarse) > 5
    assert coarse.max() <= 180


def test_kernels_pass_what_is_wide_and_average_what_is_narrow() -> None:
    averaging, inner = kernels(100.0), slice(KNOTS // 4, 3 * KNOTS // 4)
    wide, narrow = (np.cos(2 * np.pi * np.degrees(ANGLES_RAD) / period_deg) for period_deg in (90, 3))
    np.testing.assert_allclose(averaging @ np.ones(KNOTS), 1, rtol=1e-6)
    np.testing.assert_allclose((averaging @ wide)[inner], wide[inner], atol=0.05)
    assert np.abs(averaging @ narrow)[inner].max() < 0.05


def test_a_move_is_told_in_standard_errors_of_what_is_reported() -> None:
    one = np.full(UNKNOWNS, 1e-4)  # variances: 1 % of each value of ln f, 0.01 per mm of absorption
    uncertainty = Uncertainty(np.diag(one), np.diag(one), (np.diag(one), np.diag(one)))
    assert largest_move(MATERIAL, MATERIAL, uncertainty) == 0
    # Absorption alone moves by two and a half of its own, and by more of no other value.
    darker = replace(MATERIAL, absorption_per_mm=MATERIAL.absorption_per_mm + 0.025)
    assert largest_move(MATERIAL, darker, uncertainty) == pytest.approx(2.5)
    # A ripple of the phase function that no coefficient shows counts by its rms: 2 % of values known to 1 %.
    signs = np.where(np.arange(KNOTS) % 2 == 0, 1.0, -1.0)
    rippled = replace(MATERIAL, scattering=MATERIAL.scattering * np.exp(0.02 * signs))
    assert largest_move(MATERIAL, rippled, uncertainty) == pytest.approx(2, rel=0.02)
    # A value that is not determined is not waited for.
    vague = np.diag(np.append(np.ones(KNOTS), 1e-4))
    assert largest_move(MATERIAL, rippled, Uncertainty(vague, vague, (vague, vague))) < 0.1


def kernels(curvature: float) -> np.ndarray:
    """Averaging kernels (KNOTS, KNOTS) of images that give each knot's ln f this curvature."""
    one = solution(np.zeros(UNKNOWNS), 0.0)
    matrix = curvature * np.eye(UNKNOWNS)
    linear = -matrix @ Knots().unknowns(MATERIAL)
    averaging = uncertainty_of(
        replace(one, quadratic=replace(one.quadratic, matrix=matrix, linear=linear), data_noise=matrix)
    ).averaging
    assert averaging is not None
    return averaging


def test_noise_of_the_paths_widens_the_errors() -> None:
    exact, noisy = (standard_error(solution(np.zeros(UNKNOWNS), rendering)) for rendering in (0.0, 3.0))
    assert exact == pytest.approx((KNOTS * CURVATURE) ** -0.5, rel=1e-3)
    assert noisy == pytest.approx(2 * exact, rel=1e-3)


def test_a_way_that_is_left_counts_as_error() -> None:
    # All of ln f is 5 % short, so sigma_s is as well.
    short = np.append(np.full(KNOTS, 0.05), 0.0)
    assert standard_error(solution(short, 0.0)) == pytest.approx(0.05, rel=0.1)


def test_a_way_that_noise_explains_does_not() -> None:
    # Each unknown is off by one standard error, as noise makes it; with 200 unknowns the square of the length is known
    # to 10 %.
    short = np.random.default_rng(1).standard_normal(UNKNOWNS) * 1e-2
    short[-1] = 0.0
    still = standard_error(solution(np.zeros(UNKNOWNS), 0.0))
    assert standard_error(solution(short, 0.0)) == pytest.approx(still, rel=0.25)


@pytest.mark.parametrize(("width_mm", "told"), [(1.0, True), (4.0, False)])
def test_a_very_thick_cell_tells_no_scattering_by_itself(width_mm: float, told: bool) -> None:
    tiny = 1e-8 * np.eye(UNKNOWNS)
    uncertainty, index = Uncertainty(tiny, tiny, (tiny, tiny)), Index(1.33, 0.0)
    parameters = parameters_of(MATERIAL, uncertainty, index, width_mm)
    assert parameters.sigma_s_reduced.determined
    assert parameters.sigma_a.determined
    assert [getattr(parameters, name).determined for name in ("sigma_t", "sigma_s", "g")] == 3 * [told]
    assert set(phase_of(MATERIAL, uncertainty, width_mm).determined) == {told}


def test_a_fit_unlike_its_images_calls_nothing_determined() -> None:
    like = made_up_fit(532.0)
    assert with_believable_flags(like) == like
    unlike = like.model_copy(
        update={"errors": Errors(fit_error=0.3, held_out_error=None), "atoms": {"HG 0.8": like.parameters.g}}
    )
    judged = with_believable_flags(unlike)
    assert not any(one.determined for _, one in judged.parameters)
    assert not judged.atoms["HG 0.8"].determined
    assert judged.parameters.g.value == like.parameters.g.value
