"""A scan or landmark that cannot be used ends in a sentence that names the fault and what to do; each fault has its own
sentence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.anatomy.scans.roots import close_crown
from services.anatomy.scans.scan import LabelledScan, read_scan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.calibrate.registration.landmarks import Click
from services.calibrate.registration.register import ScannedTeeth, require_on_their_teeth
from services.core.errors import InputError
from services.core.files import scans
from services.core.geometry import Mesh
from services.phantom.dome_rig import dome_cameras
from tests.support.labelled_scan import bumps, universal, write_labelled_ply, write_vtp
from tests.support.landmark_pose import pose_from_landmarks

FOUR = bumps({12: (-12.5, -6.0), 11: (-4.5, 0.0), 21: (4.5, 0.0), 22: (12.5, -6.0)})
CAMERAS = {camera.name: camera for camera in dome_cameras(2, 0.2, (FOUR.mesh,))}


def mesh_of(change: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    return Mesh(change(FOUR.mesh.vertices_mm.copy()), FOUR.mesh.faces)


def read(folder: Path, mesh: Mesh = FOUR.mesh, labels: np.ndarray | None = None, **options: Any) -> LabelledScan:
    write_labelled_ply(folder / "scan.ply", mesh, FOUR.fdi if labels is None else labels)
    return read_scan(folder / "scan.ply", "either", **options)


def relabelled(**new: int) -> np.ndarray:
    return np.select([FOUR.fdi == int(old[1:]) for old in new], list(new.values()), FOUR.fdi)


def with_nan(points: np.ndarray) -> np.ndarray:
    points[3, 1] = np.nan
    return points


def turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_mm, mesh.faces[:, ::-1].copy())


def truncated(folder: Path) -> LabelledScan:
    write_vtp(folder / "scan.vtp", FOUR.mesh, universal(FOUR.fdi))
    content = (folder / "scan.vtp").read_bytes()
    (folder / "scan.vtp").write_bytes(content[: len(content) // 2])
    return read_scan(folder / "scan.vtp")


def huge(folder: Path) -> LabelledScan:
    # A binary STL file of five million triangles; its bytes are never read and take no room on the disk.
    path = folder / "scan.stl"
    with path.open("wb") as file:
        file.write(bytes(80) + np.uint32(5_000_000).tobytes())
        file.truncate(scans.STL_HEADER_BYTES + scans.STL_TRIANGLE_BYTES * 5_000_000)
    return read_scan(path, labels="labels.txt")


def cloud(folder: Path) -> LabelledScan:
    rows = "\n".join(" ".join(map(str, row)) for row in FOUR.mesh.vertices_mm[:5].tolist())
    head = (
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    )
    (folder / "scan.ply").write_text(head + rows + "\n")
    return read_scan(folder / "scan.ply")


def labels_of_another(folder: Path) -> LabelledScan:
    np.save(folder / "labels.npy", FOUR.fdi[:-7])
    read(folder, labels=FOUR.fdi)
    return read_scan(folder / "scan.ply", labels="labels.npy")


def clicks(shift: int = 0, fdi: int = 11) -> list[Click]:
    points = np.array(
        [[x, y, 7.0] for x, y in ((-12.5, -6), (-4.5, 0), (4.5, 0), (12.5, -6), (0, -3), (-8, -4), (8, 3))]
    )
    return [
        Click(f"{fdi} point {k}", name, points[(k + shift) % len(points)], camera.project(points[k][None])[0][0])
        for k in range(len(points))
        for name, camera in CAMERAS.items()
    ]


def placed(on: list[Click]) -> None:
    crown = Mesh(FOUR.mesh.vertices_mm, FOUR.mesh.faces[FOUR.fdi == 11])
    require_on_their_teeth(on, ScannedTeeth((11,), (crown,), FOUR.mesh, np.eye(4), ""))


KINDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a mirror image": (
        lambda at: jaw_from_scan(read(at, mesh_of(lambda v: v * [-1, 1, 1]))),
        "inside out or a mirror image.*mirror the scan back",
    ),
    "a mirror image with its triangles turned": (
        lambda at: jaw_from_scan(read(at, turned(mesh_of(lambda v: v * [-1, 1, 1])))),
        "wrong way around the arch; exchange left and right in its labels, or mirror the scan back",
    ),
    "triangles inside out": (lambda at: jaw_from_scan(read(at, turned(FOUR.mesh))), "inside out.*turn its triangles"),
    "inches": (lambda at: read(at, mesh_of(lambda v: v / 25.4)), "it seems to be in inch: say units = 'inch'"),
    "metres": (lambda at: read(at, mesh_of(lambda v: v / 1000)), "it seems to be in m: say units = 'm'"),
    "a third of the size": (
        lambda at: read(at, mesh_of(lambda v: v / 3)),
        "0.4.* times as far apart.*; export it in mill",
    ),
    "the other jaw": (lambda at: read(at, jaw="lower"), "said to be of the lower jaw.*correct jaw"),
    "both jaws": (lambda at: read(at, labels=relabelled(_12=42, _22=32)), "both jaws .* export each jaw alone"),
    "left and right exchanged": (
        lambda at: jaw_from_scan(read(at, labels=relabelled(_11=21, _21=11, _12=22, _22=12))),
        "exchange left and right",
    ),
    "an empty label": (
        lambda at: jaw_from_scan(read(at, labels=np.where(np.arange(len(FOUR.fdi)) == 5, 13, FOUR.fdi))),
        "label of tooth 13 covers .* mm², less than any tooth shows; label the tooth",
    ),
    "no label": (lambda at: read(at, labels=0 * FOUR.fdi), "0 labelled teeth; export at least two"),
    "a label that names no tooth": (lambda at: read(at, labels=relabelled(_12=77)), "label 77, which names no tooth"),
    "no gingiva": (lambda at: read(at, labels=relabelled(_0=13)), "no gingiva .* export it with the gums"),
    "a label in pieces": (
        lambda at: jaw_from_scan(read(at, labels=relabelled(_22=12))),
        "label of tooth 12 is in 2 pieces.*relabel",
    ),
    "labels of another scan": (
        labels_of_another,
        r"labels of shape \(\d+,\) for \d+ triangles",
    ),
    "a coordinate that is no number": (lambda at: read(at, mesh_of(with_nan)), "non-finite coordinates; repair"),
    "five million triangles": (huge, "5,000,000 triangles, more than 2,000,000; reduce it to 500,000"),
    "a file cut off": (truncated, "truncated .* export it again"),
    "a point cloud": (cloud, "holds no triangle; export the surface"),
    "a file that is absent": (lambda at: read_scan(at / "scan.stl"), "does not exist; put"),
    "another format": (lambda at: read_scan(at / "scan.step"), "neither .vtp, .ply, .stl nor .obj; export"),
    "a crown that is closed": (
        lambda _: close_crown(jaw_from_scan(FOUR).teeth[0].outer, np.array([0.0, 0.0, 1.0]), "tooth 11"),
        "no open edge at its neck",
    ),
    "landmarks exchanged": (
        lambda _: pose_from_landmarks(CAMERAS, clicks(shift=3), np.zeros(3)),
        "landmarks contradict.* see whether landmarks are exchanged",
    ),
    "too few landmarks": (
        lambda _: pose_from_landmarks(CAMERAS, clicks()[:6], np.zeros(3)),
        r"No camera sees 4 landmarks .*add \[\[landmark\]\]",
    ),
    "landmarks on a line": (
        lambda _: pose_from_landmarks(CAMERAS, [clicks()[0]] * 6, np.zeros(3)),
        "in one line or at one place.* spread them",
    ),
    "half an arch, and landmarks of the other": (
        lambda _: placed(clicks(fdi=21)),
        r"Landmark 21 point 0 is of a tooth that the scan does not have \(11\); correct",
    ),
    "landmarks in another frame": (lambda _: placed(clicks()), "lies .* mm from its tooth in the scan; give xyz_mm"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_cannot_be_used_is_named_with_its_remedy(kind: str, tmp_path: Path) -> None:
    act, sentence = KINDS[kind]
    with pytest.raises(InputError, match=sentence) as told:
        act(tmp_path)
    # One sentence, with a remedy after a semicolon.
    assert told.value.message.endswith(".")
    assert "; " in told.value.message


def test_surfaces_that_are_not_manifold_are_mended_and_counted() -> None:
    extra = np.array([[*FOUR.mesh.faces[0][:2], len(FOUR.mesh.vertices_mm) - 1]], dtype=np.int32)
    faces = np.concatenate([FOUR.mesh.faces, extra])
    jaw = jaw_from_scan(replace(FOUR, mesh=Mesh(FOUR.mesh.vertices_mm, faces), fdi=np.append(FOUR.fdi, 0)))
    assert jaw.repairs.removed_triangles >= 1
