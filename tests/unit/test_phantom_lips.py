"""Lips and retractor of a virtual jaw: solid, in front of the teeth, and open enough to see them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from services.core.geometry import Mesh
from services.phantom.dome_rig import dome_cameras
from services.phantom.jaw import JawSurfaces, jaw_surfaces
from services.phantom.lips import LIP_RADIUS_MM, lips_and_retractor
from services.preprocess.views.projection import project


@pytest.fixture(scope="module")
def surfaces() -> JawSurfaces:
    return jaw_surfaces()


@pytest.fixture(scope="module")
def teeth(surfaces: JawSurfaces) -> list[Mesh]:
    return [tooth.outer for tooth in surfaces.teeth]


@pytest.fixture(scope="module")
def lips(teeth: list[Mesh]) -> Mesh:
    return lips_and_retractor(teeth)


def test_they_are_solids_that_face_outwards(lips: Mesh) -> None:
    """A ring of round section with this middle line has the volume 2 π² R r²; a surface that faces inwards would have
    the opposite sign.
    """
    edges = lips.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    count = len(lips.vertices_mm)
    _, part = connected_components(coo_matrix((np.ones(edges.shape[1]), tuple(edges)), shape=(count, count)))
    ring = trimesh.Trimesh(lips.vertices_mm, lips.faces[part[lips.faces[:, 0]] == part[0]], process=False)
    assert ring.is_watertight
    length_mm = ring.area / (2 * np.pi * LIP_RADIUS_MM)
    assert ring.volume == pytest.approx(np.pi * LIP_RADIUS_MM**2 * length_mm, rel=0.1)


def test_they_stand_before_the_teeth_without_touching(lips: Mesh, teeth: list[Mesh]) -> None:
    gap_mm = cKDTree(np.concatenate([tooth.vertices_mm for tooth in teeth])).query(lips.vertices_mm)[0].min()
    assert gap_mm > 1.0


def test_the_front_camera_sees_the_front_teeth_between_them(
    lips: Mesh, teeth: list[Mesh], surfaces: JawSurfaces
) -> None:
    camera = dome_cameras(3, 1.0, tuple(teeth))[1]
    fdi = [tooth.fdi for tooth in surfaces.teeth]
    free, hidden = project(camera, teeth).mesh, project(camera, teeth, [lips]).mesh
    for number in (11, 21, 12, 22):
        place = fdi.index(number)
        assert (hidden == place).sum() > 0.8 * (free == place).sum()
