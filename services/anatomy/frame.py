"""The canonical tooth frame: x mesial, y buccal, z occlusal, origin at the tooth's centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

ELONGATED = 1.3
"""Ratio of the two largest principal spreads above which a mesh holds enough root for its long axis to be the tooth's
axis."""
WHOLE_ROOT = 2.1
"""Length over largest diameter above which a mesh holds a whole root: 2.4 to 3.4 with one, 1.4 to 1.8 with a stub of 4
mm."""
END = 0.1
"""Share of the length that counts as an end."""


@dataclass(frozen=True)
class ToothFrame:
    """Rigid pose of a tooth: ``canonical = rotation @ world + translation_mm``."""

    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    @staticmethod
    def identity() -> ToothFrame:
        """For meshes that are in the canonical frame already."""
        return ToothFrame(np.eye(3), np.zeros(3))

    @staticmethod
    def centred(axes: NDArray[np.float64], mesh: Mesh) -> ToothFrame:
        """Of axes (3, 3) as rows, with the origin at the middle of the mesh's box."""
        return ToothFrame(axes, -axes @ (mesh.vertices_mm.min(axis=0) + mesh.vertices_mm.max(axis=0)) / 2)

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
    """Canonical frame of an incisor, canine or premolar whose FDI number is not known, from its shape and from where it
    is seen.

    The occlusal axis is the mesh's long axis where there is a root: away from the end to which a whole root tapers, or
    from the blunter end, which is that of a root cut short. For a bare crown it points from the centre of volume to
    that of the outline, because a front tooth thins towards its edge. Molars are not known by it; ``jaw_frames`` knows
    all by their numbers. Buccal is the direction of the cameras across that axis. Mesial is y × z, which for the other
    half of the jaw is distal; the blend modes do not tell them apart.

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
        axis = axis if _leads_to_the_crown(middles - centroid, areas, axis) else -axis
    else:
        # Divergence theorem for the centre of volume; triangles weighted by their area seen along the view for the
        # centre of the outline.
        volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        solid = np.average(corners.sum(axis=1) / 4, axis=0, weights=volumes)
        outline = np.average(middles, axis=0, weights=np.abs(normals @ view))
        axis = outline - solid
        axis -= (axis @ view) * view
        axis /= np.linalg.norm(axis)
    buccal = view - (view @ axis) * axis
    buccal /= np.linalg.norm(buccal)
    return ToothFrame.centred(np.stack([np.cross(buccal, axis), buccal, axis]), outer)


def _leads_to_the_crown(offsets_mm: NDArray[np.float64], areas: NDArray[np.float64], axis: NDArray[np.float64]) -> bool:
    along = offsets_mm @ axis
    across = offsets_mm - np.outer(along, axis)
    low, high, length = along.min(), along.max(), np.ptp(along)
    if length > WHOLE_ROOT * 2 * np.linalg.norm(across, axis=1).max():
        return bool(high < -low)  # from the centre of the surface, which lies in the crown's half
    spreads = [
        np.sqrt(np.linalg.det(_plane_covariance(across[end], areas[end], axis)))
        for end in (along < low + END * length, along > high - END * length)
    ]
    return bool(spreads[1] < spreads[0])


def _plane_covariance(
    across_mm: NDArray[np.float64], areas: NDArray[np.float64], axis: NDArray[np.float64]
) -> NDArray[np.float64]:
    plane = np.linalg.svd(axis[None])[2][1:]
    return np.asarray(np.cov((across_mm @ plane.T).T, aweights=areas))
