"""First pose of a scan from points clicked in the scan and in photographs, over all cameras at once.

Starting poses come from landmarks that several cameras see, by triangulation, and from the points of one camera by
perspective-n-point (Terzakis and Lourakis, "A Consistently Fast and Globally Optimal Solution to the
Perspective-n-Point Problem", ECCV 2020). Each kind uses all points and random subsets of a few, so that a wrong click
spoils only some starts. The starts with the smallest errors, each click's error limited, are refined by robust least
squares over all cameras, and the best pose is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from services.calibrate.registration.pose import Floats, PoseStep, RigidPose, millimetres_a_pixel, pixel_derivatives
from services.core.errors import CaptureInputError
from services.core.geometry import Camera

CLICK_MM = 0.3
"""Standard error of a click in mm: the accuracy with which people place the tip of a cusp, in a scan and in a
photograph together."""
WRONG_CLICK_SIGMAS = 4.0
"""Error of a click in standard errors from which on it counts as wrong: one in 3,000 good clicks in two dimensions."""
DRAWS = 60
"""Number of random subsets for starting poses. With a third of the clicks wrong, 60 triples all contain a wrong click
only once in 10^9 cases."""
MIN_CLICKS = 4
"""Smallest number of clicks in at least one camera, and of right clicks in all cameras: three leave up to four poses,
and no way to recognise a wrong click."""
MIN_POINTS = 3
"""Smallest number of landmarks in several cameras for a starting pose: three points determine a rigid pose."""
MAX_CONDITION = 1e4
"""Condition number of the normal equations of lines of sight above which they are too parallel for triangulation."""
MIN_SPREAD_RATIO = 1e-3
"""Squared ratio of the points' spread across a line to that along it, below which the rotation about the line is
undetermined."""
REFINED_STARTS = 12
"""Number of starting poses that are refined over all cameras."""
MAX_WRONG_SHARE = 1 / 3
"""Largest fraction of wrong clicks: with more of them, another pose may agree with as many clicks."""
ROUNDS = 30
"""Largest number of Gauss–Newton steps of a refinement."""
CONVERGED = 1e-9
"""Size of a step's largest component, in rad or mm, below which a refinement ends."""


@dataclass(frozen=True)
class Click:
    """One point of the scan, and its position in one camera's photograph."""

    name: str
    """Tooth and point, such as ``11 mesial edge``."""
    camera: str
    point_mm: Floats
    """Position in the scan (3,)."""
    pixel: Floats
    """Position in the photograph (2,), pixel centres at half-integers."""


