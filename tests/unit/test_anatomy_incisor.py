"""The procedural incisor: closed, with the dentin inside the enamel, and with the dimensions in its table."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from services.anatomy.distance import SignedDistanceGrid, SurfaceDistance
from services.anatomy.templates.incisor import CROWN_MM, ROOT_STUB_MM, Incisor, build_incisor, enamel_thickness_mm

CERVIX_MM = -(CROWN_MM - ROOT_STUB_MM) / 2
"""Height of the cervical line in the centred frame, mm."""


@pytest.fixture(scope="module")
def incisor() -> Incisor:
    return build_incisor()


@pytest.mark.parametrize("part", ["outer", "dentin", "gums"])
def test_every_surface_is_closed_and_faces_outward(incisor: Incisor, part: str) -> None:
    getattr(incisor, part).require_solid(part)


@pytest.mark.parametrize("columns", [24, 64])
def test_dentin_stays_inside_enamel_at_every_resolution(columns: int) -> None:
    tooth = build_incisor(columns)
    points = np.concatenate([tooth.dentin.vertices_mm, tooth.dentin.vertices_mm[tooth.dentin.faces].mean(axis=1)])
    grid = SignedDistanceGrid(tooth.outer, 0.1, 0.3)
    assert (grid.depth_mm(points) > 0).all()
    assert grid.surface.smallest_mm(points) >= 0.05
    assert SurfaceDistance(tooth.dentin).smallest_mm(tooth.outer.vertices_mm) >= 0.05


def test_mesh_is_smooth_and_of_the_stated_size(incisor: Incisor) -> None:
    for mesh in (incisor.outer, incisor.dentin):
        assert 2000 <= len(mesh.faces) <= 6000
        # A rounded edge of 90 degrees in five rows bends by 18 degrees in each row; a crease would be 60 and more.
        assert np.degrees(trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).face_adjacency_angles).max() < 35
    box = np.stack([incisor.outer.vertices_mm.min(axis=0), incisor.outer.vertices_mm.max(axis=0)])
    np.testing.assert_allclose(box.sum(axis=0), 0, atol=1e-9)


def test_dimensions_are_wheelers_averages(incisor: Incisor) -> None:
    # Rows are up to 0.4 mm apart, diameters change by at most 0.7 mm per mm of height: 0.15 mm.
    height = incisor.outer.vertices_mm[:, 2] - CERVIX_MM

    def diameter(axis: int, at_mm: float) -> float:
        near = np.abs(height - at_mm) < 0.25
        return float(np.ptp(incisor.outer.vertices_mm[near, axis]))

    assert height.max() == pytest.approx(CROWN_MM)
    assert np.ptp(incisor.outer.vertices_mm[:, 0]) == pytest.approx(8.5, abs=0.15)
    assert diameter(0, 0.0) == pytest.approx(7.0, abs=0.15)
    assert diameter(1, 0.0) == pytest.approx(6.0, abs=0.15)
    assert diameter(1, 2.5) == pytest.approx(7.0, abs=0.15)


def test_labial_enamel_follows_the_thickness_model(incisor: Incisor) -> None:
    # The shortest distance is at most the thickness along the normal; the curvature of the wall makes a difference of
    # up to 0.05 mm.
    distance = SurfaceDistance(incisor.dentin).closest(incisor.outer.vertices_mm)[1]
    height = incisor.outer.vertices_mm[:, 2] - CERVIX_MM
    labial = (
        (np.abs(incisor.outer.vertices_mm[:, 0]) < 0.8)
        & (incisor.outer.vertices_mm[:, 1] > 0)
        & (height > 0.5)
        & (height < 8.5)
    )
    assert labial.sum() > 20
    np.testing.assert_allclose(distance[labial], enamel_thickness_mm(height[labial]), atol=0.05)
