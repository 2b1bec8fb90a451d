"""An asset shows the scan where the fit found it: cameras and lights of the asset are placed by the found pose."""

from __future__ import annotations

import numpy as np

from services.assets.stage import found_pose
from services.core.geometry import Tooth
from services.core.results import Estimate, FitReport
from services.transport.scene.rigid_moves import SCAN, moved_camera, moved_light, rigid
from tests.support.prepared import camera, lights, sphere

TOOTH = Tooth(11, sphere(4.0), None)
CENTRE_MM = TOOTH.outer.vertices_mm.mean(axis=0)


def report(*poses: tuple[list[float], float]) -> FitReport:
    """A report whose channels have these poses, each with one standard error."""
    instrument = {
        f"channel{k}": {
            name: Estimate(value=value, se=se, unit="", determined=True)
            for name, value in zip(SCAN, twist, strict=True)
        }
        for k, (twist, se) in enumerate(poses)
    }
    return FitReport.model_construct(instrument=instrument)


def test_channels_agree_on_one_pose_by_their_precision() -> None:
    first, second = [0.01, 0.0, 0.0, 0.3, 0.0, 0.1], [0.03, 0.0, 0.0, 0.0, 0.3, 0.1]
    expected = rigid(np.array([0.014, 0.0, 0.0, 0.24, 0.06, 0.1]), CENTRE_MM)
    np.testing.assert_allclose(found_pose(report((first, 0.1), (second, 0.2)), (TOOTH,)), expected, atol=1e-12)


def test_a_fit_without_a_pose_leaves_cameras_and_lights() -> None:
    np.testing.assert_array_equal(found_pose(report(), (TOOTH,)), np.eye(4))


def test_cameras_and_lights_see_the_scan_as_it_stood() -> None:
    move = found_pose(report(([0.02, -0.01, 0.03, 0.3, -0.2, 0.1], 0.1)), (TOOTH,))
    points = TOOTH.outer.vertices_mm
    stood = points @ move[:3, :3].T + move[:3, 3]
    np.testing.assert_allclose(
        moved_camera(camera("c0"), move).project(points)[0], camera("c0").project(stood)[0], atol=1e-9
    )
    for light in lights():
        np.testing.assert_allclose(
            np.linalg.norm(np.array(moved_light(light, move).position_mm) - points, axis=1),
            np.linalg.norm(np.array(light.position_mm) - stood, axis=1),
        )