def fit_landmarks(
    cameras: Mapping[str, Camera], clicks: Sequence[Click], centre_mm: Floats, click_mm: float = CLICK_MM
) -> tuple[PoseStep, str | None]:
    """Fit the scan's pose to the clicked points, without the wrong ones; an implausible pose is returned too, so that a
    picture of it can be shown.

    Args:
        cameras: cameras by name.
        clicks: clicks of all cameras.
        centre_mm: centre of the teeth in the scan (3,), about which the covariance's rotations are.
        click_mm: standard error of a click at the teeth.

    Returns:
        The pose, and a sentence that says why it is not plausible; None where it is plausible.

    Raises:
        CaptureInputError: the clicks are too few for any pose, or lie on one line.
    """
    most = max((sum(one.camera == name for one in clicks) for name in cameras), default=0)
    if most < MIN_CLICKS:
        raise CaptureInputError(
            f"No camera sees {MIN_CLICKS} landmarks of the scan (the most are {most}); add [[landmark]] entries to"
            " raw.toml, spread over the arch; dentine landmarks writes a page in which they are clicked."
        )
    starts = list(_starts(cameras, clicks))
    if not starts:
        raise CaptureInputError(
            "The landmarks lie in one line or at one place, which leaves the scan's pose open; spread them over the"
            " arch."
        )
    # Distant cameras see little perspective, so a start may be tilted to the wrong side. The refinement over all
    # cameras reveals this.
    best = _best(cameras, clicks, starts, click_mm, REFINED_STARTS)
    refined = [_refined(cameras, clicks, start, centre_mm, click_mm)[0] for start in best]
    (best_start,) = _best(cameras, clicks, [*best, *refined], click_mm, 1)
    inliers = np.ones(len(clicks), dtype=bool)
    pose, covariance = best_start, np.eye(6)
    for _ in range(len(clicks)):
        # Fit all clicks robustly in the first round, then only those within the limit, until the same clicks remain.
        pose, covariance = _refined(
            cameras, [one for one, good in zip(clicks, inliers, strict=True) if good], best_start, centre_mm, click_mm
        )
        good = _errors(cameras, clicks, pose, click_mm) < WRONG_CLICK_SIGMAS
        if (good == inliers).all():
            break
        inliers = good
        if np.count_nonzero(inliers) < MIN_CLICKS:
            break
    error = _errors(cameras, clicks, pose, click_mm)
    wrong = [one for one, good in zip(clicks, inliers, strict=True) if not good]
    is_plausible = len(wrong) <= MAX_WRONG_SHARE * len(clicks) and np.count_nonzero(inliers) >= MIN_CLICKS
    wrong_clicks = tuple(
        f"{one.name} in camera {one.camera}, {_offset_px(cameras, one, pose):.0f} px off" for one in wrong
    )
    residual_px = {
        name: float(
            np.median(
                [
                    _offset_px(cameras, one, pose)
                    for one, good in zip(clicks, inliers, strict=True)
                    if good and one.camera == name
                ]
            )
        )
        for name in cameras
        if any(good and one.camera == name for one, good in zip(clicks, inliers, strict=True))
    }
    step = PoseStep(
        "landmarks",
        pose,
        covariance,
        residual_px,
        float(np.median(error[inliers]) * click_mm),
        int(inliers.sum()),
        wrong_clicks,
    )
    return step, None if is_plausible else _contradiction(cameras, clicks, pose, inliers)


def _best(
    cameras: Mapping[str, Camera], clicks: Sequence[Click], poses: Sequence[RigidPose], click_mm: float, count: int
) -> list[RigidPose]:
    # Sort the poses by the sum of squared errors, each limited to WRONG_CLICK_SIGMAS, so that a wrong click counts
    # the same however far off it is.
    errors = [np.minimum(_errors(cameras, clicks, pose, click_mm), WRONG_CLICK_SIGMAS) for pose in poses]
    return [poses[k] for k in np.argsort([float((error**2).sum()) for error in errors])[:count]]


def _triangulated(cameras: Mapping[str, Camera], clicks: Sequence[Click]) -> tuple[Floats, Floats]:
    # Return the landmarks (N, 3) that several cameras see: their positions in the scan, and in the rig the points
    # nearest to their lines of sight.
    scan, rig = [], []
    for name in dict.fromkeys(one.name for one in clicks):
        own = [one for one in clicks if one.name == name]
        if len(own) < 2:
            continue
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for one in own:
            origin, direction = cameras[one.camera].rays(one.pixel[:1], one.pixel[1:])
            across = np.eye(3) - np.outer(direction[0], direction[0])
            normal, right = normal + across, right + across @ origin
        if np.linalg.cond(normal) < MAX_CONDITION:
            scan.append(own[0].point_mm)
            rig.append(np.linalg.solve(normal, right))
    return np.array(scan).reshape(-1, 3), np.array(rig).reshape(-1, 3)


def _starts_from_points(scan_mm: Floats, rig_mm: Floats) -> Iterator[RigidPose]:
    # Fit rotation and translation between the points (Kabsch 1976), for all of them and for random triples.
    if len(scan_mm) < MIN_POINTS:
        return
    rng = np.random.default_rng(0)
    draws = [rng.choice(len(scan_mm), MIN_POINTS, replace=False) for _ in range(DRAWS)]
    for chosen in [np.arange(len(scan_mm)), *(draws if len(scan_mm) > MIN_POINTS else [])]:
        one, two = scan_mm[chosen], rig_mm[chosen]
        left, size, right = np.linalg.svd((two - two.mean(axis=0)).T @ (one - one.mean(axis=0)))
        if size[1] > MIN_SPREAD_RATIO * size[0]:
            rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
            yield RigidPose(rotation, two.mean(axis=0) - rotation @ one.mean(axis=0))


