"""Angle from the mirror direction up to which a surface's reflection reaches in one image.

The average over all pixels at one angle between normal and half vector reveals reflections that noise hides in single
pixels. Their profile has the shape of a microfacet distribution (Walter et al. 2007, equations 25, Beckmann, and 33,
GGX). A distribution fitted near the mirror direction predicts the reflection farther out, where it is weaker than the
error of the diffuse light and a broad lobe would be mistaken for diffuse light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PROFILE_DEG = 50
"""Half-angle of the profile, degrees: farther out surfaces turn from the light and shading is not quadratic."""
ROUGHNESS = np.geomspace(0.02, 0.45, 30)
"""Roughness of the distributions tried, in steps of 11 %. The last distribution hardly decreases within the profile, so
a best fit there is no evidence of a reflection."""
SIGMA = 5.0
"""Number of standard errors by which a lobe's amplitude must exceed zero."""
CORE_SHARE = 0.15
"""Smallest reflected fraction of the light in a lobe's core. Errors of shading reach 0.12 without a reflection; a GGX
lobe of roughness 0.3 has 0.25."""
DIFFUSE_ERROR = 0.02
"""Error of the diffuse light at one angle, as a fraction of the image's mean or of the light at this angle, whichever
is larger."""
SHAPE_ERROR = 0.1
"""Deviation of a real lobe from the distribution, as a fraction of the lobe."""


@dataclass(frozen=True)
class Distribution:
    """Microfacet distribution, up to scale."""

    roughness: float
    is_beckmann: bool

    def at(self, cosines_squared: Array) -> Array:
        """Values (N,) at squared cosines (N,) between normal and half vector, all above zero."""
        squared = self.roughness**2
        if self.is_beckmann:
            return np.asarray(np.exp((1 - 1 / cosines_squared) / squared) / (squared * cosines_squared**2))
        return np.asarray(squared / (cosines_squared * (squared - 1) + 1) ** 2)


@dataclass(frozen=True)
class FoundLobe:
    """A reflection found in a profile.

    Attributes:
        distribution: its distribution.
        half_angle: angle, rad, within which it exceeds the tolerated fraction of the diffuse light.
    """

    distribution: Distribution
    half_angle: float


@dataclass(frozen=True)
class _Lobe:
    """Distribution fitted to the profile.

    Attributes:
        distribution: the distribution.
        by_angle: amplitude times distribution, at the profile's angles.
        error: relative standard error of the amplitude; negative if the amplitude is negative.
        bias: fraction of all light by which the reflection is underestimated, because diffuse light was learned from
            pixels that reflect too.
        misfit: weighted sum of squared residuals.
    """

    distribution: Distribution
    by_angle: Array
    error: float
    bias: float
    misfit: float


class LobeProfile:
    """Light and its reflected part, summed by whole degrees between normal and half vector."""

    def __init__(self) -> None:
        self._total, self._reflected, self._variance, self._count = (np.zeros(PROFILE_DEG) for _ in range(4))

    def add(
        self,
        cosines: NDArray[np.float32],
        brightness: NDArray[np.float32],
        reflected: NDArray[np.float32],
        weight: NDArray[np.float32],
    ) -> None:
        """Add pixels (N,) within ``PROFILE_DEG``; pixels of weight 0 are ignored.

        Args:
            cosines: cosines of the angle between normal and half vector.
            brightness: light of the pixels along the light's colour.
            reflected, weight: estimate of the reflected part of the brightness, and its inverse variance.
        """
        has_weight = weight > 0
        if not has_weight.all():
            cosines, brightness, reflected, weight = (
                one[has_weight] for one in (cosines, brightness, reflected, weight)
            )
        degrees = np.degrees(np.arccos(np.clip(cosines, -1, 1))).astype(np.int64)
        variance = np.asarray(1 / weight, dtype=np.float32)
        self._total += self._by_degree(degrees, brightness)
        self._reflected += self._by_degree(degrees, reflected)
        self._variance += self._by_degree(degrees, variance)
        self._count += self._by_degree(degrees, np.ones_like(brightness))

    @staticmethod
    def _by_degree(degrees: NDArray[np.int64], values: NDArray[np.float32]) -> Array:
        return np.asarray(np.bincount(degrees, values, minlength=PROFILE_DEG)[:PROFILE_DEG], dtype=np.float64)

    def lobe(self, tolerated: float, widest_deg: float) -> FoundLobe | None:
        """The lobe within whose half-angle the reflection exceeds a fraction of the diffuse light, or None.

        Args:
            tolerated: the fraction. widest_deg: upper limit of the half-angle.
        """
        used = np.flatnonzero(self._total > 0)
        # Require clearly more angles than the unknowns roughness, amplitude and bias
        if len(used) < 10:
            return None
        total, reflected, count = self._total[used], self._reflected[used], self._count[used]
        level = np.maximum(total, count * total.sum() / count.sum())
        spread = self._variance[used] + (DIFFUSE_ERROR * level) ** 2 + (SHAPE_ERROR * reflected) ** 2
        lobe = min(
            _lobes(used.astype(np.float64) + 0.5, total, reflected, count, 1 / spread), key=lambda one: one.misfit
        )
        # Reject a lobe whose amplitude is noise, that is as broad as shading, or whose core reflects too little
        core = lobe.by_angle > lobe.by_angle.max() / 2
        core_share = reflected[core].sum() / total[core].sum() + lobe.bias if core.any() else 0.0
        if not 0 < lobe.error < 1 / SIGMA or lobe.distribution.roughness == ROUGHNESS[-1] or core_share < CORE_SHARE:
            return None
        own = lobe.by_angle * count / (1 + max(lobe.bias, 0.0))
        share = own / np.maximum(total - own, 1e-9 * total.max())
        beyond = used[share < tolerated]
        half_angle_deg = min(beyond[0], widest_deg) if len(beyond) else widest_deg
        return FoundLobe(lobe.distribution, float(np.radians(half_angle_deg)))


def _lobes(degrees: Array, total: Array, reflected: Array, count: Array, weight: Array) -> Iterator[_Lobe]:
    """Fit each GGX and Beckmann distribution by weighted least squares, together with a bias.

    If diffuse light is learned from pixels that also reflect a fraction s of it, it is overestimated by the factor
    1 + s. The estimated reflection is then (1 + s) times the true one minus s times all light.
    """
    cosines_squared = np.cos(np.radians(degrees)) ** 2
    for roughness in ROUGHNESS:
        for distribution in (Distribution(float(roughness), False), Distribution(float(roughness), True)):
            facets = distribution.at(cosines_squared)
            # Skip a distribution that is almost zero at all these angles
            if facets.max() * roughness**2 < 1e-9:
                continue
            # Solve the normal equations for amplitude and bias; skip a distribution that is proportional to all light
            own, other = facets * count, -total
            square, mixed, other_square = (
                (weight * one * two).sum() for one, two in ((own, own), (own, other), (other, other))
            )
            determinant = square * other_square - mixed**2
            if determinant <= 1e-9 * square * other_square:
                continue
            by_own, by_other = (weight * own * reflected).sum(), (weight * other * reflected).sum()
            amplitude = (other_square * by_own - mixed * by_other) / determinant
            bias = (square * by_other - mixed * by_own) / determinant
            misfit = float((weight * (reflected - amplitude * own - bias * other) ** 2).sum())
            error = float(np.sqrt(other_square / determinant) / amplitude) if amplitude else np.inf
            yield _Lobe(distribution, amplitude * facets, error, float(bias), misfit)
