"""How far from the mirror direction a surface's reflection reaches in one image.

Averaged over all pixels at one angle between normal and half vector, reflections are seen that single pixels hide in
noise. Their shape is that of a microfacet distribution (Walter et al. 2007, equations 25, Beckmann, and 33, GGX).
So what is seen near the mirror direction tells how much is left where it is fainter than the errors of the diffuse
light from which it is parted: there a broad lobe would be taken for diffuse light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PROFILE_DEG = 50
"""Half-angle to which light is summed: farther out surfaces turn from the light and shading is no quadratic."""
ROUGHNESS = np.geomspace(0.02, 0.45, 30)
"""Of the distributions tried, in steps of 11 %. The last hardly falls within the profile: it proves no reflection."""
SIGMA = 5.0
"""A lobe's amplitude is told from none by so many standard errors."""
CORE_SHARE = 0.15
"""Least part of its light that a lobe's core reflects: errors of shading reach 0.12 where none is, GGX 0.3 has 0.25."""
DIFFUSE_ERROR = 0.02
"""Error of the diffuse light at one angle, as a part of the image's mean or of what is there, whichever is more."""
SHAPE_ERROR = 0.1
"""How far a real lobe strays from the distribution, as a part of itself."""


@dataclass(frozen=True)
class _Lobe:
    """A distribution with its amplitude, and how well it describes the profile.

    Attributes:
        by_angle: amplitude times distribution, at the profile's angles.
        error: standard error of the amplitude, as a part of it; negative where the amplitude is.
        bias: part of all light by which the reflection came out too small, as diffuse light was learned from pixels
            that reflect too.
        misfit: weighted sum of squares.
    """

    roughness: float
    by_angle: Array
    error: float
    bias: float
    misfit: float


class LobeProfile:
    """Light and its reflected part, summed by whole degrees from the mirror direction."""

    def __init__(self) -> None:
        self._total, self._reflected, self._variance, self._count = (np.zeros(PROFILE_DEG) for _ in range(4))

    def add(
        self,
        cosines: NDArray[np.float32],
        brightness: NDArray[np.float32],
        reflected: NDArray[np.float32],
        weight: NDArray[np.float32],
    ) -> None:
        """Add pixels (N,) within ``PROFILE_DEG``; one of weight 0 tells nothing.

        Args:
            cosines: of the angle between normal and half vector.
            reflected, weight: estimate of the reflected part of the brightness, and its inverse variance.
        """
        told = weight > 0
        if not told.all():
            cosines, brightness, reflected, weight = (one[told] for one in (cosines, brightness, reflected, weight))
        degrees = np.degrees(np.arccos(np.clip(cosines, -1, 1))).astype(np.int64)
        variance = np.asarray(1 / weight, dtype=np.float32)
        self._total += self._by_degree(degrees, brightness)
        self._reflected += self._by_degree(degrees, reflected)
        self._variance += self._by_degree(degrees, variance)
        self._count += self._by_degree(degrees, np.ones_like(brightness))

    @staticmethod
    def _by_degree(degrees: NDArray[np.int64], values: NDArray[np.float32]) -> Array:
        return np.asarray(np.bincount(degrees, values, minlength=PROFILE_DEG)[:PROFILE_DEG], dtype=np.float64)

    def half_angle(self, tolerated: float, widest_deg: float) -> float:
        """Half-angle in rad within which the reflection exceeds a part of the diffuse light; 0 where no lobe is seen.

        Args:
            tolerated: that part. widest_deg: the result is never more.
        """
        used = np.flatnonzero(self._total > 0)
        # A distribution, its amplitude and a bias need some more angles than that
        if len(used) < 10:
            return 0.0
        total, reflected, count = self._total[used], self._reflected[used], self._count[used]
        level = np.maximum(total, count * total.sum() / count.sum())
        spread = self._variance[used] + (DIFFUSE_ERROR * level) ** 2 + (SHAPE_ERROR * reflected) ** 2
        lobe = min(
            _lobes(used.astype(np.float64) + 0.5, total, reflected, count, 1 / spread), key=lambda one: one.misfit
        )
        # None where its amplitude is noise, where it is as broad as shading, or where its core reflects too little
        core = lobe.by_angle > lobe.by_angle.max() / 2
        seen = reflected[core].sum() / total[core].sum() + lobe.bias if core.any() else 0.0
        if not 0 < lobe.error < 1 / SIGMA or lobe.roughness == ROUGHNESS[-1] or seen < CORE_SHARE:
            return 0.0
        own = lobe.by_angle * count / (1 + max(lobe.bias, 0.0))
        share = own / np.maximum(total - own, 1e-9 * total.max())
        beyond = used[share < tolerated]
        return float(np.radians(min(beyond[0], widest_deg) if len(beyond) else widest_deg))


def _lobes(degrees: Array, total: Array, reflected: Array, count: Array, weight: Array) -> Iterator[_Lobe]:
    """GGX and Beckmann distributions, each fitted by weighted least squares together with a bias.

    Learned from pixels that reflect a part s of their diffuse light, diffuse light comes out (1 + s) times too bright.
    What is taken for the reflection is then (1 + s) times the reflection less s times all light.
    """
    cosines_squared = np.cos(np.radians(degrees)) ** 2
    for roughness in ROUGHNESS:
        squared = roughness**2
        ggx = squared / (cosines_squared * (squared - 1) + 1) ** 2
        beckmann = np.exp((1 - 1 / cosines_squared) / squared) / (squared * cosines_squared**2)
        for facets in (ggx, beckmann):
            # Nothing of a lobe can be seen at these angles
            if facets.max() * squared < 1e-9:
                continue
            # The normal equations of two unknowns, unless the distribution is no other than all light
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
            yield _Lobe(float(roughness), amplitude * facets, error, float(bias), misfit)