def _starts(cameras: Mapping[str, Camera], clicks: Sequence[Click]) -> Iterator[RigidPose]:
    import cv2

    yield from _starts_from_points(*_triangulated(cameras, clicks))
    rng = np.random.default_rng(0)
    for name, camera in cameras.items():
        own = [one for one in clicks if one.camera == name]
        if len(own) < MIN_CLICKS:
            continue
        points, pixels = np.array([one.point_mm for one in own]), np.array([one.pixel for one in own])
        draws = [rng.choice(len(own), MIN_CLICKS, replace=False) for _ in range(DRAWS)] if len(own) > MIN_CLICKS else []
        world_from_camera = np.linalg.inv(np.asarray(camera.camera_from_world))
        for chosen in [np.arange(len(own)), *draws]:
            try:
                found = cv2.solvePnPGeneric(
                    points[chosen], pixels[chosen], np.asarray(camera.K), None, flags=cv2.SOLVEPNP_SQPNP
                )
            except cv2.error:
                continue
            for rotation_vector, translation in zip(found[1], found[2], strict=True):
                camera_from_scan = np.eye(4)
                camera_from_scan[:3, :3], camera_from_scan[:3, 3] = (
                    cv2.Rodrigues(rotation_vector)[0],
                    np.reshape(translation, 3),
                )
                pose = world_from_camera @ camera_from_scan
                if np.isfinite(pose).all():
                    yield RigidPose(pose[:3, :3], pose[:3, 3])


def _errors(cameras: Mapping[str, Camera], clicks: Sequence[Click], pose: RigidPose, click_mm: float) -> Floats:
    # Return the distance (N,) of each click from its prediction in standard errors; infinite behind a camera.
    errors = np.empty(len(clicks))
    for k, one in enumerate(clicks):
        point = pose.apply(one.point_mm[None])
        pixel, depth = cameras[one.camera].project(point)
        size = millimetres_a_pixel(cameras[one.camera], point)[0]
        errors[k] = np.linalg.norm(pixel[0] - one.pixel) * size / click_mm if depth[0] > 0 else np.inf
    return errors


def _offset_px(cameras: Mapping[str, Camera], one: Click, pose: RigidPose) -> float:
    return float(np.linalg.norm(cameras[one.camera].project(pose.apply(one.point_mm[None]))[0][0] - one.pixel))


def _refined(
    cameras: Mapping[str, Camera], clicks: Sequence[Click], start: RigidPose, centre_mm: Floats, click_mm: float
) -> tuple[RigidPose, Floats]:
    # Minimise the Huber-weighted distances by Gauss-Newton steps; the covariance is the inverse of the normal matrix.
    pose, normal = start, np.eye(6)
    for _ in range(ROUNDS):
        centre = pose.apply(centre_mm[None])[0]
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for one in clicks:
            camera, point = cameras[one.camera], pose.apply(one.point_mm[None])
            scale = millimetres_a_pixel(camera, point)[0] / click_mm
            jacobian = scale * pixel_derivatives(camera, point, centre)[0]
            residual = scale * (one.pixel - camera.project(point)[0][0])
            weight = min(1.0, 1.5 / max(float(np.linalg.norm(residual)), 1e-12))
            normal += weight * jacobian.T @ jacobian
            right += weight * jacobian.T @ residual
        step = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(6), right)
        pose = pose.moved(step, centre)
        if np.abs(step).max() < CONVERGED:
            break
    return pose, np.linalg.inv(normal + 1e-12 * np.trace(normal) * np.eye(6))


def _contradiction(cameras: Mapping[str, Camera], clicks: Sequence[Click], pose: RigidPose, inliers: np.ndarray) -> str:
    # Say how many clicks are wrong, and name the one that is farthest from its prediction.
    wrong = [one for one, good in zip(clicks, inliers, strict=True) if not good]
    worst = max(wrong, key=lambda one: _offset_px(cameras, one, pose))
    message = (
        f"{len(wrong)} of {len(clicks)} landmarks contradict the others; the worst is {worst.name} in camera "
        f"{worst.camera}, {_offset_px(cameras, worst, pose):.0f} px from where the scan has it"
    )
    return (
        f"{message}; see whether landmarks are exchanged, left with right or tooth with tooth, and whether the scan is"
        " this person's."
    )
