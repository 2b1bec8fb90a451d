"""Positions and directions in which light leaves a slab, compared to van de Hulst's tables, Chandrasekhar's H function
and rings of a pencil beam.

The rule is that of ``tests.support.z_scores``. Totals have a tolerance of 2.5e-3 (rings 1e-3) in every run and of 1e-4
in the slow ones. Radiances have a tolerance of 0.8 % of their value, and of 0.3 % in the slow runs. There their
standard error of 0.1 % is at least ten times the rounding error of the printed digits.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.slab.simulate import Layer, SlabResult, simulate_slab
from tests.support.exit_tables import ExitCase, angular_cases, half_space_cases, ring_case
from tests.support.slab_tables import fewer_lanes
from tests.support.z_scores import LARGEST_Z, require_unbiased

RADIANCE_TOLERANCE, FINE_RADIANCE_TOLERANCE = 0.008, 0.003
TOLERANCE, FINE_TOLERANCE = 2.5e-3, 1e-4


@pytest.fixture(autouse=True)
def _short_first_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer_lanes(monkeypatch)


def require_truth(cases: list[ExitCase], seed: int) -> None:
    scores = [case.scores(case.simulate(seed + number)) for number, case in enumerate(cases)]
    # The values of one simulation share its paths, so each simulation counts as one independent value, which is the
    # worst case.
    require_unbiased(np.concatenate(scores), independent=len(cases))


@pytest.mark.parametrize(
    "tolerance", [RADIANCE_TOLERANCE, pytest.param(FINE_RADIANCE_TOLERANCE, marks=pytest.mark.slow)]
)
def test_radiance_at_every_exit_cosine_agrees_with_van_de_hulst(tolerance: float) -> None:
    cases = angular_cases(tolerance)
    assert [np.count_nonzero(~np.isnan(case.values)) for case in cases] == [12, 11]
    require_truth(cases, seed=801)


def test_half_spaces_agree_with_the_h_function() -> None:
    cases = half_space_cases(TOLERANCE, RADIANCE_TOLERANCE, "0.5", "0.8", "0.9", "0.99")
    assert len(cases) == 12
    require_truth(cases, seed=811)


@pytest.mark.slow
def test_half_spaces_agree_with_the_h_function_to_four_digits() -> None:
    # At albedo 0.999 a path scatters 40 times on average. At 0.99999 it scatters several hundred times, so this case
    # has the wider tolerance.
    cases = half_space_cases(FINE_TOLERANCE, FINE_RADIANCE_TOLERANCE, "0.5", "0.8", "0.9", "0.99", "0.999")
    require_truth(cases + half_space_cases(1e-3, FINE_RADIANCE_TOLERANCE, "0.99999"), seed=821)


def test_a_pencil_beam_leaves_within_its_rings() -> None:
    case = ring_case(1e-3)
    assert case.values.size == 26
    require_truth([case], seed=841)


@pytest.mark.slow
def test_a_pencil_beam_leaves_within_its_rings_to_four_digits() -> None:
    require_truth([ring_case(FINE_TOLERANCE)], seed=842)


def scattered_totals(layer: Layer, ior: float, boundary: str, R: float, T: float) -> NDArray[np.float64]:
    """Known totals (R, T) at normal incidence minus the light that leaves without scattering, after any number of
    reflections between the faces.
    """
    depth, mirrored = layer.sigma * layer.thickness_mm, 0.0 if boundary == "matched" else ((ior - 1) / (ior + 1)) ** 2
    through = (1 - mirrored) ** 2 * math.exp(-depth) / (1 - mirrored**2 * math.exp(-2 * depth))
    return np.array([R - mirrored - mirrored * math.exp(-depth) * through, T - through])


def hemisphere(result: SlabResult, weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Flux (R, T) of radiances, and an upper bound of its standard error: the sum of theirs, as they share paths."""
    assert result.radiance is not None
    found = result.radiance
    return np.array([found.R, found.T]) @ weights, np.array([found.R_se, found.T_se]) @ weights


@pytest.mark.parametrize(
    ("layer", "boundary", "ior", "R", "T"),
    [
        (Layer(sigma=1, alpha=0.9, g1=0.75, thickness_mm=2), "smooth", 1.33, 0.10930556, 0.55167396),
        (Layer(sigma=2, alpha=0.9, g1=0.75, thickness_mm=1), "thin", 1.631, 0.16430941, 0.58864541),
        (Layer(sigma=1, alpha=0.99, g1=0.8, thickness_mm=5), "smooth", 1.631, 0.32853474, 0.46492220),
    ],
)
def test_radiance_adds_up_to_the_reference_totals(layer: Layer, boundary: str, ior: float, R: float, T: float) -> None:
    # For refraction, its solid angles and reflecting faces there is no reference table by direction. The totals are
    # rows of the slab tables; 16 Gauss nodes integrate these smooth radiances to 1e-5.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    cosines = 0.5 * (nodes + 1)
    result = simulate_slab((layer,), boundary=boundary, ior=ior, exit_cosines=tuple(cosines), rel_error=8e-3, seed=851)  # type: ignore[arg-type]
    flux, error = hemisphere(result, math.pi * cosines * weights)
    assert (error < 8e-3 * flux + 2e-4).all()
    assert (np.abs(flux - scattered_totals(layer, ior, boundary, R, T)) <= LARGEST_Z * error).all()


def test_layers_cut_in_two_look_as_one() -> None:
    # Light leaves through several layers. Two equal halves must give the same radiance and rings as the whole layer.
    whole = Layer(sigma=2, alpha=0.95, g1=0.5, thickness_mm=1)
    half = whole.model_copy(update={"thickness_mm": 0.5})
    options = {"mu_incident": 0.6, "exit_cosines": (0.2, 0.9), "ring_edges_mm": (0.2, 1.0), "rel_error": 8e-3}
    one, two = (simulate_slab(layers, seed=seed, **options) for seed, layers in ((861, (whole,)), (862, (half, half))))  # type: ignore[arg-type]
    for kind in ("radiance", "rings"):
        ours, theirs = getattr(one, kind), getattr(two, kind)
        for side in ("R", "T"):
            values, errors = (
                np.array([getattr(part, side + suffix) for part in (ours, theirs)]) for suffix in ("", "_se")
            )
            assert (np.abs(values[0] - values[1]) <= LARGEST_Z * np.hypot(*errors)).all()


def test_rings_and_radiance_leave_unscattered_light_out() -> None:
    # Nothing scatters, so only the beam and its mirror reflections leave.
    black = Layer(sigma=1, alpha=0, thickness_mm=1)
    result = simulate_slab(
        (black,), boundary="smooth", ior=1.5, exit_cosines=(1.0,), ring_edges_mm=(0.1,), rel_error=0.5, max_seconds=1
    )
    beam = 0.96**2 * math.exp(-1) / (1 - 0.04**2 * math.exp(-2))
    assert abs(result.T / beam - 1) < 1e-4
    assert result.radiance is not None
    assert result.rings is not None
    assert max(result.radiance.R + result.radiance.T) < 1e-20
    assert max(result.rings.R + result.rings.T) < 1e-20
