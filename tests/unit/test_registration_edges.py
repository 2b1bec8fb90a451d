"""Edges located by their light: unbiased beside darkness and gums, under lens blur and a shade; and the pose found from
them.
"""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.visibility import visible_surfaces
from services.calibrate.registration.appearance import learn_appearance
from services.calibrate.registration.edges import edges_in_light
from services.calibrate.registration.landmarks import Click
from services.calibrate.registration.outlines import View, pose_from_outlines
from services.calibrate.registration.pose import RigidPose
from services.core.geometry import Camera, Mesh
from services.phantom.lab.mouth import landmarks_mm, true_mouth
from services.phantom.lab.rig import RigSize, true_rig
from tests.support.landmark_pose import pose_from_landmarks

TOOTH, GUMS, DARK = np.array([0.75, 0.66, 0.52]), np.array([0.50, 0.24, 0.22]), np.array([0.01, 0.01, 0.01])
SIZE, RADIUS, CENTRE = 80, 24.3, np.array([40.2, 39.7])
FINER = 8


def disc(outside: np.ndarray, blur_px: float, shade_px: float, noise: float) -> np.ndarray:
    """A photograph (H, W, 3) of a disc with the colour of a tooth; a shade of this width is over its edge."""
    import cv2

    y, x = (np.mgrid[0 : SIZE * FINER, 0 : SIZE * FINER] + 0.5) / FINER
    beyond = np.hypot(x - CENTRE[0], y - CENTRE[1]) - RADIUS
    fine = np.where(beyond[..., None] < 0, TOOTH, outside)
    if shade_px:
        fine = fine * (1 - 0.5 * np.exp(-(beyond**2) / (2 * shade_px**2)))[..., None]
    image = fine.reshape(SIZE, FINER, SIZE, FINER, 3).mean(axis=(1, 3))
    if blur_px:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    return np.asarray((image + np.random.default_rng(0).normal(0, noise, image.shape)).astype(np.float32))


def around(off_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Points at this distance from the disc's edge, and the directions out of the disc."""
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    outward = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return CENTRE + (RADIUS - off_px) * outward, outward


@pytest.mark.parametrize(
    ("outside", "blur_px", "shade_px"),
    [(DARK, 0.0, 0.0), (DARK, 0.9, 0.0), (GUMS, 0.0, 0.0), (GUMS, 0.9, 0.0), (GUMS, 0.5, 1.5)],
)
def test_an_edge_is_where_its_light_ends(outside: np.ndarray, blur_px: float, shade_px: float) -> None:
    image = disc(outside, blur_px, shade_px, 0.003)
    pixels, outward = around(0.4)
    found, is_told = edges_in_light(image, pixels, outward, np.zeros(len(pixels)))
    assert is_told.mean() > 0.95
    # Noise changes the mean by 0.01 px; a blurred disc looks smaller by blur² / (2 radius), 0.02 px.
    assert found[is_told].mean() == pytest.approx(0.4, abs=0.05)


def test_likeness_to_tooth_puts_an_edge_to_the_dark_too_far_out() -> None:
    # This is why edges are located by their light: the likeness passes a half where a tooth's share of a pixel is
    # still small.
    image, (pixels, outward) = disc(DARK, 0.0, 0.0, 0.003), around(0.0)
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    likeness = learn_appearance(image, np.hypot(x - CENTRE[0], y - CENTRE[1]) < RADIUS).likeness
    further = pixels + 0.3 * outward - 0.5
    assert np.median(likeness[further[:, 1].round().astype(int), further[:, 0].round().astype(int)]) > 0.5
    assert abs(np.mean(edges_in_light(image, pixels, outward, np.zeros(len(pixels)))[0])) < 0.05


def test_no_edge_is_told_where_there_is_none_or_it_leaves_the_picture() -> None:
    pixels, outward = around(0.0)
    even = np.broadcast_to(TOOTH, (SIZE, SIZE, 3)).astype(np.float32)
    assert not edges_in_light(even, pixels, outward, np.zeros(len(pixels)))[1].any()
    image = disc(DARK, 0.0, 0.0, 0.0)
    # Three pixels away from the edge, both sides look the same.
    assert not edges_in_light(image, pixels, outward, np.full(len(pixels), 7.0))[1].any()
    beside = np.array([[2.0, 40.0], [78.0, 40.0]])
    assert not edges_in_light(image, beside, np.array([[1.0, 0.0], [1.0, 0.0]]), np.zeros(2))[1].any()


@pytest.mark.slow
@pytest.mark.parametrize("subject", [31, 32, 33])
def test_plain_colours_do_not_turn_six_front_teeth(subject: int) -> None:
    # By likeness to tooth alone, the teeth would tilt by 0.4 to 0.6 degrees, always to the same side.
    mouth, rig = true_mouth(subject, subject), true_rig(RigSize((480, 352), 0.19, 3, 1), 0.0, subject)
    teeth, here = [tooth.outer for tooth in mouth.teeth], RigidPose(np.eye(3), np.zeros(3))
    cameras = [Camera(**{name: getattr(one, name) for name in Camera.model_fields}) for one in rig.cameras]
    colours = np.array([DARK, *[TOOTH] * len(teeth), GUMS])
    random = np.random.default_rng(subject)
    views = [View(camera, plain(camera, [*teeth, mouth.gums], colours, random)) for camera in cameras]
    points = [(str(name), mouth.world_from_scan[:3] @ [*point, 1]) for name, point in landmarks_mm(mouth).items()]
    clicks = [
        Click(name, camera.name, point, camera.project(point[None])[0][0] + random.normal(0, 1.0, 2))
        for name, point in points
        for camera in cameras
    ]
    centre = np.concatenate([mesh.vertices_mm for mesh in teeth]).mean(axis=0)
    start = pose_from_landmarks({camera.name: camera for camera in cameras}, clicks, centre)
    found = pose_from_outlines(views, teeth, [mouth.gums], start, centre, 8.0)
    twist = found.pose.twist_to(here, found.pose.apply(centre[None])[0])
    # A fifth of that tilt, and the design's 0.05 mm; all but one draw in a thousand are within the stated covariance
    # (chi squared of 6).
    assert np.degrees(np.linalg.norm(twist[:3])) < 0.12
    assert np.linalg.norm(twist[3:]) < 0.05
    assert twist @ np.linalg.solve(found.covariance, twist) < 22.5
    assert np.degrees(np.sqrt(np.diag(found.covariance)[:3])).max() < 0.15


def plain(camera: Camera, meshes: list[Mesh], colours: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A photograph (H, W, 3) of surfaces of uniform brightness, drawn four times finer."""
    finer = 4
    (fx, skew, cx), (_, fy, cy), last = camera.K
    K = ((finer * fx, finer * skew, finer * cx), (0.0, finer * fy, finer * cy), last)
    size = (camera.size[0] * finer, camera.size[1] * finer)
    fine = camera.model_copy(update={"size": size, "K": K})
    image = colours[visible_surfaces(fine, meshes).mesh + 1]
    image = image.reshape(camera.size[1], finer, camera.size[0], finer, 3).mean(axis=(1, 3))
    return np.asarray((image + random.normal(0, 0.003, image.shape)).astype(np.float32))
