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
"""Ratio of length to largest diameter above which a mesh holds a whole root. The ratio is 2.4 to 3.4 with a whole root,
and 1.4 to 1.8 with a stub of 4 mm."""
END = 0.1
"""Fraction of the length that counts as an end."""


@dataclass(frozen=True)
class ToothFrame:
    """Rigid pose of a tooth: ``canonical = rotation @ world + translation_mm``, with shapes (3, 3) and (3,)."""

    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    @staticmethod
    def identity() -> ToothFrame:
        """Frame of meshes that are in the canonical frame already."""
        return ToothFrame(np.eye(3), np.zeros(3))

    @staticmethod
    def centred(axes: NDArray[np.float64], mesh: Mesh) -> ToothFrame:
        """Frame with the given axes (3, 3) as rows and its origin at the middle of the mesh's bounding box."""
        return ToothFrame(axes, -axes @ (mesh.vertices_mm.min(axis=0) + mesh.vertices_mm.max(axis=0)) / 2)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Matrix (3, 3) whose rows are the mesial, buccal and occlusal directions in world coordinates."""
        return self.rotation

    def canonical_from_world(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points (N, 3) in mm from world coordinates to the canonical frame."""
        return points_mm @ self.rotation.T + self.translation_mm

    def world_from_canonical(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points (N, 3) in mm from the canonical frame to world coordinates."""
        return (points_mm - self.translation_mm) @ self.rotation


def estimate_frame(outer: Mesh, viewpoints_mm: NDArray[np.float64]) -> ToothFrame:
    """Estimate the canonical frame of an incisor, canine or premolar of unknown FDI number from its shape and views.

    With a root, the occlusal axis is the mesh's long axis. It points away from the end to which a whole root tapers, or
    away from the blunter end, where a root is cut short. For a bare crown it points from the centre of volume to that
    of the outline, because a front tooth thins towards its edge. Molars are not recognised by this;
    ``jaw_frames`` finds the frames of all teeth by their numbers. Buccal is the direction of the cameras across that
    axis. Mesial is y × z, which is distal in the other half of the jaw; the blend modes treat both alike.

    Args:
        outer: enamel surface.
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
        # Compute the centre of volume by the divergence theorem, and the centre of the outline by weighting triangles
        # with their area projected along the view.
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
        return bool(high < -low)  # the centre of the surface lies in the crown's half
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
