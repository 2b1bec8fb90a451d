"""Meshes that Mitsuba holds give back their vertices and triangles, also after a move."""

from __future__ import annotations

import numpy as np

from services.transport.platform import prepare_device
from services.transport.scene.mitsuba_mesh import faces_of, move_vertices, new_mesh, vertices_of

VERTICES_MM = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)


def test_a_mesh_gives_back_its_surface_and_moves() -> None:
    prepare_device()
    import mitsuba as mi

    mesh = new_mesh("tooth", VERTICES_MM, FACES)
    np.testing.assert_array_equal(vertices_of(mesh), VERTICES_MM)
    np.testing.assert_array_equal(faces_of(mesh), FACES)

    scene = mi.load_dict({"type": "scene", "tooth": mesh}, optimize=False)
    move_vertices(mi.traverse(scene), "tooth", VERTICES_MM + np.array([0, 0, 5]))
    np.testing.assert_array_equal(vertices_of(scene.shapes()[0]), VERTICES_MM + np.array([0, 0, 5]))
    # A ray that meets the mesh's lowest face shows that the scene's own structure moved too.
    hit = scene.ray_intersect(mi.Ray3f([0.1, 0.1, -1.0], [0.0, 0.0, 1.0]))
    np.testing.assert_allclose(np.array(hit.t), 6.0, rtol=1e-6)
