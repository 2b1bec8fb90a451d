"""Texture charts of stains: complete, without overlap, the same every time; neighbouring texels are neighbours on the
surface.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from services.anatomy.templates.incisor import build_incisor
from services.core.geometry import Mesh
from services.transport.scene.stain_uv import (
    NEIGHBOUR_DISTANCE,
    TEXEL_MM,
    StainLayout,
    bilinear_texels,
    stain_layout,
    texel_edge_mm,
)

TEXEL = 0.75


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return build_incisor().outer


@pytest.fixture(scope="module")
def layout(mesh: Mesh) -> StainLayout:
    return stain_layout(mesh, TEXEL)


def looked_up(mesh: Mesh, layout: StainLayout, count: int = 20_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # Random places on the surface, the texels used there, and their weights.
    rng = np.random.default_rng(1)
    face = rng.integers(0, len(mesh.faces), count)
    weights = rng.dirichlet(np.ones(3), count)
    places = np.einsum("sc,scd->sd", weights, mesh.vertices_mm[mesh.faces[face]])
    texels, shares = bilinear_texels(
        np.einsum("sc,scd->sd", weights, layout.corners_uv[face]), (layout.index.shape[0], layout.index.shape[1])
    )
    return places, layout.index.reshape(-1)[texels], shares


def test_every_place_reads_texels_of_its_own(mesh: Mesh, layout: StainLayout) -> None:
    places, texels, shares = looked_up(mesh, layout)
    assert (texels[shares > 1e-3] >= 0).all()
    # A texel colours points within about its own edge length; a texel shared by two charts would have its middle
    # between them, far from both.
    distance = np.linalg.norm(places[:, None] - layout.points_mm[texels], axis=2)
    assert distance[(texels >= 0) & (shares > 0.05)].max() < 2.5 * TEXEL


def test_texels_cover_the_surface_at_about_the_size_asked(mesh: Mesh, layout: StainLayout) -> None:
    corners = mesh.vertices_mm[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert layout.area_mm2.sum() == pytest.approx(area)
    # Texels inside a chart cover their edge squared, except for the distortion of the chart.
    assert np.percentile(layout.area_mm2, 80) == pytest.approx(TEXEL**2, rel=0.2)


def test_the_same_mesh_gives_the_same_layout(mesh: Mesh, layout: StainLayout) -> None:
    again = stain_layout(mesh, TEXEL)
    for name in ("corners_uv", "index", "points_mm", "area_mm2", "neighbours"):
        np.testing.assert_array_equal(getattr(again, name), getattr(layout, name))


def test_neighbours_join_the_whole_surface_across_seams(layout: StainLayout) -> None:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = layout.neighbours.T
    count = len(layout.points_mm)
    assert np.linalg.norm(layout.points_mm[a] - layout.points_mm[b], axis=1).max() <= NEIGHBOUR_DISTANCE * TEXEL
    assert connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)))[0] == 1


def test_two_sides_of_a_thin_plate_are_no_neighbours() -> None:
    box = trimesh.creation.box((8.0, 0.4, 8.0)).subdivide().subdivide()
    plate = Mesh(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int32))
    layout = stain_layout(plate, TEXEL)
    middle = np.abs(layout.points_mm[:, [0, 2]]).max(axis=1) < 3.0
    a, b = layout.neighbours[middle[layout.neighbours].all(axis=1)].T
    assert len(a) > 100
    assert (np.sign(layout.points_mm[a, 1]) == np.sign(layout.points_mm[b, 1])).all()


def test_textures_and_depths_are_the_same_thing(layout: StainLayout) -> None:
    depth = np.random.default_rng(2).uniform(0, 2, len(layout.points_mm))
    stain = layout.texture(depth)
    np.testing.assert_allclose(layout.depths(stain), depth, rtol=1e-12)
    assert (stain.transmittance[layout.index < 0] == 1).all()


def test_texels_follow_the_pixels_within_limits() -> None:
    assert texel_edge_mm(0.4) == pytest.approx(0.6)
    assert (texel_edge_mm(0.01), texel_edge_mm(5.0)) == TEXEL_MM
