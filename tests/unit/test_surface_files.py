"""Triangles of OBJ and PLY files: in the file's own order, by the vertices that its lines name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from services.core.errors import CaptureInputError
from services.core.files.meshes import read_mesh
from services.core.files.scans import read_scan_file
from tests.support.shared_data import shared_path

BALL = trimesh.creation.icosphere(subdivisions=1, radius=4.0)
CENTRES = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])


def lines_of(*, relative: bool, materials: int = 1) -> list[str]:
    """Three balls, each an object of its own, whose triangles take turns in their materials."""
    lines, before = [], 0
    for k, centre in enumerate(CENTRES):
        vertices = BALL.vertices + centre
        lines += [f"o tooth{k}", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices)]
        lines += ["vn 0 0 1", "vt 0 0"]
        for n, face in enumerate(BALL.faces):
            if materials > 1:
                lines.append(f"usemtl m{n % materials}")
            numbers = face - len(vertices) if relative else face + before + 1
            lines.append("f " + " ".join(f"{one}/{-1 if relative else k + 1}/-1" for one in numbers))
        before += len(vertices)
    return lines


FACES = np.concatenate([BALL.faces + 42 * k for k in range(3)])
VERTICES = np.concatenate([BALL.vertices + centre for centre in CENTRES])


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("materials", [1, 3])
def test_an_obj_keeps_its_own_order(relative: bool, materials: int, tmp_path: Path) -> None:
    (tmp_path / "scan.obj").write_text("\n".join(lines_of(relative=relative, materials=materials)))
    found = read_scan_file(tmp_path / "scan.obj").mesh
    np.testing.assert_allclose(found.vertices_mm, VERTICES, atol=1e-6)
    np.testing.assert_array_equal(found.faces, FACES)
    tooth = read_mesh(tmp_path / "scan.obj")
    np.testing.assert_allclose(tooth.vertices_mm[tooth.faces], VERTICES[FACES].astype(np.float64), atol=1e-6)


def test_polygons_comments_and_joined_lines(tmp_path: Path) -> None:
    text = "# box\nv 0 0 0 1 0 0 # red\nv 1 0 0\nv 1 1 0\nv 0 1 \\\n0\nf 1 2 \\\n3 4\nl 1 2\nf 4 3 -4\n"
    (tmp_path / "x.obj").write_text(text)
    found = read_scan_file(tmp_path / "x.obj").mesh
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 0]])
    np.testing.assert_array_equal(found.vertices_mm[3], [0, 1, 0])


POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar {kind} vertex_indices
end_header
0 0 0
1 0 0
0 1 0
0 0 1
{faces}"""
DAMAGED = {
    "index 0": ("x.obj", f"{POINTS}f 0 1 2\n", "line 4: a face names vertex 0"),
    "too far back": ("x.obj", f"{POINTS}f -4 1 2\n", "line 4: a face names vertex -4"),
    "too high": ("x.obj", f"{POINTS}f 1 2 4\n", "names vertex 4 of 3"),
    "a fraction": ("x.obj", f"{POINTS}f 1 2 2.5\n", "line 4"),
    "two corners": ("x.obj", f"{POINTS}f 1 2\n", "fewer than three corners"),
    "a point of two numbers": ("x.obj", "v 0 0\n", "line 1"),
    "a fraction in a PLY": ("x.ply", PLY.format(kind="int", faces="3 0 1 2\n3 0 1.5 3\n"), "names vertex 1.5"),
    "floating-point indices": ("x.ply", PLY.format(kind="float", faces="3 0 1 2\n3 0 1 3\n"), "not whole"),
    "255 of 3": ("x.ply", PLY.format(kind="int", faces="3 0 1 2\n255 0 1 3\n"), "states 255 corners and has 3"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_indices_are_refused(case: str, tmp_path: Path) -> None:
    file, text, words = DAMAGED[case]
    (tmp_path / file).write_text(text)
    for read in (read_mesh, read_scan_file):
        with pytest.raises(CaptureInputError, match=f"{words}.*; export it again"):
            read(tmp_path / file)


def test_a_binary_list_of_another_length_is_refused(tmp_path: Path) -> None:
    content = bytearray(BALL.export(file_type="ply"))
    content[-13] = 255  # the count before the last three indices
    (tmp_path / "x.ply").write_bytes(bytes(content))
    with pytest.raises(CaptureInputError, match="face 80 states 255 corners"):
        read_mesh(tmp_path / "x.ply")


def test_relative_indices_of_a_stranger() -> None:
    found = read_scan_file(shared_path("data/strangers-files/obj/negint.obj")).mesh
    used = found.vertices_mm[np.unique(found.faces)]
    assert (round(used[:, 0].min()), round(used[:, 0].max())) == (-4, 24)
