"""Which teeth of a capture are prepared, and which only hide or shadow them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from services.core.errors import CaptureInputError, MeshError
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Camera, Mesh
from services.core.raw.registration import REGISTRATION
from services.core.records import JobSpec
from services.fit.measurements.observations import read_observations
from services.preprocess.views.subject import read_subject
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


def test_surroundings_are_rendered_where_asked_or_registered(two_teeth: Path) -> None:
    write_ball(two_teeth / "gums.ply", (0, 6, 0))
    alone, around = (read_subject(two_teeth, False, 11, surroundings) for surroundings in ("auto", "on"))
    assert (alone.surroundings, len(alone.rendered_meshes())) == (False, 1)
    assert (around.surroundings, len(around.rendered_meshes())) == (True, 3)
    np.testing.assert_array_equal(alone.footprint_in(CAMERA).mesh, around.footprint_in(CAMERA).mesh)
    (two_teeth / REGISTRATION).write_text("{}")
    assert read_subject(two_teeth, False, 11, "auto").surroundings
    assert not read_subject(two_teeth, False, 11, surroundings="off").surroundings
    # A jaw is fitted whole, and a tooth that has nothing around it is alone.
    assert not read_subject(two_teeth, True, None, "on").surroundings
    (two_teeth / "gums.ply").unlink()
    assert not read_subject(two_teeth, False, None, surroundings="on").surroundings


def test_a_preparation_with_surroundings_holds_their_surfaces(tmp_path: Path) -> None:
    write_folder(tmp_path / "capture")
    write_ball(tmp_path / "capture" / "teeth" / "21" / "outer.ply", (9, 0, 0))
    write_ball(tmp_path / "capture" / "gums.ply", (4, 8, 0))
    manifest = prepare(tmp_path / "capture", tmp_path / "job", fdi=11, surroundings="on")
    assert (manifest.fdi, manifest.surroundings) == ((11,), True)
    assert "Rendered around tooth 11, with light passing between them: gums, 21." in manifest.notes
    observations = read_observations(tmp_path / "job", JobSpec(capture=tmp_path / "capture", fdi=11))
    assert [tooth.fdi for tooth in observations.neighbours] == [21]
    assert observations.gums is not None


def test_gums_that_are_rendered_must_be_closed(two_teeth: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=4)
    faces = np.asarray(ball.faces[5:], dtype=np.int32)
    write_mesh(two_teeth / "gums.ply", Mesh(np.asarray(ball.vertices) + np.array([0, 6, 0]), faces))
    assert read_subject(two_teeth, False, 11).gums is not None
    with pytest.raises(MeshError, match=r"gums\.ply"):
        read_subject(two_teeth, False, 11, surroundings="on")
