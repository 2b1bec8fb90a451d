"""Standard errors where derivatives are mostly noise: along directions that the data do not determine, the error is
that of the start, and more noise must not state less.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.covariance import Uncertainty, uncertainty
from services.fit.solve.normal_equations import normal_equations

DOMAIN = Domain((Coordinate(("enamel.sigma",)), Coordinate(("enamel.alpha",), 2.3, 1.0)))
MEASUREMENTS, SENSOR, RENDERING = 150, 0.01, 0.1
FITS = 60


@lru_cache(maxsize=4)
def _fits(noise: float) -> tuple[tuple[Uncertainty, np.ndarray], ...]:
    """Uncertainty and error of starts half a scale from the truth, for derivatives with so much noise for their size;
    no step is made.
    """
    slopes = np.random.default_rng(1).standard_normal((2, MEASUREMENTS)) * [[0.2], [0.8]]
    found = []
    for fit in range(FITS):
        rng = np.random.default_rng([2, fit])
        off = 0.5 * DOMAIN.scale * rng.standard_normal(2)
        j1, j2 = (slopes * (1 + noise * rng.standard_normal(slopes.shape)) for _ in range(2))
        sensor = SENSOR * rng.standard_normal(MEASUREMENTS)
        r1, r2 = (off @ slopes - sensor + RENDERING * rng.standard_normal(MEASUREMENTS) for _ in range(2))
        flat = np.full(MEASUREMENTS, SENSOR**2)
        equations = normal_equations(j1, j2, r1, r2, flat, 1 / flat)
        found.append((uncertainty(DOMAIN, np.array([1.5, 2.4]), equations), off))
    return tuple(found)


def test_directions_lost_in_noise_have_the_error_of_the_start() -> None:
    lost = [(known, off) for known, off in _fits(30.0) if known.undetermined_directions.shape[1] == 2]
    assert len(lost) > FITS / 3
    z = np.array([off / np.sqrt(np.diag(known.covariance)) for known, off in lost])
    # Starts are half a scale off where one scale is stated; curvature that is noise stated a hundredth of a scale.
    assert np.sqrt(np.mean(z**2)) < 1
    assert np.mean(np.abs(z) < 1.96) > 0.95


def test_more_noise_never_states_less() -> None:
    errors = [np.median([np.sqrt(np.diag(known.covariance)) for known, _ in _fits(noise)], axis=0) for noise in (1, 30)]
    assert (errors[1] > errors[0]).all()


def test_determined_directions_state_what_they_stated() -> None:
    for known, _ in _fits(0.1):
        assert known.undetermined_directions.shape[1] == 0
        assert (np.sqrt(np.diag(known.parts["prior"])) < 0.01 * DOMAIN.scale).all()


def test_parts_still_add_up_to_the_whole() -> None:
    for noise in (0.1, 30.0):
        known, _ = _fits(noise)[0]
        np.testing.assert_allclose(sum(known.parts.values()), known.covariance, rtol=1e-9)
