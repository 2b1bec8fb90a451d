"""Overlapping solids become surfaces that do not overlap: nothing is lost, nothing is there twice, and surfaces share
their cut edges bit by bit.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from services.anatomy.scans.patches import areas_mm2
from services.anatomy.scans.separation import separate
from services.assets.mitsuba.mouth_scene import mouth_scene, write_mouth_surfaces
from services.core.errors import MeshError
from services.core.geometry import Mesh, Tooth
from services.transport.optics.parameters import Medium, Mouth, Tissue

RADIUS_MM = 3.0


def ball(radius_mm: float, x_mm: float = 0.0) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=radius_mm)
    return Mesh(np.asarray(sphere.vertices) + np.array([x_mm, 0.01, 0.02]), np.asarray(sphere.faces, dtype=np.int32))


def block(*extents_mm: float) -> Mesh:
    """A box with its top in the plane z = 0."""
    box = trimesh.creation.box(extents_mm)
    return Mesh(np.asarray(box.vertices) - np.array([0, 0, extents_mm[2] / 2]), np.asarray(box.faces, dtype=np.int32))


GUMS = block(20.0, 9.0, 8.0)


def area(mesh: Mesh) -> float:
    return float(areas_mm2(mesh).sum())


def joined(*meshes: Mesh) -> Mesh:
    """One mesh in which vertices with the same coordinates, bit by bit, are one vertex."""
    first = np.cumsum([0] + [len(mesh.vertices_mm) for mesh in meshes])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, first, strict=False)])
    vertices, index = np.unique(np.concatenate([mesh.vertices_mm for mesh in meshes]), axis=0, return_inverse=True)
    return Mesh(vertices, index.reshape(-1)[faces].astype(np.int32))


def middles(mesh: Mesh) -> NDArray[np.float64]:
    return np.asarray(mesh.vertices_mm[mesh.faces].mean(axis=1))


def flipped(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_mm, mesh.faces[:, ::-1])


def test_crown_and_root_meet_the_gums_without_a_gap() -> None:
    tooth = ball(RADIUS_MM)
    parts = separate((Tooth(11, tooth, ball(2.0)),), GUMS)
    (crown,), (root,) = parts.crowns, parts.roots
    assert area(crown) + area(root) == pytest.approx(area(tooth), rel=1e-12)
    assert middles(crown)[:, 2].min() > 0 > middles(root)[:, 2].max()
    # Each of these is a closed surface: the tooth, everything that touches air, and the gums with the hollow of the
    # root.
    for solid in (joined(crown, root), joined(crown, parts.gums), joined(parts.gums, flipped(root))):
        solid.require_solid("of the cut parts")
    # The lid of the hollow is in the plane z = 0, where it adds nothing to a volume computed from the origin.
    hollowed = joined(parts.gums, flipped(root)).signed_volume_mm3()
    assert hollowed == pytest.approx(GUMS.signed_volume_mm3() - root.signed_volume_mm3(), rel=1e-9)
    assert parts.contacts == {}


def test_without_gums_a_tooth_stays_whole() -> None:
    tooth = ball(RADIUS_MM)
    parts = separate((Tooth(11, tooth),), None)
    assert area(parts.crowns[0]) == pytest.approx(area(tooth), rel=1e-12)
    assert len(parts.roots[0].faces) == len(parts.gums.faces) == 0


def test_of_two_teeth_the_first_keeps_its_surface_where_they_overlap() -> None:
    teeth = (Tooth(11, ball(RADIUS_MM), ball(1.5)), Tooth(12, ball(RADIUS_MM, 5.8), ball(1.5, 5.8)))
    parts = separate(teeth, GUMS)
    shared = parts.contacts[0, 1]
    # The cap of a sphere cut 0.1 mm from its end, 2 pi r h; the polyhedron's is smaller by what its edges cut off.
    assert area(shared) == pytest.approx(2 * np.pi * RADIUS_MM * 0.1, rel=0.3)
    # The three parts together are the first tooth; those of the second are the surface of the second without the first.
    first = joined(parts.crowns[0], parts.roots[0], shared)
    assert area(first) == pytest.approx(area(teeth[0].outer), rel=1e-9)
    assert first.signed_volume_mm3() == pytest.approx(teeth[0].outer.signed_volume_mm3(), rel=1e-9)
    second = joined(parts.crowns[1], parts.roots[1], flipped(shared))
    lens = 2 * np.pi * 0.1**2 * (3 * RADIUS_MM - 0.1) / 3
    assert teeth[1].outer.signed_volume_mm3() - second.signed_volume_mm3() == pytest.approx(lens, rel=0.5)


def test_what_cannot_be_cut_is_named() -> None:
    with pytest.raises(MeshError, match="Tooth 11 reaches into the dentin of tooth 12"):
        separate((Tooth(11, ball(RADIUS_MM)), Tooth(12, ball(RADIUS_MM, 4.0), ball(2.5, 4.0))), GUMS)
    with pytest.raises(MeshError, match=r"gums\.ply cannot be cut"):
        separate((Tooth(11, ball(RADIUS_MM)),), Mesh(GUMS.vertices_mm, GUMS.faces[2:]))


def test_a_scene_has_a_medium_on_either_side_of_each_surface(tmp_path_factory: pytest.TempPathFactory) -> None:
    teeth = (Tooth(11, ball(RADIUS_MM), ball(1.5)), Tooth(12, ball(RADIUS_MM, 5.8)))
    files = write_mouth_surfaces(tmp_path_factory.mktemp("surfaces"), teeth, GUMS, flipped(GUMS))
    assert set(files) == {"crown_11", "root_11", "dentin_11", "crown_12", "root_12", "contact_11_12", "gums", "cavity"}
    mouth = Mouth((Tissue(Medium(1, 0.5), Medium(2, 0.5)), Tissue(Medium(3, 0.5), Medium(4, 0.5))), Medium(5, 0.5), 0.3)
    scene = mouth_scene(files, (11, 12), mouth, (), (0, 0, 9), 1.0, boundary="thin")

    def sides(name: str) -> tuple[float | None, float | None]:
        references = [scene[name].get(side) for side in ("interior", "exterior")]
        inside, outside = (reference and scene[reference["id"]]["sigma_t"] for reference in references)
        return inside, outside

    assert {name: sides(name) for name in files} == {
        "crown_11": (1, None),
        "root_11": (1, 5),
        "dentin_11": (2, 1),
        "crown_12": (3, None),
        "root_12": (3, 5),
        "contact_11_12": (1, 3),
        "gums": (5, None),
        "cavity": (None, None),
    }
    assert [scene[name]["bsdf"].get("ior") for name in ("crown_11", "gums", "dentin_11")] == [1.631, 1.33, None]
    assert scene["root_11"]["bsdf"]["ior"] == pytest.approx(1.631 / 1.33)
    assert scene["cavity"]["bsdf"]["nested"]["reflectance"]["value"] == 0.3
    rough = mouth_scene(files, (11, 12), mouth, (), (0, 0, 9), 1.0, boundary="rough", roughness=0.2)
    faces = {name: rough[name]["bsdf"] for name in ("crown_11", "root_11", "gums")}
    assert {name: face["int_ior"] for name, face in faces.items()} == pytest.approx(
        {"crown_11": 1.631, "root_11": 1.631 / 1.33, "gums": 1.33}
    )
    assert {face["alpha"] for face in faces.values()} == {0.2}
