"""The virtual laboratory's optics: lens, sensor, highlights, scan, and the file that describes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.calibrate.lights.mirror import highlight_points
from services.core.geometry import Camera, Mesh
from services.core.raw.folder import read_raw_folder
from services.core.raw.frames import read_counts
from services.phantom.lab.folder import RawWriter
from services.phantom.lab.mouth import FITTED, SCAN_NOISE_MM, LabMouth, landmarks_mm, true_mouth
from services.phantom.lab.rig import CAMERA_MM, Lens, RigSize, true_rig
from services.phantom.lab.sensor import Sensor
from services.phantom.lab.session import GLINT, MIRROR_MM, WHITE_RADIANCE, Session

SIZE = RigSize((160, 120), 0.5, 2, 4)
RIG = true_rig(SIZE, 64.0, 5)


@pytest.fixture(scope="module")
def mouth() -> LabMouth:
    return true_mouth(3, 1)


def test_a_lens_and_its_inverse_agree() -> None:
    lens = Lens(RIG.cameras[0])
    points = np.random.default_rng(0).uniform(-25, 25, (200, 3))
    pinhole = Camera.project(RIG.cameras[0], points)[0]
    # OpenCV iterates the inverse to 1e-9 of a focal length of a thousand pixels.
    np.testing.assert_allclose(lens.undistorted(lens.project(points)), pinhole, atol=1e-4)
    assert np.abs(lens.project(points) - pinhole).max() > 0.1


def test_a_rig_is_off_its_plan_and_keeps_the_gauge() -> None:
    np.testing.assert_allclose(np.mean([light.intensity for light in RIG.lights], axis=0), 1, rtol=1e-12)
    for camera in RIG.cameras:
        pixel, depth = camera.project(np.zeros((1, 3)))
        # A camera is aimed when it is mounted, so the teeth are at its principal point.
        np.testing.assert_allclose(pixel[0], [camera.K[0][2], camera.K[1][2]], atol=1e-6)
        assert 1.0 < abs(depth[0] - CAMERA_MM) + abs(camera.K[0][0] * SIZE.pixel_mm - CAMERA_MM) < 60.0


def test_a_sensors_noise_is_as_said() -> None:
    sensor, camera = Sensor(mosaic="RGGB"), RIG.cameras[0]
    even = np.full((120, 160, 3), 0.5 * WHITE_RADIANCE)
    one, two = (sensor.photograph(camera, even, 0.02, np.random.default_rng(k)).astype(float) for k in (1, 2))
    signal = sensor.filtered(even / np.array(camera.radiance_per_count))[:2, :2] * 0.02
    for row, column in np.ndindex(2, 2):
        part, other = one[row::2, column::2], two[row::2, column::2]
        expected = signal[row, column]
        read = sensor.read_electrons * sensor.counts_per_electron
        variance = expected * sensor.counts_per_electron + read**2 + 1 / 12
        # 4,800 values: the mean to five of its standard errors, their variance to five times sqrt(2 / n).
        assert part.mean() - sensor.black == pytest.approx(expected, abs=float(5 * np.sqrt(variance / part.size)))
        assert (part - other).var() / 2 == pytest.approx(variance, rel=5 * np.sqrt(2 / part.size))
    assert sensor.photograph(camera, 100 * even, 0.02, np.random.default_rng(1)).max() == 4095


def test_a_session_is_a_raw_folder_and_its_highlights_obey_the_law_of_reflection(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    sensor = Sensor(full_well=1e9, read_electrons=0.0)
    writer = RawWriter(tmp_path, RIG, sensor, random)
    session = Session(writer, random, 1)
    session.sphere(1, 4, 2, "mirror")
    session.board(1, 0)
    board = {"name": "plate", "type": "chessboard", "squares": [9, 7], "square_mm": 7.0}
    writer.finish({"sphere": [{"name": "mirror", "kind": "mirror", "radius_mm": MIRROR_MM}], "board": [board]})
    folder = read_raw_folder(tmp_path)
    assert [frame.kind for frame in folder.frame] == ["mirror-sphere", "board"]

    # The calibration solves Alhazen's problem by another method.
    camera = RIG.cameras[1]
    pose = np.array(camera.camera_from_world)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    spot = highlight_points(eye, np.array([RIG.lights[2].position_mm]), session.centres_mm[4], MIRROR_MM)
    pixel = Lens(camera).project(spot)[0]
    counts = read_counts(tmp_path, folder, folder.frame[0]).astype(float) - sensor.black
    scale = np.array(camera.radiance_per_count) / (0.02 * WHITE_RADIANCE)
    light = counts * scale[[[0, 1], [1, 2]]][np.ix_(np.arange(120) % 2, np.arange(160) % 2)]
    y, x = np.mgrid[0:120, 0:160] + 0.5
    near = np.hypot(x - pixel[0], y - pixel[1]) < 5
    weight = np.where(near, light - 0.02, 0)
    # Rounding to counts moves the mean by less than a hundredth of a pixel.
    assert (weight * x).sum() / weight.sum() == pytest.approx(pixel[0], abs=0.02)
    assert (weight * y).sum() / weight.sum() == pytest.approx(pixel[1], abs=0.02)
    assert light[near].max() == pytest.approx(GLINT, rel=0.3)


def test_a_scan_is_open_at_the_neck_and_as_noisy_as_said(mouth: LabMouth) -> None:
    scan = mouth.scan
    assert sorted(set(scan.fdi.tolist())) == [0, 11, 12, 13, 21, 22, 23]
    assert (scan.mesh.edge_counts() == 1).sum() > 50
    own = np.unique(scan.mesh.faces[scan.fdi == FITTED])
    world = scan.mesh.vertices_mm[own] @ mouth.world_from_scan[:3, :3].T + mouth.world_from_scan[:3, 3]
    from trimesh import Trimesh
    from trimesh.proximity import closest_point

    outer = mouth.fitted.outer
    distance = closest_point(Trimesh(outer.vertices_mm, outer.faces, process=False), world)[1]
    # Of noise in three directions, only the part across the surface changes it; some hundred vertices give it to a
    # tenth.
    assert np.sqrt((distance**2).mean()) == pytest.approx(SCAN_NOISE_MM, rel=0.2)


def test_the_measured_tooth_stands_in_gums_among_teeth_with_dentin(mouth: LabMouth) -> None:
    from trimesh import Trimesh

    assert mouth.fitted.fdi == FITTED
    assert [tooth.fdi for tooth in mouth.teeth] == [11, 13, 12, 21, 22, 23]
    gums = Trimesh(mouth.gums.vertices_mm, mouth.gums.faces, process=False)
    mouth.gums.require_solid("gums")
    for tooth in mouth.teeth:
        assert tooth.dentin is not None
        points = tooth.outer.vertices_mm
        low, high = points[points[:, 2] < -6][::5], points[points[:, 2] > 1][::20]
        assert gums.contains(low).all()
        assert not gums.contains(high).any()


def test_a_scans_root_is_as_wide_below_the_gums_as_the_one_it_does_not_see(mouth: LabMouth) -> None:
    # Light passes through the thin gums beside the neck, whose crest is at -2.4 mm, into the root and to the crown.
    jaw = jaw_from_scan(mouth.scan, "whole")
    world_from_arch = mouth.world_from_scan @ np.linalg.inv(jaw.arch_from_scan)
    made = next(tooth.outer for tooth in jaw.teeth if tooth.fdi == FITTED)
    made = Mesh(made.vertices_mm @ world_from_arch[:3, :3].T + world_from_arch[:3, 3], made.faces)
    for height in (-2.5, -3.0):
        found, true = (_width_mm(mesh, height) for mesh in (made, mouth.fitted.outer))
        assert found == pytest.approx(true, rel=0.03)


def _width_mm(mesh: Mesh, height_mm: float) -> float:
    from trimesh import Trimesh

    cut = Trimesh(mesh.vertices_mm, mesh.faces, process=False).section([0, 0, 1], [0, 0, height_mm])
    return float(np.ptp(cut.vertices[:, 0]))


def test_landmarks_lie_on_their_teeth_edge_below_neck(mouth: LabMouth) -> None:
    found = landmarks_mm(mouth)
    assert len(found) == 12
    turn, shift = mouth.world_from_scan[:3, :3], mouth.world_from_scan[:3, 3]
    for tooth in (one.fdi for one in mouth.teeth):
        edge, neck = (turn @ found[tooth, name] + shift for name in ("edge", "neck"))
        assert 6 < edge[2] - neck[2] < 12
