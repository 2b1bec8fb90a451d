"""Enamel thickness, compared with published figures of a real tooth."""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.core.files.meshes import read_mesh
from services.core.geometry import Mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from services.phantom.dome_rig import dome_cameras
from services.transport.thickness import enamel_thickness_mm, thickness_image, thickness_map, uncertain_thickness
from tests.support.shared_data import shared_path
from tests.support.small_tooth import SEMI_AXES_MM, dentin_shape, ellipsoid, sphere


def test_the_real_incisors_figures() -> None:
    folder = shared_path("data/tooth-ur1")
    thickness = enamel_thickness_mm(
        read_mesh(folder / "UR1_enamel.ply").vertices_mm, read_mesh(folder / "UR1_dentin.ply")
    )
    # Published to three digits; a candidate triangle missed near an edge costs up to spacing^2 / 2d = 0.005 mm.
    assert thickness.mean() == pytest.approx(0.653, abs=0.002)
    assert np.percentile(thickness, 95) == pytest.approx(1.066, abs=0.003)
    assert thickness.max() == pytest.approx(1.34, abs=0.006)
    assert np.mean(thickness < 0.05) == pytest.approx(0.06, abs=0.005)


def test_the_image_shows_what_the_camera_sees() -> None:
    tooth = build_incisor()
    (camera,) = dome_cameras(1, 0.5, (tooth.outer,))
    image = thickness_image(tooth.outer, tooth.dentin, camera)
    width, height = camera.size
    assert image.shape == (height, width)
    assert np.isnan(image[[0, -1]]).all()
    assert np.isnan(image[:, [0, -1]]).all()
    # The silhouette's area at half-millimetre pixels.
    assert np.isfinite(image).sum() * 0.25 == pytest.approx(105, abs=6)
    # Thin over the root at the top of the picture, thick towards the incisal edge at its bottom.
    rows = np.array([np.nanmedian(row) for row in image[4:-4]])
    assert rows[0] < 0.2
    assert rows[-1] > 0.9


def test_the_image_of_the_scanned_tooth_has_its_pixels() -> None:
    root = shared_path("data/tooth-ur1-truth")
    capture = read_record(root / "capture.json", FolderCapture)
    outer, dentin = (read_mesh(root / f"teeth/11/{name}.ply") for name in ("outer", "dentin"))
    image = thickness_image(outer, dentin, capture.cameras[0])
    lit = np.load(root / "c0_l0.npy")[..., 0] > 0
    # Every pixel whose centre sees the tooth is lit through it; a lit rim pixel's centre may miss it.
    assert not np.any(np.isfinite(image) & ~lit)
    assert np.isfinite(image).sum() > 0.8 * lit.sum()


def test_errors_of_weights_become_errors_of_thickness() -> None:
    # A ball of dentin that shrinks: thickness is 0.5 + 0.4 c, so its error is 0.4 that of c, at every point and of the
    # mean.
    ball = sphere(3.5)
    shape = DentinShape(ball, -0.4 * sphere(1.0).vertices_mm[None])
    found = uncertain_thickness(sphere(4.0).vertices_mm, shape, np.array([0.3]), np.array([[0.05**2]]))
    # Tolerances for the faceted balls: 642 vertices each, with radii up to 0.5 % too short between vertices.
    np.testing.assert_allclose(found.values_mm, 0.62, atol=0.02)
    np.testing.assert_allclose(found.errors_mm, 0.02, rtol=0.02)
    assert abs(found.mean_error_mm - 0.02) < 4e-4


def test_errors_against_many_drawn_shapes() -> None:
    # Two modes with correlated weights: 150 draws give a standard deviation to 5.8 %. The tolerance is 4 times that,
    # plus the second order of a spread of 0.05.
    shape, points = dentin_shape(), ellipsoid(SEMI_AXES_MM).vertices_mm[::40]
    weights, covariance = np.array([0.5, 0.4]), np.array([[0.0025, -0.001], [-0.001, 0.002]])
    found = uncertain_thickness(points, shape, weights, covariance)
    drawn = np.random.default_rng(1).multivariate_normal(weights, covariance, 150)
    seen = np.array([enamel_thickness_mm(points, Mesh(shape.vertices_mm(tuple(c)), shape.base.faces)) for c in drawn])
    np.testing.assert_allclose(found.errors_mm, seen.std(axis=0), rtol=0.25)
    assert abs(found.mean_error_mm / seen.mean(axis=1).std() - 1) < 0.25


def test_a_camera_sees_thickness_and_its_error_at_the_same_pixels() -> None:
    ball, outer = sphere(3.5), sphere(4.0)
    shape = DentinShape(ball, -0.4 * sphere(1.0).vertices_mm[None])
    (camera,) = dome_cameras(1, 0.5, (outer,))
    found = thickness_map(outer, shape, (0.3,), np.array([[0.05**2]]), camera)
    assert found is not None
    assert found.errors_mm is not None
    np.testing.assert_array_equal(np.isfinite(found.image_mm), np.isfinite(found.errors_mm))
    # As above; here a ray may also meet a flat face of the ball instead of a vertex.
    np.testing.assert_allclose(found.image_mm[np.isfinite(found.image_mm)], 0.62, atol=0.03)
    np.testing.assert_allclose(found.errors_mm[np.isfinite(found.errors_mm)], 0.02, rtol=0.03)
    assert found.mean.se == pytest.approx(0.02, rel=0.03)
    assert found.mean.determined

    # With known dentin it is the plain image; with assumed dentin the same image, marked as not determined; elsewhere
    # there is nothing to see.
    inside = Mesh(shape.vertices_mm((0.3,)), ball.faces)
    for dentin, weights, is_known in ((DentinShape.known(inside), (), True), (shape, (0.3,), False)):
        plain = thickness_map(outer, dentin, weights, None, camera)
        assert plain is not None
        assert plain.errors_mm is None
        assert plain.mean.determined is is_known
        np.testing.assert_array_equal(plain.image_mm, thickness_image(outer, inside, camera))
    assert (
        thickness_map(Mesh(outer.vertices_mm + np.array([0.0, 500.0, 0.0]), outer.faces), shape, (0.3,), None, camera)
        is None
    )
