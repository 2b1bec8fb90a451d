"""Registration of an average crown to the mesh of a tooth: iterative closest points (Besl and McKay 1992) with normals,
from many rotations at once.

Only the crown of the average tooth is registered, so that it does not matter how much root the mesh has. Its size is
free within limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.average_arch import side_of_front
from services.anatomy.templates.crown import ToothSolid, build_tooth
from services.anatomy.templates.dimensions import upper_tooth
from services.core.geometry import Mesh

Array = NDArray[np.float64]

NORMAL_MM = 2.0
"""Distance in mm that a difference of one radian between normals counts as. It prevents matches between opposite walls
of a crown, which are some millimetres apart."""
FARTHEST_MM = 3.0
"""Largest distance that a point counts with, mm. A point farther away is on a part that the other surface lacks."""
SOFT_MM = 1.0
"""Distance at which a point has half its weight in the next step, mm."""
SCALES = (0.8, 1.25)
"""Smallest and largest ratio of a tooth's size to the average's. Real teeth differ by 10 to 20 %, and an upper average
also represents the smaller lower incisors."""
NECK_SHARE = 0.12
"""Fraction of the crown's length above its neck in which the mesh is not compared, because its cervical line, or the
place where it was cut and closed, differs from the average's."""
MESH_POINTS, CROWN_POINTS = 3000, 2500
"""Numbers of points of the mesh and of the average among which closest points are searched; they are 0.3 mm apart."""
REVERSE_STEP = 4
"""Step with which the mesh's points are chosen for the comparison with the average."""
MIN_REVERSE_POINTS = 20
"""Smallest number of the mesh's points above the neck for which a misfit is computed."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a surface with their outward normals, (N, 3) each."""

    points_mm: Array
    normals: Array

    @property
    def features(self) -> Array:
        """Features (N, 6) in mm: positions, and normals scaled by ``NORMAL_MM``."""
        return np.concatenate([self.points_mm, NORMAL_MM * self.normals], axis=1)


@dataclass(frozen=True)
class Placements:
    """G similarity transforms from the average crown to a mesh."""

    axes: Array
    """(G, 3, 3): rows are the canonical axes in world coordinates."""
    centres_mm: Array
    """(G, 3): world position of the middle of the average crown's bounding box."""
    scales: Array
    """(G,): ratio of the mesh's size to that of the average."""
    misfits_mm: Array
    """(G,): mean distance, normals included, of the crown's points from the mesh."""


