"""Errors of a scanned surface as a smooth random height, whose slopes tilt the normals.

The height is a sum of Gaussian bumps at centres on the surface, each with a coefficient of its own. Independent normal
coefficients give a height whose correlation falls to exp(-r² / 2 l²) at a distance r, where l is the correlation length
and a bump has the standard deviation l / √2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SPACING = 0.85
"""Distance between the centres of bumps, as a share of the correlation length: a bump's standard deviation times 1.2,
at which the height's variance is even to a few per cent."""
REACH = 4.0
"""Distance, in a bump's standard deviations, beyond which it is zero: it has fallen to 3e-4."""


@dataclass(frozen=True)
class SurfaceError:
    """How far a scanned surface may be from the true one.

    Attributes:
        height_mm: standard deviation of the height, mm.
        length_mm: correlation length, mm.
    """

    height_mm: float = 0.02
    length_mm: float = 1.0

    @property
    def bump_mm(self) -> float:
        """Standard deviation of a bump, mm."""
        return self.length_mm / math.sqrt(2)


def spread_centres(points_mm: Array, spacing_mm: float) -> Array:
    """Points (K, 3) of a cloud (N, 3) so that no two are closer than ``spacing_mm`` and each point has one so close."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points_mm)
    is_free, centres = np.ones(len(points_mm), dtype=bool), []
    # Go through the points by their position, so that the centres do not depend on the order of the photographs
    for number in np.lexsort(points_mm.T):
        if is_free[number]:
            centres.append(number)
            is_free[tree.query_ball_point(points_mm[number], spacing_mm)] = False
    return points_mm[centres]


def tilts(points_mm: Array, tangents: Array, centres_mm: Array, error: SurfaceError) -> Array:
    """Tilt of the normals along two tangents by a height of 1 mm at each centre, (2, N, K), rad.

    Args:
        points_mm: (N, 3) points on the surface. tangents: (2, N, 3) unit tangents there. centres_mm: (K, 3).
        error: the surface's error.
    """
    away = points_mm[:, None] - centres_mm[None]
    width = error.bump_mm
    squared = (away**2).sum(axis=-1) / width**2
    height = np.where(squared < REACH**2, np.exp(-squared / 2), 0.0)
    # A normal tilts against the slope, and a bump's slope is - height * away / width²
    return np.stack([np.einsum("nkx,nx->nk", away, tangent) * height / width**2 for tangent in tangents])


def coefficient_se(centres_mm: Array, points_mm: Array, error: SurfaceError) -> float:
    """Standard deviation of a bump's coefficient, mm, by which the height has the given one on average."""
    squared = ((points_mm[:, None] - centres_mm[None]) ** 2).sum(axis=-1) / error.bump_mm**2
    return float(error.height_mm / np.sqrt(np.exp(-squared).sum(axis=1).mean()))


def tangents_of(normal: Array) -> Array:
    """Two unit tangents (2, N, 3) of unit normals (N, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first)])
