"""The step after the closing measurement: promise and comparison made up here, to see which steps are taken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from services.fit.execution.channel_fit import CLOSING_MIN_SHARE, CLOSING_TRIALS, last_step
from services.fit.optics.domain import Coordinate, Domain
from services.fit.solve.normal_equations import LossChange

WHOLE = 0.5


@dataclass
class FakeModel:
    """Promises without noise, along a parabola that is least at the whole step."""

    promised: float = -1000.0

    def step(self, _part_count: int) -> np.ndarray:
        return np.array([WHOLE])

    def promise(self, step: np.ndarray) -> tuple[float, float]:
        share = float(step[0]) / WHOLE
        return self.promised * (2 * share - share**2), 0.0

    def slope(self, step: np.ndarray) -> float:
        return 2 * self.promised * float(step[0]) / WHOLE


@dataclass
class FakeProblem:
    """Compares to a change of the whole step ± 359, along a parabola of the slope at its start."""

    change: float
    slope: float = -2000.0
    domain: Domain = field(default_factory=lambda: Domain((Coordinate(("enamel.sigma",)),)))
    asked: list[float] = field(default_factory=list)

    def compare(self, x_old: np.ndarray, x_new: np.ndarray, **_: int) -> LossChange:
        share = float(x_new[0] - x_old[0]) / WHOLE
        self.asked.append(share)
        return LossChange(self.slope * share + (self.change - self.slope) * share**2, (share * 359.0) ** 2)


def taken(problem: Any, part_count: int, **model: float) -> float:
    """The step that is taken as a share of the whole."""
    fake: Any = FakeModel(**model)
    return float(last_step(problem, np.zeros(1), fake, part_count, 64)[0]) / WHOLE


def test_many_teeth_are_wrong_independently() -> None:
    # By hand: of one tooth the promise is -1000 ± 500, with the comparison 100 ± 359 that makes -274 ± 292; of fourteen
    # -1000 ± 134, together -866 ± 125.
    assert taken(FakeProblem(100.0), part_count=1) == 0
    assert taken(FakeProblem(100.0), part_count=14) == pytest.approx(1)


def test_a_step_that_is_contradicted_is_tried_at_the_parabolas_least() -> None:
    # 1300 is 3.4 of its standard errors. With slope -2000 and 300 at the whole the parabola is least at 2000 / 4600,
    # -435 ± 156 for -681 ± 91 promised.
    problem = FakeProblem(300.0)
    assert taken(problem, part_count=14) == pytest.approx(2000 / 4600)
    assert len(problem.asked) == CLOSING_TRIALS


def test_a_step_that_is_worse_at_any_length_is_refused() -> None:
    # With a slope of its own upwards the shorter step, 2000 / 6200 of the whole, is worse by 639, 5.5 standard errors.
    problem = FakeProblem(1100.0, slope=2400.0)
    assert taken(problem, part_count=14) == 0
    assert len(problem.asked) == CLOSING_TRIALS


@pytest.mark.parametrize("change", [50_000.0, 1e12])
def test_a_step_is_shortened_to_a_tenth_at_most(change: float) -> None:
    problem = FakeProblem(change)
    taken(problem, part_count=1)
    assert problem.asked == pytest.approx([1, CLOSING_MIN_SHARE])


def test_a_step_that_promises_nothing_is_not_compared() -> None:
    problem = FakeProblem(-1000.0)
    assert taken(problem, part_count=14, promised=20.0) == 0
    assert not problem.asked
