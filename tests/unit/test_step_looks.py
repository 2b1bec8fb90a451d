"""A step is compared with a quarter of the paths first, and with the rest only where these do not decide; and a fit
ends where more paths would shorten no standard error.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.core.errors import NonFiniteError
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.elimination import eliminate
from services.fit.solve.normal_equations import LossChange, NormalEquations
from services.fit.solve.precision import is_settled, rendering_shares
from services.fit.solve.step_test import StepTest, judged
from tests.support.curvature import isotropic

DOMAIN = Domain((Coordinate(("enamel.sigma",)), Coordinate(("dentin.sigma",))))
VAGUE = -1.0, 1e6
"""A predicted change that is too uncertain to decide anything."""


class Comparisons:
    """Changes of -1 whose standard error falls with the root of the paths."""

    def __init__(self, se_of_one_path: float) -> None:
        self.se, self.looks = se_of_one_path, list[tuple[int, int]]()

    def __call__(self, samples: int, trial: int) -> LossChange:
        self.looks.append((samples, trial))
        return LossChange(-1.0, self.se**2 / samples)


def test_a_clear_step_costs_a_quarter_of_the_paths() -> None:
    compare = Comparisons(se_of_one_path=1.0)
    test = judged(compare, 100, 2, 0.0, VAGUE)
    assert test.is_better(3.0)
    assert compare.looks == [(25, 2)]


def test_an_unclear_step_gets_all_paths_and_their_common_error() -> None:
    """With 25 paths the error is 0.4, two and a half of which the change is; with all 100 together it is 0.2."""
    compare = Comparisons(se_of_one_path=2.0)
    test = judged(compare, 100, 2, 0.0, VAGUE)
    assert [samples for samples, _ in compare.looks] == [25, 75]
    assert len({trial for _, trial in compare.looks}) == 2
    assert test.change == pytest.approx(-1.0)
    assert test.change_se == pytest.approx(0.2)
    assert test.is_better(3.0)


def test_a_good_prediction_decides_with_few_paths() -> None:
    compare = Comparisons(se_of_one_path=4.0)
    assert isinstance(judged(compare, 100, 0, 0.0, (-1.0, 0.1)), StepTest)
    assert len(compare.looks) == 1


def test_a_loss_that_is_not_finite_is_no_change() -> None:
    with pytest.raises(NonFiniteError):
        judged(lambda _samples, _trial: LossChange(math.nan, 1.0), 100, 0, 0.0, VAGUE)


def equations(rendering: float, curvature_noise: float) -> NormalEquations:
    """Two coordinates of curvature 100, so of a standard error of 0.1 by the photographs."""
    return NormalEquations(
        100 * np.eye(2), np.zeros(2), isotropic(2, curvature_noise**2), rendering**2 * np.eye(2), 100 * np.eye(2)
    )


@pytest.mark.parametrize(
    ("rendering", "curvature_noise", "step", "expected"),
    [
        (2.0, 1.0, 0.01, True),
        (2.0, 1.0, 0.06, False),  # half a standard error remains
        (6.0, 1.0, 0.01, False),  # the noise of rendering is half of the whole
        (2.0, 60.0, 0.01, False),  # the standard errors themselves are hardly known
    ],
)
def test_a_fit_is_settled_within_a_third_of_each_standard_error(
    rendering: float, curvature_noise: float, step: float, expected: bool
) -> None:
    found = equations(rendering, curvature_noise)
    reduced = eliminate(found, DOMAIN.precision, np.zeros(2), 2)
    assert is_settled(DOMAIN, found, reduced, np.array([step, 0.0])) is expected


def test_shares_are_those_of_the_covariance() -> None:
    """Without a prior, the rendering's part is C / H^2 and the photographs' D / H^2."""
    rendering, whole = rendering_shares(DOMAIN, equations(rendering=3.0, curvature_noise=0.0))
    assert rendering == pytest.approx([0.03, 0.03])
    assert whole == pytest.approx([math.sqrt(0.01 + 0.03**2)] * 2)
