"""A grid of lower bounds of the distance to the nearest surface, so that short free flights need no ray tracing.

The distance to a surface changes by at most the distance moved, so ``d(cell centre) - |x - centre|`` is a lower bound
everywhere in the cell: a flight shorter than that meets nothing, exactly and not approximately.

A process builds several scenes of the same teeth: a channel's, the one with held-out lights, those in which the
instrument moves. They share the distances to equal surfaces, which are most of the time of building a scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from services.core.geometry import Mesh

CELL_MM = 0.1
"""Smallest size of a grid cell, mm."""
MAX_CELLS = 6_000_000
"""Largest number of grid cells; larger scenes have larger cells."""
SPACING_PER_CELL = 0.3
"""Largest distance from any surface point to the nearest sample of its surface, over the size of a cell."""
SAMPLES_AT_A_TIME = 1 << 15
"""Number of samples of surfaces made at a time, so that they stay in the processor's cache."""
REBUILD_MM = 0.1
"""Largest motion of a border in mm that only lowers the bound; after a larger one the distance is measured again."""
MARGIN_MM = 1.5
"""Margin in mm around an inner surface's box within which its distance is measured, where there are several such
surfaces; all other places are taken to be just as far away."""
_distances: WeakValueDictionary[bytes, NDArray[np.float64]] = WeakValueDictionary()
"""Distances to surfaces of the scenes that this process holds, by content of the surface and its grid."""


