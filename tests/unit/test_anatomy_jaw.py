"""The phantom jaw: closed and nested surfaces, dimensions as in the table, teeth side by side without overlap, roots in
the gums; the engine renders it.
"""

from __future__ import annotations

import csv
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SurfaceDistance
from services.anatomy.templates.dimensions import UPPER_TEETH, upper_tooth
from services.anatomy.templates.jaw import GAP_MM, SHORT_OF_PLANE_MM, TILT_SPREAD_DEG, Jaw, JawTooth, build_jaw
from services.core.geometry import Mesh
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.scene.nesting import require_nested
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces, View
from tests.support.phantom_bodies import phantom_jaw
from tests.support.shared_data import shared_path

FDI = (17, 16, 15, 14, 13, 12, 11, 21, 22, 23, 24, 25, 26, 27)
SUBJECT = 1
DIMENSIONS_REL = 0.03


@pytest.fixture(scope="module")
def average() -> Jaw:
    return phantom_jaw(None)


@pytest.fixture(scope="module")
def subject() -> Jaw:
    return phantom_jaw(SUBJECT)


@pytest.fixture(params=["average", "subject"])
def jaw(request: pytest.FixtureRequest) -> Jaw:
    found: Jaw = request.getfixturevalue(request.param)
    return found


def heights_mm(tooth: JawTooth, mesh: Mesh) -> NDArray[np.float64]:
    """Heights of a mesh's vertices above the tooth's cervical line."""
    return tooth.frame.canonical_from_world(mesh.vertices_mm)[:, 2] - tooth.cervix_mm


