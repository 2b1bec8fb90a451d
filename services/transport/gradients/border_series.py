"""Change of images with the position of the dentin's border, as a series in spherical harmonics; and the patches on
which light is averaged.

With L(x, w) the radiance of a light in propagation direction w, and L+(x, w) the importance, the response of the
cameras to light that travels so, a change of the media changes an image by dI = -int dV int dw L+ [dsigma L - dsigma_s
(f * L)]. A border that moves by v along the dentin's outward normal n exchanges enamel for dentin in the volume it
sweeps. In real spherical harmonics, in which f is diagonal with its Legendre moments f_j,

    dI/dc = -int dA (n . v) sum_j c_j sum_k L_jk L+_jk,
    c_j = [sigma - sigma_s f_j] dentin - [sigma - sigma_s f_j] enamel.

In c_0 the light that extinction removes and scattering returns cancels before anything is sampled: c_0 is the
difference of absorption.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from services.core.geometry import Mesh
from services.transport.optics.parameters import Medium

Array = NDArray[np.float64]
LLOYD_ROUNDS = 10
"""Number of iterations of Lloyd's algorithm."""


@dataclass(frozen=True)
class BorderSeries:
    """The series of two media, and the closed form that replaces it where it would not converge."""

    enamel: Medium
    dentin: Medium

    def coefficients(self, order: int) -> Array:
        """c_j for j = 0 ... order, per mm. The last one is halved, which averages the last two partial sums, because
        terms alternate in sign where light is scattered back.
        """
        j = np.arange(order + 1)
        terms = _attenuation(self.dentin, j) - _attenuation(self.enamel, j)
        terms[-1] *= 0.5 if order else 1.0
        return terms

    def uncollided(self, cosine: Array) -> Array:
        """sum_jk c_j Y_jk Y_jk in closed form, per mm and sr, for arriving light and camera importance of one direction
        each, at the cosine between the two.

        Unless both directions lie on one line, the term of extinction is zero, and that of scattering is the value of
        the phase function.
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
    """Divide a surface into at most ``count`` patches of like size that bend little; returns each triangle's patch,
    (T,).

    Lloyd's algorithm on the triangles' centroids and unit normals (a turn by one radian counts as one millimetre),
    started from farthest points.
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
