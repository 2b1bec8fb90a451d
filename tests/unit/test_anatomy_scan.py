"""How labelled scans are read, and which are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.anatomy.scans.scan import LabelledScan, fdi_from_universal, read_scan
from services.core.errors import CaptureInputError, InputError, MeshError
from services.core.geometry import Mesh
from tests.support.labelled_scan import bumps, universal, write_labelled_ply, write_vtp

SCAN = bumps({11: (-4.5, 0.0), 21: (4.5, 0.0)})


def require_same(found: LabelledScan, expected: LabelledScan) -> None:
    np.testing.assert_array_equal(found.mesh.vertices_mm, expected.mesh.vertices_mm)
    np.testing.assert_array_equal(found.mesh.faces, expected.mesh.faces)
    np.testing.assert_array_equal(found.fdi, expected.fdi)


@pytest.mark.parametrize(
    "options",
    [
        {"form": "ascii"},
        {"form": "inline"},
        {"form": "inline", "compressed": False},
        {"form": "inline", "compressed": False, "joined": True, "header_type": "UInt64"},
        {"form": "appended-base64"},
        {"form": "appended-base64", "header_type": "UInt64"},
        {"form": "appended-base64", "compressed": False, "joined": True},
        {"form": "appended-raw"},
        {"form": "appended-raw", "compressed": False, "byte_order": "BigEndian"},
    ],
)
def test_every_way_of_writing_polydata_reads_the_same(tmp_path: Path, options: dict[str, Any]) -> None:
    write_vtp(tmp_path / "scan.vtp", SCAN.mesh, universal(SCAN.fdi), **options)
    require_same(read_scan(tmp_path / "scan.vtp"), SCAN)


def test_a_labelled_ply_reads_the_same(tmp_path: Path) -> None:
    write_labelled_ply(tmp_path / "scan.ply", SCAN.mesh, SCAN.fdi)
    require_same(read_scan(tmp_path / "scan.ply", numbering="fdi"), SCAN)


def test_universal_numbers_run_from_upper_right_to_lower_right() -> None:
    assert [fdi_from_universal(n) for n in range(1, 33)] == [
        *range(18, 10, -1),
        *range(21, 29),
        *range(38, 30, -1),
        *range(41, 49),
    ]
    with pytest.raises(InputError, match="permanent teeth are 1 to 32"):
        fdi_from_universal(33)


def relabelled(old: int, new: float) -> np.ndarray:
    labels = universal(SCAN.fdi).astype(float)
    return np.where(labels == old, new, labels)


@pytest.mark.parametrize(
    ("labels", "sentence"),
    [
        (None, "no label per triangle named Label \\(it has: none\\)"),
        (relabelled(8, 40), "label 40, which names no tooth in universal numbering"),
        (relabelled(8, 8.5), "label 8.5, which names no tooth"),
        (relabelled(8, np.nan), "label nan, which names no tooth"),
        (relabelled(0, 7), "no gingiva"),
        (relabelled(9, 0), "1 labelled teeth; export at least two"),
        (relabelled(9, 24), "teeth of both jaws \\(11, 31\\)"),
    ],
)
def test_labels_that_cannot_be_used_end_in_a_sentence(tmp_path: Path, labels: np.ndarray | None, sentence: str) -> None:
    write_vtp(tmp_path / "scan.vtp", SCAN.mesh, labels)
    with pytest.raises(CaptureInputError, match=sentence):
        read_scan(tmp_path / "scan.vtp")


def test_metres_are_refused(tmp_path: Path) -> None:
    write_vtp(tmp_path / "scan.vtp", Mesh(SCAN.mesh.vertices_mm / 1000, SCAN.mesh.faces), universal(SCAN.fdi))
    with pytest.raises(MeshError, match="it seems to be in m: say units = 'm'"):
        read_scan(tmp_path / "scan.vtp")


@pytest.mark.parametrize("form", ["ascii", "inline", "appended-base64", "appended-raw"])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.95])
def test_a_truncated_file_is_named(tmp_path: Path, form: str, share: float) -> None:
    path = tmp_path / "scan.vtp"
    write_vtp(path, SCAN.mesh, universal(SCAN.fdi), form=form)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CaptureInputError, match=r"scan\.vtp is truncated or no VTK XML file"):
        read_scan(path)


def test_appended_data_cut_short_inside_a_whole_document_are_named(tmp_path: Path) -> None:
    path = tmp_path / "scan.vtp"
    for form in ("appended-base64", "appended-raw"):
        write_vtp(path, SCAN.mesh, universal(SCAN.fdi), form=form)
        content = path.read_bytes()
        end = content.index(b"\n</AppendedData>")
        path.write_bytes(content[: end - 4000] + content[end:])
        with pytest.raises(CaptureInputError, match="truncated"):
            read_scan(path)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('type="PolyData"', 'type="UnstructuredGrid"', "holds VTK UnstructuredGrid"),
        ("vtkZLibDataCompressor", "vtkLZ4DataCompressor", "compressed by vtkLZ4DataCompressor"),
        ('NumberOfStrips="0"', 'NumberOfStrips="2"', "polygons or strips besides triangles"),
        ('<?xml version="1.0"?>', '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]>', "declares XML entities"),
        ('type="Int64"', 'type="String"', "'String'"),
    ],
)
def test_files_of_another_kind_end_in_a_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    path = tmp_path / "scan.vtp"
    write_vtp(path, SCAN.mesh, universal(SCAN.fdi))
    path.write_bytes(path.read_bytes().replace(old.encode(), new.encode()))
    with pytest.raises(CaptureInputError, match=sentence):
        read_scan(path)


def test_triangles_of_points_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    faces = SCAN.mesh.faces.copy()
    faces[5, 1] = len(SCAN.mesh.vertices_mm)
    write_vtp(tmp_path / "scan.vtp", Mesh(SCAN.mesh.vertices_mm, faces), universal(SCAN.fdi))
    with pytest.raises(CaptureInputError, match="a triangle names point"):
        read_scan(tmp_path / "scan.vtp")


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("a.vtp", r"a\.vtp does not exist"),
        ("a.ply", r"a\.ply does not exist"),
        ("a.glb", "neither .vtp, .ply, .stl nor .obj"),
    ],
)
def test_missing_and_unlabelled_formats_are_named(tmp_path: Path, name: str, sentence: str) -> None:
    with pytest.raises(CaptureInputError, match=sentence):
        read_scan(tmp_path / name)


def test_a_ply_without_labels_or_content_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    write_labelled_ply(path, SCAN.mesh, SCAN.fdi)
    path.write_text(path.read_text().replace("property int label", "property int shade"))
    with pytest.raises(CaptureInputError, match=r"named Label \(it has: shade\)"):
        read_scan(path)
    path.write_text("ply\nnothing")
    with pytest.raises(CaptureInputError, match="cannot be read"):
        read_scan(path)
