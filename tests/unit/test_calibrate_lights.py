"""Lights from highlights on mirror spheres: the law of reflection, known truth, and the positions of a measured rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import pose_matrix
from services.calibrate.lights.listed import align_list, swapped_names
from services.calibrate.lights.mirror import (
    PosedCamera,
    highlight_points,
    mirrored_rays,
    outline_errors,
    sphere_from_outline,
)
from services.calibrate.lights.positions import LightsFit, fit_lights
from services.core.errors import CaptureInputError
from tests.support.shared_data import shared_path
from tests.support.sphere_sessions import SphereSession, dome_lights, outline_points, sphere_session, three_cameras

NAMES = [f"L{number}" for number in range(60)]


def test_highlights_obey_the_law_of_reflection() -> None:
    camera, centre = three_cameras()[0], np.array([10.0, -20, 5])
    lights = dome_lights(40, np.random.default_rng(0))
    points = highlight_points(camera.centre_mm, lights, centre, 25.0)
    normals = (points - centre) / 25.0
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=1e-12)
    halves = sum(
        (aim - points) / np.linalg.norm(aim - points, axis=1, keepdims=True) for aim in (lights, camera.centre_mm[None])
    )
    assert np.cross(halves, normals) == pytest.approx(0, abs=1e-12)
    seen, rays = mirrored_rays(camera, camera.project(points), centre, 25.0)
    assert seen == pytest.approx(points, abs=1e-6)
    assert np.cross(lights - seen, rays) / 1000 == pytest.approx(0, abs=1e-6)


def test_a_sphere_is_where_its_outline_says() -> None:
    camera, centre = three_cameras()[2], np.array([-40.0, 30, 20])
    edge, _ = outline_points(camera, centre, 25.0, 40)
    assert sphere_from_outline(camera, edge, 25.0) == pytest.approx(centre, abs=1e-6)
    assert outline_errors(camera, edge, centre, 25.0) == pytest.approx(0, abs=1e-6)


def whitened(fit: LightsFit, session: SphereSession) -> np.ndarray:
    errors = (fit.positions_mm - session.lights_mm[fit.lights], fit.centres_mm - session.centres_mm)
    error = np.concatenate([one.ravel() for one in errors])
    covariance = fit.covariance[: len(error), : len(error)]
    scale = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(scale, scale))
    return np.asarray(np.linalg.solve(factor, error / scale))


def test_errors_of_lights_are_as_large_as_their_covariance_says() -> None:
    """Two sessions of 12 lights and 4 spheres: 96 values, so rms z has a standard error of 0.07."""
    pooled = []
    for seed in range(2):
        random = np.random.default_rng(seed)
        session = sphere_session(random, dome_lights(12, random))
        fit = fit_lights(session.views, session.cameras, NAMES)
        assert fit.outliers == ()
        pooled.append(whitened(fit, session))
    assert 0.8 < np.sqrt(np.mean(np.square(pooled))) < 1.25


@pytest.mark.slow
def test_errors_of_cameras_reach_the_lights() -> None:
    """Cameras moved by 50 µrad and 20 µm, which move lights more than noise does: 108 values."""
    pooled = []
    for seed in range(3):
        random = np.random.default_rng(20 + seed)
        session = sphere_session(random, dome_lights(8, random), highlight_px=0.005, edge_px=0.02)
        scale = np.tile(np.concatenate([np.full(8, 1e-9), np.full(3, 5e-5), np.full(3, 0.02)]), 3)
        off = random.normal(0, scale).reshape(3, 14)
        believed = [
            PosedCamera(camera.lens, camera.pose + one[8:]) for camera, one in zip(session.cameras, off, strict=True)
        ]
        pooled.append(whitened(fit_lights(session.views, believed, NAMES, np.diag(scale**2)), session))
    assert 0.8 < np.sqrt(np.mean(np.square(pooled))) < 1.25


def test_a_highlight_of_something_else_is_named() -> None:
    random = np.random.default_rng(3)
    session = sphere_session(random, dome_lights(10, random))
    wrong = session.views[5].highlights_px.copy()
    wrong[2] += [4.0, -3.0]
    views = [*session.views[:5], replace(session.views[5], highlights_px=wrong), *session.views[6:]]
    fit = fit_lights(views, session.cameras, NAMES)
    assert [(one.camera, one.place, one.light) for one in fit.outliers] == [(2, 1, session.views[5].lights[2])]
    assert 4.5 < fit.outliers[0].residual_px < 5.5


def test_a_light_that_shows_once_is_named() -> None:
    random = np.random.default_rng(4)
    session = sphere_session(random, dome_lights(6, random))
    views = [session.views[0]]
    for view in session.views[1:]:
        others = view.lights != session.views[0].lights[0]
        views.append(replace(view, lights=view.lights[others], highlights_px=view.highlights_px[others]))
    with pytest.raises(CaptureInputError, match=f"Light L{session.views[0].lights[0]} shows on a mirror sphere only"):
        fit_lights(views, session.cameras, NAMES)


def test_lights_of_a_measured_rig_are_found_again() -> None:
    """A published rig's eight lights, 350 to 520 mm before its camera, seen on four spheres through its intrinsics."""
    from scipy.io import loadmat

    folder = shared_path("data/near-light-rig")
    lights = np.asarray(loadmat(folder / "light.mat")["S"], dtype=np.float64)
    K = np.asarray(loadmat(folder / "camera.mat")["K"], dtype=np.float64)
    lights = lights if lights.shape[1] == 3 else lights.T
    assert lights.shape == (8, 3)
    # The rig has one camera; here three cameras have its lens, as a light is found only from two directions or more.
    lens = Lens((2592, 1944), np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    random = np.random.default_rng(1)
    # The rig's lights surround its camera, so its frame is moved to where the virtual cameras look from.
    turn = pose_matrix(np.array([np.pi, 0, 0, 0, 0, 450.0]))
    moved = lights @ turn[:3, :3].T + turn[:3, 3]
    session = sphere_session(random, moved, highlight_px=0.05, radius_mm=15.0)
    cameras = [PosedCamera(lens, camera.pose) for camera in session.cameras]
    views = []
    for view in session.views:
        camera, centre = cameras[view.camera], session.centres_mm[view.place]
        edge, _ = outline_points(camera, centre, 15.0, 60)
        points = highlight_points(camera.centre_mm, moved[view.lights], centre, 15.0)
        found = camera.project(points) + random.normal(0, 0.05, (len(points), 2))
        views.append(replace(view, outline_px=edge + random.normal(0, 0.1, edge.shape), highlights_px=found))
    fit = fit_lights(views, cameras, NAMES)
    off = np.linalg.norm(fit.positions_mm - moved, axis=1)
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert 0.7 < np.sqrt(np.mean(whitened(fit, replace(session, lights_mm=moved)) ** 2)) < 1.35


def test_a_list_is_laid_over_the_lights_and_swapped_names_are_found() -> None:
    random = np.random.default_rng(6)
    lights = dome_lights(20, random)
    motion = pose_matrix(np.array([0.3, -0.5, 0.2, 100, 50, -20]))
    listed = (lights - motion[:3, 3]) @ motion[:3, :3] + random.normal(0, 2, lights.shape)
    found = lights + random.normal(0, 1, lights.shape)
    found[[3, 8]] = found[[8, 3]]
    found[5] = np.nan
    aligned = align_list(listed, found)
    assert aligned is not None
    # 18 good lights with errors of 2 mm: the shift is known to about 2 ÷ √18 mm.
    assert np.linalg.norm(aligned.positions_mm - lights, axis=1).max() < 10
    assert aligned.outliers == (3, 8)
    assert swapped_names(found, aligned) == [(3, 8), (8, 3)]
    assert np.isnan(aligned.distances_mm[5])
    assert align_list(listed[:3], found[:3]) is None
