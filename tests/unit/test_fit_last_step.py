"""The step after the final uncertainty estimate: which steps are taken, for made-up promises and comparisons."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.normal_equations import LossChange
from services.fit.stages.last_step import FINAL_MIN_SHARE, FINAL_TRIALS, last_step

WHOLE = 0.5


@dataclass
class FakeModel:
    """Promises without noise, along a parabola that is least at the whole step."""

    promised: float = -1000.0

    def step(self, _part_count: int) -> np.ndarray:
        return np.array([WHOLE])

    def predicted_change(self, step: np.ndarray) -> tuple[float, float]:
        share = float(step[0]) / WHOLE
        return self.promised * (2 * share - share**2), 0.0

    def slope(self, step: np.ndarray) -> float:
        return 2 * self.promised * float(step[0]) / WHOLE


@dataclass
class FakeProblem:
    """Compares the loss: the whole step gives ``change`` ± 359; the parabola begins with ``slope``."""

    change: float
    slope: float = -2000.0
    domain: Domain = field(default_factory=lambda: Domain((Coordinate(("enamel.sigma",)),)))
    asked: list[float] = field(default_factory=list)

    def compare(self, x_old: np.ndarray, x_new: np.ndarray, **_: int) -> LossChange:
        share = float(x_new[0] - x_old[0]) / WHOLE
        self.asked.append(share)
        return LossChange(self.slope * share + (self.change - self.slope) * share**2, (share * 359.0) ** 2)


def taken(problem: Any, part_count: int, **model: float) -> float:
    """The length of the step taken, as a share of the whole step."""
    fake: Any = FakeModel(**model)
    return float(last_step(problem, np.zeros(1), fake, part_count, 64)[0][0]) / WHOLE


def test_many_teeth_are_wrong_independently() -> None:
    # By hand: for one tooth the promise is -1000 ± 500, which together with the comparison 100 ± 359 gives -274 ± 292;
    # for fourteen teeth it is -1000 ± 134, together -866 ± 125.
    assert taken(FakeProblem(100.0), part_count=1) == 0
    assert taken(FakeProblem(100.0), part_count=14) == pytest.approx(1)


def test_a_step_that_is_contradicted_is_tried_at_the_parabolas_least() -> None:
    # The difference of 1300 is 3.4 standard errors. With a slope of -2000 and 300 at the whole step, the parabola is
    # lowest at 2000 / 4600, with -435 ± 156 where -681 ± 91 was promised.
    problem = FakeProblem(300.0)
    assert taken(problem, part_count=14) == pytest.approx(2000 / 4600)
    assert len(set(problem.asked)) == FINAL_TRIALS


def test_a_step_that_is_worse_at_any_length_is_refused() -> None:
    # The measured slope points upwards: the shorter step, 2000 / 6200 of the whole, is worse by 639, 5.5 standard
    # errors.
    problem = FakeProblem(1100.0, slope=2400.0)
    assert taken(problem, part_count=14) == 0
    assert len(set(problem.asked)) == FINAL_TRIALS


@pytest.mark.parametrize("change", [50_000.0, 1e12])
def test_a_step_is_shortened_to_a_tenth_at_most(change: float) -> None:
    problem = FakeProblem(change)
    taken(problem, part_count=1)
    assert list(dict.fromkeys(problem.asked)) == pytest.approx([1, FINAL_MIN_SHARE])


def test_a_step_that_promises_nothing_is_not_compared() -> None:
    problem = FakeProblem(-1000.0)
    assert taken(problem, part_count=14, promised=20.0) == 0
    assert not problem.asked


def test_what_comparisons_refuted_does_not_count_as_unfinished() -> None:
    fake: Any = FakeModel()
    # With 300 at the whole step the minimum is at 2000 / 4600 of it. With 1100 it is at 2000 / 6200, where 639 is found
    # against a slope of -645: at 645 / 2568 of that.
    step, share = last_step(cast("Any", FakeProblem(300.0)), np.zeros(1), fake, 14, 64)
    assert share == pytest.approx(2000 / 4600)
    step, share = last_step(cast("Any", FakeProblem(1100.0, slope=2400.0)), np.zeros(1), fake, 14, 64)
    assert not step.any()
    assert share == pytest.approx(2000 / 6200 * 645 / 2568, rel=1e-3)
    # Where nothing refutes it, all of it counts.
    step, share = last_step(cast("Any", FakeProblem(100.0)), np.zeros(1), fake, 1, 64)
    assert not step.any()
    assert share == 1
