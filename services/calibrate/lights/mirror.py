"""A mirror sphere before a camera: its outline, and where a light shows on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import rotation_matrix

Floats = NDArray[np.float64]
ANGLE_PRECISION = 1e-14
"""Radians: a millionth of a nanometre on a sphere of 20 mm."""
MAX_STEPS = 60
"""Halving alone would need 48; Newton's steps end after five to eight."""


@dataclass(frozen=True)
class Eye:
    """A calibrated camera: its lens and pose camera_from_world (6,)."""

    lens: Lens
    pose: Floats

    @cached_property
    def rotation(self) -> Floats:
        """From world to camera (3, 3)."""
        return rotation_matrix(self.pose[:3])

    @cached_property
    def centre_mm(self) -> Floats:
        """Where it stands in the world (3,)."""
        return np.asarray(-self.rotation.T @ self.pose[3:])

    def project(self, points_mm: Floats) -> Floats:
        """Pixels (N, 2) of world points (N, 3)."""
        return self.lens.project(points_mm @ self.rotation.T + self.pose[3:])

    def directions(self, pixels: Floats) -> Floats:
        """Unit directions (N, 3) in the world of pixels (N, 2)."""
        local = self.lens.undistort(pixels)
        return np.asarray(local @ self.rotation / np.linalg.norm(local, axis=1, keepdims=True))


def sphere_from_outline(eye: Eye, outline_px: Floats, radius_mm: float) -> Floats:
    """Centre (3,) in mm of a sphere of known radius from pixels (E, 2) of its outline.

    The rays to the outline form a right cone, so w · d = 1 for all their unit directions d: its axis is w's, and the
    cosine of its opening is 1 ÷ |w|. That is linear, and holds for the ellipse that the outline is in the image.
    """
    rays = eye.directions(outline_px)
    axis = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0]
    length = float(np.linalg.norm(axis))
    sine = max(1 - 1 / length**2, 1e-12) ** 0.5
    return np.asarray(eye.centre_mm + axis / length * radius_mm / sine)


def outline_errors(eye: Eye, outline_px: Floats, centres_mm: Floats, radii_mm: Floats | float) -> Floats:
    """How far outside spheres' drawn outlines pixels (E, 2) lie, in px (E,); spheres are one or one a pixel."""
    towards = np.broadcast_to(centres_mm - eye.centre_mm, (len(outline_px), 3))
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    axis, sine = towards / distance, np.broadcast_to(radii_mm, len(outline_px))[:, None] / distance
    rays = eye.directions(outline_px)
    # The outline's point on the side of each pixel: the ray tilted from the axis by exactly the cone's opening.
    across = rays - (rays * axis).sum(axis=1, keepdims=True) * axis
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    edge = np.sqrt(1 - sine**2) * axis + sine * across
    drawn = eye.project(eye.centre_mm + distance * edge)
    beyond = eye.project(eye.centre_mm + distance * (edge + 1e-3 * across)) - drawn
    beyond /= np.linalg.norm(beyond, axis=1, keepdims=True)
    return np.asarray(((outline_px - drawn) * beyond).sum(axis=1))


def highlight_points(eyes_mm: Floats, lights_mm: Floats, centres_mm: Floats, radii_mm: Floats | float) -> Floats:
    """Points (N, 3) of spheres that mirror lights (N, 3) into eyes (N, 3) or (3,): Alhazen's problem.

    The point lies in the plane of eye, centre and light, at an angle from the eye's direction that makes both angles to
    the normal alike. Their difference grows with that angle, so Newton's steps find it, halved brackets keeping them.
    Centres are (N, 3) or (3,), radii (N,) or a number.
    """
    to_light = lights_mm - centres_mm
    to_eye = np.broadcast_to(eyes_mm - centres_mm, to_light.shape)
    eye_distance, light_distance = np.linalg.norm(to_eye, axis=1), np.linalg.norm(to_light, axis=1)
    first = to_eye / eye_distance[:, None]
    along = (to_light * first).sum(axis=1)
    second = to_light - along[:, None] * first
    # A light exactly behind the eye mirrors at the middle; any second axis does then.
    aside = np.linalg.norm(second, axis=1)
    second = np.where(aside[:, None] > 1e-9, second / np.maximum(aside, 1e-9)[:, None], 0.0)
    between = np.arctan2(aside, along)
    low, high, angle = np.zeros(len(to_light)), between, between / 2
    for _ in range(MAX_STEPS):
        to_the_eye, by_eye = _from_normal(angle, eye_distance, radii_mm)
        to_the_light, by_light = _from_normal(between - angle, light_distance, radii_mm)
        off = to_the_eye - to_the_light
        low, high = np.where(off > 0, low, angle), np.where(off > 0, angle, high)
        tried = angle - off / (by_eye + by_light)
        before, angle = angle, np.where((tried >= low) & (tried <= high), tried, (low + high) / 2)
        if np.abs(angle - before).max() < ANGLE_PRECISION:
            break
    angle = angle[:, None]
    normals = np.cos(angle) * first + np.sin(angle) * second
    return np.asarray(centres_mm + np.broadcast_to(radii_mm, len(normals))[:, None] * normals)


def _from_normal(angle: Floats, distance_mm: Floats, radii_mm: Floats | float) -> tuple[Floats, Floats]:
    """At a point of a sphere: the angle between its normal and a thing, whose direction from the centre is ``angle``
    away, and the derivative.
    """
    cosine = np.cos(angle)
    found = np.arctan2(distance_mm * np.sin(angle), distance_mm * cosine - radii_mm)
    squared = distance_mm**2 - 2 * distance_mm * radii_mm * cosine + np.square(radii_mm)
    return found, (distance_mm**2 - distance_mm * radii_mm * cosine) / squared


def mirrored_rays(eye: Eye, highlights_px: Floats, centre_mm: Floats, radius_mm: float) -> tuple[Floats, Floats]:
    """Points (N, 3) where rays through pixels (N, 2) meet a sphere, and unit directions (N, 3) in which they leave it.

    A ray that misses the sphere leaves from the point that it comes nearest to.
    """
    rays, origin = eye.directions(highlights_px), eye.centre_mm
    towards = centre_mm - origin
    middle = rays @ towards
    depth = np.sqrt(np.maximum(middle**2 - towards @ towards + radius_mm**2, 0.0))
    points = origin + (middle - depth)[:, None] * rays
    normals = (points - centre_mm) / np.linalg.norm(points - centre_mm, axis=1, keepdims=True)
    return points, rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals


def nearest_point(origins_mm: Floats, directions: Floats) -> Floats:
    """The point (3,) whose squared distances from lines (N, 3) are least."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    # A small pull to the origins keeps nearly parallel lines from an answer at infinity.
    normal, side = across.sum(axis=0) + 1e-9 * np.eye(3), (across @ origins_mm[:, :, None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.solve(normal, side + 1e-9 * origins_mm.mean(axis=0)))
