"""Distances and level sets, compared with shapes for which there are formulas."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from services.anatomy.distance import SignedDistanceGrid, SurfaceDistance
from services.anatomy.isosurface import surface_net
from services.core.geometry import Mesh


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, dtype=np.float64), np.asarray(shape.faces, dtype=np.int32))


BOX = mesh_of(trimesh.creation.box(extents=(4.0, 6.0, 8.0)))


def box_depth(points: np.ndarray) -> np.ndarray:
    return (np.array([2.0, 3.0, 4.0]) - np.abs(points)).min(axis=1)


def test_closest_points_on_a_box_are_exact() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [1.9, 2.9, 3.9]
    nearest, distance, faces = SurfaceDistance(BOX).closest(points)
    # Where two walls are almost equally near, the search may take the farther one: an error of up to the squared
    # spacing over twice the distance.
    np.testing.assert_allclose(distance, box_depth(points), atol=0.005)
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), distance, atol=1e-12)
    assert faces.max() < len(BOX.faces)


@pytest.mark.parametrize("spacing_mm", [0.1, 1.0])
@pytest.mark.parametrize("apart_mm", [0.05, 0.5, 3.0])
def test_the_smallest_distance_is_that_of_the_nearest_point(apart_mm: float, spacing_mm: float) -> None:
    points = np.random.default_rng(1).uniform([2 + apart_mm, -3, -4], [4 + apart_mm, 3, 4], (2000, 3))
    surface = SurfaceDistance(BOX, spacing_mm)
    assert surface.smallest_mm(points) == surface.closest(points)[1].min()
    assert surface.smallest_mm(points) == pytest.approx(apart_mm, abs=0.01)


def test_signed_grid_knows_inside_and_depth() -> None:
    grid = SignedDistanceGrid(BOX, pitch_mm=0.2)
    points = np.random.default_rng(1).uniform(-1, 1, (4000, 3)) * [2.3, 3.3, 4.3]
    depth, expected = grid.depth_mm(points), np.minimum((np.array([2.0, 3.0, 4.0]) - np.abs(points)).min(axis=1), 1e9)
    clear = np.abs(expected) > 0.05
    assert (np.sign(depth[clear]) == np.sign(expected[clear])).all()
    inside = expected > 0
    # Trilinear interpolation across the kinks where walls are equally near: half a pitch at most.
    np.testing.assert_allclose(depth[inside], expected[inside], atol=0.1)


def test_inward_direction_is_the_wall_normal() -> None:
    grid = SignedDistanceGrid(BOX, pitch_mm=0.2)
    np.testing.assert_allclose(
        grid.inward(np.array([[1.5, 0.0, 0.0], [0.0, -2.6, 0.0]])), [[-1, 0, 0], [0, 1, 0]], atol=0.02
    )


@pytest.mark.parametrize("pitch", [0.3, 0.17])
def test_surface_net_of_a_sphere(pitch: float) -> None:
    def field(points: np.ndarray) -> np.ndarray:
        return 3.0 - np.linalg.norm(points, axis=1)

    net = surface_net(field, np.full(3, -3.5), np.full(3, 3.5), pitch, level=0.5)
    net.require_solid("net")
    # A cell's mean crossing lies within pitch^2 / (8 R) of the sphere's chord, twice over for the cell's diagonal.
    np.testing.assert_allclose(np.linalg.norm(net.vertices_mm, axis=1), 2.5, atol=3 * pitch**2 / 2.5)
    assert net.signed_volume_mm3() == pytest.approx(4 / 3 * np.pi * 2.5**3, rel=0.03)
