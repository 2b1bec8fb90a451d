"""Centres of spheres from their outlines in all cameras, for spheres without highlights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.mirror import PosedCamera, outline_errors, sphere_from_outline
from services.calibrate.lights.positions import EDGE_SHIFT_SE_PX
from services.calibrate.reweighted import solve_reweighted
from services.core.robust import HUBER_SIGMAS

Floats = NDArray[np.float64]
EDGE_SE_PX = 0.1
"""Standard error of one edge point. It weighs the edge points against the prior of the shift that all edges of a camera
share; the answer hardly depends on it."""
STEP_MM = 1e-3
"""Step of the central differences."""


@dataclass(frozen=True)
class OutlineView:
    """The outline of one sphere in one camera.

    Attributes:
        camera: number of the camera.
        place: number of the place where the sphere stood.
        radius_mm: radius of the sphere.
        outline_px: points of its outline (E, 2), pixel centres at half-integers.
    """

    camera: int
    place: int
    radius_mm: float
    outline_px: Floats


def fit_centres(views: Sequence[OutlineView], cameras: Sequence[PosedCamera]) -> Floats:
    """Fit the spheres' centres (P, 3) by place, in mm.

    All edges of a camera may be detected outside or inside the true outline by one common shift. In one camera this
    shift looks like a nearer or farther sphere; several cameras together separate it from the distance.
    """
    count = max(view.place for view in views) + 1
    start = np.zeros(3 * count + len(cameras))
    for place in range(count):
        here = [view for view in views if view.place == place]
        found = [sphere_from_outline(cameras[view.camera], view.outline_px, view.radius_mm) for view in here]
        start[3 * place : 3 * place + 3] = np.mean(found, axis=0)

    def residuals(values: Floats) -> Floats:
        centres, shifts = values[: 3 * count].reshape(-1, 3), values[3 * count :]
        off = [
            outline_errors(cameras[view.camera], view.outline_px, centres[view.place], view.radius_mm)
            - shifts[view.camera]
            for view in views
        ]
        return np.concatenate([np.concatenate(off) / EDGE_SE_PX, shifts / EDGE_SHIFT_SE_PX])

    def derivative(values: Floats) -> Floats:
        columns = []
        for index in range(len(values)):
            step = np.zeros(len(values))
            step[index] = STEP_MM
            columns.append((residuals(values + step) - residuals(values - step)) / (2 * STEP_MM))
        return np.stack(columns, axis=1)

    return solve_reweighted(residuals, derivative, start, HUBER_SIGMAS)[: 3 * count].reshape(-1, 3)
