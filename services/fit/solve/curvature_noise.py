"""How noisy a curvature from Monte Carlo Jacobians is, kept where it matters: among coordinates that act on the same measurements.

The covariance of all entries of a curvature H (F, F) has F^4 numbers, gigabytes for the coordinates of a jaw. But a measurement near one tooth knows of few
coordinates. So noise is a sum of parts, each the covariance of the entries of H among some coordinates, from measurements of its own.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NoisePart:
    """Covariance of the entries H_ab, a <= b, of one set of measurements."""

    coordinates: tuple[int, ...]
    moments: Array
    """(P, P), P = n (n + 1) / 2 pairs of the n coordinates, in the order of ``numpy.triu_indices``."""

    def product_with(self, vector: Array) -> Array:
        """The matrix (n, P) that gives H v from the entries of H, for the part's coordinates of v (n,)."""
        n = len(vector)
        first, second = np.triu_indices(n)
        matrix, pairs = np.zeros((n, len(first))), np.arange(len(first))
        matrix[first, pairs] = vector[second]
        matrix[second, pairs] = vector[first]
        return matrix


@dataclass(frozen=True)
class CurvatureNoise:
    """Covariance of a curvature as a sum of independent parts."""

    parts: tuple[NoisePart, ...]

    def __add__(self, other: CurvatureNoise) -> CurvatureNoise:
        """Noise of the sum of two independent curvatures."""
        sums = {part.coordinates: part for part in self.parts}
        for part in other.parts:
            known = sums.get(part.coordinates)
            sums[part.coordinates] = (
                part if known is None else NoisePart(part.coordinates, known.moments + part.moments)
            )
        return CurvatureNoise(tuple(sums.values()))

    def scaled(self, factor: float) -> CurvatureNoise:
        """Noise of a curvature multiplied by sqrt(factor)."""
        return CurvatureNoise(tuple(NoisePart(part.coordinates, factor * part.moments) for part in self.parts))

    def variance(self, directions: Array) -> Array:
        """Variance of u'Hu for each column u of ``directions`` (F, K)."""
        total = np.zeros(directions.shape[1])
        for part in self.parts:
            own = directions[list(part.coordinates)]
            first, second = np.triu_indices(len(own))
            entries = own[first] * own[second] * np.where(first == second, 1.0, 2.0)[:, None]
            total += np.einsum("pk,pk->k", entries, part.moments @ entries)
        return np.maximum(total, 0.0)

    def of_product(self, vector: Array) -> Array:
        """Covariance (F, F) of H v for a vector v (F,)."""
        total = np.zeros((len(vector), len(vector)))
        for part in self.parts:
            own = list(part.coordinates)
            product = part.product_with(vector[own])
            total[np.ix_(own, own)] += product @ part.moments @ product.T
        return total

    def record(self) -> list[dict[str, Any]]:
        """As JSON values, numbers exact."""
        return [
            {
                "coordinates": part.coordinates,
                "moments": base64.b64encode(np.ascontiguousarray(part.moments).tobytes()).decode(),
            }
            for part in self.parts
        ]

    @staticmethod
    def of(record: list[dict[str, Any]]) -> CurvatureNoise:
        """From ``record``."""
        parts = []
        for entry in record:
            numbers = np.frombuffer(base64.b64decode(entry["moments"]), dtype=np.float64)
            size = len(entry["coordinates"]) * (len(entry["coordinates"]) + 1) // 2
            parts.append(NoisePart(tuple(entry["coordinates"]), numbers.reshape(size, size)))
        return CurvatureNoise(tuple(parts))


def per_pixel(terms: Array, lights: int) -> Array:
    """Sums (F, N) over the lights of a pixel of terms (F, lights x N): what is of one pixel is of the same walks, what is of two is independent."""
    return np.asarray(terms.reshape(len(terms), lights, -1).sum(axis=1))


def curvature_noise(
    mean: Array, difference: Array, weight: Array, coordinates: Sequence[int], lights: int = 1
) -> NoisePart:
    """Noise of sum w j j' among some coordinates, from the mean and difference (F, M) of two independently seeded estimates of j."""
    m, d = mean[list(coordinates)], difference[list(coordinates)]
    first, second = np.triu_indices(len(m))
    entries = per_pixel(0.5 * (m[first] * d[second] + d[first] * m[second]) * weight, lights)
    return NoisePart(tuple(coordinates), entries @ entries.T)
