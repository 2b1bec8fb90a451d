"""Scans in every format: with labels beside them, in other units, damaged, and with whole roots."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from services.anatomy.scans.scan import LabelledScan, read_scan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.anatomy.scans.units import MM_PER_UNIT, PLAUSIBLE_RATIO, Unit, neighbour_ratio
from services.anatomy.templates.dimensions import root_length_mm
from services.core.errors import CaptureInputError, MeshError
from services.core.files import scans
from services.core.geometry import Mesh
from tests.support.labelled_scan import PITCH_MM, bumps, universal, write_labelled_ply, write_vtp
from tests.support.shared_data import shared_path

SCAN = bumps({11: (-4.5, 0.0), 21: (4.5, 0.0)})
FOUR = bumps({12: (-12.5, -6.0), 11: (-4.5, 0.0), 21: (4.5, 0.0), 22: (12.5, -6.0)})


def exported(path: Path, mesh: Mesh = SCAN.mesh) -> Path:
    trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).export(path)
    return path


def vertex_labels() -> np.ndarray:
    # A vertex belongs to a tooth if any of its triangles does, so the border may move by a triangle.
    labels = np.zeros(len(SCAN.mesh.vertices_mm), dtype=np.int64)
    for tooth in SCAN.teeth:
        labels[SCAN.mesh.faces[SCAN.fdi == tooth]] = tooth
    return labels


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_a_label_a_triangle_may_lie_in_a_file_beside_the_scan(tmp_path: Path, suffix: str) -> None:
    path = exported(tmp_path / f"scan.{suffix}")
    np.savetxt(tmp_path / "labels.txt", SCAN.fdi, fmt="%d")
    scan = read_scan(path, "fdi", "labels.txt")
    np.testing.assert_array_equal(scan.fdi, SCAN.fdi)
    # trimesh merges vertices independently and must count as many.
    assert len(scan.mesh.vertices_mm) == len(trimesh.load_mesh(path).vertices) == len(SCAN.mesh.vertices_mm)
    assert scan.doubled_vertices == (3 * len(SCAN.fdi) - len(SCAN.mesh.vertices_mm) if suffix == "stl" else 0)
    corners = scan.mesh.vertices_mm[scan.mesh.faces]
    np.testing.assert_allclose(corners, SCAN.mesh.vertices_mm[SCAN.mesh.faces], atol=1e-5)


@pytest.mark.parametrize("beside", ["labels.json", "labels.npy", "labels.csv"])
def test_a_label_a_vertex_names_the_triangles_too(tmp_path: Path, beside: str) -> None:
    path, labels = exported(tmp_path / "scan.obj"), vertex_labels()
    if beside.endswith("json"):
        (tmp_path / beside).write_text(json.dumps({"jaw": "upper", "labels": labels.tolist()}))
    elif beside.endswith("npy"):
        np.save(tmp_path / beside, labels)
    else:
        np.savetxt(tmp_path / beside, labels, fmt="%d")
    scan = read_scan(path, "either", beside)
    assert scan.teeth == (11, 21)
    assert (scan.fdi == SCAN.fdi).mean() > 0.95


def test_either_numbering_is_told_by_the_labels(tmp_path: Path) -> None:
    write_vtp(tmp_path / "universal.vtp", SCAN.mesh, universal(SCAN.fdi))
    write_labelled_ply(tmp_path / "fdi.ply", SCAN.mesh, SCAN.fdi)
    for name in ("universal.vtp", "fdi.ply"):
        assert read_scan(tmp_path / name, "either").teeth == (11, 21)


@pytest.mark.parametrize("unit", ["mm", "cm", "m", "inch"])
@pytest.mark.parametrize("said", ["mm", "cm", "m", "inch"])
def test_the_unit_is_judged_by_the_teeth(tmp_path: Path, unit: Unit, said: Unit) -> None:
    mesh = Mesh(SCAN.mesh.vertices_mm / MM_PER_UNIT[unit], SCAN.mesh.faces)
    write_vtp(tmp_path / "scan.vtp", mesh, universal(SCAN.fdi))
    if unit == said:
        scan = read_scan(tmp_path / "scan.vtp", units=said)
        np.testing.assert_allclose(scan.mesh.vertices_mm, SCAN.mesh.vertices_mm, atol=1e-9)
    else:
        with pytest.raises(MeshError, match=rf"if its unit is {said}; it seems to be in {unit}: say units = '{unit}'"):
            read_scan(tmp_path / "scan.vtp", units=said)


def test_damage_is_mended_and_counted() -> None:
    # A hole far from the teeth, a copy of a triangle, and one at an edge that has two already.
    middles = SCAN.mesh.vertices_mm[SCAN.mesh.faces].mean(axis=1)
    centre = middles[np.abs(middles[:, 1]).argmax()] * [0, 0.7, 0]
    away = np.linalg.norm(middles - centre, axis=1) > 1.0
    assert not away.all()
    first = SCAN.mesh.faces[away][0]
    faces = np.concatenate([SCAN.mesh.faces[away], [first], [[first[0], first[1], len(SCAN.mesh.vertices_mm) - 1]]])
    damaged = LabelledScan(Mesh(SCAN.mesh.vertices_mm, faces.astype(np.int32)), np.append(SCAN.fdi[away], [0, 0]), 7)
    jaw = jaw_from_scan(damaged)
    assert jaw.repairs.doubled_vertices == 7
    assert 2 <= jaw.repairs.removed_triangles <= 6
    assert len(jaw.repairs.holes_mm) == 1
    # Around a hole of 1 mm radius along triangles' edges.
    assert 2 * np.pi < jaw.repairs.holes_mm[0] < 2 * np.pi + 16 * PITCH_MM
    assert "1 holes closed" in jaw.repairs.sentence()
    assert jaw_from_scan(SCAN).repairs.sentence().startswith("0 doubled vertices joined, 0 triangles removed")


def test_a_mirror_image_is_refused() -> None:
    mirrored = FOUR.mesh.vertices_mm * [-1, 1, 1]
    with pytest.raises(CaptureInputError, match="inside out or a mirror image"):
        jaw_from_scan(replace(FOUR, mesh=Mesh(mirrored, FOUR.mesh.faces)))
    with pytest.raises(CaptureInputError, match="wrong way around the arch; exchange left and right"):
        jaw_from_scan(replace(FOUR, mesh=Mesh(mirrored, FOUR.mesh.faces[:, ::-1].copy())))


def test_whole_roots_are_as_long_as_those_of_their_kind() -> None:
    stubs, whole = jaw_from_scan(FOUR), jaw_from_scan(FOUR, "whole")
    for short, long, frame in zip(stubs.teeth, whole.teeth, whole.frames, strict=True):
        long.outer.require_solid(f"tooth {long.fdi}")
        heights = [np.ptp(frame.canonical_from_world(tooth.outer.vertices_mm)[:, 2]) for tooth in (short, long)]
        assert heights[1] - heights[0] == pytest.approx(root_length_mm(long.fdi % 10, is_upper=True) - 4.0, abs=1e-6)


@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_too_many_triangles_are_refused_before_they_are_read(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = exported(tmp_path / f"scan.{suffix}")
    monkeypatch.setattr(scans, "MAX_TRIANGLES", 1000)
    monkeypatch.setattr(scans, "_read_by_trimesh", None)
    with pytest.raises(CaptureInputError, match=r"has [\d,]+ triangles, more than 1,000; reduce it"):
        read_scan(path)


def test_labels_of_another_count_or_none_are_named(tmp_path: Path) -> None:
    path = exported(tmp_path / "scan.stl")
    with pytest.raises(CaptureInputError, match="or name a file of labels beside it"):
        read_scan(path)
    with pytest.raises(CaptureInputError, match=r"Label file .*labels.txt does not exist"):
        read_scan(path, labels="labels.txt")
    (tmp_path / "labels.txt").write_text("0\n11\n")
    with pytest.raises(CaptureInputError, match=r"labels of shape \(2,\) for \d+ triangles and \d+ vertices"):
        read_scan(path, labels="labels.txt")
    (tmp_path / "labels.json").write_text('{"label": []}')
    with pytest.raises(CaptureInputError, match=r"labels.json cannot be read \('labels'\)"):
        read_scan(path, labels="labels.json")


def test_the_other_jaw_than_said_is_refused(tmp_path: Path) -> None:
    write_vtp(tmp_path / "scan.vtp", SCAN.mesh, universal(SCAN.fdi))
    with pytest.raises(CaptureInputError, match="said to be of the lower jaw, but its labels name teeth of the upper"):
        read_scan(tmp_path / "scan.vtp", jaw="lower")


def test_a_real_arch_is_in_millimetres_and_trimesh_counts_its_points_alike(tmp_path: Path) -> None:
    scan = read_scan(shared_path("data/intraoral-arch/Example_01.vtp"), "either", jaw="upper")
    middles = [scan.mesh.vertices_mm[scan.mesh.faces[scan.fdi == n]].mean(axis=(0, 1)) for n in scan.teeth]
    ratio = neighbour_ratio(scan.teeth, np.array(middles))
    assert ratio is not None
    assert PLAUSIBLE_RATIO[0] < ratio < PLAUSIBLE_RATIO[1]
    np.save(tmp_path / "labels.npy", scan.fdi)
    again = read_scan(exported(tmp_path / "scan.stl", scan.mesh), "either", "labels.npy")
    # The description of the data, and trimesh's merging, give the same number.
    assert len(again.mesh.vertices_mm) == len(trimesh.load_mesh(tmp_path / "scan.stl").vertices) == 50_643
    np.testing.assert_array_equal(again.fdi, scan.fdi)
