"""The grid of clearances never overstates the distance to the nearest surface, however often inner surfaces move;
scenes of equal surfaces measure them once.
"""

from __future__ import annotations

import gc

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from services.anatomy.distance import SurfaceDistance
from services.core.geometry import Mesh
from services.transport.platform import prepare_device

EDGE_MM, RADIUS_MM = (12.0, 6.0, 6.0), 1.5
ROUNDING_MM = 1e-4
"""Rounding error of positions and bounds in single precision."""


def ball(x_mm: float) -> Mesh:
    found = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS_MM)
    return Mesh(np.asarray(found.vertices) + np.array([x_mm, 0.0, 0.0]), np.asarray(found.faces, dtype=np.int32))


def test_bounds_hold_and_tell_something_as_surfaces_move() -> None:
    prepare_device()
    import mitsuba as mi

    from services.transport.scene.clearance import Clearance

    box = trimesh.creation.box(EDGE_MM).subdivide_to_size(1.0)
    outer = Mesh(np.asarray(box.vertices), np.asarray(box.faces, dtype=np.int32))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4000, 3)) * EDGE_MM
    grid = Clearance(outer.vertices_mm, outer.faces)
    # A small move only lowers the bound; after a large move distances are measured again; then one ball moves back.
    for left, right in ((-3.0, 3.0), (-3.08, 3.0), (-4.0, 3.0), (-3.0, 3.5)):
        inner = [ball(left), ball(right)]
        grid.move_inner(inner)
        bound = np.asarray(grid(mi.Point3f(*points.T.astype(np.float32)), mi.Bool(True)))
        true = np.min([SurfaceDistance(mesh).closest(points)[1] for mesh in (outer, *inner)], axis=0)
        assert (bound <= true + ROUNDING_MM).all()
        # The bound loses twice a cell's half diagonal, the spacing of samples and the slack of a small move: a third of
        # a millimetre with cells of 0.1 mm.
        assert np.mean(true - bound) < 0.35


def test_scenes_of_one_tooth_share_its_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_device()
    from services.transport.scene.clearance import Clearance

    measured: list[int] = []
    measure = Clearance._measure

    def counted(
        self: Clearance, vertices_mm: NDArray[np.float64], faces: NDArray[np.int32], window: tuple[slice, ...]
    ) -> NDArray[np.float64]:
        measured.append(len(faces))
        return measure(self, vertices_mm, faces, window)

    monkeypatch.setattr(Clearance, "_measure", counted)
    outer, inner, other = ball(0.31), ball(0.3), ball(0.45)
    outer = Mesh(2 * outer.vertices_mm, outer.faces)
    scenes = []
    for _ in range(3):
        scene = Clearance(outer.vertices_mm.copy(), outer.faces.copy())
        scene.move_inner([Mesh(inner.vertices_mm.copy(), inner.faces)])
        scenes.append(scene)
    assert len(measured) == 2, "a second scene of equal surfaces measures nothing"
    # A scene whose surface moved measures it, and leaves the others' distances as they are.
    tables = [np.array(scene._table) for scene in scenes]
    scenes[0].move_inner([other])
    assert len(measured) == 3
    assert not np.array_equal(np.array(scenes[0]._table), tables[0])
    np.testing.assert_array_equal(np.array(scenes[1]._table), tables[1])
    np.testing.assert_array_equal(tables[1], tables[0])
    # They are let go with the last scene that holds them.
    del scene
    scenes.clear()
    gc.collect()
    Clearance(outer.vertices_mm, outer.faces)
    assert len(measured) == 4
