"""Measuring geometries of instruments for shades, placed on a tooth's surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh
from services.transport.rays import RayScene
from services.transport.scene.recipe import View

Floats = NDArray[np.float64]
DISTANCE_MM = 500.0
"""Distance of lights and camera from the spot, mm: far beyond a tooth's size, so that rays are nearly parallel."""
APERTURE_MM = 3.0
"""Diameter of the spot whose mean is measured, mm, as of instruments with a small aperture. The light covers the whole
tooth, so that no light is lost at the aperture's edge."""
PIXELS = 8
"""Pixels across the spot; each is a mean over its area."""
RINGS = 8
"""Number of lights on the ring of 45/0, so that the azimuth averages out."""
SKY = 48
"""Number of lights in place of a uniform sky."""


def _ring() -> Floats:
    angles = 2 * np.pi * (np.arange(RINGS) + 0.5) / RINGS
    return np.asarray(np.stack([np.cos(angles), np.sin(angles), np.ones(RINGS)], axis=1) / np.sqrt(2))


def _sky() -> Floats:
    # Points of a spiral with equal shares of the irradiance: uniform in the square of the sine.
    sine = np.sqrt((np.arange(SKY) + 0.5) / SKY)
    angles = np.pi * (3 - np.sqrt(5)) * np.arange(SKY)
    return np.stack([sine * np.cos(angles), sine * np.sin(angles), np.sqrt(1 - sine**2)], axis=1)


GEOMETRIES: Mapping[str, Floats] = MappingProxyType({"45/0": _ring(), "d/0": _sky()})
"""Name of a geometry, illumination / view from the normal -> directions (N, 3) of lights of equal irradiance, z along
the normal. 45/0 has lights on a ring at 45 degrees, d/0 a uniform sky; the mirror reflection is not seen by either."""


@dataclass(frozen=True)
class Spot:
    """Where on a tooth a shade is measured."""

    point_mm: Floats
    normal: Floats
    """Unit vector (3,) out of the tooth, mean over the aperture."""


@dataclass(frozen=True)
class Placed:
    """An instrument on a tooth: lights of equal irradiance on the spot, and pixels that see it."""

    light_positions_mm: Floats
    light_intensities: Floats
    view: View
    white_radiance: float
    """Radiance of a perfect diffuser at the spot under all lights together."""


def spot_towards(outer: Mesh, viewpoint_mm: Floats) -> Spot:
    """The middle of a tooth as one sees it from a viewpoint: where a ray towards the middle of its box meets it."""
    middle = (outer.vertices_mm.min(axis=0) + outer.vertices_mm.max(axis=0)) / 2
    direction = middle - viewpoint_mm
    direction /= np.linalg.norm(direction)
    hit = RayScene(outer).first_hits(viewpoint_mm[None], direction[None])
    point = np.asarray(hit.points_mm[0])
    corners = outer.vertices_mm[outer.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    within = (np.linalg.norm(corners.mean(axis=1) - point, axis=1) < APERTURE_MM / 2) & (normals @ direction < 0)
    normal = normals[within].sum(axis=0) if within.any() else -direction
    return Spot(point, normal / np.linalg.norm(normal))


def placed(geometry: str, spot: Spot) -> Placed:
    """Lights and camera of a geometry on a spot."""
    axes = _axes(spot.normal)
    directions = GEOMETRIES[geometry]
    cosines = directions[:, 2]
    intensities = 1 / cosines
    positions = spot.point_mm + DISTANCE_MM * directions @ axes
    camera = _camera(spot, axes)
    x, y = np.meshgrid(np.arange(PIXELS), np.arange(PIXELS))
    inside = np.hypot(x + 0.5 - PIXELS / 2, y + 0.5 - PIXELS / 2) <= PIXELS / 2
    pixels = np.stack([x[inside], y[inside]], axis=1).astype(np.int32)
    white = float((intensities * cosines).sum() / (np.pi * DISTANCE_MM**2))
    return Placed(positions, intensities, View(camera, pixels), white)


def _axes(normal: Floats) -> Floats:
    """Rows x, y, z of a frame whose z is the normal."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _camera(spot: Spot, axes: Floats) -> Camera:
    rotation = np.stack([axes[0], -axes[1], -axes[2]])
    position = spot.point_mm + DISTANCE_MM * spot.normal
    pose = np.eye(4)
    pose[:3] = np.column_stack([rotation, -rotation @ position])
    focal = DISTANCE_MM * PIXELS / APERTURE_MM
    rows: Any = tuple(map(tuple, pose.tolist()))
    return Camera(
        name="spot",
        size=(PIXELS, PIXELS),
        K=((focal, 0.0, PIXELS / 2), (0.0, focal, PIXELS / 2), (0.0, 0.0, 1.0)),
        camera_from_world=rows,
    )
