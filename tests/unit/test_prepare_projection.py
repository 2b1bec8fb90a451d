"""Projection, compared with an analytic sphere and, on the scanned incisor, with trimesh's ray tracer."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from services.core.files.meshes import read_teeth
from services.core.geometry import Camera, Mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from services.preprocess.views.projection import project
from tests.support.shared_data import shared_path

CAMERA = Camera(
    name="front",
    size=(64, 48),
    K=((4000, 0, 32), (0, 4000, 24), (0, 0, 1)),
    camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1000), (0, 0, 0, 1)),
)


def sphere(radius_mm: float, centre_mm: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius_mm)
    return Mesh(np.asarray(ball.vertices) + centre_mm, np.asarray(ball.faces, dtype=np.int32))


def test_sphere_depth_and_normal() -> None:
    view = project(CAMERA, [sphere(5)])
    y, x = np.nonzero(view.covered)
    origin, rays = CAMERA.rays(x.astype(np.float64) + 0.5, y.astype(np.float64) + 0.5)
    # First intersection of a ray with a sphere about the world's origin
    along = -rays @ origin
    hit = origin + (along - np.sqrt(along**2 - origin @ origin + 25))[:, None] * rays
    # The triangles lie below the sphere by at most this; seen obliquely that grows as 1/cos
    ball = sphere(5)
    sagitta_mm = 5 - np.linalg.norm(ball.vertices_mm[ball.faces].mean(axis=1), axis=1).min()
    facing = -(hit * rays).sum(axis=1) / 5
    central = facing > 0.3
    assert np.abs(view.depth_mm[y, x] - (hit[:, 2] + 1000))[central].max() < sagitta_mm / 0.3
    cosine = (view.normal[y, x] * hit / 5).sum(axis=1)
    # Interpolated normals err by less than the angle a triangle subtends from its centre
    assert np.arccos(np.clip(cosine, -1, 1))[central].max() < np.sqrt(2 * sagitta_mm / 5)


def test_covered_pixels_lie_wholly_inside_the_outline() -> None:
    view = project(CAMERA, [sphere(5)])
    y, x = np.mgrid[0:48, 0:64]
    # Outline of a sphere: a circle of tangent rays, sin = radius / distance
    outline_px = 4000 * np.tan(np.arcsin(5 / 1000))
    farthest = np.hypot(np.maximum(np.abs(x - 32), np.abs(x + 1 - 32)), np.maximum(np.abs(y - 24), np.abs(y + 1 - 24)))
    assert not view.covered[farthest > outline_px].any()
    assert view.covered[farthest < outline_px - 0.1].all()


def test_nearer_surface_wins_and_occluders_hide() -> None:
    near, far = sphere(2, (0, 0, -6)), sphere(5)
    view = project(CAMERA, [far, near])
    assert view.mesh[24, 32] == 1
    assert view.mesh[24, 32 + 15] == 0
    hidden = project(CAMERA, [far], [near])
    assert hidden.mesh[24, 32] == -1
    assert not hidden.covered[24, 32]
    assert hidden.covered[24, 32 + 15]


def test_the_part_of_a_mesh_in_front_of_the_camera_is_seen_where_another_part_is_behind_it() -> None:
    ball, far_behind = sphere(5), sphere(5, (0, 0, -2000))
    vertices = np.concatenate([ball.vertices_mm, far_behind.vertices_mm])
    both = Mesh(vertices, np.concatenate([ball.faces, far_behind.faces + len(ball.vertices_mm)]))
    np.testing.assert_array_equal(project(CAMERA, [both]).mesh, project(CAMERA, [ball]).mesh)


def test_surface_points_project_back_to_their_pixels() -> None:
    view = project(CAMERA, [sphere(5)])
    points = view.points_mm(CAMERA, slice(10, 30))
    y, x = np.nonzero(view.mesh[10:30] >= 0)
    image, _ = CAMERA.project(points[y, x].astype(np.float64))
    # float32 points 1 m away resolve 6e-5 mm, 4 px/mm
    assert np.abs(image - np.stack([x + 0.5, y + 10.5], axis=1)).max() < 5e-4
    assert np.isnan(points[0, 0]).all()


@pytest.mark.parametrize(("camera", "hit", "whole"), [(0, 395, 367), (1, 406, 380), (2, 403, 370)])
def test_incisor_pixels(camera: int, hit: int, whole: int) -> None:
    """The counts are those of trimesh's ray tracer on the same pixel centres and corners; the images, rendered by
    stock Mitsuba, confirm them.
    """
    folder = shared_path("data/tooth-ur1-truth")
    description = read_record(folder / "capture.json", FolderCapture)
    view = project(description.cameras[camera], [read_teeth(folder)[0].outer])
    assert (int(np.count_nonzero(view.mesh >= 0)), int(np.count_nonzero(view.covered))) == (hit, whole)
    light = np.max(
        [np.load(folder / entry.file)[..., 0] for entry in description.images if entry.camera == f"c{camera}"], axis=0
    )
    assert (light[view.mesh >= 0] > 0).all()
