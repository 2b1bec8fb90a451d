"""Using the prior of the instrument's errors in full: smaller errors where a fit had not used it, correct ones, and
faults that are named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.recombination import Recombination, faults

Array = NDArray[np.float64]

PRIOR = np.diag([0.01, 0.01, 0.003]) ** 2
TISSUE, ERRORS, COUNT = 2, 3, 60
LIMITS = dict.fromkeys(range(ERRORS), 3.0)
"""Number of standard errors beyond which an error is a fault, by its index."""


@dataclass(frozen=True)
class Crude:
    """A linear fit whose derivatives are not those of its images; a move also changes the images, and the fit does not
    know of it.
    """

    answer: Array
    """Derivative (F, M) of its answer by the measurements."""
    response: Array
    """Derivative B (F, K) of its answer by the prior's means."""
    exact: Array
    """The images' own derivatives, (M, F)."""
    move: Array
    """Change (M,) of the measurements by one ± of the move."""

    @property
    def covariance(self) -> Array:
        """Covariance (F, F) of its answer about the truth."""
        moved = self.answer @ self.move
        return self.answer @ self.answer.T + self.response @ PRIOR @ self.response.T + np.outer(moved, moved)

    @property
    def found(self) -> Recombination:
        return Recombination(self.covariance, self.response, PRIOR)

    def draw(self, random: np.random.Generator, fault: Array | float = 0.0) -> Array:
        """One answer minus the truth, and the instrument's errors in it minus the means of their prior, (F + K,)."""
        means = random.standard_normal(ERRORS) @ np.sqrt(PRIOR) + fault
        measured = self.move * random.standard_normal() + random.standard_normal(COUNT)
        off = self.answer @ measured + self.response @ means
        return np.concatenate([off, off[TISSUE:] - means])


def crude(seed: int, misfit: float, moved: float) -> Crude:
    """Measurements with unit noise: they determine the tissue well, and the instrument's errors about as well as their
    prior does.
    """
    random = np.random.default_rng(seed)
    exact = np.concatenate(
        [3 * random.standard_normal((COUNT, TISSUE)), 20 * random.standard_normal((COUNT, ERRORS))], axis=1
    )
    exact[:, 2] += 4 * exact[:, 0]
    believed = exact + misfit * np.abs(exact).mean(axis=0) * np.concatenate(
        [random.standard_normal((COUNT, TISSUE)), np.zeros((COUNT, ERRORS))], axis=1
    )
    precision = np.zeros((TISSUE + ERRORS,) * 2)
    precision[TISSUE:, TISSUE:] = np.linalg.inv(PRIOR)
    # The answer solves believed' (exact x - y) + precision (x - mean) = 0.
    solved = np.linalg.inv(believed.T @ exact + precision)
    return Crude(solved @ believed.T, (solved @ precision)[:, TISSUE:], exact, moved * random.standard_normal(COUNT))


def test_a_fit_that_used_its_prior_in_full_stays_as_it_is() -> None:
    whole = crude(1, misfit=0.0, moved=0.0)
    np.testing.assert_allclose(whole.found.change(), 0.0, atol=1e-9)


def test_no_error_is_known_worse_than_its_prior_and_every_other_at_least_as_well() -> None:
    one = crude(2, misfit=1.0, moved=2.0)
    assert one.covariance[TISSUE, TISSUE] > 1.5 * PRIOR[0, 0], "the crude fit is not crude"
    settled = one.found.updated(one.found.change()).covariance
    assert (np.diag(settled)[TISSUE:] <= np.diag(PRIOR) * (1 + 1e-9)).all()
    assert (np.diag(settled) <= np.diag(one.covariance) * (1 + 1e-9)).all()
    assert settled[0, 0] < 0.9 * one.covariance[0, 0]


