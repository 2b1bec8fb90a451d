"""How much of a noisy normal matrix is used, on random matrices whose signal and noise are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.slab.cell.dictionary import henyey_greenstein
from services.slab.solve.coordinates import Knots
from services.slab.solve.measured_directions import broad_step, measured_directions, noise_ratio, step_matrix
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.prior import Quadratic

BROAD = Knots().broad_directions()
DEVIATIONS = Knots().broad_standard_deviations(henyey_greenstein(5.0, 0.5, 0.0))
WEAK = BROAD[:, 0] / float(np.linalg.norm(BROAD[:, 0]))
"""sigma_s at a constant shape: the direction that holds the only signal here."""
SPREAD = 0.02
"""Standard deviation of a matrix's entries. Eigenvalues of such noise reach 2 SPREAD sqrt(UNKNOWNS) = 0.57 (Wigner's
semicircle), those of ten directions 0.13."""
SIGNAL = 0.3
PRIOR = 0.01 * np.eye(UNKNOWNS)
GRADIENT_NOISE = 0.01 * np.eye(UNKNOWNS)
"""Small, so that only chance in the matrix limits a step."""


def chance(rng: np.random.Generator) -> np.ndarray:
    half = rng.standard_normal((UNKNOWNS, UNKNOWNS))
    return SPREAD * (half + half.T) / np.sqrt(2)


def quadratic(seed: int, signal: float = SIGNAL) -> Quadratic:
    """Noise of J is one in every direction; the matrix has random errors."""
    rng = np.random.default_rng(seed)
    matrix = signal * np.outer(WEAK, WEAK) + chance(rng)
    return Quadratic(matrix, -matrix @ WEAK, np.eye(UNKNOWNS), np.zeros(UNKNOWNS), chance(rng))


def test_what_exceeds_a_tenth_of_the_noise_is_believed_as_it_is() -> None:
    directions = measured_directions(quadratic(1, signal=3.0), PRIOR)
    # Reference is 1.01 in every direction, and chance changes an entry by 0.02: four times that.
    assert float(WEAK @ directions.curvature @ WEAK) == pytest.approx(3.0, abs=0.08)
    assert directions.signals.min() > 0.1
    gradient = np.random.default_rng(2).standard_normal(UNKNOWNS)
    np.testing.assert_allclose(directions.projected(directions.projected(gradient)), directions.projected(gradient))
    noise = directions.noise(np.outer(gradient, gradient))
    np.testing.assert_allclose(
        noise, np.outer(directions.projected(gradient), directions.projected(gradient)), atol=1e-9
    )


def test_two_steps_go_most_of_the_way_along_a_broad_direction() -> None:
    # The minimum is one WEAK away; a step limited by the whole noise goes 0.3 / 1.3 = 23 % of the way.
    alone, both = [], []
    for seed in range(10):
        one = quadratic(seed)
        matrix = step_matrix(one, PRIOR, 1.0)
        assert np.linalg.eigvalsh(matrix)[0] > 0
        first = np.asarray(np.linalg.solve(matrix, -one.linear), dtype=np.float64)
        alone.append(float(first @ WEAK))
        both.append(float((first + broad_step(one, PRIOR, BROAD, DEVIATIONS, GRADIENT_NOISE, first)) @ WEAK))
    # Chance makes a single way shorter or longer, by about 0.1 in 0.3; ten of them show the mean.
    assert np.mean(alone) < 0.3
    assert np.mean(both) > 1.8 * np.mean(alone)
    assert max(both) < 1.3


def test_a_broad_step_moves_nothing_else_and_not_where_chance_bends_the_matrix_down() -> None:
    other = np.zeros(UNKNOWNS)
    other[50:52] = np.sqrt(0.5), -np.sqrt(0.5)
    step = broad_step(quadratic(1), PRIOR, BROAD, DEVIATIONS, GRADIENT_NOISE, np.zeros(UNKNOWNS))
    # Cosines of up to eight times the angle differ by less than 8 times a knot's 0.9 degrees between neighbours.
    assert abs(other @ step) < 0.13 * np.abs(step).max()
    bent, nothing = replace(quadratic(1), matrix=-np.eye(UNKNOWNS)), np.zeros((UNKNOWNS, UNKNOWNS))
    assert not broad_step(bent, nothing, BROAD, DEVIATIONS, GRADIENT_NOISE, np.ones(UNKNOWNS)).any()
    assert not broad_step(quadratic(1), PRIOR, BROAD[:, :0], DEVIATIONS[:0], GRADIENT_NOISE, np.ones(UNKNOWNS)).any()


def test_a_broad_step_goes_no_further_than_the_gradients_noise_lets_it() -> None:
    gradient = 30 * np.eye(UNKNOWNS)
    displacements = [
        float(broad_step(quadratic(1), PRIOR, BROAD, DEVIATIONS, share * gradient, np.zeros(UNKNOWNS)) @ WEAK)
        for share in (1e-4, 1, 100)
    ]
    assert displacements[0] > displacements[1] > displacements[2] > 0
    # A hundred times the noise lets the prior hold it: what is left goes as one over the noise.
    assert displacements[2] < 0.05 * displacements[1] * (1 + displacements[0] / displacements[1])


def test_the_gradients_noise_is_told_in_units_of_images_that_fit() -> None:
    one = quadratic(1, signal=3.0)
    assert noise_ratio(one, PRIOR, 4 * (one.matrix + one.noise)) == pytest.approx(4)
