"""The instrument's errors and their prior once more, by how far either is off: the best unbiased combination of the two.

A fit weighs the errors' prior against photographs whose noise alone it knows, by derivatives that are not the images' own. Held mean cosines, moves of
scan and dome, and those derivatives leave an answer x (F,) with more error than that, so its errors e, the last K of x, may be worse than their prior was.
The prior says e = m + n, n of covariance V. With B = dx / dm, the answer's response to the prior,

    d = e - m,   c = Cov(x, d) = C[:, e] - B V,   D = Cov(d) = C[e, e] - B[e] V - V B[e]' + V,   x <- x - G d,   C <- C - c D^-1 c',   G = c D^-1

is the linear unbiased combination of least variance (Gauss and Markov). Where the fit used its prior in full, c = 0 and nothing changes; after it no ± of an
error is larger than the prior's. The tissue goes along as far as its error goes with the instrument's.
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
    """What the prior's second use changes."""

    cross: Array
    """c (F, K)."""
    spread: Array
    """D (K, K): covariance of the errors of the first answer about their prior, if neither is wrong."""
    follows: Array
    """B[e] (K, K): how far the first answer's errors follow their prior."""
    prior: Array
    """V (K, K)."""

    def gain(self, without: tuple[int, ...] = ()) -> Array:
        """G (F, K).

        Args:
            without: places of errors whose prior is not believed.
        """
        used, gain = [k for k in range(len(self.prior)) if k not in without], np.zeros_like(self.cross)
        unit = np.sqrt(np.diag(self.prior))[used]
        gain[:, used] = self.cross[:, used] @ _inverse(self.spread[np.ix_(used, used)], unit)
        return gain


def recombine(covariance: Array, response: Array, prior: Array) -> Recombination:
    """Combine an answer with its prior once more.

    Args:
        covariance: C (F, F) of the answer.
        response: B (F, K).
        prior: V (K, K).
    """
    first = len(covariance) - len(prior)
    common = response @ prior
    spread = covariance[first:, first:] - common[first:] - common[first:].T + prior
    return Recombination(covariance[:, first:] - common, spread, response[first:], prior)


def _inverse(spread: Array, unit: Array) -> Array:
    # In units of the prior's ±; directions without any spread have no part in c either.
    values, vectors = np.linalg.eigh(0.5 * (spread + spread.T) / np.outer(unit, unit))
    kept = values > SMALLEST_SHARE
    whitened = (vectors[:, kept] / np.sqrt(values[kept])) / unit[:, None]
    return np.asarray(whitened @ whitened.T)


FAULT_Z = 3.0
"""An error that lies more than so many standard errors from its prior is a fault of the calibration: 1 good one in 370 does."""


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

    One by one: each is freed of its prior before the others are judged, as a wrong one draws others along (Baarda 1968). An error of the prior by f
    moves d by (1 - B) f.

    Args:
        off: d (K,), errors of the first answer less their prior's mean.
    """
    off, spread, moves = off.copy(), found.spread.copy(), np.eye(len(off)) - found.follows
    left, told = set(range(len(off))), list[Fault]()
    while left:
        z = {k: float(off[k] / np.sqrt(max(spread[k, k], 1e-300))) for k in left}
        worst = max(z, key=lambda k: abs(z[k]))
        if abs(z[worst]) <= FAULT_Z:
            break
        told.append(Fault(worst, float(off[worst] / max(moves[worst, worst], SMALLEST_SHARE)), z[worst]))
        along = spread[:, worst] / spread[worst, worst]
        off, moves = off - along * off[worst], moves - np.outer(along, moves[worst])
        spread = spread - np.outer(along, spread[worst])
        left.remove(worst)
    return tuple(told)
