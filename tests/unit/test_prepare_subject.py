"""Which teeth of a capture are prepared, and which only hide or shadow them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from services.core.errors import CaptureInputError
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Camera, Mesh
from services.preprocess.subject import read_subject
from tests.support.folder_captures import prepare, write_folder

CAMERA = Camera(
    name="front",
    size=(64, 48),
    K=((4000, 0, 32), (0, 4000, 24), (0, 0, 1)),
    camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1000), (0, 0, 0, 1)),
)


def write_ball(path: Path, centre_mm: tuple[float, float, float]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4)
    write_mesh(path, Mesh(np.asarray(ball.vertices) + centre_mm, np.asarray(ball.faces, dtype=np.int32)))


@pytest.fixture
def two_teeth(tmp_path: Path) -> Path:
    """Two teeth; 21 is nearer to the camera and hides half of 11."""
    write_ball(tmp_path / "teeth" / "11" / "outer.ply", (0, 0, 0))
    write_ball(tmp_path / "teeth" / "21" / "outer.ply", (4, 0, -10))
    return tmp_path


def test_the_tooth_that_is_named_is_seen_alone_behind_the_others(two_teeth: Path) -> None:
    both, one = read_subject(two_teeth, whole=False), read_subject(two_teeth, whole=False, fdi=11)
    assert [tooth.fdi for tooth in one.teeth] == [11]
    seen = both.footprint_in(CAMERA).mesh
    np.testing.assert_array_equal(one.footprint_in(CAMERA).mesh == 0, seen == 0)
    # The other tooth hides a part of it; that part does not count as tooth.
    assert (seen == 1).sum() > 100
    assert not ((one.footprint_in(CAMERA).mesh >= 0) & (seen == 1)).any()


def test_others_and_gums_are_in_the_way(two_teeth: Path) -> None:
    write_ball(two_teeth / "gums.ply", (0, 6, 0))
    subject = read_subject(two_teeth, whole=False, fdi=11)
    ways = [mesh.vertices_mm.mean(axis=0) for mesh in subject.occluders]
    np.testing.assert_allclose(ways, [(4, 0, -10), (0, 6, 0)], atol=1e-3)
    assert len(read_mesh(two_teeth / "gums.ply").faces) == len(subject.occluders[1].faces)


def test_a_tooth_that_is_not_there_is_refused(two_teeth: Path) -> None:
    with pytest.raises(CaptureInputError, match="names tooth 12, but the capture has 11, 21; name one of these"):
        read_subject(two_teeth, whole=False, fdi=12)


def test_a_preparation_holds_the_named_tooth_alone(tmp_path: Path) -> None:
    write_folder(tmp_path / "capture")
    write_ball(tmp_path / "capture" / "teeth" / "21" / "outer.ply", (9, 0, 0))
    manifest = prepare(tmp_path / "capture", tmp_path / "job", fdi=11)
    assert manifest.fdi == (11,)
    assert not (tmp_path / "job" / "prepared" / "teeth" / "21").exists()
