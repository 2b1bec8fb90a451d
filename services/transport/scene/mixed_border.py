"""A border between enamel and dentin across which albedo and phase function change gradually (teeth 2018 Eq. 15 to 18,
corrected in optics.md).

The share of enamel is l = logistic(q / s), q the signed distance to the dentin's surface, positive in enamel.
Extinction stays sharp, so free flights and light maps are those of the sharp border.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.anatomy.distance import SignedDistanceGrid
from services.core.geometry import Mesh

WIDTHS_PER_SCALE = 8.0
"""Width of the border over the scale s: l goes from 2 % to 98 % across it."""
PITCH_MM = 0.15
"""Smallest pitch of the grid, mm."""
MAX_CELLS = 8_000_000
"""Largest number of grid cells; larger scenes have a larger pitch."""
MARGIN_WIDTHS = 1.5
"""Margin of the grid around the dentin, in widths of the border; at its end l is 1 within 1e-5."""
ON_SURFACE_MM = 1e-6
"""Distance in mm up to which a point counts as on the surface."""

Array = NDArray[np.float64]


class MixedBorder:
    """The share of enamel on a grid, and how it changes as the dentin's surface moves."""

    def __init__(self, width_mm: float) -> None:
        self.width_mm = width_mm
        self._inverse_scale = dr.opaque(mi.Float, WIDTHS_PER_SCALE / width_mm)

    def move(self, dentin: Mesh, modes_mm: NDArray[np.float64]) -> None:
        """Measure distances to the present dentin surface, and how they change with the modes (M, V, 3) of its
        vertices.
        """
        margin = MARGIN_WIDTHS * self.width_mm
        extent = np.ptp(dentin.vertices_mm, axis=0) + 2 * margin
        pitch = max(PITCH_MM, float(np.cbrt(extent.prod() / MAX_CELLS)))
        grid = SignedDistanceGrid(dentin, pitch, margin)
        low, high = grid.bounds_mm
        self._low, self._inverse_pitch = dr.opaque(mi.Point3f, low.tolist()), dr.opaque(mi.Float, 1 / pitch)
        self._shape = grid.depth.shape

        # Measure exactly where the mixture changes, because the grid's own distances away from the surface are a little
        # too large.
        distance = -grid.depth
        near = np.abs(distance) < margin
        axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, self._shape, strict=True)]
        points = np.stack([axis[index] for axis, index in zip(axes, np.nonzero(near), strict=True)], axis=-1)
        nearest, length, face = grid.surface.closest(points)
        distance[near] = np.copysign(length, distance[near])
        self._distance = _texture(distance)
        self._motion = []
        for speed in _speeds(dentin, modes_mm, points, nearest, distance[near], face):
            values = np.zeros_like(distance)
            values[near] = speed
            self._motion.append(_texture(values))

    def share(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Share of enamel at a point, and its slope dl/dq, per mm."""
        x = self._sample_texture(self._distance, point, active) * self._inverse_scale
        # Branch on the sign, so that the exponential stays small.
        small = dr.exp(-dr.abs(x))
        share = dr.select(x >= 0, 1, small) / (1 + small)
        return share, small / dr.square(1 + small) * self._inverse_scale

    def motion(self, point: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """Change of the signed distance q with each mode's weight, mm."""
        return [self._sample_texture(texture, point, active) for texture in self._motion]

    def _sample_texture(self, texture: mi.Texture3f, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        # Grid points are texel centres; a texture's first axis is its last coordinate.
        cell = mi.Point3f(point - self._low) * self._inverse_pitch + 0.5
        depth, height, width = self._shape
        return mi.Float(texture.eval(mi.Point3f(cell.z / width, cell.y / height, cell.x / depth), active)[0])


def _texture(values: NDArray[np.float64]) -> mi.Texture3f:
    return mi.Texture3f(mi.TensorXf(values[..., None].astype(np.float32)), wrap_mode=dr.WrapMode.Clamp)


def _speeds(
    dentin: Mesh, modes_mm: Array, points: Array, nearest: Array, distance: Array, face: NDArray[np.int64]
) -> list[Array]:
    """Change of q with each mode's weight, -(gradient of q) . displacement of the closest surface point, (N,) for each
    mode.
    """
    if len(modes_mm) == 0:
        return []
    from trimesh.triangles import points_to_barycentric

    corners = dentin.vertices_mm[dentin.faces[face]]
    weights = points_to_barycentric(corners, nearest)
    # Off the surface the gradient points away from the closest point; on it, along the normal.
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off = np.abs(distance[:, None]) > ON_SURFACE_MM
    gradient = np.where(off, (points - nearest) / np.where(off, distance[:, None], 1), normals)
    return [-np.einsum("ni,nk,nki->n", gradient, weights, mode[dentin.faces[face]]) for mode in modes_mm]
