"""A grid that tells how far the nearest surface is at least, so that short free flights need no ray tracing.

The distance to a surface changes by at most the distance moved, so ``d(cell centre) - |x - centre|`` is a lower bound
everywhere in the cell: a flight shorter than that meets nothing, exactly and not approximately.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

CELL_MM = 0.1
MOST_CELLS = 6_000_000
"""Larger scenes have larger cells."""
SPACING_PER_CELL = 0.3
"""Surfaces are sampled so densely that no surface point is farther than this from a sample, over the size of a cell."""
REBUILD_MM = 0.1
"""A border that moved less than this only lowers the bound; one that moved more is measured again."""


def surface_samples(vertices_mm: NDArray[np.float64], faces: NDArray[np.int32], spacing_mm: float) -> NDArray[np.float64]:
    """Points on every triangle, none of whose points is farther than the spacing from one of them."""
    corners = vertices_mm[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # A sub-triangle of edge e has no point farther than e / sqrt(3) from its nearest corner.
    parts = np.maximum(1, np.ceil(longest / (np.sqrt(3) * spacing_mm)).astype(int))
    points = [vertices_mm]
    for count in np.unique(parts[parts > 1]):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        weights = np.stack([i, j, count - i - j], axis=-1)[i + j <= count] / count
        points.append(np.einsum("wk,tkd->twd", weights, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(points)


class Clearance:
    """Lower bound of the distance to any surface, inside solids."""

    def __init__(self, outer_vertices_mm: NDArray[np.float64], outer_faces: NDArray[np.int32], solids_mm: NDArray[np.float64] | None = None) -> None:
        """Take the surfaces that never move, and the solids' vertices (V, 3) where not all of those bound one."""
        solids_mm = outer_vertices_mm if solids_mm is None else solids_mm
        low, extent = solids_mm.min(axis=0), np.ptp(solids_mm, axis=0)
        self._cell_mm = max(CELL_MM, float(np.cbrt(extent.prod() / MOST_CELLS)))
        self._shape = np.ceil(extent / self._cell_mm).astype(int) + 1
        self._corner = low
        self._outer = self._distance(outer_vertices_mm, outer_faces)
        self._inner: NDArray[np.float64] | None = None
        self._measured_mm: NDArray[np.float64] | None = None
        self._low = dr.opaque(mi.Point3f, low.tolist())
        self._upload(self._outer)

    def move_inner(self, vertices_mm: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
        """Account for the inner surface at its present place."""
        moved = np.inf if self._measured_mm is None else float(np.linalg.norm(vertices_mm - self._measured_mm, axis=1).max())
        if moved > REBUILD_MM:
            self._inner, self._measured_mm, moved = self._distance(vertices_mm, faces), vertices_mm, 0.0
        assert self._inner is not None
        self._upload(np.minimum(self._outer, self._inner - moved))

    def _distance(self, vertices_mm: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
        empty = np.ones(self._shape, dtype=bool)
        spacing = SPACING_PER_CELL * self._cell_mm
        cells = np.floor((surface_samples(vertices_mm, faces, spacing) - self._corner) / self._cell_mm).astype(int)
        kept = ((cells >= 0) & (cells < self._shape)).all(axis=1)
        empty[tuple(cells[kept].T)] = False
        # From cell centre to cell centre; a sample may sit in its cell's corner.
        between_centres = ndimage.distance_transform_edt(empty, sampling=self._cell_mm)
        return np.asarray(between_centres - np.sqrt(3) / 2 * self._cell_mm - spacing).reshape(-1)

    def _upload(self, bound: NDArray[np.float64]) -> None:
        self._table = mi.Float(bound.astype(np.float32))
        dr.eval(self._table)

    def __call__(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Bound at ``point``, mm; not positive where nothing is known."""
        cell = mi.Point3f(point - self._low) * (1 / self._cell_mm)
        index = dr.floor(cell)
        inside = active
        for k in range(3):
            inside &= (index[k] >= 0) & (index[k] < int(self._shape[k]))
        x, y, z = (mi.UInt32(dr.maximum(index[k], 0)) for k in range(3))
        flat = (x * int(self._shape[1]) + y) * int(self._shape[2]) + z
        offset = dr.norm(cell - index - 0.5) * self._cell_mm
        return dr.select(inside, dr.gather(mi.Float, self._table, flat, inside) - offset, 0)
