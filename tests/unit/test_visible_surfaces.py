"""The nearest surface at each sample, compared with every triangle tested at every sample."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.anatomy.visibility import NOTHING, visible_surfaces
from services.core.geometry import Camera, Mesh

SIZE, FOCAL_PX = (40, 30), 400.0
CAMERA = Camera(
    name="front",
    size=SIZE,
    K=((FOCAL_PX, 0, 20), (0, FOCAL_PX, 15), (0, 0, 1)),
    camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1000), (0, 0, 0, 1)),
)


def triangles(corners_px: NDArray[np.float64], depth_mm: NDArray[np.float64]) -> list[Mesh]:
    """One mesh for each triangle with corners (N, 3, 2) in the image at depths (N, 3)."""
    local = (corners_px - [20, 15]) / FOCAL_PX * depth_mm[..., None]
    vertices = np.concatenate([local, depth_mm[..., None] - 1000], axis=-1)
    return [Mesh(own, np.array([[0, 1, 2]], dtype=np.int32)) for own in vertices]


def nearest(
    corners_px: NDArray[np.float64], depth_mm: NDArray[np.float64]
) -> tuple[NDArray[np.int16], NDArray[np.float64], NDArray[np.bool_]]:
    """Nearest triangle (H, W) at pixel centres, its depth, and where no edge or second depth makes this a matter of
    rounding.
    """
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    label, nearness = np.full(x.shape, NOTHING, dtype=np.int16), np.zeros(x.shape)
    is_clear = np.ones(x.shape, dtype=bool)
    for number, (corners, depths) in enumerate(zip(corners_px, depth_mm, strict=True)):
        edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)
        if np.linalg.det(edges) >= 0:
            continue  # it faces away
        b1, b2 = np.moveaxis((np.stack([x, y], axis=-1) - corners[0]) @ np.linalg.inv(edges).T, -1, 0)
        barycentric = np.stack([1 - b1 - b2, b1, b2])
        lowest, inverse = barycentric.min(axis=0), (barycentric / depths[:, None, None]).sum(axis=0)
        is_clear &= (np.abs(lowest) > 1e-6) & ((lowest < 0) | (np.abs(inverse / np.maximum(nearness, 1e-9) - 1) > 1e-9))
        is_nearer = (lowest >= 0) & (inverse > nearness)
        label[is_nearer], nearness[is_nearer] = number, inverse[is_nearer]
    with np.errstate(divide="ignore"):
        return label, 1 / nearness, is_clear


@pytest.mark.parametrize("kind", ["any", "slivers", "on the grid", "larger than the image"])
def test_every_sample_shows_the_nearest_triangle(kind: str) -> None:
    random = np.random.default_rng(3)
    centre, spread = random.uniform(0, 1, (200, 1, 2)) * SIZE, random.uniform(-6, 6, (200, 3, 2))
    if kind == "slivers":
        spread[:, 2] = spread[:, 1] + random.uniform(-0.05, 0.05, (200, 2))
    if kind == "larger than the image":
        spread *= 20
    corners_px = centre + spread
    if kind == "on the grid":
        # Corners on and between pixel centres, so that many edges run along rows, columns and diagonals of samples
        corners_px = np.rint(2 * corners_px) / 2
        edge1, edge2 = corners_px[:, 1] - corners_px[:, 0], corners_px[:, 2] - corners_px[:, 0]
        corners_px = corners_px[edge1[:, 0] * edge2[:, 1] != edge1[:, 1] * edge2[:, 0]]
    depth_mm = random.uniform(800, 1200, (len(corners_px), 3))
    label, depth, is_clear = nearest(corners_px, depth_mm)
    found = visible_surfaces(CAMERA, triangles(corners_px, depth_mm))
    assert is_clear.mean() > 0.2
    np.testing.assert_array_equal(found.mesh[is_clear], label[is_clear])
    np.testing.assert_allclose(found.depth_mm[is_clear], depth[is_clear], rtol=1e-9)


def test_adjacent_triangles_leave_no_gap_on_their_common_edge() -> None:
    """A fan whose spokes run through many pixel centres covers its whole square."""
    rim = np.array([(0, 0), (20, 0), (40, 0), (40, 15), (40, 30), (20, 30), (0, 30), (0, 15)], dtype=float)
    corners_px = np.stack([np.full((8, 2), (20.5, 15.5)), np.roll(rim, -1, axis=0), rim], axis=1)
    found = visible_surfaces(CAMERA, triangles(corners_px, np.full((8, 3), 1000.0)))
    assert (found.mesh != NOTHING).all()
