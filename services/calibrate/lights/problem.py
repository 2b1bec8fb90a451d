"""Residuals of mirror spheres: detected minus projected pixels of outlines and highlights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.mirror import (
    PosedCamera,
    highlight_points,
    mirrored_rays,
    nearest_point,
    outline_errors,
    sphere_from_outline,
)
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
MIN_HIGHLIGHTS = 2
"""Smallest number of highlights of one light: a single highlight determines two of the three coordinates."""


@dataclass(frozen=True)
class SphereView:
    """One mirror sphere in one camera.

    Attributes:
        camera: number of the camera.
        place: number of the place; the sphere did not move between photographs of one place.
        radius_mm: radius of the sphere.
        outline_px: points of its outline (E, 2), pixel centres at half-integers.
        lights: numbers of the lights whose highlights were found (H,).
        highlights_px: centres of these highlights (H, 2).
    """

    camera: int
    place: int
    radius_mm: float
    outline_px: Floats
    lights: NDArray[np.int64]
    highlights_px: Floats


class Problem:
    """Residuals of all views.

    The order of the unknowns is lights (3 each), spheres' centres by place (3 each), edge shifts by camera (1 each).
    Further values in a vector of unknowns are ignored here.
    """

    def __init__(self, views: Sequence[SphereView], n_cameras: int, light_names: Sequence[str]) -> None:
        self.views = views
        light_numbers = np.concatenate([view.lights for view in views])
        self.lights, counts = np.unique(light_numbers, return_counts=True)
        if few := [int(n) for n, count in zip(self.lights, counts, strict=True) if count < MIN_HIGHLIGHTS]:
            raise CaptureInputError(
                f"Light {light_names[few[0]]} shows on a mirror sphere only once, which tells a direction and no place;"
                " photograph the sphere in a second place or by a second camera."
            )
        self.n_places, self.n_cameras = max(view.place for view in views) + 1, n_cameras
        self.row = np.searchsorted(self.lights, light_numbers)
        per_view, edges = [len(view.lights) for view in views], [len(view.outline_px) for view in views]
        self.camera, self.edge_camera = (np.repeat([view.camera for view in views], n) for n in (per_view, edges))
        self.place, self.edge_place = (np.repeat([view.place for view in views], n) for n in (per_view, edges))
        self._radius, self._edge_radius = (np.repeat([view.radius_mm for view in views], n) for n in (per_view, edges))
        self._highlights_px = np.concatenate([view.highlights_px for view in views])
        self._edges_px = np.concatenate([view.outline_px for view in views])

    @property
    def length(self) -> int:
        """Number of unknowns."""
        return self.first_shift + self.n_cameras

    @property
    def first_centre(self) -> int:
        """Index of the first coordinate of a centre among the unknowns."""
        return 3 * len(self.lights)

    @property
    def first_shift(self) -> int:
        """Index of the first edge shift among the unknowns."""
        return self.first_centre + 3 * self.n_places

    def split(self, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the lights (..., M, 3) and centres (..., P, 3) in mm and the edge shifts (..., K) in px of values
        (..., U).
        """
        first, second, sets = self.first_centre, self.first_shift, values.shape[:-1]
        return (
            values[..., :first].reshape(*sets, -1, 3),
            values[..., first:second].reshape(*sets, -1, 3),
            values[..., second : self.length],
        )

    def start(self, cameras: Sequence[PosedCamera]) -> Floats:
        """Return first values of the unknowns: each sphere from its outlines alone, and each light at the point nearest
        to its reflected rays; edge shifts are 0.
        """
        centres = np.zeros((self.n_places, 3))
        for place in range(self.n_places):
            here = [view for view in self.views if view.place == place]
            found = [sphere_from_outline(cameras[view.camera], view.outline_px, view.radius_mm) for view in here]
            centres[place] = np.mean(found, axis=0)
        mirrored = [
            mirrored_rays(cameras[view.camera], view.highlights_px, centres[view.place], view.radius_mm)
            for view in self.views
        ]
        points, rays = (np.concatenate(parts) for parts in zip(*mirrored, strict=True))
        lights = [nearest_point(points[self.row == row], rays[self.row == row]) for row in range(len(self.lights))]
        return np.concatenate([np.ravel(lights), centres.ravel(), np.zeros(self.n_cameras)])

    def highlights(self, cameras: Sequence[PosedCamera], values: Floats) -> Floats:
        """Return detected minus projected highlights (..., N, 2) in px for values (..., U)."""
        lights, centres, _ = self.split(values)
        off = np.empty((*values.shape[:-1], *self._highlights_px.shape))
        where = np.broadcast_to(
            np.array([camera.centre_mm for camera in cameras])[self.camera], (*off.shape[:-1], 3)
        ).reshape(-1, 3)
        points = highlight_points(
            where,
            lights[..., self.row, :].reshape(-1, 3),
            centres[..., self.place, :].reshape(-1, 3),
            np.broadcast_to(self._radius, off.shape[:-1]).reshape(-1),
        ).reshape(*off.shape[:-1], 3)
        for number, camera in enumerate(cameras):
            mine = self.camera == number
            if mine.any():
                seen = points[..., mine, :]
                drawn = camera.project(seen.reshape(-1, 3)).reshape(*seen.shape[:-1], 2)
                off[..., mine, :] = self._highlights_px[mine] - drawn
        return off

    def outlines(self, cameras: Sequence[PosedCamera], values: Floats) -> Floats:
        """Return the distances (..., E) in px of detected edges from the projected outlines, positive outside, minus
        the camera's edge shift, for values (..., U).
        """
        _, centres, shifts = self.split(values)
        off = np.empty((*values.shape[:-1], len(self._edges_px)))
        for number, camera in enumerate(cameras):
            mine = self.edge_camera == number
            if mine.any():
                where = centres[..., self.edge_place[mine], :]
                found = outline_errors(camera, self._edges_px[mine], where, self._edge_radius[mine])
                off[..., mine] = found - shifts[..., number, None]
        return off