def test_what_it_states_is_what_repeated_fits_show() -> None:
    one, random = crude(2, misfit=1.0, moved=2.0), np.random.default_rng(3)
    change = one.found.change()
    draws = np.array([one.draw(random) for _ in range(4000)])
    off, apart = draws[:, : TISSUE + ERRORS], draws[:, TISSUE + ERRORS :]
    shown = np.cov((off + apart @ change.T).T)
    stated = one.found.updated(change).covariance
    # A variance from 4,000 draws is known to 2.2 %: 4 of that.
    np.testing.assert_allclose(np.diag(shown) / np.diag(stated), 1.0, atol=4 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(
        np.diag(np.cov(apart.T)) / np.diag(one.found.difference_covariance), 1.0, atol=4 * np.sqrt(2 / 4000)
    )


def test_a_fault_is_named_with_its_size_and_does_not_draw_others_along() -> None:
    one, random, size = crude(4, misfit=0.3, moved=0.5), np.random.default_rng(5), np.array([-0.1, 0.0, 0.0])
    named = [faults(one.draw(random, fault=size)[TISSUE + ERRORS :], one.found, LIMITS) for _ in range(200)]
    assert all(told and told[0].index == 0 for told in named)
    sizes = np.array([told[0].size for told in named])
    # The prior's mean is off by -0.1, so the error is 0.1 above it: mean of 200.
    assert abs(sizes.mean() - 0.1) < 4 * sizes.std() / np.sqrt(200)
    # Each of the two others is named by chance in one case in 370: in 200 rounds there are fewer than 6 in all but one
    # case in 10,000.
    assert sum(len(told) - 1 for told in named) < 6


def test_an_error_that_images_cannot_check_is_believed_and_not_named() -> None:
    one, random, size = crude(4, misfit=0.3, moved=0.5), np.random.default_rng(5), np.array([-0.1, 0.0, 0.0])
    deviations = one.draw(random, fault=size)[TISSUE + ERRORS :]
    assert 0 in {fault.index for fault in faults(deviations, one.found, LIMITS)}
    assert 0 not in {fault.index for fault in faults(deviations, one.found, {1: 3.0, 2: 3.0})}


def test_each_error_is_a_fault_beyond_its_own_limit() -> None:
    one, random, size = crude(4, misfit=0.3, moved=0.5), np.random.default_rng(5), np.array([-0.1, -0.1, 0.0])
    deviations = one.draw(random, fault=size)[TISSUE + ERRORS :]
    named = {fault.index: abs(fault.z) for fault in faults(deviations, one.found, LIMITS)}
    assert named.keys() >= {0, 1}, "both faults are clear"
    raised = LIMITS | {0: named[0] + 1.0}
    assert {fault.index for fault in faults(deviations, one.found, raised)} == named.keys() - {0}


def test_good_calibrations_are_told_as_wrong_as_rarely_as_their_errors_say() -> None:
    one, random = crude(2, misfit=1.0, moved=2.0), np.random.default_rng(6)
    false = sum(bool(faults(one.draw(random)[TISSUE + ERRORS :], one.found, LIMITS)) for _ in range(2000))
    # Three errors at z = 3: at most 3 / 370 of 2,000, which is 16; the bound is 4 Poisson errors above that.
    assert false < 16 + 4 * np.sqrt(16)


def test_an_answer_that_is_freed_of_a_prior_does_not_follow_it_and_states_its_error() -> None:
    one, random = crude(4, misfit=0.3, moved=0.5), np.random.default_rng(7)
    change = one.found.change(rejected=(0,))
    after = one.found.updated(change)
    np.testing.assert_allclose(after.response[:, 0], 0.0, atol=1e-9)
    # However far off the prior's mean is, the answer is not: mean and spread of 4,000 draws, within 4 of their errors.
    draws = np.array([one.draw(random, fault=np.array([-0.3, 0.0, 0.0])) for _ in range(4000)])
    off = draws[:, : TISSUE + ERRORS] + draws[:, TISSUE + ERRORS :] @ change.T
    stated = np.sqrt(np.diag(after.covariance))
    assert (np.abs(off.mean(axis=0)) < 4 * stated / np.sqrt(4000)).all()
    np.testing.assert_allclose(off.std(axis=0) / stated, 1.0, atol=4 / np.sqrt(2 * 4000))
    # The two other errors keep their prior.
    assert (stated[TISSUE + 1 :] <= np.sqrt(np.diag(PRIOR))[1:] * (1 + 1e-9)).all()
