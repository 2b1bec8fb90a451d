"""Vertices that no triangle uses are left out, wherever they lie, and it is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from services.anatomy.scans.scan import read_scan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.core.files.meshes import read_mesh, read_teeth
from services.core.geometry import Mesh
from services.preprocess.views.subject import read_subject
from tests.support.labelled_scan import bumps, write_labelled_ply

FAR = np.full((40, 3), 900.0)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A ball of a tooth's size, whose file has 40 vertices beside it that no triangle uses."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=4.0)
    folder = tmp_path / "teeth" / "11"
    folder.mkdir(parents=True)
    points = np.concatenate([ball.vertices, FAR])
    trimesh.Trimesh(points, ball.faces, process=False).export(folder / "outer.ply")
    return tmp_path


def test_a_teeths_unused_vertices_change_neither_its_size_nor_its_centre(capture: Path) -> None:
    mesh = read_mesh(capture / "teeth" / "11" / "outer.ply")
    assert np.abs(mesh.vertices_mm).max() < 4.001
    assert np.linalg.norm(mesh.vertices_mm.mean(axis=0)) < 1e-6
    assert mesh.dropped_vertices == len(FAR)
    assert [tooth.fdi for tooth in read_teeth(capture)] == [11]


def test_a_preparation_says_how_many(capture: Path) -> None:
    note = read_subject(capture, whole=False).note
    assert note == "Vertices that no triangle uses are left out: 40 of teeth/11/outer.ply."


def test_a_scans_unused_vertices_are_left_out(tmp_path: Path) -> None:
    scan = bumps({11: (-4.5, 0.0), 21: (4.5, 0.0)})
    apart = Mesh(np.concatenate([scan.mesh.vertices_mm, FAR[:1]]), scan.mesh.faces)
    write_labelled_ply(tmp_path / "scan.ply", apart, scan.fdi)
    read = read_scan(tmp_path / "scan.ply", "fdi", "label")
    np.testing.assert_array_equal(read.mesh.vertices_mm, scan.mesh.vertices_mm)
    assert "1 vertices that no triangle uses left out" in jaw_from_scan(read).repairs.sentence()
