"""Which points of a surface a point light reaches, by a shadow map rendered from the light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.anatomy.visibility import visible_surfaces
from services.core.geometry import Camera, Mesh

Image = NDArray[np.float32]
SHADOW_PIXEL_MM = 0.25
"""Pixel size, mm on the surface, of the depth map seen from a light. It is the accuracy of a shadow's edge, a quarter
of the distance that light spreads inside a tooth."""
DEPTH_BIAS_MM = 0.3
"""Smallest distance in mm by which a surface must be nearer to the light to shade a point. A smaller difference may be
the point's own surface, because scans are rough by this much."""
MIN_COSINE = 0.05
"""Smallest cosine between light and normal that is used for a surface's slant, 87 degrees; smaller ones are raised to
it."""


def is_unoccluded(
    points_mm: Image, normal: Image, position_mm: tuple[float, float, float], meshes: Sequence[Mesh]
) -> NDArray[np.bool_]:
    """Whether a point light reaches each point (H, W) past known surfaces, by a shadow map rendered from the light."""
    light_camera = _camera_at(position_mm, meshes)
    nearest = visible_surfaces(light_camera, meshes)
    height, width = points_mm.shape[:2]
    pixels, depth = light_camera.project(points_mm.reshape(-1, 3).astype(np.float64))
    column, row = (np.floor(np.nan_to_num(pixels[:, k], nan=-1.0)).astype(np.int64) for k in range(2))
    inside = (column >= 0) & (row >= 0) & (column < light_camera.size[0]) & (row < light_camera.size[1])
    first = nearest.depth_mm[np.where(inside, row, 0), np.where(inside, column, 0)]
    # Allow for the slant: across one pixel of the map a surface's depth varies by the pixel size times the tangent of
    # the angle of incidence.
    to_light = np.asarray(position_mm) - points_mm
    cosine = np.clip((to_light * normal).sum(axis=-1) / np.linalg.norm(to_light, axis=-1), MIN_COSINE, 1).ravel()
    slant_mm = SHADOW_PIXEL_MM * np.sqrt(1 / cosine**2 - 1)
    blocked = inside & (first < depth - DEPTH_BIAS_MM - slant_mm)
    return np.asarray(~blocked.reshape(height, width))


def _camera_at(position_mm: tuple[float, float, float], meshes: Sequence[Mesh]) -> Camera:
    """Camera at a light's position that frames the meshes with pixels of ``SHADOW_PIXEL_MM`` at their centre."""
    vertices = np.concatenate([mesh.vertices_mm for mesh in meshes])
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    forward = centre - np.asarray(position_mm)
    distance = float(np.linalg.norm(forward))
    forward /= distance
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = distance / SHADOW_PIXEL_MM
    local = (vertices - np.asarray(position_mm)) @ rotation.T
    image = focal * local[:, :2] / local[:, 2:]
    low = np.floor(image.min(axis=0)) - 1
    width, height = (int(extent) for extent in np.ceil(image.max(axis=0)) + 1 - low)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position_mm)
    K = ((focal, 0.0, float(-low[0])), (0.0, focal, float(-low[1])), (0.0, 0.0, 1.0))
    camera_from_world = tuple(tuple(float(value) for value in row) for row in pose)
    return Camera(name="light", size=(width, height), K=K, camera_from_world=camera_from_world)  # type: ignore[arg-type]
