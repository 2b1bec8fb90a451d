"""A matt ball under a dome of lights, and other balls whose shadows on it follow from a formula."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh

BALL_MM = 6.0
"""Radius of the ball that stands for a tooth, about the world's origin; the camera looks along +z."""
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1000.0), (0.0, 0.0, 0.0, 1.0))


def camera(pixel_mm: float) -> Camera:
    """A camera 1 m away that shows all of the ball."""
    size = round(16 / pixel_mm)
    K = ((1000 / pixel_mm, 0.0, size / 2), (0.0, 1000 / pixel_mm, size / 2), (0.0, 0.0, 1.0))
    return Camera(name="front", size=(size, size), K=K, camera_from_world=POSE)


def ball(radius_mm: float, centre_mm: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=5, radius=radius_mm)
    return Mesh(np.asarray(made.vertices) + centre_mm, np.asarray(made.faces, dtype=np.int32))


def lights_mm(count: int) -> NDArray[np.float64]:
    """Positions (count, 3) in mm over the half of the dome on the camera's side."""
    k = np.arange(count) + 0.5
    cosine, turn = 1 - 0.8 * k / count, 2.4 * k
    sine = np.sqrt(1 - cosine**2)
    return np.asarray(1000 * np.stack([sine * np.cos(turn), sine * np.sin(turn), -cosine], axis=1))


def before_ball(light_mm: NDArray[np.float64], away_mm: float) -> tuple[float, float, float]:
    """A point on the line from the light to the part of the ball that faces both camera and light.

    Args:
        away_mm: distance from the ball's surface towards the light.
    """
    towards = light_mm / np.linalg.norm(light_mm)
    middle = towards + np.array([0.0, 0.0, -1.0])
    x, y, z = (BALL_MM * middle / np.linalg.norm(middle) + away_mm * towards).tolist()
    return x, y, z


def behind_ball(
    points_mm: NDArray[np.floating],
    light_mm: NDArray[np.float64],
    centre_mm: tuple[float, float, float],
    radius_mm: float,
) -> NDArray[np.bool_]:
    """Whether the line segment from each point (..., 3) to the light (3,) passes through a ball."""
    way = light_mm - points_mm
    along = np.clip(((centre_mm - points_mm) * way).sum(-1) / (way * way).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(points_mm + along[..., None] * way - centre_mm, axis=-1) < radius_mm)


def albedo(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Albedo of the ball. It varies, so that a dark pixel in one image alone does not show a shadow."""
    return np.nan_to_num(0.3 + 0.2 * np.sin(points_mm[..., 0]) * np.cos(points_mm[..., 1]))
