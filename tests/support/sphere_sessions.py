"""Calibration sessions with mirror spheres: the outlines and highlights that an exact rig sees, computed by the law of
reflection alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import Lens
from services.calibrate.lights.mirror import PosedCamera, highlight_points
from services.calibrate.lights.problem import SphereView
from tests.support.board_sessions import SIZE, looking

Floats = NDArray[np.float64]
CENTRES_MM = np.array([[-70.0, -40, 0], [70, -30, 20], [0, 45, -20], [10, 0, 60]])
EDGE_POINTS = 60
STEEPEST = 0.25
"""Cosine of the angle of incidence below which a highlight counts as not visible."""


@dataclass(frozen=True)
class SphereSession:
    """Three cameras, lights a metre away, and mirror spheres of 25 mm radius at four places."""

    cameras: tuple[PosedCamera, ...]
    lights_mm: Floats
    centres_mm: Floats
    views: tuple[SphereView, ...]


def three_cameras() -> tuple[PosedCamera, ...]:
    """Three cameras with the same lens, 450 mm from the origin and 35° apart."""
    lens = Lens(SIZE, np.array([3200.0, 3206.0, 805.0, 590.0, -0.12, 0.08, 0.0006, -0.0004]))
    where = (450 * np.array([np.sin(a), 0.2, np.cos(a)]) for a in np.deg2rad([-35.0, 0.0, 35.0]))
    return tuple(PosedCamera(lens, looking(position, np.zeros(3))) for position in where)


def dome_lights(count: int, random: np.random.Generator) -> Floats:
    """Positions (N, 3) in mm of lights about a metre from the origin, all around on the cameras' side."""
    directions = random.normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(1000 * directions * random.uniform(0.95, 1.05, (count, 1)))


def outline_points(camera: PosedCamera, centre_mm: Floats, radius_mm: float, count: int) -> tuple[Floats, Floats]:
    """Pixels (N, 2) of a sphere's outline, and unit vectors (N, 2) that point away from its centre."""
    towards = centre_mm - camera.centre_mm
    distance = float(np.linalg.norm(towards))
    axis, sine = towards / distance, radius_mm / distance
    one = np.cross(axis, [0.0, 1.0, 0.0])
    one /= np.linalg.norm(one)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    across = np.cos(angle) * one + np.sin(angle) * np.cross(axis, one)
    edge = camera.project(camera.centre_mm + distance * (np.sqrt(1 - sine**2) * axis + sine * across))
    outward = edge - camera.project(centre_mm[None])
    return edge, outward / np.linalg.norm(outward, axis=1, keepdims=True)


def sphere_session(
    random: np.random.Generator,
    lights_mm: Floats,
    *,
    highlight_px: float = 0.05,
    edge_px: float = 0.1,
    edge_shift_px: float = 0.1,
    radius_mm: float = 25.0,
) -> SphereSession:
    """Draw a mirror sphere at four places for three cameras, with Gaussian errors and a common outward shift of edges.

    Args:
        highlight_px: standard deviation of a highlight's position.
        edge_px: standard deviation of an outline's point.
        edge_shift_px: shift of all outlines away from the sphere's centre.
    """
    cameras = three_cameras()
    centres = CENTRES_MM + random.normal(0, 3, CENTRES_MM.shape)
    views = []
    for place, centre in enumerate(centres):
        for number, camera in enumerate(cameras):
            edge, outward = outline_points(camera, centre, radius_mm, EDGE_POINTS)
            edge = edge + outward * (edge_shift_px + random.normal(0, edge_px, (EDGE_POINTS, 1)))
            points = highlight_points(camera.centre_mm, lights_mm, centre, radius_mm)
            to_camera = (camera.centre_mm - points) / np.linalg.norm(camera.centre_mm - points, axis=1, keepdims=True)
            seen = np.flatnonzero(((points - centre) / radius_mm * to_camera).sum(axis=1) > STEEPEST)
            found = camera.project(points[seen]) + random.normal(0, highlight_px, (len(seen), 2))
            views.append(SphereView(number, place, radius_mm, edge, seen, found))
    return SphereSession(cameras, lights_mm, centres, tuple(views))
