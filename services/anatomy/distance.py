"""Distance from points to a closed triangle mesh: unsigned by closest points, and signed on a grid."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

CANDIDATES = 6
"""Number of nearest surface samples whose triangles are tested for the closest point."""
BLOCK = 8192
"""Number of points measured at a time, so that intermediate values stay in the processor's cache."""


class SurfaceDistance:
    """Closest points on a mesh.

    A KD-tree over surface samples proposes triangles, and the closest point on each of them is exact. The proposal can
    miss the best triangle by a distance error of at most ``spacing_mm``² / (2 distance), which vanishes against the
    enamel's 0.1 to 1.5 mm.
    """

    def __init__(self, mesh: Mesh, spacing_mm: float = 0.1) -> None:
        from scipy.spatial import cKDTree

        self.mesh, self._spacing_mm = mesh, spacing_mm
        self._corners = mesh.vertices_mm[mesh.faces]
        samples, self._owner = sample_triangles(self._corners, spacing_mm)
        self._tree = cKDTree(samples)

    def closest(
        self, points_mm: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Closest surface points (N, 3), unsigned distances (N,) in mm and their faces (N,)."""
        parts = [self._closest(points_mm[start : start + BLOCK]) for start in range(0, max(len(points_mm), 1), BLOCK)]
        nearest, distance, faces = (np.concatenate(values) for values in zip(*parts, strict=True))
        return nearest, distance, faces

    def _closest(
        self, points_mm: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        from trimesh.triangles import closest_point

        _, neighbour = self._tree.query(points_mm, k=CANDIDATES)
        faces = self._owner[neighbour]
        # Near samples often lie in one triangle, which is tested once.
        first = np.ones(faces.shape, dtype=bool)
        for k in range(1, CANDIDATES):
            first[:, k] = (faces[:, :k] != faces[:, k, None]).all(axis=1)
        tested = points_mm[np.nonzero(first)[0]]
        on_surface = closest_point(self._corners[faces[first]], tested)
        squared = np.full(faces.shape, np.inf)
        squared[first] = ((on_surface - tested) ** 2).sum(axis=-1)
        row, best = np.arange(len(points_mm)), squared.argmin(axis=1)
        place = np.cumsum(first).reshape(first.shape) - 1
        return on_surface[place[row, best]], np.sqrt(squared[row, best]), faces[row, best]

    def smallest_mm(self, points_mm: NDArray[np.float64]) -> float:
        """Smallest of the distances of points (N, 3), in mm."""
        # A sample lies within the spacing of each surface point, so that only points whose sample is at most that much
        # farther than the nearest one can be nearest to the surface.
        among_few = self._tree.query(points_mm[::16])[0].min()
        distance = self._tree.query(points_mm, distance_upper_bound=among_few + self._spacing_mm)[0]
        return float(self.closest(points_mm[distance <= distance.min() + self._spacing_mm])[1].min())


class SignedDistanceGrid:
    """Depth below a closed surface in mm, positive inside, trilinear between grid points ``pitch_mm`` apart."""

    def __init__(self, mesh: Mesh, pitch_mm: float = 0.15, margin_mm: float = 0.6) -> None:
        low = mesh.vertices_mm.min(axis=0) - margin_mm
        shape = np.ceil((mesh.vertices_mm.max(axis=0) + margin_mm - low) / pitch_mm).astype(int) + 1
        self._low, self._pitch = low, pitch_mm
        axes = [low[k] + pitch_mm * np.arange(shape[k]) for k in range(3)]
        inside = _inside_columns(mesh, axes)
        # Find exact closest points in a shell around the surface; points farther away inherit the closest point of the
        # nearest shell point (about pitch² / depth too far).
        from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

        shell = binary_dilation(inside, iterations=2) & ~binary_erosion(inside, iterations=2)
        place = np.nonzero(shell)
        self.surface = SurfaceDistance(mesh)
        """Exact distances from the same surface."""
        nearest = self.surface.closest(np.stack([axes[k][place[k]] for k in range(3)], axis=-1))[0]
        number = np.zeros(shell.shape, dtype=np.int32)
        number[place] = np.arange(len(nearest))
        source = distance_transform_edt(~shell, return_distances=False, return_indices=True)
        self.depth = np.empty(shell.shape)
        for i, x in enumerate(axes[0]):
            point = nearest[number[tuple(source[:, i])]]
            squared = (
                (x - point[..., 0]) ** 2 + (axes[1][:, None] - point[..., 1]) ** 2 + (axes[2] - point[..., 2]) ** 2
            )
            self.depth[i] = np.where(inside[i], 1.0, -1.0) * np.sqrt(squared)

    @property
    def bounds_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest and largest coordinates of the grid."""
        return self._low, self._low + self._pitch * (np.asarray(self.depth.shape) - 1)

    @cached_property
    def _slopes(self) -> list[NDArray[np.float64]]:
        return list(np.gradient(self.depth, self._pitch))

    def _interpolate(self, volume: NDArray[np.float64], points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.ndimage import map_coordinates

        return np.asarray(map_coordinates(volume, ((points_mm - self._low) / self._pitch).T, order=1, mode="nearest"))

    def depth_mm(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (N,) below the surface, negative outside."""
        return self._interpolate(self.depth, points_mm)

    def inward(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (N, 3) of the depth; its length is 1 off the medial axis and less on it."""
        return np.stack([self._interpolate(slope, points_mm) for slope in self._slopes], axis=-1)


def sample_triangles(corners: NDArray[np.float64], spacing_mm: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (S, 3) of a regular lattice in each triangle, fine enough for its longest edge, and their triangles (S,).

    Args:
        corners: (F, 3, 3).
        spacing_mm: largest distance between neighbouring points.
    """
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    order = np.maximum(1, np.ceil(longest / spacing_mm)).astype(int)
    points, owners = [], []
    for n in np.unique(order):
        chosen = np.flatnonzero(order == n)
        i, j = (index.reshape(-1) for index in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        keep = i + j < n
        u, v = (i[keep] + 1 / 3) / n, (j[keep] + 1 / 3) / n
        weights = np.stack([1 - u - v, u, v], axis=-1)
        points.append(np.einsum("sk,fkx->fsx", weights, corners[chosen]).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(u)))
    return np.concatenate(points), np.concatenate(owners)


def _inside_columns(mesh: Mesh, axes: list[NDArray[np.float64]]) -> NDArray[np.bool_]:
    # Grid points inside the mesh, by the parity of surface crossings below each along z. Columns are shifted by an
    # irrational fraction of a cell, so that none hits an edge or a vertex.
    xs, ys, zs = axes
    pitch = xs[1] - xs[0]
    xs, ys = xs + pitch * 1e-4 * np.sqrt(2), ys + pitch * 1e-4 * np.sqrt(3)
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first = np.stack([np.searchsorted(xs, low[:, 0]), np.searchsorted(ys, low[:, 1])], axis=-1)
    last = np.stack([np.searchsorted(xs, high[:, 0]), np.searchsorted(ys, high[:, 1])], axis=-1)
    span = last - first
    count = span.prod(axis=1)
    face = np.repeat(np.arange(len(count)), count)
    local = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    i, j = first[face, 0] + local // np.maximum(span[face, 1], 1), first[face, 1] + local % np.maximum(span[face, 1], 1)

    # Compute barycentric coordinates in the xy plane; vertical triangles have no area there and are never crossed.
    ab, ac, ap = (b - a)[face, :2], (c - a)[face, :2], np.stack([xs[i], ys[j]], axis=-1) - a[face, :2]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
        v = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
        hit = (area != 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
    height = a[face, 2] + u * (b - a)[face, 2] + v * (c - a)[face, 2]
    odd = np.zeros((len(xs), len(ys), len(zs) + 1), dtype=bool)
    np.logical_xor.at(odd, (i[hit], j[hit], np.searchsorted(zs, height[hit])), True)
    return np.asarray(np.logical_xor.accumulate(odd, axis=2)[..., :-1])
