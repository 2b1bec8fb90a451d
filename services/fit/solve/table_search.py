"""Search for the start of a fit: the best homogeneous tooth in a table over albedo x density x anisotropy (teeth 2018,
section 7).

An image is a polynomial in the albedo when its paths are binned by scattering order, I(alpha) = sum_n alpha^n I_n. So a
render at alpha = 1, split into bins of orders, gives every albedo at once, and tens of renders over density x
anisotropy give tens of thousands of table points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import to_natural

Array = NDArray[np.float64]

REDUCED_DENSITIES = (0.2, 0.4, 0.7, 1.1, 1.6, 2.3, 3.3, 4.8)
"""Reduced scattering coefficients sigma (1 - g), per mm: the literature's span for enamel and dentin. The grid is in
the reduced coefficient and not in sigma, so that every render costs no more than needed."""
ANISOTROPIES = (0.0, 0.7)
"""Mean cosines g of the table's renders."""
STARTS = 3
"""Largest number of candidates from which fits start."""
KAPPA = (1.0, 3.0)
"""Range of -log10(1 - alpha). The upper limit is where absorption becomes invisible; beyond it the fit would start on a
plateau."""
SCALE_TRUST = 0.35
"""Weight of the logarithm of the image scale against the relative image error. It is small although lights are
calibrated, because one medium stands for two."""


def order_edges(last: int = 2048) -> NDArray[np.int64]:
    """Bin edges over the number of scatterings: single orders first, then four bins per octave."""
    fine = np.arange(0, 9)
    coarse = np.round(8 * 2.0 ** (np.arange(1, 4 * int(np.log2(last / 8)) + 1) / 4))
    return np.unique(np.concatenate([fine, coarse])).astype(np.int64)


def bin_powers(alpha: Array, edges: NDArray[np.int64]) -> Array:
    """Mean of alpha^n over the orders of each bin, (A, K), from the geometric sum; stable as alpha tends to 1.

    Within a bin the orders are taken as equally frequent; bins are narrow enough (2^(1/4)) that this hardly matters.
    """
    log_alpha = np.log(alpha)[:, None]
    first, count = edges[:-1][None].astype(float), np.diff(edges)[None].astype(float)
    ratio = np.expm1(count * log_alpha) / np.where(log_alpha == 0, 1.0, np.expm1(log_alpha))
    return np.where(log_alpha == 0, 1.0, np.exp(first * log_alpha) * ratio / count)


@dataclass(frozen=True)
class Node:
    """Density (1/mm) and anisotropy of one render of the table."""

    sigma: float
    g: float


@dataclass(frozen=True)
class Candidate:
    """A point of the table and the error of its images."""

    sigma: float
    alpha: float
    g: float
    error: float
    """Relative image error after the best common scale, 0 to 1."""
    scale: float
    """The best common scale: photographs over renders."""

    @property
    def score(self) -> float:
        """The quantity that the search minimises: image error and, with a small weight, the scale's distance from 1."""
        return float(np.hypot(self.error, np.log(self.scale) * SCALE_TRUST)) if self.scale > 0 else np.inf


def nodes() -> tuple[Node, ...]:
    """The nodes of one channel's table."""
    return tuple(Node(reduced / (1 - g), g) for g in ANISOTROPIES for reduced in REDUCED_DENSITIES)


@dataclass(frozen=True)
class Observed:
    """The photographs of one block, flattened."""

    reference: Array
    variance: Array
    weight: Array

    @staticmethod
    def of(reference: Array, variance: Array, weight: Array) -> Observed:
        """Photographs (L, N) with their variance and their weight in the fit."""
        return Observed(reference.reshape(-1), variance.reshape(-1), weight.reshape(-1))


def search_node(
    node: Node,
    orders: Sequence[tuple[Array, Array]],
    edges: NDArray[np.int64],
    observed: Sequence[Observed],
    albedos: int,
) -> tuple[Candidate, ...]:
    """Errors of one node's table points, best first.

    Args:
        node: density and anisotropy of the renders.
        orders: per block, two independently seeded images at alpha = 1 by bin of order, (K, L, N) each.
        edges: bin edges (K + 1,) over the number of scatterings.
        observed: per block, the photographs.
        albedos: number of albedo values.
    """
    alpha = np.array([to_natural("alpha", x) for x in np.linspace(*KAPPA, albedos)])
    powers = bin_powers(alpha, edges)

    # <C,R> and <C,C> are polynomials in the same powers, so no image is formed per albedo; products of two seeds keep
    # noise from biasing <C,C>.
    bins = len(edges) - 1
    cross, gram, total = np.zeros(bins), np.zeros((bins, bins)), 0.0
    for (first, second), photographs in zip(orders, observed, strict=True):
        a, b = first.reshape(bins, -1), second.reshape(bins, -1)
        product = (a * photographs.weight) @ b.T
        cross += 0.5 * (a + b) @ (photographs.weight * photographs.reference)
        gram += 0.5 * (product + product.T)
        total += float(photographs.weight @ (photographs.reference**2 - photographs.variance))
    cr, cc = powers @ cross, np.einsum("ak,kl,al->a", powers, gram, powers)

    # A black render (<C,C> = 0) explains nothing: error 1, scale 0.
    lit = (cc > 0) & (cr > 0) & (total > 0)
    safe = np.where(lit, cc, 1.0)
    scale = np.where(lit, cr / safe, 0.0)
    error = np.sqrt(np.clip(np.where(lit, 1 - cr**2 / (safe * max(total, 1e-300)), 1.0), 0.0, 1.0))
    found = [
        Candidate(node.sigma, float(a), node.g, float(e), float(s)) for a, e, s in zip(alpha, error, scale, strict=True)
    ]
    return tuple(sorted(found, key=lambda c: c.score))


def best(per_node: Sequence[Sequence[Candidate]]) -> tuple[Candidate, ...]:
    """The best candidates, at most one per node, best first."""
    return tuple(sorted((node[0] for node in per_node if node), key=lambda c: c.score)[:STARTS])
