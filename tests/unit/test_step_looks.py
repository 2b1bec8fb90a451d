"""A step is compared with a quarter of the paths first, and with all of them only where these do not decide."""

from __future__ import annotations

import math

import pytest

from services.core.errors import NonFiniteError
from services.fit.solve.normal_equations import LossChange
from services.fit.solve.step_test import StepTest, judged

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


def test_an_unclear_step_gets_all_paths() -> None:
    """With 25 paths the error is 0.4, two and a half of which the change is; with 100 it is 0.2."""
    compare = Comparisons(se_of_one_path=2.0)
    test = judged(compare, 100, 2, 0.0, VAGUE)
    assert [samples for samples, _ in compare.looks] == [25, 100]
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
