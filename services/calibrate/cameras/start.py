"""First guesses for bundle adjustment: each camera's lens from its own boards, then the poses of cameras and boards
from boards that several cameras see.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.bundle import Rig
from services.calibrate.cameras.lens import HALF_PIXEL, MODELS, Lens
from services.calibrate.cameras.rotations import pose_matrix, pose_vector
from services.calibrate.cameras.sightings import View
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
MIN_CORNERS = 6
"""Smallest number of corners of a usable view: four determine a pose without any check, and six still outvote one bad
corner."""
VOTES = 2
"""Rounds of voting: the first corrects poses that a single wrong photograph spoilt, the second corrects poses that
were derived from those."""
MIN_VIEWS = 3
"""Smallest number of views for a lens: three views of a plane determine the five intrinsic values (Zhang 2000)."""


def usable(views: Sequence[View]) -> list[View]:
    """Return the views with at least ``MIN_CORNERS`` corners that do not lie on one line."""
    return [view for view in views if len(view.pixels) >= MIN_CORNERS and _spans_a_plane(view.corners_mm)]


def first_lens(views: Sequence[View], size: tuple[int, int], model: str, name: str) -> Lens:
    """Estimate a camera's intrinsics by OpenCV from its own views (Zhang 2000).

    Raises:
        CaptureInputError: the camera has fewer than ``MIN_VIEWS`` usable views.
    """
    return lens_and_scatter(views, size, model, name)[0]


def lens_and_scatter(views: Sequence[View], size: tuple[int, int], model: str, name: str) -> tuple[Lens, float]:
    """Estimate a camera's intrinsics by OpenCV, and the standard deviation in px of one coordinate of its corners from
    the residuals and their degrees of freedom.

    Raises:
        CaptureInputError: the camera has fewer than ``MIN_VIEWS`` usable views.
    """
    import cv2

    good = usable(views)
    if len(good) < MIN_VIEWS:
        raise CaptureInputError(
            f"Camera {name} shows {len(good)} boards with at least {MIN_CORNERS} corners, and {MIN_VIEWS} are needed; "
            "photograph the board there in more places and tilts."
        )
    flags = _flags(model)
    points = [np.ascontiguousarray(view.corners_mm, dtype=np.float32) for view in good]
    pixels = [np.ascontiguousarray(view.pixels - HALF_PIXEL, dtype=np.float32) for view in good]
    rms, K, distortion, _, _ = cv2.calibrateCamera(points, pixels, size, None, None, flags=flags)
    count = MODELS[model]
    focal = [K[0, 0], K[1, 1], K[0, 2] + HALF_PIXEL, K[1, 2] + HALF_PIXEL]
    # OpenCV's rms is that of the corners' distances. Each corner has two coordinates, and the pose of each view costs
    # six degrees of freedom.
    corners = sum(len(view.pixels) for view in good)
    freedom = max(2 * corners - len(focal) - count - 6 * len(good), 1)
    lens = Lens(size, np.concatenate([focal, np.ravel(distortion)[:count]]))
    return lens, float(rms * np.sqrt(corners / freedom))


def board_pose(view: View, lens: Lens) -> Floats:
    """Return the pose (6,) camera_from_board of one view that minimises the squared reprojection errors.

    Raises:
        CaptureInputError: no pose projects the board's corners to the view.
    """
    import cv2

    flat = np.ascontiguousarray(lens.undistort(view.pixels)[:, :2])
    identity = np.eye(3)
    is_found, rotation, translation = cv2.solvePnP(view.corners_mm, flat, identity, None, flags=cv2.SOLVEPNP_IPPE)
    if not is_found:
        raise CaptureInputError(f"The board in {view.name} has no pose that draws its corners; photograph it again.")
    rotation, translation = cv2.solvePnPRefineLM(
        view.corners_mm,
        view.pixels,
        lens.matrix,
        lens.distortion if len(lens.distortion) else None,
        rotation,
        translation,
    )
    return np.concatenate([np.ravel(rotation), np.ravel(translation)])


def first_rig(views: Sequence[View], lenses: Sequence[Lens], names: Sequence[str]) -> Rig:
    """Return first poses of all cameras and boards, found from place 0 on, at each step through the linked view with
    the most corners.

    Raises:
        CaptureInputError: a camera or a place shares no board with the others.
    """
    n_places = max(view.place for view in views) + 1
    cameras: dict[int, Floats] = {}
    places: dict[int, Floats] = {0: np.eye(4)}
    good = {id(view) for view in usable(views)}
    poses = {
        number: pose_matrix(board_pose(view, lenses[view.camera]))
        for number, view in enumerate(views)
        if id(view) in good
    }
    remaining = sorted(poses, key=lambda number: -len(views[number].pixels))
    while remaining:
        linked = [n for n in remaining if views[n].place in places or views[n].camera in cameras]
        if not linked:
            break
        view, camera_from_board = views[linked[0]], poses[linked[0]]
        if view.place in places:
            cameras.setdefault(view.camera, camera_from_board @ np.linalg.inv(places[view.place]))
        else:
            places[view.place] = np.linalg.inv(cameras[view.camera]) @ camera_from_board
        remaining.remove(linked[0])
    for _ in range(VOTES):
        _vote(views, lenses, poses, cameras, places)
    if unlinked := next((name for number, name in enumerate(names) if number not in cameras), None):
        raise CaptureInputError(
            f"Camera {unlinked} sees no board together with the other cameras; photograph a board where both see it."
        )
    if len(places) < n_places:
        missing = next(place for place in range(n_places) if place not in places)
        raise CaptureInputError(f"No camera sees the board at place {missing}; leave it out or photograph it again.")
    return Rig(
        tuple(lenses),
        np.array([pose_vector(cameras[number]) for number in range(len(names))]),
        np.array([np.zeros(6), *(pose_vector(places[place]) for place in range(1, n_places))]),
    )


def _vote(
    views: Sequence[View],
    lenses: Sequence[Lens],
    poses: dict[int, Floats],
    cameras: dict[int, Floats],
    places: dict[int, Floats],
) -> None:
    """Give each camera, then each place but the first, the proposed pose with the least median reprojection error.

    Each of its own photographs proposes one pose, so a single photograph that is wrongly described does not spoil the
    poses of the others. With two photographs or fewer the pose stays as it is.
    """
    linked = [number for number in poses if views[number].camera in cameras and views[number].place in places]
    for camera in cameras:
        own_views = [number for number in linked if views[number].camera == camera]
        proposed = [poses[number] @ np.linalg.inv(places[views[number].place]) for number in own_views]
        candidates = [
            (views[n], lenses[camera], [pose @ places[views[n].place] for pose in proposed]) for n in own_views
        ]
        if len(proposed) > 2:
            cameras[camera] = proposed[_best(candidates)]
    for place in list(places)[1:]:
        own_views = [number for number in linked if views[number].place == place]
        proposed = [np.linalg.inv(cameras[views[number].camera]) @ poses[number] for number in own_views]
        candidates = [
            (views[n], lenses[views[n].camera], [cameras[views[n].camera] @ pose for pose in proposed])
            for n in own_views
        ]
        if len(proposed) > 2:
            places[place] = proposed[_best(candidates)]


def _best(candidates: Sequence[tuple[View, Lens, list[Floats]]]) -> int:
    """Return the number of the proposed pose with the least median reprojection error over the corners of all views.

    Args:
        candidates: for each view, its lens and the proposed poses camera_from_board (4, 4), in the same order for all
            views.
    """
    distances_px = []
    for view, lens, proposed in candidates:
        poses = np.stack(proposed)
        points = np.einsum("pij,nj->pni", poses[:, :3, :3], view.corners_mm) + poses[:, None, :3, 3]
        drawn = lens.project(points.reshape(-1, 3)).reshape(len(poses), -1, 2)
        distances_px.append(np.linalg.norm(drawn - view.pixels, axis=2))
    return int(np.argmin(np.median(np.concatenate(distances_px, axis=1), axis=1)))


def _spans_a_plane(corners_mm: Floats) -> bool:
    spread = np.linalg.svd(corners_mm - corners_mm.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 0.05 * spread[0])


def _flags(model: str) -> int:
    import cv2

    fixed = {
        "pinhole": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        "radial-tangential-4": cv2.CALIB_FIX_K3,
        "radial-tangential-5": 0,
        "rational-8": cv2.CALIB_RATIONAL_MODEL,
    }
    return int(fixed[model])
