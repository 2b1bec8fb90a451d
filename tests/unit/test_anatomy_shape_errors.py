"""Displacements of the dentin that its blend shape cannot follow: smooth, of a known size, inside the enamel."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.anatomy.blend import dentin_blend_shape
from services.anatomy.distance import SignedDistanceGrid
from services.anatomy.frame import ToothFrame
from services.anatomy.shape_errors import CLEARANCE_MM, ERROR_MM, MODES, shape_errors
from services.anatomy.templates.dimensions import upper_tooth
from services.anatomy.templates.incisor import build_incisor
from services.core.geometry import Mesh

WEIGHTS = (0.6, 0.6, 0.6)
GRID_ERROR_MM = 0.02
"""Error of a depth interpolated trilinearly between grid points 0.1 mm apart, at the sharpest edges."""
UNEVEN = 0.1
"""Relative difference of the size that eight modes leave between places, of which the modes describe some better."""


@pytest.fixture(scope="module")
def incisor() -> tuple[Mesh, Mesh, NDArray[np.float64]]:
    outer, crown = build_incisor().outer, upper_tooth(1)
    dentin = dentin_blend_shape(outer, crown=crown)
    errors = shape_errors(outer, dentin, WEIGHTS, ToothFrame.identity(), crown)
    return outer, Mesh(dentin.vertices_mm(WEIGHTS), dentin.base.faces), errors


def test_displacements_of_either_sign_leave_enamel(incisor: tuple[Mesh, Mesh, NDArray[np.float64]]) -> None:
    outer, dentin, errors = incisor
    assert errors.shape == (MODES, len(dentin.vertices_mm), 3)
    grid = SignedDistanceGrid(outer, 0.1)
    for moved in (dentin.vertices_mm + sign * error for error in errors for sign in (1, -1)):
        assert grid.depth_mm(moved).min() >= CLEARANCE_MM - GRID_ERROR_MM
        Mesh(moved, dentin.faces).require_solid("dentin")


def test_the_crown_moves_by_the_stated_error_and_the_root_stays(
    incisor: tuple[Mesh, Mesh, NDArray[np.float64]],
) -> None:
    _, dentin, errors = incisor
    height = dentin.vertices_mm[:, 2]
    size = np.sqrt((errors**2).sum(axis=(0, 2)))
    below_neck = height < height.max() - upper_tooth(1).crown_length_mm
    assert below_neck.any()
    assert size[below_neck].max() == 0
    # The middle of the crown has room on both sides.
    middle = (height > height.max() - 6) & (height < height.max() - 3)
    assert size.max() <= (1 + UNEVEN) * ERROR_MM
    assert np.sqrt((size[middle] ** 2).mean()) == pytest.approx(ERROR_MM, rel=UNEVEN)


def test_walls_move_independently_and_neighbours_together(incisor: tuple[Mesh, Mesh, NDArray[np.float64]]) -> None:
    _, dentin, errors = incisor
    points = dentin.vertices_mm
    middle = np.abs(points[:, 2] - (points[:, 2].max() - 4)) < 0.5
    front, back = (
        np.flatnonzero(middle & (np.abs(points[:, 0]) < 1) & (side * (points[:, 1] - points[middle, 1].mean()) > 0))
        for side in (1, -1)
    )
    lengths = np.linalg.norm(errors, axis=2) * np.sign(errors @ np.array([0.0, 1.0, 0.0]))

    def correlation(a: NDArray[np.int_], b: NDArray[np.int_]) -> float:
        covariance = lengths[:, a].T @ lengths[:, b]
        size_a, size_b = (np.sqrt((lengths[:, one] ** 2).sum(axis=0)) for one in (a, b))
        return float((covariance / np.outer(size_a, size_b)).mean())

    assert correlation(front, front) > 0.9
    assert abs(correlation(front, back)) < 0.3
