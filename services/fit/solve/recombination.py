"""Second combination of the instrument's errors with their prior: the linear unbiased estimate of least variance.

A fit weighs the errors' prior against photographs of which it knows the noise alone, by derivatives that are not the
images' own. Held mean cosines, movements of scan and dome, and those derivatives give the solution x (F,) more error
than that, so its errors e, the last K of x, may be less precise than their prior. The prior says e = m + n, n of
covariance V. With B = dx / dm, the solution's response to the prior, and d = e - m,

    c = Cov(x, d) = C[:, e] - B V,   D = Cov(d) = C[e, e] - B[e] V - V B[e]' + V,   G = c D^-1,
    x <- x - G d,   C <- C - c D^-1 c'

is the linear unbiased combination of least variance (Gauss and Markov). Where the fit used its prior in full, c = 0 and
nothing changes; afterwards no standard error of an instrument error is larger than the prior's. The tissue's parameters
change by as much as their error is correlated with the instrument's. An error that lies too far from its prior is freed
of the prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST_SHARE = 1e-9
"""Smallest variance of a direction of d, as a share of the prior's. Below it the variance is rounding: the solution
equals the prior there."""


@dataclass(frozen=True)
class Recombination:
    """A solution and the prior of its last K coordinates, to be combined."""

    covariance: Array
    """Covariance C (F, F) of the solution."""
    response: Array
    """Response B = dx / dm (F, K) of the solution to the prior's mean."""
    prior: Array
    """Covariance V (K, K) of the prior."""

    @property
    def cross_covariance(self) -> Array:
        """Covariance of x and d, c (F, K)."""
        return np.asarray(self.covariance[:, self._first :] - self.response @ self.prior)

    @property
    def difference_covariance(self) -> Array:
        """Covariance D (K, K) of d, if neither solution nor prior is faulty."""
        common = self.error_response @ self.prior
        return np.asarray(self.covariance[self._first :, self._first :] - common - common.T + self.prior)

    @property
    def error_response(self) -> Array:
        """Response B[e] (K, K) of the solution's own errors to the prior's mean."""
        return self.response[self._first :]

    @property
    def _first(self) -> int:
        return len(self.covariance) - len(self.prior)

    def change(self, rejected: tuple[int, ...] = ()) -> Array:
        """Q (F, K) of the best combination x + Q d, which is -G where every prior is believed.

        Args:
            rejected: indices of the errors whose prior is rejected. The solution is freed of these priors: their means
                are set where the solution puts the errors.
        """
        used = [k for k in range(len(self.prior)) if k not in rejected]
        freed = np.zeros_like(self.response)
        if rejected:
            own, pulls = list(rejected), np.eye(len(self.prior)) - self.error_response
            freed[:, own] = self.response[:, own] @ np.linalg.inv(pulls[np.ix_(own, own)])
        freed_solution = self.updated(freed)
        unit, change = np.sqrt(np.diag(self.prior))[used], np.zeros_like(freed)
        change[:, used] = -freed_solution.cross_covariance[:, used] @ _inverse(
            freed_solution.difference_covariance[np.ix_(used, used)], unit
        )
        through = np.eye(len(self.prior)) + freed[self._first :]
        return np.asarray(freed + change @ through)

    def updated(self, change: Array) -> Recombination:
        """The solution x + Q d, with its covariance and response."""
        both = change @ self.cross_covariance.T
        covariance = self.covariance + both + both.T + change @ self.difference_covariance @ change.T
        response = self.response + change @ (self.error_response - np.eye(len(self.prior)))
        return Recombination(covariance, response, self.prior)


def _inverse(covariance: Array, unit: Array) -> Array:
    # Pseudo-inverse in units of the prior's standard errors: directions of d without variance have none in c either.
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / np.outer(unit, unit))
    kept = values > SMALLEST_SHARE
    whitened = (vectors[:, kept] / np.sqrt(values[kept])) / unit[:, None]
    return np.asarray(whitened @ whitened.T)


@dataclass(frozen=True)
class Fault:
    """A calibration error that lies farther from its prior than the standard errors of both allow."""

    index: int
    """Index among the errors."""
    size: float
    """Estimate of the prior's fault from the images, in the error's unit."""
    z: float
    """``size`` over its standard error, which covers the images' errors and the prior's."""


def faults(deviations: Array, found: Recombination, limits: Mapping[int, float]) -> tuple[Fault, ...]:
    """Errors that lie more than their limit from their prior, the most significant first.

    A prior that is off by f moves d by f h, with h the error's own column of 1 - B[e], so f = h'D^-1 d / h'D^-1 h is
    the estimate of f from all errors together. The faults are removed one by one before the others are tested, because
    a faulty error biases the others (data snooping, Baarda 1968).

    Args:
        deviations: d (K,), errors of the first solution less their prior's mean.
        found: the first solution and its prior.
        limits: number of standard errors beyond which an error is a fault, by its index; the prior of all others is
            believed.
    """
    moves, weight = (
        np.eye(len(deviations)) - found.error_response,
        _inverse(found.difference_covariance, np.sqrt(np.diag(found.prior))),
    )
    remaining, detected = set(limits), list[Fault]()
    while remaining:
        information = {k: float(moves[:, k] @ weight @ moves[:, k]) for k in remaining}
        sizes = {k: float(moves[:, k] @ weight @ deviations) / max(information[k], 1e-300) for k in remaining}
        z = {k: sizes[k] * float(np.sqrt(information[k])) for k in remaining}
        worst = max(remaining, key=lambda k: abs(z[k]) / limits[k])
        if abs(z[worst]) <= limits[worst]:
            break
        detected.append(Fault(worst, sizes[worst], z[worst]))
        along = weight @ moves[:, worst]
        weight = weight - np.outer(along, along) / information[worst]
        remaining.remove(worst)
    return tuple(detected)
