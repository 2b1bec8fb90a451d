"""The step after the closing measurement: promise and comparison made up here, to see which steps are taken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from services.fit.optics.domain import Coordinate, Domain
from services.fit.solve.normal_equations import LossChange
from services.fit.stages import CLOSING_TRIALS, last_step

WHOLE = 0.5


@dataclass
class FakeModel:
    """Promises without noise, in proportion to the step."""

    promised: float = -1000.0

    def step(self, _things: int) -> np.ndarray:
        return np.array([WHOLE])

    def promise(self, step: np.ndarray) -> tuple[float, float]:
        return self.promised * float(step[0]) / WHOLE, 0.0


@dataclass
class FakeProblem:
    """Compares to a change of the whole step ± 359, and in proportion to it."""

    change: float
    domain: Domain = field(default_factory=lambda: Domain((Coordinate(("enamel.sigma",)),)))
    asked: int = 0

    def compare(self, x_old: np.ndarray, x_new: np.ndarray, **_: int) -> LossChange:
        share, self.asked = float(x_new[0] - x_old[0]) / WHOLE, self.asked + 1
        return LossChange(share * self.change, (share * 359.0) ** 2)


def taken(problem: Any, things: int, **model: float) -> float:
    """The step that is taken as a share of the whole."""
    fake: Any = FakeModel(**model)
    return float(last_step(problem, np.zeros(1), fake, things, 64)[0]) / WHOLE


def test_many_teeth_are_wrong_independently() -> None:
    # By hand: of one tooth the promise is -1000 ± 500, with the comparison 100 ± 359 that makes -274 ± 292; of fourteen -1000 ± 134, together -866 ± 125.
    assert taken(FakeProblem(100.0), things=1) == 0
    assert taken(FakeProblem(100.0), things=14) == pytest.approx(1)


def test_a_step_that_is_contradicted_is_tried_shorter() -> None:
    # 1300 is 3.4 standard errors of the difference, as the shorter one's is.
    problem = FakeProblem(300.0)
    assert taken(problem, things=14) == 0
    assert problem.asked == CLOSING_TRIALS


def test_a_step_that_promises_nothing_is_not_compared() -> None:
    problem = FakeProblem(-1000.0)
    assert taken(problem, things=14, promised=20.0) == 0
    assert problem.asked == 0
