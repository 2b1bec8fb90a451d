"""Separating teeth in scans without labels: a real arch whose labels are removed, and clicks that cannot be used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.anatomy.scans.patches import middle_mm, vector_area_mm2
from services.anatomy.scans.scan import LabelledScan, read_scan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.anatomy.scans.segmentation import segment_by_landmarks
from services.core.errors import CaptureInputError, MeshError
from services.core.geometry import Mesh
from tests.support.labelled_scan import CROWN_MM, bumps, write_vtp
from tests.support.shared_data import shared_path

PLACES = {12: (-12.5, -6.0), 11: (-4.5, 0.0), 21: (4.5, 0.0), 22: (12.5, -6.0)}
FOUR = bumps(PLACES)
TOPS = {fdi: np.array([[x, y, CROWN_MM]]) for fdi, (x, y) in PLACES.items()}


def clicked(scan: LabelledScan, rng: np.random.Generator, sigma_mm: float) -> dict[int, np.ndarray]:
    # One point for each tooth, above its middle near its top, with an error along each axis, on the nearest triangle of
    # the scan.
    occlusal = vector_area_mm2(scan.mesh)
    occlusal /= np.linalg.norm(occlusal)
    middles, points = scan.mesh.vertices_mm[scan.mesh.faces].mean(axis=1), {}
    for fdi in scan.teeth:
        own = scan.fdi == fdi
        centre = middle_mm(Mesh(scan.mesh.vertices_mm, scan.mesh.faces[own]))
        rise = np.quantile(middles[own] @ occlusal, 0.97) - centre @ occlusal
        aimed = centre + rise * occlusal + rng.normal(0, sigma_mm, 3)
        points[fdi] = middles[[np.linalg.norm(middles - aimed, axis=1).argmin()]]
    return points


def test_a_real_arch_without_its_labels_gets_them_back() -> None:
    arch = read_scan(shared_path("data/intraoral-arch/Example_01.vtp"))
    found = segment_by_landmarks(arch.mesh, clicked(arch, np.random.default_rng(200), 0.5), "the arch")
    is_right, is_tooth = found == arch.fdi, arch.fdi > 0
    # The requirement for teeth; 96.5 % was measured, and 94.6 % for the gums. Constants were chosen on teeth 21 to 27.
    assert is_right[is_tooth].mean() >= 0.95
    assert is_right[arch.fdi // 10 == 1].mean() >= 0.95
    assert is_right[~is_tooth].mean() >= 0.90


@pytest.mark.slow
def test_a_real_arch_without_its_labels_becomes_solids() -> None:
    arch = read_scan(shared_path("data/intraoral-arch/Example_01.vtp"))
    found = segment_by_landmarks(arch.mesh, clicked(arch, np.random.default_rng(201), 1.0), "the arch")
    assert (found == arch.fdi)[arch.fdi > 0].mean() >= 0.95
    jaw = jaw_from_scan(LabelledScan(arch.mesh, found), "whole")
    assert [tooth.fdi for tooth in jaw.teeth] == [*range(11, 18), *range(21, 28)]
    for tooth in jaw.teeth:
        tooth.outer.require_solid(f"tooth {tooth.fdi}", (2.0, 100.0))


def test_a_file_without_labels_is_parted_by_points(tmp_path: Path) -> None:
    write_vtp(tmp_path / "scan.vtp", FOUR.mesh, None)
    scan = read_scan(tmp_path / "scan.vtp", labels=None, points_mm=TOPS)
    assert not scan.is_labelled
    assert scan.teeth == (11, 12, 21, 22)
    # A bump is labelled from 1 mm above the plate upwards; the crease around it is lower, one or two triangles of
    # 0.4 mm further out.
    assert (scan.fdi == FOUR.fdi)[FOUR.fdi > 0].mean() > 0.98
    assert (scan.fdi == FOUR.fdi).mean() > 0.85


def test_points_at_the_gums_do_not_change_a_tooth() -> None:
    low = FOUR.mesh.vertices_mm[np.abs(FOUR.mesh.vertices_mm[:, 2] - 1.0) < 0.5]
    with_low = {
        fdi: np.concatenate([top, low[[np.linalg.norm(low[:, :2] - top[0, :2], axis=1).argmin()]]])
        for fdi, top in TOPS.items()
    }
    found = segment_by_landmarks(FOUR.mesh, with_low, "the scan")
    np.testing.assert_array_equal(found, segment_by_landmarks(FOUR.mesh, TOPS, "the scan"))


@pytest.mark.parametrize("pair", [(11, 21), (12, 11), (21, 22)])
def test_exchanged_numbers_are_named(tmp_path: Path, pair: tuple[int, int]) -> None:
    write_vtp(tmp_path / "scan.vtp", FOUR.mesh, None)
    one, other = pair
    exchanged = TOPS | {one: TOPS[other], other: TOPS[one]}
    with pytest.raises(MeshError, match=f"Teeth {min(pair)} and {max(pair)} of scan .* order of their numbers"):
        read_scan(tmp_path / "scan.vtp", labels=None, points_mm=exchanged)


def turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_mm, mesh.faces[:, ::-1].copy())


@pytest.mark.parametrize(
    ("mesh", "points_mm", "sentence"),
    [
        (FOUR.mesh, {}, "The scan has no labels, and landmarks name 0 of its teeth; click one point on each tooth"),
        (FOUR.mesh, TOPS | {11: TOPS[11] + 5.0}, "landmark of tooth 11 lies .* mm from the scan; give xyz_mm"),
        (FOUR.mesh, TOPS | {13: TOPS[12] + 0.5}, "Landmarks of teeth 12 and 13 are 0.87 mm apart"),
        (FOUR.mesh, TOPS | {19: TOPS[12]}, "name tooth 19, which is no permanent tooth"),
        (turned(FOUR.mesh), TOPS, "inside out or a mirror image"),
    ],
)
def test_points_that_cannot_be_used_are_named(mesh: Mesh, points_mm: dict[int, np.ndarray], sentence: str) -> None:
    with pytest.raises(CaptureInputError, match=sentence):
        segment_by_landmarks(mesh, points_mm, "the scan")


def joined(one: Mesh, other: Mesh) -> Mesh:
    return Mesh(
        np.concatenate([one.vertices_mm, other.vertices_mm]),
        np.concatenate([one.faces, other.faces + len(one.vertices_mm)]).astype(np.int32),
    )


def test_a_landmark_on_another_piece_of_the_scan_is_named() -> None:
    piece = bumps({23: (32.0, -12.0)}).mesh
    apart = joined(FOUR.mesh, piece)
    points_mm = TOPS | {23: np.array([[32.0, -12.0, CROWN_MM]])}
    sentence = "landmark of tooth 23 lies on a piece of the scan that does not hang together .* one connected surface"
    with pytest.raises(CaptureInputError, match=sentence):
        segment_by_landmarks(apart, points_mm, "the scan")
