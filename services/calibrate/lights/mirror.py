"""Geometry of a mirror sphere in front of a camera: its outline, and the highlight of a light on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import rotation_matrix

Floats = NDArray[np.float64]
ANGLE_PRECISION = 1e-14
"""Change of the angle in radians at which the iteration ends: less than a millionth of a nanometre on a sphere of
20 mm."""
MAX_STEPS = 60
"""Largest number of iterations: bisection alone would need 48, Newton's method ends after five to eight."""


@dataclass(frozen=True)
class PosedCamera:
    """A calibrated camera: its lens and pose camera_from_world (6,)."""

    lens: Lens
    pose: Floats

    @cached_property
    def rotation(self) -> Floats:
        """Rotation from world to camera axes (3, 3)."""
        return rotation_matrix(self.pose[:3])

    @cached_property
    def centre_mm(self) -> Floats:
        """Position of the camera's centre in the world (3,)."""
        return np.asarray(-self.rotation.T @ self.pose[3:])

    def project(self, points_mm: Floats) -> Floats:
        """Return the pixels (N, 2) of world points (N, 3) in mm."""
        return self.lens.project(points_mm @ self.rotation.T + self.pose[3:])

    def directions(self, pixels: Floats) -> Floats:
        """Return the unit directions (N, 3) in world axes of pixels (N, 2)."""
        local = self.lens.undistort(pixels)
        return np.asarray(local @ self.rotation / np.linalg.norm(local, axis=1, keepdims=True))


def sphere_from_outline(camera: PosedCamera, outline_px: Floats, radius_mm: float) -> Floats:
    """Return the centre (3,) in mm of a sphere of known radius from pixels (E, 2) of its outline.

    The rays to the outline form a right circular cone, so one vector w has w · d = 1 for the unit directions d of all
    rays: w points along the cone's axis, and the cosine of the cone's half angle is 1 ÷ |w|. This is linear in w, and
    exact although the outline is an ellipse in the image.
    """
    rays = camera.directions(outline_px)
    axis = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]
    length = float(np.linalg.norm(axis))
    sine = max(1 - 1 / length**2, 1e-12) ** 0.5
    return np.asarray(camera.centre_mm + axis / length * radius_mm / sine)


def outline_errors(camera: PosedCamera, outline_px: Floats, centres_mm: Floats, radii_mm: Floats | float) -> Floats:
    """Return the signed distances (..., E) in px of pixels (E, 2) from the projected outlines of spheres, positive
    outside.

    Args:
        camera: the calibrated camera.
        outline_px: detected points of outlines (E, 2).
        centres_mm: centre of the one sphere (3,), or of each pixel's sphere (E, 3), or several of these (..., E, 3).
        radii_mm: radius of the one sphere, or of each pixel's sphere (E,).
    """
    towards = np.asarray(centres_mm - camera.centre_mm)
    towards = np.broadcast_to(towards, (*towards.shape[:-2], len(outline_px), 3))
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    axis, sine = towards / distance, np.broadcast_to(radii_mm, len(outline_px))[:, None] / distance
    rays = camera.directions(outline_px)
    # The outline's point next to each pixel: tilt the cone's axis towards the pixel's ray by exactly the half angle.
    across = rays - (rays * axis).sum(axis=-1, keepdims=True) * axis
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    edge = np.sqrt(1 - sine**2) * axis + sine * across
    projected, beside = (
        camera.project((camera.centre_mm + distance * point).reshape(-1, 3)).reshape(*edge.shape[:-1], 2)
        for point in (edge, edge + 1e-3 * across)
    )
    outward = beside - projected
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    return np.asarray(((outline_px - projected) * outward).sum(axis=-1))


