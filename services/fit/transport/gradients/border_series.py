"""What moving the dentin's border does to images, order by order in spherical harmonics; and the patches on which light
is averaged.

With L(x, w) the radiance of a light in propagation direction w, and L+(x, w) what the cameras count of light that
travels so, a change of the media changes an image by dI = -int dV int dw L+ [dsigma L - dsigma_s (f * L)]. A border
that moves by v along the dentin's outward normal n exchanges enamel for dentin in the volume it sweeps. In real
spherical harmonics, in which f is diagonal with its Legendre moments f_j,

    dI/dc = -int dA (n . v) sum_j c_j sum_k L_jk L+_jk,
    c_j = [sigma - sigma_s f_j] dentin - [sigma - sigma_s f_j] enamel.

What extinction takes and scattering returns cancels in c_0 before anything is sampled: c_0 is the difference of
absorption.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from services.core.geometry import Mesh
from services.fit.optics.parameters import Medium

Array = NDArray[np.float64]
LLOYD_ROUNDS = 10


@dataclass(frozen=True)
class BorderSeries:
    """The series of two media, and what stands in its place where it would not converge."""

    enamel: Medium
    dentin: Medium

    def coefficients(self, order: int) -> Array:
        """c_j for j = 0 ... order, per mm, the last one halved: the mean of the last two partial sums, as terms
        alternate where light is sent back.
        """
        j = np.arange(order + 1)
        terms = _attenuation(self.dentin, j) - _attenuation(self.enamel, j)
        terms[-1] *= 0.5 if order else 1.0
        return terms

    def uncollided(self, cosine: Array) -> Array:
        """sum_jk c_j Y_jk Y_jk between light that arrives and light that is seen in one direction each, per mm and sr,
        at the cosine between the two.

        Unless both are one line, extinction takes nothing, and what scatters is the phase function's own value.
        """
        return _scattered(self.enamel, cosine) - _scattered(self.dentin, cosine)


def _attenuation(medium: Medium, j: NDArray[np.int64]) -> Array:
    moments = medium.beta * np.power(medium.g1, j) + (1 - medium.beta) * np.power(medium.g2, j)
    return np.asarray(medium.sigma * (1 - medium.alpha * moments))


def _scattered(medium: Medium, cosine: Array) -> Array:
    def lobe(g: float) -> Array:
        return np.asarray((1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5))

    return np.asarray(
        medium.sigma * medium.alpha * (medium.beta * lobe(medium.g1) + (1 - medium.beta) * lobe(medium.g2))
    )


def patches(surface: Mesh, count: int) -> NDArray[np.int64]:
    """Divide a surface into at most so many patches of like size that bend little: each triangle's patch, (T,).

    Lloyd's algorithm on middles and unit normals of triangles (a turn by one radian counts as one millimetre), from
    farthest points.
    """
    corners = surface.vertices_mm[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled_areas = np.linalg.norm(normals, axis=1)
    points = np.concatenate([corners.mean(axis=1), normals / np.maximum(doubled_areas, 1e-30)[:, None]], axis=1)
    count = min(count, len(points))

    chosen, distance = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    centres = points[chosen]
    for _ in range(LLOYD_ROUNDS):
        nearest = cKDTree(centres).query(points)[1]
        weights = np.maximum(np.bincount(nearest, doubled_areas, minlength=count), 1e-30)
        centres = np.stack(
            [np.bincount(nearest, doubled_areas * column, minlength=count) / weights for column in points.T], axis=1
        )
    return np.asarray(np.unique(cKDTree(centres).query(points)[1], return_inverse=True)[1])
