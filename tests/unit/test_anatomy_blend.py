"""The dentin blend shape stays a solid inside the enamel for every weight."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from services.core.errors import MeshError
from services.core.geometry import Mesh
from services.core.meshfiles import read_mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from services.fit.anatomy.blend import BASE_DEPTH_MM, CLEARANCE_MM, FULL_DEPTH_MM, MODES, dentin_blend_shape
from services.fit.anatomy.distance import SignedDistanceGrid, SurfaceDistance
from services.fit.anatomy.frame import ToothFrame, estimate_frame
from services.fit.anatomy.incisor import build_incisor
from services.fit.transport.recipe import DentinShape
from tests.support.shared_data import shared_path

GRID_ERROR_MM = 0.02
"""Trilinear depth between grid points 0.1 mm apart, at the sharpest edges of the scans."""


def scanned_incisor() -> tuple[Mesh, ToothFrame]:
    root = shared_path("data/tooth-ur1-truth")
    cameras = read_record(root / "capture.json", FolderCapture).cameras
    outer = read_mesh(root / "teeth/11/outer.ply")
    return outer, estimate_frame(outer, np.array([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras]))


def scanned_crown() -> tuple[Mesh, ToothFrame]:
    outer = read_mesh(shared_path("data/intraoral-photos/ref_mesh/Ref_Mesh_Tag=0_FDI=11.obj"))
    return outer, estimate_frame(outer, np.array([[0.0, -1000.0, 0.0]]))


def procedural() -> tuple[Mesh, ToothFrame]:
    return build_incisor().outer, ToothFrame.identity()


class Case:
    def __init__(self, outer: Mesh, frame: ToothFrame) -> None:
        self.outer, self.frame = outer, frame
        self.shape: DentinShape = dentin_blend_shape(outer, frame)
        self.grid = SignedDistanceGrid(outer, 0.1)

    def smallest_depth_mm(self, weights: tuple[float, ...]) -> float:
        vertices = self.shape.vertices_mm(weights)
        return float(self.grid.depth_mm(np.concatenate([vertices, vertices[self.shape.base.faces].mean(axis=1)])).min())


@pytest.fixture(scope="module", params=[procedural, scanned_incisor, scanned_crown], ids=lambda make: make.__name__)
def case(request: pytest.FixtureRequest) -> Case:
    return Case(*request.param())


def test_base_is_a_solid_a_tenth_of_a_millimetre_inside(case: Case) -> None:
    case.shape.base.require_solid("base")
    depth = SurfaceDistance(case.outer).closest(case.shape.base.vertices_mm)[1]
    assert np.median(depth) == pytest.approx(BASE_DEPTH_MM, abs=1e-3)
    assert depth.min() >= BASE_DEPTH_MM - 1e-3
    # Only corners of concave creases go deeper.
    assert np.mean(depth > BASE_DEPTH_MM + 0.01) < 0.03


@settings(max_examples=20, deadline=None)
@given(weights=st.tuples(*[st.floats(0, 1)] * 3))
def test_every_weight_leaves_enamel_everywhere(case: Case, weights: tuple[float, float, float]) -> None:
    assert case.smallest_depth_mm(weights) >= CLEARANCE_MM - GRID_ERROR_MM
    moved = Mesh(case.shape.vertices_mm(weights), case.shape.base.faces)
    moved.require_solid("dentin")
    # Smoothness of the modes: hardly any triangle turns over, even where opposite walls have come close.
    before, after = (trimesh.Trimesh(m.vertices_mm, m.faces, process=False).face_normals for m in (case.shape.base, moved))
    assert np.mean((before * after).sum(axis=1) < 0) < 2e-3


def test_each_mode_moves_along_its_axis_and_thickens_enamel(case: Case) -> None:
    assert len(MODES) == len(case.shape.modes_mm) == 3
    for mode, axis in zip(case.shape.modes_mm, case.frame.axes[[1, 0, 2]], strict=True):
        np.testing.assert_allclose(mode - np.outer(mode @ axis, axis), 0, atol=1e-12)
        assert np.abs(mode).max() > 0.3
    volumes = [Mesh(case.shape.vertices_mm(c), case.shape.base.faces).signed_volume_mm3() for c in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1))]
    assert volumes == sorted(volumes, reverse=True)


@pytest.mark.parametrize("fdi", [13, 16, 36, 45])
def test_other_teeth_of_a_scan_have_a_blend_shape_too(fdi: int) -> None:
    tooth = Case(read_mesh(shared_path(f"data/intraoral-photos/ref_mesh/Ref_Mesh_Tag=0_FDI={fdi}.obj")), ToothFrame.identity())
    for weights in np.random.default_rng(fdi).random((5, 3)):
        assert tooth.smallest_depth_mm(tuple(weights)) >= CLEARANCE_MM - GRID_ERROR_MM


def test_full_weights_reach_the_full_depth_where_the_tooth_is_thick() -> None:
    outer, _ = procedural()
    shape = dentin_blend_shape(outer)
    full = shape.vertices_mm((1, 1, 1))
    depth = SurfaceDistance(outer).closest(full)[1]
    # The labial wall above the cervix, where each side has more than 2.5 mm: 1.5 mm, less what smoothing takes near the thinner parts.
    thick = (np.abs(shape.base.vertices_mm[:, 0]) < 1.5) & (np.abs(shape.base.vertices_mm[:, 2] + 1.5) < 1.0) & (shape.base.vertices_mm[:, 1] > 0)
    assert thick.sum() > 10
    np.testing.assert_allclose(depth[thick], FULL_DEPTH_MM, atol=0.1)


def test_building_is_deterministic_and_of_the_size_asked_for() -> None:
    outer, _ = procedural()
    coarse, again, fine = (dentin_blend_shape(outer, faces=faces) for faces in (2000, 2000, 8000))
    assert np.array_equal(coarse.modes_mm, again.modes_mm)
    assert 1500 < len(coarse.base.faces) < 2500
    assert 6000 < len(fine.base.faces) < 10000


def test_a_shell_without_room_for_dentin_is_refused() -> None:
    plate = trimesh.creation.box(extents=(8.0, 0.15, 8.0)).subdivide().subdivide()
    with pytest.raises(MeshError, match="no closed surface"):
        dentin_blend_shape(Mesh(np.asarray(plate.vertices), np.asarray(plate.faces, dtype=np.int32)))


def test_an_open_enamel_mesh_is_refused() -> None:
    outer, _ = procedural()
    with pytest.raises(MeshError, match="not watertight"):
        dentin_blend_shape(Mesh(outer.vertices_mm, outer.faces[5:]))
