"""Rotation vectors and their derivatives, for many points at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SERIES_BELOW_RAD = 1e-4
"""Angle below which series replace the closed forms: these lose digits to cancellation there, and the series are exact
to 1e-16."""


def cross_matrix(vectors: Floats) -> Floats:
    """Return the skew-symmetric matrices (..., 3, 3) whose product with y is the cross product v × y, for vectors v
    (..., 3).
    """
    x, y, z = np.moveaxis(np.asarray(vectors, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def rotation_matrix(rotation_vector: Floats) -> Floats:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians, by Rodrigues' formula."""
    vector = np.asarray(rotation_vector, dtype=np.float64)
    cross, (sine, versine, _) = cross_matrix(vector), _coefficients(vector)
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def left_jacobian(rotation_vector: Floats) -> Floats:
    """Return the left Jacobians J (..., 3, 3) of rotation vectors w (..., 3) in radians: exp(w + dw) = exp(J dw) exp(w)
    to first order (Barfoot, State Estimation for Robotics, eq. 7.77).
    """
    vector = np.asarray(rotation_vector, dtype=np.float64)
    cross, (_, versine, cubic) = cross_matrix(vector), _coefficients(vector)
    return np.eye(3) + versine * cross + cubic * (cross @ cross)


def rotation_vector(matrix: Floats) -> Floats:
    """Return the rotation vector (3,) in radians, at most π long, of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrix).as_rotvec(), dtype=np.float64)


def pose_matrix(pose: Floats) -> Floats:
    """Return the rigid transforms (..., 4, 4) of poses (..., 6): a rotation vector in rad and a translation in mm."""
    pose = np.asarray(pose, dtype=np.float64)
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation_matrix(pose[..., :3]), pose[..., 3:], 1
    return matrix


def pose_vector(matrix: Floats) -> Floats:
    """Return the pose (6,) of a rigid transform (4, 4)."""
    return np.concatenate([rotation_vector(matrix[:3, :3]), matrix[:3, 3]])


def inverse_pose(pose: Floats) -> Floats:
    """Return the pose (6,) of the inverse transform of a pose (6,)."""
    return np.concatenate([-pose[:3], -rotation_matrix(pose[:3]).T @ pose[3:]])


def _coefficients(vector: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sin a ÷ a, (1 − cos a) ÷ a² and (a − sin a) ÷ a³ of the vectors' lengths a, each (..., 1, 1), by series
    or closed forms.
    """
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    square, small = angle**2, angle < SERIES_BELOW_RAD
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    versine = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    cubic = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    return sine, versine, cubic