def depth_mm(surface: SurfaceDistance, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance below a closed smooth surface, negative outside; the side is the nearest face's, as no faces meet at
    sharp angles.
    """
    nearest, distance, face = surface.closest(points_mm)
    a, b, c = (surface.mesh.vertices_mm[surface.mesh.faces[face, k]] for k in range(3))
    outside = np.einsum("ij,ij->i", points_mm - nearest, np.cross(b - a, c - a)) > 0
    return np.where(outside, -distance, distance)


def section_mm(tooth: JawTooth, height_mm: float) -> NDArray[np.float64]:
    """Canonical x, y of the points where edges of the outer surface cross this height above the cervical line."""
    points = tooth.frame.canonical_from_world(tooth.outer.vertices_mm)
    edges = tooth.outer.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    below, above = points[edges[:, 0]], points[edges[:, 1]]
    plane = tooth.cervix_mm + height_mm
    crossing = (below[:, 2] <= plane) & (above[:, 2] > plane)
    below, above = below[crossing], above[crossing]
    share = (plane - below[:, 2]) / (above[:, 2] - below[:, 2])
    return (below + share[:, None] * (above - below))[:, :2]


def test_fourteen_teeth_stand_in_order(jaw: Jaw) -> None:
    assert tuple(tooth.fdi for tooth in jaw.teeth) == FDI
    assert jaw.tooth(23).fdi == 23
    # The patient's right is at negative x, incisors are in front.
    assert [np.sign(tooth.jaw_from_tooth[0, 3]) for tooth in jaw.teeth] == [-1] * 7 + [1] * 7
    forward = [tooth.jaw_from_tooth[1, 3] for tooth in jaw.teeth]
    assert (np.diff(forward[:7]) > 0).all()
    assert (np.diff(forward[7:]) < 0).all()


def test_every_solid_bounds_a_medium(jaw: Jaw) -> None:
    jaw.cavity.require_surface("cavity")
    solids = {"gums": jaw.gums} | {
        f"{part} {tooth.fdi}": getattr(tooth, part) for tooth in jaw.teeth for part in ("outer", "dentin")
    }
    for name, mesh in solids.items():
        mesh.require_solid(name)
        assert mesh.vertices_mm.dtype == np.float64
        # Every edge occurs once in each direction: no face is turned over.
        edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        assert len(np.unique(edges, axis=0)) == len(edges), name


def test_meshes_are_fine_even_and_smooth(average: Jaw) -> None:
    for tooth in average.teeth[:7]:
        for mesh in (tooth.outer, tooth.dentin):
            assert len(mesh.faces) <= 6000
            surface = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
            # A rounded edge of 90 degrees in three rows bends by 30 degrees in each row; on the side of a cusp the
            # slope of the crown is added.
            assert np.degrees(surface.face_adjacency_angles).max() < 50
            assert 0.3 <= np.median(surface.edges_unique_length) <= 0.5


def test_dentin_lies_inside_enamel(subject: Jaw) -> None:
    # The root's cover is 0.08 mm along the normal; faces of 0.4 mm over its rounding of 0.8 mm cut in by 0.4² / (8 x
    # 0.8) = 0.025 mm. Every second tooth: one of each kind.
    for tooth in subject.teeth[::2]:
        require_nested(tooth.outer, tooth.dentin, 0.05)


def test_enamel_is_thicker_towards_the_tip(average: Jaw) -> None:
    # On a labial strip, where enamel is measured.
    for tooth in average.teeth[:7]:
        canonical, height = tooth.frame.canonical_from_world(tooth.outer.vertices_mm), heights_mm(tooth, tooth.outer)
        strip = (np.abs(canonical[:, 0]) < 1.0) & (canonical[:, 1] > 0) & (height > 0)
        thickness = SurfaceDistance(tooth.dentin).closest(tooth.outer.vertices_mm[strip])[1]
        share = height[strip] / upper_tooth(tooth.fdi % 10).crown_length_mm
        low, middle, high = (float(np.median(thickness[np.abs(share - at) < 0.08])) for at in (0.15, 0.45, 0.75))
        assert 0.3 < low < middle < high < 1.5, tooth.fdi
        # And from outside: there is enamel below every part of the surface.
        assert thickness.min() > 0.3, tooth.fdi


def test_enamel_of_the_central_incisor_follows_the_labial_model(average: Jaw) -> None:
    # 0.35 + 0.75 z / 10.5; shortest distance is at most the thickness along the normal, and walls' curvature makes up
    # to 0.05 mm of difference.
    tooth = average.tooth(11)
    height, canonical = heights_mm(tooth, tooth.outer), tooth.frame.canonical_from_world(tooth.outer.vertices_mm)
    labial = (np.abs(canonical[:, 0]) < 0.8) & (canonical[:, 1] > 0) & (height > 0.5) & (height < 8.5)
    thickness = SurfaceDistance(tooth.dentin).closest(tooth.outer.vertices_mm[labial])[1]
    assert labial.sum() > 20
    np.testing.assert_allclose(thickness, 0.35 + 0.75 * height[labial] / 10.5, atol=0.05)


@pytest.mark.parametrize("fdi", FDI)
def test_crowns_have_the_dimensions_of_the_table(average: Jaw, fdi: int) -> None:
    # The widest diameters and the length are exact; the narrowing towards the tongue, defined at the widest place,
    # changes the sections at the cervix by up to 1.5 %.
    tooth, d = average.tooth(fdi), upper_tooth(fdi % 10)
    canonical = tooth.frame.canonical_from_world(tooth.outer.vertices_mm)
    crown = canonical[canonical[:, 2] >= tooth.cervix_mm]
    cervix = np.ptp(section_mm(tooth, 0.0), axis=0)
    measured = crown[:, 2].max() - tooth.cervix_mm, *np.ptp(crown[:, :2], axis=0), *cervix
    table = d.crown_length_mm, d.md_crown_mm, d.ll_crown_mm, d.md_cervix_mm, d.ll_cervix_mm
    np.testing.assert_allclose(measured, table, rtol=DIMENSIONS_REL)


def test_the_table_is_the_references() -> None:
    with shared_path("reference/tooth_dimensions.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [f"maxillary {d.name}" for d in UPPER_TEETH] == [row["tooth"] for row in rows]
    assert [f"1{d.position} 2{d.position}" for d in UPPER_TEETH] == [row["fdi"] for row in rows]
    assert [d.status for d in UPPER_TEETH] == [row["status"] for row in rows]
    columns = (
        "crown_length",
        "md_crown",
        "md_cervix",
        "ll_crown",
        "ll_cervix",
        "cervical_curvature_mesial",
        "cervical_curvature_distal",
    )
    for d, row in zip(UPPER_TEETH, rows, strict=True):
        table = [
            d.crown_length_mm,
            d.md_crown_mm,
            d.md_cervix_mm,
            d.ll_crown_mm,
            d.ll_cervix_mm,
            d.curvature_mesial_mm,
            d.curvature_distal_mm,
        ]
        assert table == [float(row[f"{column}_mm"]) for column in columns], d.name


def test_neighbours_all_but_touch_and_never_overlap(subject: Jaw) -> None:
    # Teeth are moved until the distance of a vertex is within 0.005 mm of the gap. Measured from the other tooth's
    # vertices, the distance differs by what faces of 0.45 mm cut off from crowns whose radius of curvature is 3 mm or
    # more, 0.45² / (8 x 3) = 0.008 mm. Sizes vary by 5 %.
    surfaces = [SurfaceDistance(tooth.outer) for tooth in subject.teeth]
    for (one, one_surface), (other, other_surface) in pairwise(zip(subject.teeth, surfaces, strict=True)):
        for still, near in ((one_surface, other), (other_surface, one)):
            # Only vertices within a millimetre of the other tooth's box can be the nearest.
            box, points = still.mesh.vertices_mm, near.outer.vertices_mm
            within = ((points > box.min(axis=0) - 1) & (points < box.max(axis=0) + 1)).all(axis=1)
            deepest = depth_mm(still, points[within]).max()
            assert abs(deepest + GAP_MM) < 0.005 + 0.008 + 0.05 * GAP_MM, (one.fdi, other.fdi)


def test_the_average_is_symmetric(average: Jaw) -> None:
    mirror = np.array([-1.0, 1.0, 1.0])
    for place in range(1, 8):
        right, left = average.tooth(10 + place), average.tooth(20 + place)
        np.testing.assert_array_equal(left.outer.vertices_mm, mirror * right.outer.vertices_mm)
        np.testing.assert_array_equal(left.dentin.vertices_mm, mirror * right.dentin.vertices_mm)
    # The gums' surface is symmetric, its vertices are not: a mirrored vertex is off the surface by at most what its
    # faces cut off from bends of 0.6 mm radius.
    points = mirror * average.gums.vertices_mm[::7]
    assert SurfaceDistance(average.gums, 0.2).closest(points)[1].max() < 0.6**2 / (8 * 0.6)


def test_gums_hold_the_roots_and_leave_the_crowns_free(subject: Jaw) -> None:
    gums = SurfaceDistance(subject.gums, 0.3)
    for tooth in subject.teeth:
        height = heights_mm(tooth, tooth.outer)
        assert depth_mm(gums, tooth.outer.vertices_mm[height < -0.1]).min() > 0, tooth.fdi
        # Papillae between front teeth cover about an eighth of the crown's vertices.
        assert np.mean(depth_mm(gums, tooth.outer.vertices_mm[height > 0.5]) < 0) > 0.8, tooth.fdi


def test_gums_are_higher_between_the_front_teeth(average: Jaw) -> None:
    # At the midline, between the central incisors, against the middle of the right one.
    x, y, z = average.gums.vertices_mm.T
    front = y > 15
    between, middle = (
        float(z[front & (np.abs(x - at) < 0.5)].max()) for at in (0.0, average.tooth(11).jaw_from_tooth[0, 3])
    )
    assert 2.0 < between - middle < 4.0


def test_the_cavity_lies_behind_and_above_the_teeth(average: Jaw) -> None:
    wall, incisor = average.cavity.vertices_mm, average.tooth(11).outer.vertices_mm
    assert wall[:, 1].max() < incisor[:, 1].max()
    assert wall[:, 2].min() < average.gums.vertices_mm[:, 2].min()
    assert wall[:, 1].min() < average.tooth(17).outer.vertices_mm[:, 1].min()


def test_frames_turn_canonical_axes_into_the_jaws(jaw: Jaw) -> None:
    for tooth in jaw.teeth:
        pose = tooth.jaw_from_tooth
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        canonical = tooth.frame.canonical_from_world(tooth.outer.vertices_mm)
        np.testing.assert_allclose(canonical @ pose[:3, :3].T + pose[:3, 3], tooth.outer.vertices_mm, atol=1e-12)
        np.testing.assert_allclose(canonical.min(axis=0) + canonical.max(axis=0), 0, atol=1e-9)
        # Buccal points away from a place in the middle of the mouth, mesial forward or to the midline.
        x, buccal, occlusal = pose[:3, :3].T
        # Tilted by at most this much about two axes.
        assert occlusal[2] >= np.cos(np.radians(TILT_SPREAD_DEG)) ** 2
        assert buccal @ (pose[:3, 3] - [0, -10, pose[2, 3]]) > 0
        to_midline = -np.sign(pose[0, 3])
        mesial = x if tooth.fdi < 20 else -x
        assert mesial @ [to_midline, 1.0, 0] > 0.5


def test_average_teeth_stand_upright_with_the_front_on_the_occlusal_plane(average: Jaw) -> None:
    for tooth in average.teeth:
        np.testing.assert_allclose(tooth.jaw_from_tooth[2, :3], [0, 0, 1], atol=1e-12)
        short = SHORT_OF_PLANE_MM.get(tooth.fdi % 10, 0.0)
        assert tooth.outer.vertices_mm[:, 2].max() == pytest.approx(-short, abs=1e-9)


def test_a_seed_repeats_and_seeds_differ(subject: Jaw, average: Jaw) -> None:
    again, other = build_jaw(SUBJECT), phantom_jaw(SUBJECT + 1)
    for one, same, different in zip(subject.teeth, again.teeth, other.teeth, strict=True):
        np.testing.assert_array_equal(one.outer.vertices_mm, same.outer.vertices_mm)
        np.testing.assert_array_equal(one.dentin.vertices_mm, same.dentin.vertices_mm)
        assert np.abs(one.outer.vertices_mm - different.outer.vertices_mm).max() > 0.01
    np.testing.assert_array_equal(subject.gums.vertices_mm, again.gums.vertices_mm)
    for drawn in (subject, other):
        size = [tooth.cervix_mm / mean.cervix_mm for tooth, mean in zip(drawn.teeth, average.teeth, strict=True)]
        np.testing.assert_allclose(size, size[0])
        assert 0.95 <= size[0] <= 1.05
        # Dentin's share of a tooth follows the enamel's thickness, which differs from tooth to tooth.
        share = [t.dentin.signed_volume_mm3() / t.outer.signed_volume_mm3() for t in (*drawn.teeth, *average.teeth)]
        change = np.array(share[:14]) / share[14:] - 1
        assert 0.01 < np.ptp(change) < 0.15


def test_the_engine_takes_the_whole_jaw(subject: Jaw, monkeypatch: pytest.MonkeyPatch) -> None:
    # A coarse grid of clearances is soon measured, and changes no image.
    monkeypatch.setattr("services.transport.scene.clearance.MAX_CELLS", 300_000)
    lights = dome_lights(3, ("green",), seed=1)
    teeth = tuple(ToothSurfaces(t.outer, DentinShape.known(t.dentin)) for t in subject.teeth)
    recipe = SceneRecipe(
        teeth,
        np.array([light.position_mm for light in lights]),
        np.array([light.intensity[0] for light in lights]),
        "thin",
        gums=subject.gums,
        cavity=subject.cavity,
    )
    (camera,) = dome_cameras(1, 2.0, tuple(tooth.outer for tooth in subject.teeth))
    # The middles of the right incisors and canine, and the gums above them.
    crowns = np.array([subject.tooth(fdi).jaw_from_tooth[:3, 3] + [0, 0, 2] for fdi in (11, 12, 13)])
    pixels = np.floor(camera.project(np.concatenate([crowns, crowns - [0, 0, 8]]))[0]).astype(np.int32)
    tissue = Tissue(Medium(4.5, 0.997, g1=0.8), Medium(12.0, 0.9945, g1=0.75))
    images = Engine(recipe).images(
        Mouth((tissue,) * len(teeth), Medium(9.0, 0.9, g1=0.8), 0.2), View(camera, pixels), samples=16, seed=1
    )
    assert np.isfinite(images.mean).all()
    # Under the first light, from the front, teeth are brighter than gums, which absorb thirty times as much.
    assert images.mean[0, :3].min() > 0
    assert images.mean[0, :3].mean() > images.mean[0, 3:].mean()
