"""A small tooth that renders in milliseconds: an ellipsoid of enamel around dentin with two shape modes, five lights,
one camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Camera, Mesh
from services.core.records import Boundary
from services.transport.scene.recipe import SceneRecipe, View, single_tooth

SEMI_AXES_MM = np.array([3.0, 2.0, 4.0])
LIGHTS_MM = np.array([[100, 600, 50], [500, 300, 100], [-500, 200, -200], [0, -600, 100], [50, 100, 600.0]])
INTENSITY = 1e5
CAMERA_DISTANCE_MM = 600.0


def sphere(radius_mm: float = 1.0, subdivisions: int = 3) -> Mesh:
    """A ball about the origin."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_mm)
    return Mesh(np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int32))


def ellipsoid(semi_axes_mm: NDArray[np.float64]) -> Mesh:
    """An ellipsoid about the origin."""
    ball = sphere()
    return Mesh(ball.vertices_mm * semi_axes_mm, ball.faces)


def dentin_shape() -> DentinShape:
    """Dentin 0.3 mm below the surface; the first mode shrinks all of it, the second its buccal half (+y)."""
    base, towards = ellipsoid(SEMI_AXES_MM - 0.3), sphere().vertices_mm
    buccal = np.stack([0 * towards[:, 0], -0.8 * np.maximum(towards[:, 1], 0), 0 * towards[:, 2]], axis=1)
    return DentinShape(base, np.stack([-0.9 * towards, buccal]))


def camera_at(
    direction: tuple[float, float, float], size: int = 8, span_mm: float = 9.0, distance_mm: float = CAMERA_DISTANCE_MM
) -> Camera:
    """A camera that looks at the origin from a direction, with a field of view of ``span_mm`` there and z upwards."""
    backward = np.asarray(direction) / np.linalg.norm(direction)
    x = np.cross(-backward, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(-backward, x), -backward])
    pose = np.eye(4)
    pose[:3] = np.column_stack([rotation, -rotation @ backward * distance_mm])
    focal = distance_mm * size / span_mm
    matrix = ((focal, 0.0, size / 2), (0.0, focal, size / 2), (0.0, 0.0, 1.0))
    rows: Any = tuple(map(tuple, pose.tolist()))
    return Camera(name="c0", size=(size, size), K=matrix, camera_from_world=rows)


def whole_view(camera: Camera, margin: int = 0) -> View:
    """All pixels of a camera except a margin, row by row."""
    width, height = camera.size
    x, y = np.meshgrid(np.arange(margin, width - margin), np.arange(margin, height - margin))
    return View(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))


def recipe(boundary: Boundary = "matched") -> SceneRecipe:
    """The tooth's scene."""
    return single_tooth(
        ellipsoid(SEMI_AXES_MM), dentin_shape(), LIGHTS_MM, np.full(len(LIGHTS_MM), INTENSITY), boundary
    )
