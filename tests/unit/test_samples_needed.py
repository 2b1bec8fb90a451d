"""A fit is repeated with the paths that its standard errors need, and with no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.precision import MAX_RENDERING, samples_needed

DOMAIN = Domain((Coordinate(("enamel.sigma",)), Coordinate(("dentin.sigma",))))


def known(rendering: tuple[float, float], others: tuple[float, float], undetermined: bool = False) -> Uncertainty:
    """Uncertainty of two coordinates by the variances of rendering and of all else; the second may be undetermined."""
    return Uncertainty(
        DOMAIN,
        np.zeros(2),
        np.diag(np.add(rendering, others)),
        np.array([[0.0], [1.0]]) if undetermined else np.zeros((2, 0)),
        np.eye(2),
        parts={"rendering": np.diag(rendering), "gain": np.diag(others)},
    )


def test_the_paths_bring_rendering_to_its_share_of_the_worst_standard_error() -> None:
    """The variance of the second coordinate's rendering is that of all else at first."""
    needed = samples_needed(known((1e-4, 4e-4), (4e-4, 4e-4)), 100, 10_000)
    rendering = 4e-4 * 100 / needed
    assert rendering / (rendering + 4e-4) == pytest.approx(MAX_RENDERING**2, rel=0.01)


def test_a_step_that_noise_left_unfinished_asks_for_paths() -> None:
    enough = known((1e-4, 1e-4), (4e-4, 4e-4))
    left = replace(enough, parts={**enough.parts, "unfinished": np.diag([0.0, 3e-4])})
    assert samples_needed(left, 100, 10_000) > samples_needed(enough, 100, 10_000) == 100


def test_enough_paths_are_enough() -> None:
    assert samples_needed(known((1e-4, 1e-4), (4e-4, 4e-4)), 100, 10_000) == 100


def test_the_limit_holds_and_nothing_is_taken_away() -> None:
    assert samples_needed(known((1.0, 1.0), (0.0, 0.0)), 100, 1_000) == 1_000
    assert samples_needed(known((1.0, 1.0), (0.0, 0.0)), 2_000, 1_000) == 2_000


def test_a_coordinate_that_the_data_leave_open_asks_for_nothing() -> None:
    assert samples_needed(known((1e-4, 9.0), (4e-4, 1e-4), undetermined=True), 100, 10_000) == 100