def highlight_points(
    camera_centres_mm: Floats, lights_mm: Floats, centres_mm: Floats, radii_mm: Floats | float
) -> Floats:
    """Return the points (N, 3) in mm of spheres that reflect lights (N, 3) into cameras (N, 3) or (3,): Alhazen's
    problem.

    The point lies in the plane of camera, centre and light, at the angle from the camera's direction for which camera
    and light have equal angles to the normal. The difference of the two angles grows with this angle, so Newton's
    method finds its zero, safeguarded by bisection. Centres are (N, 3) or (3,), radii (N,) or a number, both in mm.
    """
    to_light = lights_mm - centres_mm
    to_camera = np.broadcast_to(camera_centres_mm - centres_mm, to_light.shape)
    camera_distance, light_distance = np.linalg.norm(to_camera, axis=1), np.linalg.norm(to_light, axis=1)
    first = to_camera / camera_distance[:, None]
    along = (to_light * first).sum(axis=1)
    second = to_light - along[:, None] * first
    # A light exactly in the camera's direction is reflected at angle 0, where the second axis does not matter.
    aside = np.linalg.norm(second, axis=1)
    second = np.where(aside[:, None] > 1e-9, second / np.maximum(aside, 1e-9)[:, None], 0.0)
    between = np.arctan2(aside, along)
    low, high, angle = np.zeros(len(to_light)), between, between / 2
    for _ in range(MAX_STEPS):
        camera_angle, camera_slope = _from_normal(angle, camera_distance, radii_mm)
        light_angle, light_slope = _from_normal(between - angle, light_distance, radii_mm)
        off = camera_angle - light_angle
        low, high = np.where(off > 0, low, angle), np.where(off > 0, angle, high)
        newton_angle = angle - off / (camera_slope + light_slope)
        before, angle = angle, np.where((newton_angle >= low) & (newton_angle <= high), newton_angle, (low + high) / 2)
        if np.abs(angle - before).max() < ANGLE_PRECISION:
            break
    angle = angle[:, None]
    normals = np.cos(angle) * first + np.sin(angle) * second
    return np.asarray(centres_mm + np.broadcast_to(radii_mm, len(normals))[:, None] * normals)


def _from_normal(angle: Floats, distance_mm: Floats, radii_mm: Floats | float) -> tuple[Floats, Floats]:
    """Return the angle between the normal at a point of a sphere and the direction from this point to a camera or
    light, and the derivative of this angle with respect to ``angle``.

    Args:
        angle: angle at the sphere's centre between the normal and the direction to the camera or light, in rad (N,).
        distance_mm: distance of the camera or light from the sphere's centre (N,).
        radii_mm: radius of the spheres, (N,) or a number.
    """
    cosine = np.cos(angle)
    found = np.arctan2(distance_mm * np.sin(angle), distance_mm * cosine - radii_mm)
    squared = distance_mm**2 - 2 * distance_mm * radii_mm * cosine + np.square(radii_mm)
    return found, (distance_mm**2 - distance_mm * radii_mm * cosine) / squared


def mirrored_rays(
    camera: PosedCamera, highlights_px: Floats, centre_mm: Floats, radius_mm: float
) -> tuple[Floats, Floats]:
    """Return the points (N, 3) where rays through pixels (N, 2) meet a sphere, and the unit directions (N, 3) of the
    reflected rays.

    A ray that misses the sphere is reflected at the ray's point nearest to the centre.
    """
    rays, origin = camera.directions(highlights_px), camera.centre_mm
    towards = centre_mm - origin
    middle = rays @ towards
    depth = np.sqrt(np.maximum(middle**2 - towards @ towards + radius_mm**2, 0.0))
    points = origin + (middle - depth)[:, None] * rays
    normals = (points - centre_mm) / np.linalg.norm(points - centre_mm, axis=1, keepdims=True)
    return points, rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals


def nearest_point(origins_mm: Floats, directions: Floats) -> Floats:
    """Return the point (3,) with the least sum of squared distances from lines of origins (N, 3) and unit directions
    (N, 3).
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    # A small term that draws the point to the mean origin keeps the answer finite for nearly parallel lines.
    normal, side = across.sum(axis=0) + 1e-9 * np.eye(3), (across @ origins_mm[:, :, None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.solve(normal, side + 1e-9 * origins_mm.mean(axis=0)))