def surface_samples(
    vertices_mm: NDArray[np.float64], faces: NDArray[np.int32], spacing_mm: float
) -> Iterator[NDArray[np.float64]]:
    """Sample points (S, 3) on every triangle, some triangles at a time, such that no surface point is farther than the
    spacing from the nearest sample.
    """
    corners = vertices_mm[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # A sub-triangle of edge e has no point farther than e / sqrt(3) from its nearest corner.
    parts = np.maximum(1, np.ceil(longest / (np.sqrt(3) * spacing_mm)).astype(int))
    yield vertices_mm
    for count in np.unique(parts[parts > 1]):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        weights = np.stack([i, j, count - i - j], axis=-1)[i + j <= count] / count
        chosen = corners[parts == count]
        step = max(1, SAMPLES_AT_A_TIME // len(weights))
        for first in range(0, len(chosen), step):
            yield np.einsum("wk,tkd->twd", weights, chosen[first : first + step]).reshape(-1, 3)


@dataclass(frozen=True)
class _Measured:
    """The distance to one inner surface, and the vertices with which it was measured."""

    vertices_mm: NDArray[np.float64]
    window: tuple[slice, ...]
    bound: NDArray[np.float64]


class Clearance:
    """Lower bound of the distance to any surface, inside solids."""

    def __init__(
        self,
        outer_vertices_mm: NDArray[np.float64],
        outer_faces: NDArray[np.int32],
        solids_mm: NDArray[np.float64] | None = None,
    ) -> None:
        """Take the surfaces that never move, and the vertices (V, 3) of those that bound a solid, where not all of them
        do.
        """
        solids_mm = outer_vertices_mm if solids_mm is None else solids_mm
        low, extent = solids_mm.min(axis=0), np.ptp(solids_mm, axis=0)
        self._cell_mm = max(CELL_MM, float(np.cbrt(extent.prod() / MAX_CELLS)))
        self._shape = np.ceil(extent / self._cell_mm).astype(int) + 1
        self._corner = low
        self._outer = self._distance(outer_vertices_mm, outer_faces, self._window(None))
        self._inner: dict[int, _Measured] = {}
        self._low = dr.opaque(mi.Point3f, low.tolist())
        self._upload(self._outer)

    def move_inner(self, surfaces: Sequence[Mesh]) -> None:
        """Update the bound for the inner surfaces at their present places."""
        bound = self._outer.copy() if len(surfaces) == 1 else np.minimum(self._outer, MARGIN_MM - REBUILD_MM)
        for k, surface in enumerate(surfaces):
            known = self._inner.get(k)
            moved = (
                np.inf
                if known is None
                else float(np.linalg.norm(surface.vertices_mm - known.vertices_mm, axis=1).max())
            )
            if known is None or moved > REBUILD_MM:
                window = self._window(surface.vertices_mm if len(surfaces) > 1 else None)
                known, moved = (
                    _Measured(surface.vertices_mm, window, self._distance(surface.vertices_mm, surface.faces, window)),
                    0.0,
                )
                self._inner[k] = known
            bound[known.window] = np.minimum(bound[known.window], known.bound - moved)
        self._upload(bound)

    def _window(self, vertices_mm: NDArray[np.float64] | None) -> tuple[slice, ...]:
        # Cells within the margin of a surface's box; all cells for None.
        if vertices_mm is None:
            return tuple(slice(0, int(count)) for count in self._shape)
        low = np.floor((vertices_mm.min(axis=0) - MARGIN_MM - self._corner) / self._cell_mm).astype(int)
        high = np.ceil((vertices_mm.max(axis=0) + MARGIN_MM - self._corner) / self._cell_mm).astype(int) + 1
        return tuple(
            slice(max(int(a), 0), max(int(b), 0)) for a, b in zip(low, np.minimum(high, self._shape), strict=True)
        )

    def _distance(
        self, vertices_mm: NDArray[np.float64], faces: NDArray[np.int32], window: tuple[slice, ...]
    ) -> NDArray[np.float64]:
        # Distance to one surface within a window, measured unless another scene holds it.
        content = blake2b(repr((window, self._cell_mm, self._corner.tolist(), vertices_mm.dtype, faces.dtype)).encode())
        for array in (vertices_mm, faces):
            content.update(array.tobytes())
        found = _distances.get(content.digest())
        if found is None:
            found = self._measure(vertices_mm, faces, window)
            found.setflags(write=False)
            _distances[content.digest()] = found
        return found

    def _measure(
        self, vertices_mm: NDArray[np.float64], faces: NDArray[np.int32], window: tuple[slice, ...]
    ) -> NDArray[np.float64]:
        first = np.array([one.start for one in window])
        empty = np.ones([max(one.stop - one.start, 0) for one in window], dtype=bool)
        spacing = SPACING_PER_CELL * self._cell_mm
        for samples in surface_samples(vertices_mm, faces, spacing):
            cells = np.floor((samples - self._corner) / self._cell_mm).astype(int) - first
            kept = ((cells >= 0) & (cells < empty.shape)).all(axis=1)
            empty[tuple(cells[kept].T)] = False
        if empty.all():
            return np.zeros(empty.shape)
        # The transform measures from cell centre to cell centre; a sample may sit in its cell's corner.
        nearest = ndimage.distance_transform_edt(
            empty, sampling=self._cell_mm, return_distances=False, return_indices=True
        )
        bound = np.empty(empty.shape)
        _, y, z = np.ogrid[tuple(slice(count) for count in empty.shape)]
        for x, (layer, there) in enumerate(zip(bound, np.moveaxis(nearest, 1, 0), strict=True)):
            steps_mm = [self._cell_mm * (to - here) for to, here in zip(there, (x, y[0], z[0]), strict=True)]
            between_centres = np.sqrt(steps_mm[0] ** 2 + steps_mm[1] ** 2 + steps_mm[2] ** 2)
            layer[:] = between_centres - np.sqrt(3) / 2 * self._cell_mm - spacing
        return bound

    def _upload(self, bound: NDArray[np.float64]) -> None:
        self._table = mi.Float(bound.reshape(-1).astype(np.float32))
        dr.eval(self._table)

    def __call__(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Lower bound in mm at ``point``; not positive where the distance is not known."""
        cell = mi.Point3f(point - self._low) * (1 / self._cell_mm)
        index = dr.floor(cell)
        inside = mi.Bool(active)  # a copy: &= changes an array in its place
        for k in range(3):
            inside &= (index[k] >= 0) & (index[k] < int(self._shape[k]))
        x, y, z = (mi.UInt32(dr.maximum(index[k], 0)) for k in range(3))
        flat = (x * int(self._shape[1]) + y) * int(self._shape[2]) + z
        offset = dr.norm(cell - index - 0.5) * self._cell_mm
        return dr.select(inside, dr.gather(mi.Float, self._table, flat, inside) - offset, 0)
