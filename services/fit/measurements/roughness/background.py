"""Light from inside the subject around a highlight: smooth over the surface, and of no other known form.

Its free part is a polynomial of the place, another one times the cosine of incidence, and a third one times that cosine
as light spreads it inside. And it has Gaussian bumps, whose coefficients are as small as all photographs together show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.roughness.patches import Patch
from services.fit.measurements.roughness.surface import REACH, SPACING, spread_centres, tangents_of

Array = NDArray[np.float64]

DEGREE = 2
"""Degree of the polynomials."""
SPREAD_MM = 0.7
"""Standard deviation of the spread of light inside, over which the cosine of incidence is averaged."""
LENGTHS_MM = (1.0, 2.0)
"""Correlation lengths of the bumps: the one that is used, near the length over which light spreads in enamel, and the
one by which it is judged how far the answer depends on this choice."""
START_SHARE = 0.05
"""Standard deviation of the bumps' coefficients before any photograph is seen, as a share of the patch's median
radiance."""


@dataclass(frozen=True)
class Background:
    """Terms of one patch's background.

    Attributes:
        terms: (N, T) at the patch's pixels, the free ones first.
        free: number of free terms.
    """

    terms: Array
    free: int

    def precision(self, share: float) -> Array:
        """Inverse variances (T,) of the coefficients."""
        found = np.full(self.terms.shape[1], 1 / share**2)
        # No bound, only so that a term that the pixels do not tell from the others has an answer
        found[: self.free] = 1e-6
        return found


def free_terms(patch: Patch) -> Array:
    """Terms (N, T) whose coefficients are free, about as large as the patch's radiance."""
    away = patch.points_mm - patch.points_mm.mean(axis=0)
    u, v = (away @ tangent[0] for tangent in tangents_of(patch.to_camera.mean(axis=0)[None]))
    reach = max(float(np.abs(u).max()), float(np.abs(v).max()), 1e-9)
    u, v = u / reach, v / reach
    places = np.stack([u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1) * _level(patch)
    sharp = (patch.normals.mean(axis=1) * patch.to_light).sum(axis=1)
    shades = sharp, _spread(sharp, patch.points_mm)
    return np.concatenate([places, *(places * shade[:, None] for shade in shades)], axis=1)


def background_of(patch: Patch, length_mm: float) -> Background:
    """The background of a patch, with bumps of a correlation length."""
    smooth = free_terms(patch)
    centres = spread_centres(patch.points_mm, SPACING * length_mm)
    squared = _squared(patch.points_mm, centres) / (length_mm**2 / 2)
    bumps = np.where(squared < REACH**2, np.exp(-squared / 2), 0.0) * _level(patch)
    return Background(np.concatenate([smooth, bumps], axis=1), smooth.shape[1])


def _spread(cosine: Array, points_mm: Array) -> Array:
    """Cosine of incidence (N,), averaged over the patch's pixels as light spreads inside."""
    weight = np.exp(-_squared(points_mm, points_mm) / (2 * SPREAD_MM**2))
    return np.asarray(weight @ cosine / weight.sum(axis=1))


def _squared(points: Array, others: Array) -> Array:
    """Squared distances (N, M)."""
    product = points @ others.T
    return np.asarray(np.maximum((points**2).sum(axis=1)[:, None] + (others**2).sum(axis=1) - 2 * product, 0))


def _level(patch: Patch) -> float:
    return max(float(np.median(np.abs(patch.value))), 1e-300)
