"""The instrument's errors and their prior once more, by how far either is off: the best unbiased combination of the
two.

A fit weighs the errors' prior against photographs whose noise alone it knows, by derivatives that are not the images'
own. Held mean cosines, moves of scan and dome, and those derivatives leave an answer x (F,) with more error than that,
so its errors e, the last K of x, may be worse than their prior was. The prior says e = m + n, n of covariance V. With B
= dx / dm, the answer's response to the prior, and d = e - m,

    c = Cov(x, d) = C[:, e] - B V,   D = Cov(d) = C[e, e] - B[e] V - V B[e]' + V,   G = c D^-1,
    x <- x - G d,   C <- C - c D^-1 c'

is the linear unbiased combination of least variance (Gauss and Markov). Where the fit used its prior in full, c = 0 and
nothing changes; after it no ± of an error is larger than the prior's. The tissue goes along as far as its error goes
with the instrument's. An error that lies too far from its prior is freed of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST_SHARE = 1e-9
"""A direction of d whose variance is a smaller share of the prior's is rounding: there the answer is the prior."""


@dataclass(frozen=True)
class Recombination:
    """An answer and its prior, to be combined once more."""

    covariance: Array
    """C (F, F) of the answer."""
    response: Array
    """B (F, K)."""
    prior: Array
    """V (K, K)."""

    @property
    def cross(self) -> Array:
        """Covariance of x and d, c (F, K)."""
        return np.asarray(self.covariance[:, self._first :] - self.response @ self.prior)

    @property
    def spread(self) -> Array:
        """D (K, K): covariance of the errors of the answer about their prior, if neither is wrong."""
        common = self.follows @ self.prior
        return np.asarray(self.covariance[self._first :, self._first :] - common - common.T + self.prior)

    @property
    def follows(self) -> Array:
        """B[e] (K, K): how far the answer's errors follow their prior."""
        return self.response[self._first :]

    @property
    def _first(self) -> int:
        return len(self.covariance) - len(self.prior)

    def change(self, wrong: tuple[int, ...] = ()) -> Array:
        """Q (F, K) of the best combination x + Q d, which is -G where every prior is believed.

        Args:
            wrong: places of errors whose prior is not. The answer is freed of these: their prior's means go where the
                answer puts the errors.
        """
        used = [k for k in range(len(self.prior)) if k not in wrong]
        freed = np.zeros_like(self.response)
        if wrong:
            own, pulls = list(wrong), np.eye(len(self.prior)) - self.follows
            freed[:, own] = self.response[:, own] @ np.linalg.inv(pulls[np.ix_(own, own)])
        left = self.after(freed)
        unit, change = np.sqrt(np.diag(self.prior))[used], np.zeros_like(freed)
        change[:, used] = -left.cross[:, used] @ _inverse(left.spread[np.ix_(used, used)], unit)
        through = np.eye(len(self.prior)) + freed[self._first :]
        return np.asarray(freed + change @ through)

    def after(self, change: Array) -> Recombination:
        """The answer x + Q d."""
        both = change @ self.cross.T
        covariance = self.covariance + both + both.T + change @ self.spread @ change.T
        response = self.response + change @ (self.follows - np.eye(len(self.prior)))
        return Recombination(covariance, response, self.prior)


def _inverse(spread: Array, unit: Array) -> Array:
    # In units of the prior's ±; directions without any spread have no part in c either.
    values, vectors = np.linalg.eigh(0.5 * (spread + spread.T) / np.outer(unit, unit))
    kept = values > SMALLEST_SHARE
    whitened = (vectors[:, kept] / np.sqrt(values[kept])) / unit[:, None]
    return np.asarray(whitened @ whitened.T)


FAULT_Z = 3.0
"""An error that lies more than so many standard errors from its prior is a fault of the calibration: 1 good one in 370
does."""


@dataclass(frozen=True)
class Fault:
    """An error that lies farther from its prior than both allow."""

    place: int
    """Its place among the errors."""
    size: float
    """What the images say of it, without its prior."""
    z: float
    """That over what the images' errors and the prior's ± allow together."""


def faults(off: Array, found: Recombination) -> tuple[Fault, ...]:
    """Errors that lie more than ``FAULT_Z`` standard errors from their prior, the clearest first.

    A prior that is off by f moves d by f h, h = (1 - B[e])'s own column, so f = h'D^-1 d / h'D^-1 h is what all errors
    together say of it. One by one: each fault is taken out before the others are judged, as a wrong one draws others
    along (Baarda 1968).

    Args:
        off: d (K,), errors of the first answer less their prior's mean.
    """
    moves, weight = np.eye(len(off)) - found.follows, _inverse(found.spread, np.sqrt(np.diag(found.prior)))
    left, told = set(range(len(off))), list[Fault]()
    while left:
        seen = {k: float(moves[:, k] @ weight @ moves[:, k]) for k in left}
        sizes = {k: float(moves[:, k] @ weight @ off) / max(seen[k], 1e-300) for k in left}
        worst = max(left, key=lambda k: abs(sizes[k]) * np.sqrt(seen[k]))
        z = sizes[worst] * float(np.sqrt(seen[worst]))
        if abs(z) <= FAULT_Z:
            break
        told.append(Fault(worst, sizes[worst], z))
        along = weight @ moves[:, worst]
        weight = weight - np.outer(along, along) / seen[worst]
        left.remove(worst)
    return tuple(told)
