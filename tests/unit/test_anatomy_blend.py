"""The dentin blend shape: a closed solid inside the enamel for every weight."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from services.anatomy.blend import BASE_DEPTH_MM, CLEARANCE_MM, FULL_DEPTH_MM, MODES, dentin_blend_shape
from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SignedDistanceGrid, SurfaceDistance
from services.anatomy.frame import ToothFrame, estimate_frame
from services.anatomy.templates.dimensions import upper_tooth
from services.anatomy.templates.incisor import build_incisor
from services.core.errors import MeshError
from services.core.files.meshes import read_mesh
from services.core.geometry import Mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from tests.support.phantom_bodies import phantom_jaw
from tests.support.shared_data import shared_path

GRID_ERROR_MM = 0.02
"""Error of a depth interpolated trilinearly between grid points 0.1 mm apart, at the sharpest edges of the scans."""


def scanned_incisor() -> tuple[Mesh, ToothFrame]:
    root = shared_path("data/tooth-ur1-truth")
    cameras = read_record(root / "capture.json", FolderCapture).cameras
    outer = read_mesh(root / "teeth/11/outer.ply")
    return outer, estimate_frame(outer, np.array([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in cameras]))


def scanned_crown() -> tuple[Mesh, ToothFrame]:
    outer = read_mesh(shared_path("data/intraoral-photos/ref_mesh/Ref_Mesh_Tag=0_FDI=11.obj"))
    return outer, estimate_frame(outer, np.array([[0.0, 0.0, 1000.0]]))


def procedural() -> tuple[Mesh, ToothFrame]:
    return build_incisor().outer, ToothFrame.identity()


class Case:
    def __init__(self, outer: Mesh, frame: ToothFrame) -> None:
        self.outer, self.frame = outer, frame
        self.shape: DentinShape = dentin_blend_shape(outer, frame)
        # In the canonical frame the tooth's box is smallest.
        self.grid = SignedDistanceGrid(Mesh(frame.canonical_from_world(outer.vertices_mm), outer.faces), 0.1, 0.3)

    def smallest_depth_mm(self, weights: tuple[float, ...]) -> float:
        vertices = self.frame.canonical_from_world(self.shape.vertices_mm(weights))
        return float(self.grid.depth_mm(np.concatenate([vertices, vertices[self.shape.base.faces].mean(axis=1)])).min())


@cache
def made(make: Callable[[], tuple[Mesh, ToothFrame]]) -> Case:
    return Case(*make())


@pytest.fixture(scope="module", params=[procedural, scanned_incisor, scanned_crown], ids=lambda make: make.__name__)
def case(request: pytest.FixtureRequest) -> Case:
    return made(request.param)


def test_base_is_a_solid_a_tenth_of_a_millimetre_inside(case: Case) -> None:
    case.shape.base.require_solid("base")
    depth = case.grid.surface.closest(case.frame.canonical_from_world(case.shape.base.vertices_mm))[1]
    assert np.median(depth) == pytest.approx(BASE_DEPTH_MM, abs=1e-3)
    assert depth.min() >= BASE_DEPTH_MM - 1e-3
    # Only corners of concave creases are deeper.
    assert np.mean(depth > BASE_DEPTH_MM + 0.01) < 0.03


@settings(max_examples=20, deadline=None)
@given(weights=st.tuples(*[st.floats(0, 1)] * 3))
def test_every_weight_leaves_enamel_everywhere(case: Case, weights: tuple[float, float, float]) -> None:
    assert case.smallest_depth_mm(weights) >= CLEARANCE_MM - GRID_ERROR_MM
    moved = Mesh(case.shape.vertices_mm(weights), case.shape.base.faces)
    moved.require_solid("dentin")
    # The modes are smooth: hardly any triangle turns over, even where opposite walls have come close to each other.
    before, after = (
        trimesh.Trimesh(m.vertices_mm, m.faces, process=False).face_normals for m in (case.shape.base, moved)
    )
    assert np.mean((before * after).sum(axis=1) < 0) < 2e-3


def test_each_mode_moves_along_its_axis_and_thickens_enamel(case: Case) -> None:
    assert len(MODES) == len(case.shape.modes_mm) == 3
    for mode, axis in zip(case.shape.modes_mm, case.frame.axes[[1, 0, 2]], strict=True):
        along = np.outer(mode @ axis, axis)
        assert np.abs(along).max() > 0.3
        # Exact except where the crown narrows and the dentin is kept inside.
        assert np.square(mode - along).sum() <= 0.1 * np.square(mode).sum()
    volumes = [
        Mesh(case.shape.vertices_mm(c), case.shape.base.faces).signed_volume_mm3()
        for c in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1))
    ]
    assert volumes == sorted(volumes, reverse=True)


@pytest.mark.parametrize("fdi", [13, 36])
def test_other_teeth_of_a_scan_have_a_blend_shape_too(fdi: int) -> None:
    tooth = Case(
        read_mesh(shared_path(f"data/intraoral-photos/ref_mesh/Ref_Mesh_Tag=0_FDI={fdi}.obj")), ToothFrame.identity()
    )
    for weights in np.random.default_rng(fdi).random((5, 3)):
        assert tooth.smallest_depth_mm(tuple(weights)) >= CLEARANCE_MM - GRID_ERROR_MM


def test_weights_make_enamel_thicken_with_the_root_of_height() -> None:
    outer, _ = procedural()
    crown = upper_tooth(1)
    shape = dentin_blend_shape(outer, crown=crown)
    depth = SurfaceDistance(outer).closest(shape.vertices_mm((1, 1, 0)))[1]
    height = shape.base.vertices_mm[:, 2] - (outer.vertices_mm[:, 2].max() - crown.crown_length_mm)
    # The middle of the labial wall, where each side has room: the depth is that of the rule, less what smoothing takes
    # away. On the root nothing moves.
    wall = (
        (np.abs(shape.base.vertices_mm[:, 0]) < 1.5)
        & (shape.base.vertices_mm[:, 1] > 0)
        & (height > 1.5)
        & (height < 4.5)
    )
    assert wall.sum() > 10
    rule = BASE_DEPTH_MM + (FULL_DEPTH_MM - BASE_DEPTH_MM) * np.sqrt(height[wall] / crown.crown_length_mm)
    np.testing.assert_allclose(depth[wall], rule, atol=0.15)
    np.testing.assert_allclose(shape.modes_mm[:, height < -0.1], 0, atol=GRID_ERROR_MM)


@pytest.mark.parametrize(
    ("fdi", "weights"),
    [(11, (0.55, 0.55, 1.0)), (13, (0.55, 0.55, 0.55)), (14, (0.55, 0.55, 0.55)), (16, (0.55, 0.55, 0.55))],
)
def test_some_weights_are_near_the_dentin_of_other_makers(fdi: int, weights: tuple[float, float, float]) -> None:
    # The phantom's dentin does not come from this family; these are the nearest of 64 combinations of weights. Bound:
    # the 0.15 mm that a fit is to reach on average on this half of the crown.
    tooth = phantom_jaw(1).tooth(fdi)
    shape = dentin_blend_shape(tooth.outer, tooth.frame, crown=upper_tooth(fdi % 10))
    height = tooth.outer.vertices_mm @ tooth.frame.axes[2]
    points = tooth.outer.vertices_mm[height > height.max() - upper_tooth(fdi % 10).crown_length_mm / 2][::7]
    true = SurfaceDistance(tooth.dentin).closest(points)[1]
    found = SurfaceDistance(Mesh(shape.vertices_mm(weights), shape.base.faces)).closest(points)[1]
    assert np.abs(found - true).mean() < 0.15


def test_building_is_deterministic_and_of_the_size_asked_for() -> None:
    outer, _ = procedural()
    coarse, again, first = dentin_blend_shape(outer, faces=2000), dentin_blend_shape(outer), made(procedural).shape
    assert np.array_equal(first.modes_mm, again.modes_mm)
    assert 1500 < len(coarse.base.faces) < 2500
    assert 3000 < len(first.base.faces) < 5000


def test_a_shell_without_room_for_dentin_is_refused() -> None:
    plate = trimesh.creation.box(extents=(8.0, 0.15, 8.0)).subdivide().subdivide()
    with pytest.raises(MeshError, match="no closed surface"):
        dentin_blend_shape(Mesh(np.asarray(plate.vertices), np.asarray(plate.faces, dtype=np.int32)))


def test_an_open_enamel_mesh_is_refused() -> None:
    outer, _ = procedural()
    with pytest.raises(MeshError, match="not watertight"):
        dentin_blend_shape(Mesh(outer.vertices_mm, outer.faces[5:]))
