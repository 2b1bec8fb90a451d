"""Where a scan is in the rig: derivatives, landmarks with wrong clicks, outlines of known shapes, a phantom and a
patient.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from services.calibrate.registration.appearance import learn_appearance
from services.calibrate.registration.contours import tooth_contours
from services.calibrate.registration.landmarks import CLICK_MM, Click
from services.calibrate.registration.outlines import View, pose_from_outlines
from services.calibrate.registration.pose import RigidPose, pixel_derivatives
from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Mesh
from services.phantom.dome_rig import dome_cameras
from tests.support import patient_photos
from tests.support.landmark_pose import pose_from_landmarks
from tests.support.photographed_mouth import clicks_on, photographed_mouth
from tests.support.shared_data import shared_path

ARCH = Mesh(np.array([[-30.0, -20, -4], [30, -20, -4], [0, 20, 4]]), np.array([[0, 1, 2]], dtype=np.int32))
CAMERAS = {camera.name: camera for camera in dome_cameras(3, 0.15, (ARCH,))}
CENTRE = np.array([1.0, -4.0, 2.0])


def drawn_pose(rng: np.random.Generator) -> RigidPose:
    return RigidPose(Rotation.from_rotvec(rng.uniform(-1, 1, 3)).as_matrix(), rng.uniform(-20, 20, 3))


def drawn_clicks(rng: np.random.Generator, rig_from_scan: RigidPose, sigma_mm: float) -> list[Click]:
    # Points along an arch, each clicked in all cameras.
    turn = np.linspace(0.2, np.pi - 0.2, 7)
    rig = np.stack([28 * np.cos(turn), 35 * np.sin(turn) - 20, rng.uniform(-3, 3, 7)], axis=1)
    scan = (rig - rig_from_scan.translation_mm) @ rig_from_scan.rotation
    return [
        Click(
            f"{number} tip",
            camera.name,
            scan[number],
            camera.project(rig[number][None])[0][0] + rng.normal(0, sigma_mm / camera.pixel_mm(rig[number]), 2),
        )
        for number in range(len(rig))
        for camera in CAMERAS.values()
    ]


def test_derivatives_of_pixels_agree_with_differences() -> None:
    rng, camera = np.random.default_rng(3), CAMERAS["c1"]
    points, still = rng.uniform(-20, 20, (5, 3)), RigidPose(np.eye(3), np.zeros(3))
    exact = pixel_derivatives(camera, points, CENTRE)
    for k in range(6):
        step = 1e-5 * np.eye(6)[k]
        ahead, behind = (camera.project(still.moved(sign * step, CENTRE).apply(points))[0] for sign in (1, -1))
        # Central differences of step h are off by h², 1e-10 of some 7,000 px a radian.
        np.testing.assert_allclose((ahead - behind) / 2e-5, exact[:, :, k], atol=1e-4)


def test_a_twist_leads_from_one_pose_to_the_other() -> None:
    rng = np.random.default_rng(4)
    one, two = drawn_pose(rng), drawn_pose(rng)
    there = one.moved(one.twist_to(two, CENTRE), CENTRE)
    np.testing.assert_allclose(there.matrix, two.matrix, atol=1e-12)


@pytest.mark.slow
def test_landmarks_give_the_pose_and_honest_errors() -> None:
    scores = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = drawn_pose(rng)
        exact = pose_from_landmarks(CAMERAS, drawn_clicks(rng, truth, 0.0), CENTRE)
        np.testing.assert_allclose(exact.pose.matrix, truth.matrix, atol=1e-6)
        found = pose_from_landmarks(CAMERAS, drawn_clicks(rng, truth, CLICK_MM), CENTRE)
        twist = found.pose.twist_to(truth, found.pose.apply(CENTRE[None])[0])
        # Whitened, as errors of rotation and shift are correlated.
        scores.append(np.linalg.solve(np.linalg.cholesky(found.covariance), twist))
    # 72 values; this is the range by chance (0.7 to 1.35 holds from 32 values on).
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.35


def test_wrong_clicks_are_left_out_and_named() -> None:
    rng = np.random.default_rng(8)
    truth = drawn_pose(rng)
    clicks = drawn_clicks(rng, truth, 0.1)
    wrong = [
        Click(one.name, one.camera, one.point_mm, one.pixel + np.array([30, 10])) if k in (4, 9) else one
        for k, one in enumerate(clicks)
    ]
    found = pose_from_landmarks(CAMERAS, wrong, CENTRE)
    assert [text.rpartition(",")[0] for text in found.left_out] == [
        f"{clicks[k].name} in camera {clicks[k].camera}" for k in (4, 9)
    ]
    assert np.linalg.norm(found.pose.twist_to(truth, CENTRE)[3:]) < 0.2


def test_exchanged_landmarks_are_refused() -> None:
    rng = np.random.default_rng(9)
    clicks = drawn_clicks(rng, drawn_pose(rng), 0.1)
    # Clicks of other teeth: each landmark has the pixels of the one two places further.
    points = np.roll([one.point_mm for one in clicks][::3], 2, axis=0)
    shifted = [Click(one.name, one.camera, points[k // 3], one.pixel) for k, one in enumerate(clicks)]
    with pytest.raises(
        CaptureInputError, match=r"landmarks contradict the others; the worst is .* or tooth with tooth"
    ):
        pose_from_landmarks(CAMERAS, shifted, CENTRE)


def test_too_few_landmarks_are_refused() -> None:
    rng = np.random.default_rng(9)
    with pytest.raises(CaptureInputError, match=r"No camera sees 4 landmarks of the scan \(the most are 3\)"):
        pose_from_landmarks(CAMERAS, drawn_clicks(rng, drawn_pose(rng), 0.1)[:9], CENTRE)


def test_a_spheres_outline_is_where_geometry_has_it() -> None:
    radius, distance, focal = 10.0, 300.0, 3000.0
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    camera = Camera(
        name="c", size=(260, 260), K=((focal, 0, 130.3), (0, focal, 129.6), (0, 0, 1)),
        camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, distance), (0, 0, 0, 1)),
    )  # fmt: skip
    contour, label = tooth_contours(camera, [Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))])
    offset = contour.pixels - [130.3, 129.6]
    away = np.linalg.norm(offset, axis=1)
    # The line of sight touches the sphere; its polyhedron lies up to 0.04 % further in.
    expected = focal * radius / np.sqrt(distance**2 - radius**2)
    assert away.mean() == pytest.approx(expected, abs=0.05)
    # Directions come from a mask of whole pixels, smoothed over 1.5 of them: single ones are off by up to 10 degrees.
    along = np.einsum("ij,ij->i", offset / away[:, None], contour.outward)
    assert along.min() > 0.97
    assert along.mean() > 0.998
    assert np.abs(contour.points_mm[:, 2]).max() < 0.2 * radius
    assert (label == 0).sum() == pytest.approx(np.pi * expected**2, rel=0.002)


def test_outlines_bring_a_phantom_within_the_target() -> None:
    mouth = photographed_mouth(None, 1)
    start = pose_from_landmarks(mouth.cameras, clicks_on(mouth, np.random.default_rng(1)), mouth.centre_mm)
    # A camera that sees no tooth changes nothing and is reported.
    views = (*mouth.views, turned_away(mouth.views[0]))
    found = pose_from_outlines(views, mouth.teeth, [mouth.gums], start, mouth.centre_mm)
    assert found.left_out[-1] == "camera away, which sees no tooth at this pose"
    assert set(found.residual_px) == set(mouth.cameras)
    centre = mouth.rig_from_scan.apply(mouth.centre_mm[None])[0]
    twist = found.pose.twist_to(mouth.rig_from_scan, centre)
    # The target of the design: an error of 0.2 mm alone would change an image by 3 to 5 %.
    assert np.linalg.norm(twist[3:]) < 0.05
    assert np.degrees(np.linalg.norm(twist[:3])) < 0.1
    assert (np.sqrt(np.diag(found.covariance))[3:] < 0.05).all()
    # Clicks alone do not reach it.
    assert np.linalg.norm(start.pose.twist_to(mouth.rig_from_scan, centre)[3:]) > 0.05


def turned_away(view: View) -> View:
    pose = np.diag([-1.0, 1, -1, 1]) @ np.asarray(view.camera.camera_from_world)
    fields = view.camera.model_dump() | {"name": "away", "camera_from_world": tuple(map(tuple, pose.tolist()))}
    return View(Camera.model_validate(fields), view.image)


@pytest.mark.parametrize("channels", [1, 3, 8])
def test_a_tooth_is_told_from_gums_by_any_number_of_channels(channels: int) -> None:
    rng, tooth = np.random.default_rng(5), np.zeros((80, 90), dtype=bool)
    tooth[20:60, 25:65] = True
    colour = np.where(tooth[..., None], np.linspace(0.8, 0.6, channels), np.linspace(0.5, 0.2, channels))
    image = (colour * (1 + rng.normal(0, 0.02, colour.shape))).astype(np.float32)
    likeness = learn_appearance(image, tooth).likeness
    # The colours differ by 15 standard deviations of the noise; pixels beside the outline are smoothed across it.
    assert likeness[25:55, 30:60].min() > 0.9
    assert likeness[:15].max() < 0.1


# The other view takes the same way; its limit is wider.
@pytest.mark.parametrize(("view", "limit_px"), [pytest.param("frontal", 4.0, marks=pytest.mark.slow), ("upper", 3.0)])
def test_a_patients_teeth_meet_their_labelled_edges(view: str, limit_px: float) -> None:
    root = shared_path("data/intraoral-photos")
    teeth, camera = patient_photos.upper_teeth(root), patient_photos.camera(view)
    centre = np.concatenate([mesh.vertices_mm for mesh in teeth]).mean(axis=0)
    start = pose_from_landmarks({view: camera}, patient_photos.clicks(view), centre)
    found = pose_from_outlines([patient_photos.photograph(root, view)], teeth, [], start, centre)
    placed = [Mesh(found.pose.apply(mesh.vertices_mm), mesh.faces) for mesh in teeth]
    contour, _ = tooth_contours(camera, placed)
    # The data's own fit comes to 2 to 4 px frontal and 0 to 3 px above.
    assert np.median(patient_photos.distance_to_edges_px(root, view, contour.pixels)) <= limit_px
