"""Rigid pose of the scan in the rig, and the result of one step of its estimation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RigidPose:
    """A rigid transform from the scan to the rig: ``rig = rotation @ scan + translation_mm``."""

    rotation: Floats
    """Rotation matrix (3, 3)."""
    translation_mm: Floats
    """Translation (3,)."""

    @property
    def matrix(self) -> Floats:
        """The transform rig_from_scan (4, 4)."""
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = self.rotation, self.translation_mm
        return found

    def apply(self, points_mm: Floats) -> Floats:
        """Return points (N, 3) of the scan in the rig's frame."""
        return points_mm @ self.rotation.T + self.translation_mm

    def moved(self, twist: Floats, centre_mm: Floats) -> RigidPose:
        """Return this pose after a rotation by ``twist[:3]`` (rotation vector, rad) about a point of the rig (3,) and a
        translation by ``twist[3:]`` (mm).
        """
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_rotvec(twist[:3]).as_matrix()
        return RigidPose(rotation @ self.rotation, rotation @ (self.translation_mm - centre_mm) + centre_mm + twist[3:])

    def twist_to(self, other: RigidPose, centre_mm: Floats) -> Floats:
        """Return the twist (6,) about a point of the rig (3,) that transforms this pose to another."""
        from scipy.spatial.transform import Rotation

        rotation = other.rotation @ self.rotation.T
        shift = other.translation_mm - centre_mm - rotation @ (self.translation_mm - centre_mm)
        return np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), shift])


@dataclass(frozen=True)
class PoseStep:
    """Result of one step of the registration."""

    name: Literal["landmarks", "outlines"]
    pose: RigidPose
    covariance: Floats
    """Covariance (6, 6) of the twist about the teeth's centre in the rig: rad, then mm."""
    residual_px: Mapping[str, float]
    """Median distance between predicted and observed positions, by camera."""
    residual_mm: float
    """The same distance at the teeth, over all cameras."""
    points: int
    """Number of points that were used."""
    left_out: tuple[str, ...] = ()
    """Descriptions of the points that were left out."""


def pixel_derivatives(camera: Camera, points_mm: Floats, centre_mm: Floats) -> Floats:
    """Return the derivatives (N, 2, 6) of the pixels of points (N, 3) in the rig with respect to a twist about a centre
    (3,).
    """
    pose, K = np.asarray(camera.camera_from_world), np.asarray(camera.K)
    local = points_mm @ pose[:3, :3].T + pose[:3, 3]
    flat = local @ K.T
    depth = flat[:, 2:3]
    # d(u / w) = (du - (u / w) dw) / w; the rows of K R are the derivatives of u, v, w with respect to the point.
    rows = K @ pose[:3, :3]
    by_point = (rows[None, :2] - (flat[:, :2] / depth)[..., None] * rows[None, 2:3]) / depth[..., None]
    offset = points_mm - centre_mm
    # A small rotation w moves a point by w x offset.
    turned = np.zeros((len(points_mm), 3, 3))
    turned[:, 0, 1], turned[:, 0, 2] = offset[:, 2], -offset[:, 1]
    turned[:, 1, 0], turned[:, 1, 2] = -offset[:, 2], offset[:, 0]
    turned[:, 2, 0], turned[:, 2, 1] = offset[:, 1], -offset[:, 0]
    return np.concatenate([by_point @ turned, by_point], axis=2)


def millimetres_a_pixel(camera: Camera, points_mm: Floats) -> Floats:
    """Return the size (N,) in mm of a pixel at points (N, 3) of the rig."""
    return np.asarray(camera.project(points_mm)[1] / camera.K[0][0])
