"""The canonical tooth frame: x mesial, y buccal, z occlusal, origin at the tooth's centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

ELONGATED = 1.3
"""Ratio of the two largest principal spreads above which a mesh holds enough root for its long axis to be the tooth's axis."""


@dataclass(frozen=True)
class ToothFrame:
    """Rigid pose of a tooth: ``canonical = rotation @ world + translation_mm``."""

    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    @staticmethod
    def identity() -> ToothFrame:
        """For meshes that are in the canonical frame already."""
        return ToothFrame(np.eye(3), np.zeros(3))

    @property
    def axes(self) -> NDArray[np.float64]:
        """(3, 3): rows are the mesial, buccal and occlusal directions in world coordinates."""
        return self.rotation

    def canonical_from_world(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in the canonical frame."""
        return points_mm @ self.rotation.T + self.translation_mm

    def world_from_canonical(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in world coordinates."""
        return (points_mm - self.translation_mm) @ self.rotation


def estimate_frame(outer: Mesh, viewpoints_mm: NDArray[np.float64]) -> ToothFrame:
    """Canonical frame of a front tooth from its shape and from where it is seen.

    The occlusal axis is the mesh's long axis where there is a root, towards the end with the flatter cross-section (the incisal edge); for a bare crown
    it points from the centre of volume to the centre of the outline, because a front tooth thins towards its edge. Buccal is the direction of the
    cameras across that axis. Mesial is y × z, which for the other half of the jaw is distal; the blend modes do not tell them apart.

    Args:
        viewpoints_mm: camera centres (N, 3).
    """
    corners = outer.vertices_mm[outer.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas, middles = np.linalg.norm(normals, axis=1), corners.mean(axis=1)
    centre = (outer.vertices_mm.min(axis=0) + outer.vertices_mm.max(axis=0)) / 2
    view = (viewpoints_mm - centre).mean(axis=0)
    view /= np.linalg.norm(view)

    centroid = np.average(middles, axis=0, weights=areas)
    spread, principal = np.linalg.eigh(np.cov((middles - centroid).T, aweights=areas))
    if np.sqrt(spread[2] / spread[1]) > ELONGATED:
        axis = principal[:, 2]
        axis = axis if _flatness(middles - centroid, areas, axis) > _flatness(middles - centroid, areas, -axis) else -axis
    else:
        # Divergence theorem for the centre of volume; triangles weighted by their area seen along the view for the centre of the outline.
        volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        solid = np.average(corners.sum(axis=1) / 4, axis=0, weights=volumes)
        outline = np.average(middles, axis=0, weights=np.abs(normals @ view))
        axis = outline - solid
        axis -= (axis @ view) * view
        axis /= np.linalg.norm(axis)
    buccal = view - (view @ axis) * axis
    buccal /= np.linalg.norm(buccal)
    rotation = np.stack([np.cross(buccal, axis), buccal, axis])
    return ToothFrame(rotation, -rotation @ centre)


def _flatness(offsets_mm: NDArray[np.float64], areas: NDArray[np.float64], axis: NDArray[np.float64]) -> float:
    # Ratio of the principal spreads of the cross-section in the last tenth along the axis.
    along = offsets_mm @ axis
    end = along > along.max() - 0.1 * np.ptp(along)
    across = offsets_mm[end] - np.outer(along[end], axis)
    spread = np.linalg.eigvalsh(np.cov(across.T, aweights=areas[end]))
    return float(np.sqrt(spread[2] / max(spread[1], 1e-9)))
