"""Centres of spheres from their outlines in all cameras, where no highlights tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.lights.mirror import Eye, outline_errors, sphere_from_outline
from services.calibrate.lights.positions import EDGE_SHIFT_SE_PX, HUBER_SIGMAS
from services.calibrate.reweighted import solve_reweighted

Floats = NDArray[np.float64]
EDGE_SE_PX = 0.1
"""Of one edge point, against which the shift that all edges of a camera share is held; the answer hardly depends on
it."""
STEP_MM = 1e-3


@dataclass(frozen=True)
class OutlineView:
    """A sphere's outline (E, 2) in one camera: numbers of camera and place, and the radius in mm."""

    camera: int
    place: int
    radius_mm: float
    outline_px: Floats


def fit_centres(views: Sequence[OutlineView], eyes: Sequence[Eye]) -> Floats:
    """Centres (P, 3) by place, in mm.

    All edges of a camera may be found outside or inside of the true outline alike. One camera would take that for a
    nearer or farther sphere; cameras together tell it from distance.
    """
    count = max(view.place for view in views) + 1
    start = np.zeros(3 * count + len(eyes))
    for place in range(count):
        here = [view for view in views if view.place == place]
        found = [sphere_from_outline(eyes[view.camera], view.outline_px, view.radius_mm) for view in here]
        start[3 * place : 3 * place + 3] = np.mean(found, axis=0)

    def residuals(values: Floats) -> Floats:
        centres, shifts = values[: 3 * count].reshape(-1, 3), values[3 * count :]
        off = [
            outline_errors(eyes[view.camera], view.outline_px, centres[view.place], view.radius_mm)
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
