"""Sandwich covariance Cov(x) = T M^-1 meat M^-T T' of a fit's solution, before and after the prior of the instrument's
errors is used in full (``recombination``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain
from services.fit.coordinates.instrument_errors import FAULT_Z, kind_of_error, single_faults
from services.fit.solve.recombination import Fault, Recombination, faults

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sandwich:
    """Factors of Cov(x) = T M^-1 meat M^-T T', each (F, F), with the prior of the last K coordinates used in full."""

    transform: Array
    inverse: Array
    meat: Array
    misfit: float
    """Factor s by which residuals exceed the measurements' noise."""
    weighing: Array
    """Difference (F, F) between the meat by which the combination with the prior is chosen and the meat that is stated
    (``FinalSums.expected_shift_covariance``)."""
    prior: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Covariance V (K, K) of the prior of the instrument's errors."""
    prior_weight: float = 1.0
    """Factor by which the fit multiplied that prior (``elimination.weighed``)."""
    rejected: tuple[int, ...] = ()
    """Indices of the instrument's errors whose prior is rejected as a fault."""

    @property
    def covariance(self) -> Array:
        """Covariance (F, F) of x."""
        return self.covariance_of(self.inverse, self.meat)

    def covariance_of(self, inverse: Array, meat: Array) -> Array:
        """Covariance (F, F) of x for another M^-1 and meat, each (F, F)."""
        before = self.product(inverse, meat)
        if not len(self.prior):
            return before
        response = self.response(inverse)
        weighed = Recombination(self.product(inverse, meat + self.weighing), response, self.prior)
        return Recombination(before, response, self.prior).updated(weighed.change(self.rejected)).covariance

    def product(self, inverse: Array, meat: Array) -> Array:
        """Covariance T M^-1 meat M^-T T' (F, F) before the prior is used in full."""
        half = self.transform @ inverse
        return np.asarray(half @ meat @ half.T)

    def response(self, inverse: Array) -> Array:
        """Response B = dx / dm (F, K) of the solution to the mean of the errors' prior."""
        own = self.transform[len(self.transform) - len(self.prior) :]
        return np.asarray(self.transform @ inverse @ own.T @ (self.prior_weight * np.linalg.inv(self.prior)))


@dataclass(frozen=True)
class CombinedSolution:
    """Solution after the prior of the instrument's errors was used in full."""

    x: Array
    covariance: Array
    parts: dict[str, Array]
    sandwich: Sandwich
    faults: tuple[Fault, ...]
    is_full_step: bool = True
    """Whether the solution took the whole step; False where the step was shortened to the range in which images are
    linear."""


def combine_with_prior(
    domain: Domain,
    x: Array,
    sandwich: Sandwich,
    meats: Mapping[str, Array],
    unfinished: Array,
    part_count: int = 1,
) -> CombinedSolution:
    """Use the prior of the instrument's errors in full, except for errors that are found to be faults of the
    calibration.

    Args:
        domain: coordinates of the fit and the prior of the instrument's errors.
        x: the solution (F,).
        sandwich: factors of its covariance.
        meats: whitened parts of the meat by source, (F, F) each; they add up to the sandwich's meat.
        unfinished: covariance (F, F) of the remaining step to the minimum.
        part_count: number of objects that the fit treats as separate in the images, such as the teeth of a jaw.
    """
    count, parts_before = (
        domain.tissue_count,
        {name: sandwich.product(sandwich.inverse, meat) for name, meat in meats.items()},
    )
    whole = sandwich.product(sandwich.inverse, sandwich.meat) + unfinished
    parts_before["unfinished"] = unfinished
    if not domain.errors.names:
        return CombinedSolution(x, whole, parts_before, sandwich, ())
    sandwich = replace(sandwich, prior=domain.errors.matrix, prior_weight=domain.errors.weight)
    response = sandwich.response(sandwich.inverse)
    found = Recombination(whole, response, sandwich.prior)
    weighed = Recombination(whole + sandwich.product(sandwich.inverse, sandwich.weighing), response, sandwich.prior)
    kinds = map(kind_of_error, domain.errors.names)
    detected = faults(x[count:], found, {k: FAULT_Z[kind] for k, kind in enumerate(kinds) if kind in FAULT_Z})
    rejected = single_faults([fault.index for fault in detected], domain.errors.names)
    change = weighed.change(rejected)
    updated = found.updated(change)

    # Transform every part but the prior's by 1 + Q; the prior's parts follow from the new solution's response.
    through = np.eye(len(x))
    through[:, count:] += change
    parts = {name: through @ part @ through.T for name, part in parts_before.items()} | _of_prior(domain, updated)

    # Take only as much of the step as moves the tissue by one scale for each object, because images are not linear
    # farther than that; the rest of the step counts as error.
    step, (low, high) = change @ x[count:], domain.bounds
    length = float(np.linalg.norm((step / domain.scale)[:count]) / np.sqrt(part_count))
    taken = np.asarray(step / max(1.0, length), dtype=np.float64)
    remaining = np.outer(step - taken, step - taken)
    parts["unfinished"] = parts["unfinished"] + remaining
    moved = np.clip(x + taken, low, high)
    return CombinedSolution(
        moved, updated.covariance + remaining, parts, replace(sandwich, rejected=rejected), detected, length <= 1
    )


def _of_prior(domain: Domain, found: Recombination) -> dict[str, Array]:
    # Covariance of the solution by the prior's error, of covariance V = L L', split by kind of error. Where kinds are
    # correlated, their common part counts for the first of them.
    kinds = np.array([kind_of_error(name) for name in domain.errors.names])
    halves = found.response @ np.linalg.cholesky(found.prior)
    return {kind: halves[:, kinds == kind] @ halves[:, kinds == kind].T for kind in dict.fromkeys(kinds.tolist())}
