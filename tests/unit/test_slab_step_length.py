"""How far a step of the last stages may go: short of where exp makes images brighter than the step promises."""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.cell.dictionary import KNOTS, tent_solid_angles
from services.slab.solve.coordinates import Knots
from services.slab.solve.mixture import Mixtures
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.prior import Quadratic
from services.slab.solve.step_length import predicted_fall, shortened

PRIOR = np.zeros((UNKNOWNS, UNKNOWNS))
ZIGZAG = np.append(np.where(np.arange(KNOTS) % 2 == 0, 1.0, -1.0), 0.0)
SUM = np.append(tent_solid_angles(), 0.0)


def quadratic_of_the_sum(weight: float) -> Quadratic:
    """Half the misfit of images that show the sum of f over all directions with this weight, are fitted by x = 0, and
    have a slope of -1 along the zigzag, as noise has.
    """
    zeros = np.zeros((UNKNOWNS, UNKNOWNS))
    return Quadratic(weight * np.outer(SUM, SUM), -ZIGZAG / KNOTS, zeros, np.zeros(UNKNOWNS), zeros)


@pytest.mark.parametrize(
    ("weight", "length"),
    [
        (0.0, 1.0),
        # f = exp(0.5 z) with z = 1 and -1 in turn has a mean of cosh(0.5) = 1.128. The sum over directions, of 4 pi,
        # rises by 1.6 and the misfit by 1.3 times the weight, where the slope makes it fall by 0.52.
        (1.0, 0.5),
        # At half the step cosh gives 0.40 and 0.079 times the weight for 0.25, and at a quarter 0.098 and 0.0049 for
        # 0.125.
        (10.0, 0.25),
    ],
)
def test_a_step_that_exp_spoils_is_halved(weight: float, length: float) -> None:
    x, change, quadratic = np.zeros(UNKNOWNS), 0.5 * ZIGZAG, quadratic_of_the_sum(weight)
    assert predicted_fall(quadratic, PRIOR, x, change) > 0.4  # all that a model in ln f sees
    assert np.array_equal(shortened(change, quadratic, PRIOR, x, Knots()), length * change)


def test_a_step_of_weights_is_never_halved_for_that() -> None:
    # f is linear in the weights of atoms, so a step to the minimum of the quadratic goes all the way.
    slope, zeros = np.array([-1.0, 0.5, 0.0]), np.zeros((3, 3))
    quadratic = Quadratic(np.diag([100.0, 30.0, 1.0]), slope, zeros, np.zeros(3), zeros)
    change = np.array([0.01, -0.5 / 30, 0.0])
    atoms = np.ones((KNOTS, 2)) / (4 * np.pi)
    assert np.array_equal(shortened(change, quadratic, zeros, np.zeros(3), Mixtures(atoms)), change)
