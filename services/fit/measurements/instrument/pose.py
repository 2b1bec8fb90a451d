"""The pose of the scan as six unknowns of a fit that all photographs share: a rotation vector, rad, and a shift in mm.

A scan that moves by T under fixed cameras gives the same images as a fixed scan under cameras whose camera_from_world
is multiplied by T from the right. So renders follow the pose exactly and no surface is built again. What lights change
on a scan that turns under them follows from their formula.

The derivative of a photograph by the pose costs no path. A surface point of the scan moves over the image by a
displacement d per unit of the pose, which geometry gives exactly, and carries its radiance along, so a pixel changes by
-d times the slope of the image. The slopes are those of the photograph itself: at the solution they are the render's,
and renders have many times the photographs' noise. Each slope leaves out its own pixel, so the noise of the photograph
in the slope and in the residual are independent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh
from services.transport.scene.rigid_moves import SCAN

Array = NDArray[np.float64]

SAMPLES = 1500
"""Number of surface points at which the change of irradiance is computed."""
SPREAD_MM = 2.0
"""Standard deviation of the distance over which a tooth spreads the light that enters it: about two mean free paths of
scattered light. The change of irradiance is averaged over it. Of 0.5 to 3 mm, and of floors of 0.02 to 1, this pair
explains most of the changes that renders of the micro-CT incisor show where its lights turn by 3.4 degrees, with a
factor of 0.97 between both."""
FLOOR = 0.05
"""Least irradiance, as a share of the lit surface's mean, to which its changes are compared: light from inside a tooth
leaves where none enters."""


def displacements(camera: Camera, points_mm: Array, centre_mm: Array) -> Array:
    """Displacement (6, 2, N) in the image, px per rad and per mm, of surface points (N, 3) that move with the scan."""
    pose, k = np.asarray(camera.camera_from_world), np.asarray(camera.K)
    local = points_mm @ pose[:3, :3].T + pose[:3, 3]
    image = local @ k.T
    depth = image[:, 2:]
    by_axis = [(k[axis] - image[:, axis : axis + 1] / depth * k[2]) / depth @ pose[:3, :3] for axis in range(2)]
    velocity = _velocities(points_mm, centre_mm)
    return np.asarray(np.einsum("anx,knx->kan", np.array(by_axis), velocity))


def brightenings(surface: Mesh, lights_mm: Array, centre_mm: Array) -> tuple[Array, Array]:
    """Points (S, 3) of a surface and the relative change (6, L, S) of their irradiance by each coordinate of the pose.

    The irradiance of a point at r with normal n by a light at p is proportional to n . v / |v|^3, v = p - r.
    """
    corners = surface.vertices_mm[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    reach = np.cumsum(area)
    chosen = np.searchsorted(reach, (np.arange(SAMPLES) + 0.5) / SAMPLES * reach[-1])
    points_mm, normals = corners[chosen].mean(axis=1), across[chosen] / area[chosen, None]

    # Average over the tooth: weights (S, S) between samples, each of which stands for the same area.
    apart = ((points_mm[:, None] - points_mm) ** 2).sum(axis=-1)
    weights = np.exp(-apart / (2 * SPREAD_MM**2)).astype(np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    velocity, turning = _velocities(points_mm, centre_mm), _velocities(normals, np.zeros(3))
    turning[3:] = 0.0
    changes = np.zeros((len(SCAN), len(lights_mm), SAMPLES))
    for k, light_mm in enumerate(lights_mm):
        way = light_mm - points_mm
        distance = np.linalg.norm(way, axis=1)
        cosine = (normals * way).sum(axis=1)
        is_lit, unit = cosine > 0, float((distance**2).mean())
        change = (
            np.einsum("knx,nx->kn", turning, way)
            - np.einsum("knx,nx->kn", velocity, normals)
            + 3 * cosine * np.einsum("knx,nx->kn", velocity, way) / distance**2
        )
        irradiance = weights @ (is_lit * cosine / distance**3).astype(np.float32) * unit
        total = weights @ (is_lit * change / distance**3).T.astype(np.float32) * unit
        lit = irradiance[irradiance > 0]
        changes[:, k] = total.T / (irradiance + FLOOR * (lit.mean() if len(lit) else 1.0))
    return points_mm, changes


def _velocities(points_mm: Array, centre_mm: Array) -> Array:
    # Movement (6, N, 3) of points by each coordinate of the pose: w x r about the centre, then t.
    arms_mm, axes = points_mm - centre_mm, np.eye(3)
    turned = np.cross(axes[:, None], arms_mm)
    return np.concatenate([turned, np.broadcast_to(axes[:, None], turned.shape)])