class CrownMatch:
    """Average crown of a tooth's kind and side, for registration to the tooth's mesh."""

    def __init__(self, fdi: int, outer: Mesh) -> None:
        """Sample both surfaces.

        Args:
            fdi: FDI number of the tooth; a lower tooth is compared with the upper one of its kind.
            outer: closed enamel surface, with or without a part of the root.
        """
        from scipy.spatial import cKDTree

        average = _average_tooth(fdi % 10)
        crown = average.outer.faces[
            average.outer.vertices_mm[average.outer.faces].mean(axis=1)[:, 2] > average.cervix_mm
        ]
        # Mirror the average for the patient's left above and right below, where x is not mesial.
        self._mirror = np.array([-float(side_of_front(fdi)), 1.0, 1.0])
        self._crown = Mesh(average.outer.vertices_mm, crown)
        self._middle = (
            average.outer.vertices_mm[crown].min(axis=(0, 1)) + average.outer.vertices_mm[crown].max(axis=(0, 1))
        ) / 2
        self._mesh, self._average = _sampled(outer, MESH_POINTS), self._crown_points(CROWN_POINTS)
        # Leaves of some thirty points are fastest in six dimensions.
        self._mesh_tree, self._average_tree = (
            cKDTree(surface.features, leafsize=32) for surface in (self._mesh, self._average)
        )

    @property
    def half_size_mm(self) -> Array:
        """Half of the average crown's extent (3,) along its own axes."""
        return np.asarray(np.ptp(self._crown_points(CROWN_POINTS).points_mm, axis=0) / 2)

    def register(self, axes: Array, points: int, rounds: int, top_mm: Array | None = None) -> Placements:
        """Register the crown to the mesh from given axes; at first the crown's top lies at the mesh's top.

        Args:
            axes: (G, 3, 3), initial canonical axes.
            points: number of the crown's points that are compared.
            rounds: number of iterations.
            top_mm: (3,), initial position of the crown's top in place of the mesh's top.
        """
        crown = self._crown_points(points)
        placed = (
            self._initial_placements(axes, crown.points_mm)
            if top_mm is None
            else self._placements_below(axes, crown.points_mm, top_mm)
        )
        for _ in range(rounds):
            placed = self._step(placed, crown)
        _, distance = self._closest(placed, crown)
        return Placements(placed.axes, placed.centres_mm, placed.scales, np.minimum(distance, FARTHEST_MM).mean(axis=1))

    def reverse_misfits_mm(self, placed: Placements) -> Array:
        """Mean distance (G,), normals included, of the mesh's points from the average crown, above its neck."""
        points, normals = self._mesh.points_mm[::REVERSE_STEP], self._mesh.normals[::REVERSE_STEP]
        low, high = self._average.points_mm[:, 2].min(), self._average.points_mm[:, 2].max()
        misfits = np.full(len(placed.axes), FARTHEST_MM)
        for g, (axes, centre, scale) in enumerate(zip(placed.axes, placed.centres_mm, placed.scales, strict=True)):
            features = SurfacePoints((points - centre) @ axes.T / scale, normals @ axes.T).features
            features = features[features[:, 2] > low + NECK_SHARE * (high - low)]
            if len(features) >= MIN_REVERSE_POINTS:
                misfits[g] = np.minimum(self._average_tree.query(features)[0], FARTHEST_MM).mean()
        return misfits

    def _crown_points(self, count: int) -> SurfacePoints:
        found = _sampled(self._crown, count)
        return SurfacePoints((found.points_mm - self._middle) * self._mirror, found.normals * self._mirror)

    def _placements_below(self, axes: Array, crown_mm: Array, top_mm: Array) -> Placements:
        ones = np.ones(len(axes))
        return Placements(axes, top_mm - np.ptp(crown_mm[:, 2]) / 2 * axes[:, 2], ones, ones)

    def _initial_placements(self, axes: Array, crown_mm: Array) -> Placements:
        length, middle = float(np.ptp(crown_mm[:, 2])), np.empty((len(axes), 3))
        for g, own in enumerate(axes):
            along = np.einsum("kj,nj->kn", own, self._mesh.points_mm)
            top = along[2].max()
            within = along[:2, along[2] > top - length]
            middle[g] = [*(within.min(axis=1) + within.max(axis=1)) / 2, top - length / 2]
        ones = np.ones(len(axes))
        return Placements(axes, np.einsum("gkj,gk->gj", axes, middle), ones, ones)

    def _closest(self, placed: Placements, crown: SurfacePoints) -> tuple[Array, Array]:
        # Point of the mesh closest to each point of the crown (G, N, 3), and its distance (G, N).
        points = (
            placed.scales[:, None, None] * np.einsum("gkj,nk->gnj", placed.axes, crown.points_mm)
            + placed.centres_mm[:, None]
        )
        normals = np.einsum("gkj,nk->gnj", placed.axes, crown.normals)
        distance, nearest = self._mesh_tree.query(np.concatenate([points, NORMAL_MM * normals], axis=2).reshape(-1, 6))
        return self._mesh.points_mm[nearest].reshape(points.shape), np.asarray(distance.reshape(points.shape[:2]))

    def _step(self, placed: Placements, crown: SurfacePoints) -> Placements:
        # Find the similarity that brings the crown's points nearest to the mesh's (Umeyama 1991), with less weight for
        # distant points.
        target, distance = self._closest(placed, crown)
        weight = 1 / (1 + (distance / SOFT_MM) ** 2)[..., None]
        total = weight.sum(axis=1)
        from_middle, to_middle = (weight * crown.points_mm).sum(axis=1) / total, (weight * target).sum(axis=1) / total
        offset = crown.points_mm - from_middle[:, None]
        left, size, right = np.linalg.svd(np.einsum("gni,gnj->gij", weight * offset, target - to_middle[:, None]))
        signs = np.ones_like(size)
        signs[:, 2] = np.sign(np.linalg.det(left @ right))
        axes = np.einsum("gik,gk,gkj->gij", left, signs, right)
        scales = np.clip((size * signs).sum(axis=1) / (weight * offset**2).sum(axis=(1, 2)), *SCALES)
        return Placements(
            axes, to_middle - scales[:, None] * np.einsum("gkj,gk->gj", axes, from_middle), scales, placed.misfits_mm
        )


@cache
def _average_tooth(position: int) -> ToothSolid:
    # At most eight teeth, which do not change.
    return build_tooth(upper_tooth(position))


def _sampled(mesh: Mesh, count: int) -> SurfacePoints:
    # Sample points evenly by area; the same mesh always gives the same points.
    random = np.random.default_rng(0)
    corners = mesh.vertices_mm[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled_areas = np.linalg.norm(normals, axis=1)
    cumulative = np.cumsum(doubled_areas)
    chosen = np.searchsorted(cumulative, (np.arange(count) + 0.5) / count * cumulative[-1])
    u, v = random.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (corners[chosen, k] for k in range(3))
    return SurfacePoints(a + u[:, None] * (b - a) + v[:, None] * (c - a), normals[chosen] / doubled_areas[chosen, None])
