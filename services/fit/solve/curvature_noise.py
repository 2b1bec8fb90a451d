"""Noise of a curvature from Monte Carlo Jacobians, stored only among coordinates that act on the same measurements.

The covariance of all entries of a curvature H (F, F) has F^4 numbers, gigabytes for the coordinates of a jaw. But a
measurement near one tooth depends on few coordinates. So the noise is a sum of independent parts, each the covariance
of the entries of H among some coordinates, by a set of measurements of its own.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@lru_cache(maxsize=64)
def pairs_of(count: int, exact: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices a and b (P,) of the noisy entries H_ab: pairs of the noisy coordinates, then each of them with every
    exact one.

    Args:
        count: number of coordinates whose derivatives are noisy; they come first.
        exact: number of coordinates whose derivatives are known exactly, such as a gain's; entries between two of them
            have no noise.
    """
    first, second = np.triu_indices(count)
    noisy, known = np.divmod(np.arange(count * exact), max(exact, 1))
    pairs = np.concatenate([first, noisy]), np.concatenate([second, count + known])
    for indices in pairs:
        indices.flags.writeable = False
    return pairs


@dataclass(frozen=True)
class NoisePart:
    """Covariance of the noisy entries H_ab of one set of measurements."""

    coordinates: tuple[int, ...]
    """Coordinates whose derivatives are noisy."""
    moments: Array
    """Covariance (P, P) of the entries, in the order of ``pairs_of``."""
    exact: tuple[int, ...] = ()
    """Coordinates whose derivatives are known exactly."""

    @property
    def own(self) -> list[int]:
        """All coordinates of the part, the noisy ones first."""
        return [*self.coordinates, *self.exact]

    @property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices into ``own`` of the two coordinates of each entry."""
        return pairs_of(len(self.coordinates), len(self.exact))

    def product_with(self, vector: Array) -> Array:
        """The matrix (n, P) that gives H v from the entries of H, for the part's coordinates of v (n,)."""
        first, second = self.pairs
        matrix, pairs = np.zeros((len(vector), len(first))), np.arange(len(first))
        matrix[first, pairs] = vector[second]
        matrix[second, pairs] = vector[first]
        return matrix


@dataclass(frozen=True)
class CurvatureNoise:
    """Covariance of a curvature as a sum of independent parts."""

    parts: tuple[NoisePart, ...]

    def __add__(self, other: CurvatureNoise) -> CurvatureNoise:
        """Noise of the sum of two independent curvatures."""
        sums = {(part.coordinates, part.exact): part for part in self.parts}
        for part in other.parts:
            known = sums.get((part.coordinates, part.exact))
            sums[part.coordinates, part.exact] = (
                part if known is None else replace(part, moments=known.moments + part.moments)
            )
        return CurvatureNoise(tuple(sums.values()))

    def scaled(self, factor: float) -> CurvatureNoise:
        """Noise of a curvature multiplied by sqrt(factor)."""
        return CurvatureNoise(tuple(replace(part, moments=factor * part.moments) for part in self.parts))

    def variance(self, directions: Array) -> Array:
        """Variance of u'Hu for each column u of ``directions`` (F, K)."""
        total = np.zeros(directions.shape[1])
        for part in self.parts:
            own, (first, second) = directions[part.own], part.pairs
            entries = own[first] * own[second] * np.where(first == second, 1.0, 2.0)[:, None]
            total += np.einsum("pk,pk->k", entries, part.moments @ entries)
        return np.maximum(total, 0.0)

    def of_product(self, vector: Array) -> Array:
        """Covariance (F, F) of H v for a vector v (F,)."""
        total = np.zeros((len(vector), len(vector)))
        for part in self.parts:
            own = part.own
            product = part.product_with(vector[own])
            total[np.ix_(own, own)] += product @ part.moments @ product.T
        return total

    def of_eliminated(self, inverse: Array, count: int) -> Array:
        """Bias (F, F) that noise gives A S^-1 A', where A (F, K) are the entries of the first F coordinates with the
        others, all exact: sum_kl S^-1_kl Cov(A_ak, A_bl).

        Args:
            inverse: S^-1 (K, K).
            count: number F of the first coordinates.
        """
        total = np.zeros((count, count))
        for part in self.parts:
            own, known = list(part.coordinates), [k - count for k in part.exact]
            cross = part.moments[-len(own) * len(known) :, -len(own) * len(known) :]
            by_entry = cross.reshape(len(own), len(known), len(own), len(known))
            total[np.ix_(own, own)] += np.einsum("akbl,kl->ab", by_entry, inverse[np.ix_(known, known)])
        return total

    def record(self) -> list[dict[str, Any]]:
        """The parts as JSON values; numbers survive exactly."""
        return [
            {
                "coordinates": part.coordinates,
                **({"exact": part.exact} if part.exact else {}),
                "moments": base64.b64encode(np.ascontiguousarray(part.moments).tobytes()).decode(),
            }
            for part in self.parts
        ]

    @staticmethod
    def of(record: list[dict[str, Any]]) -> CurvatureNoise:
        """Noise from the JSON values of ``record``."""
        parts = []
        for entry in record:
            numbers = np.frombuffer(base64.b64decode(entry["moments"]), dtype=np.float64)
            coordinates, exact = tuple(entry["coordinates"]), tuple(entry.get("exact", ()))
            size = len(pairs_of(len(coordinates), len(exact))[0])
            parts.append(NoisePart(coordinates, numbers.reshape(size, size), exact))
        return CurvatureNoise(tuple(parts))


def per_pixel(terms: Array, lights: int) -> Array:
    """Sums (F, N) of terms (F, lights x N) over the lights of each pixel. Terms of one pixel come from the same walks;
    those of different pixels are independent.
    """
    return np.asarray(terms.reshape(len(terms), lights, -1).sum(axis=1))


def curvature_noise(
    mean: Array,
    difference: Array,
    weight: Array,
    coordinates: Sequence[int],
    lights: int = 1,
    exact: Sequence[int] = (),
) -> NoisePart:
    """Noise of sum w j j' among some coordinates, from the mean and difference (F, M) of two independently seeded
    estimates of j.

    Args:
        exact: further coordinates, whose derivatives have no noise.
    """
    m, d = mean[list(coordinates)], difference[list(coordinates)]
    first, second = pairs_of(len(m), 0)
    entries = per_pixel(0.5 * (m[first] * d[second] + d[first] * m[second]) * weight, lights)
    if len(exact):
        # One noisy coordinate at a time, to save memory: a capture may have a gain for each of hundreds of lights.
        cross = [per_pixel(0.5 * weight * own * mean[list(exact)], lights) for own in d]
        entries = np.concatenate([entries, *cross])
    return NoisePart(tuple(coordinates), entries @ entries.T, tuple(exact))
