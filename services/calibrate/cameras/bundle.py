"""Bundle adjustment: lenses, camera poses and board poses that minimise the reprojection error of all corners.

The world frame is that of the board at place 0, so this place has no parameters. A camera projects a corner c of the
board at place p to π(R (R_p c + t_p) + t). The corners' errors are taken as independent, with one σ per camera. A fit
with Huber's loss comes first. Corners with large residuals after it are left out as outliers, and a plain
least-squares fit of the others gives the values and their covariance σ² (JᵀJ)⁻¹, with σ² from the residuals and their
degrees of freedom (Triggs et al., Bundle Adjustment, 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import cross_matrix, left_jacobian, pose_matrix, rotation_matrix
from services.calibrate.cameras.sightings import Corners, View, joined
from services.core.errors import CaptureInputError
from services.core.robust import HUBER_SIGMAS, robust_sigma

Floats = NDArray[np.float64]
OUTLIER_SIGMAS = 5.0
"""Residual in σ beyond which a corner is an outlier. A good session has 10⁴ corners, and 2·10⁴ normal coordinates
exceed 5 σ once in a hundred sessions."""
SIGMA_FLOOR_PX = 1e-6
"""Smallest σ of a corner in px, because exact synthetic corners have no scatter and residuals are divided by σ."""
ROBUST_ROUNDS = 3
"""Largest number of rounds that alternate between an estimate of σ and a robust fit."""
SETTLED_SCALE = 0.1
"""Relative change of the robust σ between two rounds below which the rounds end: outliers lie far beyond a tenth
of σ."""
STEP_PRECISION = 1e-10
"""Tolerance of the linear solver within a step. With a looser one the steps are no Gauss–Newton steps, and a hundred of
them are needed."""
MISPLACED_PX, MISPLACED_TIMES = 10.0, 10.0
"""Limits of a photograph's median reprojection error under the first guess: in px, and as a multiple of the median over
all photographs. The larger one holds. First guesses are off by some pixels, interchanged frames by hundreds."""
MIN_INLIERS = 4
"""Number of corners that determine a pose."""


@dataclass(frozen=True)
class Rig:
    """Parameters of a bundle adjustment.

    Attributes:
        lenses: intrinsics of the K cameras.
        cameras: poses camera_from_world (K, 6), each a rotation vector in rad and a translation in mm.
        places: poses world_from_board (P, 6); the first is zero.
    """

    lenses: tuple[Lens, ...]
    cameras: Floats
    places: Floats


@dataclass(frozen=True)
class Layout:
    """Positions of the parameters in the parameter vector: lenses, camera poses, then the poses of places 1 to P − 1.

    Attributes:
        sizes: width and height in pixels of each of the K cameras.
        lens_lengths: number of intrinsic values of each lens.
        n_places: number P of places.
        lenses_fixed: whether the lenses are kept out of the vector.
    """

    sizes: tuple[tuple[int, int], ...]
    lens_lengths: tuple[int, ...]
    n_places: int
    lenses_fixed: bool = False

    @property
    def lens_starts(self) -> list[int]:
        """First column of each lens, and the column after the last one."""
        return [0, *np.cumsum(self.lens_lengths).tolist()]

    @property
    def first_pose(self) -> int:
        """First column of the camera poses."""
        return 0 if self.lenses_fixed else sum(self.lens_lengths)

    @property
    def length(self) -> int:
        """Number of parameters."""
        return self.first_pose + 6 * (len(self.sizes) + self.n_places - 1)

    def camera_columns(self, camera: int) -> NDArray[np.int64]:
        """Columns of a camera's pose."""
        return self.first_pose + 6 * camera + np.arange(6)

    def lens_columns(self, camera: int) -> NDArray[np.int64]:
        """Columns of a camera's lens; empty where the lenses are fixed."""
        count = 0 if self.lenses_fixed else self.lens_lengths[camera]
        return self.lens_starts[camera] + np.arange(count)

    def place_columns(self, place: int) -> NDArray[np.int64]:
        """Columns of a board's pose; place 0 has none."""
        return self.first_pose + 6 * (len(self.sizes) + place - 1) + np.arange(6)

    def pack(self, rig: Rig) -> Floats:
        """Return the parameter vector (length,) of a rig."""
        lenses = [] if self.lenses_fixed else [lens.values for lens in rig.lenses]
        return np.concatenate([*lenses, rig.cameras.ravel(), rig.places[1:].ravel()])

    def unpack(self, values: Floats, template: Rig) -> Rig:
        """Return the rig of a parameter vector; fixed lenses and the pose of place 0 come from the template."""
        starts = self.lens_starts
        lenses = template.lenses
        if not self.lenses_fixed:
            lenses = tuple(Lens(size, values[starts[k] : starts[k + 1]]) for k, size in enumerate(self.sizes))
        poses = values[self.first_pose :].reshape(-1, 6)
        count = len(self.sizes)
        return Rig(lenses, poses[:count], np.concatenate([template.places[:1], poses[count:]]))


@dataclass(frozen=True)
class BundleFit:
    """Result of a bundle adjustment.

    Attributes:
        rig: lenses and poses.
        layout: order of the parameters in the covariance.
        covariance: covariance of all parameters (length, length), in the frame of place 0.
        sigma_px: standard deviation of one coordinate of a corner, by camera (K,); their common scale is estimated from
            the residuals.
        residuals_px: observed minus projected position (N, 2) of all corners in the order of the views, outliers
            included.
        inliers: True for each corner that the final fit used (N,).
        corners: all corners, in the order of the residuals.
        converged: whether the solver met its tolerance.
    """

    rig: Rig
    layout: Layout
    covariance: Floats
    sigma_px: Floats
    residuals_px: Floats
    inliers: NDArray[np.bool_]
    corners: Corners
    converged: bool

    def rms_px(self, camera: int | None = None) -> float:
        """Root mean square reprojection error in px, over the inliers of one camera or of all cameras."""
        chosen = self.inliers if camera is None else self.inliers & (self.corners.camera == camera)
        return float(np.sqrt((self.residuals_px[chosen] ** 2).sum(axis=1).mean()))


def layout_of(rig: Rig, *, lenses_fixed: bool = False) -> Layout:
    """Return the layout of a rig's parameters."""
    return Layout(
        tuple(lens.size for lens in rig.lenses),
        tuple(len(lens.values) for lens in rig.lenses),
        len(rig.places),
        lenses_fixed,
    )


def project_corners(rig: Rig, corners: Corners) -> Floats:
    """Return the pixels (N, 2) to which a rig projects corners."""
    pixels = np.empty_like(corners.pixels)
    local = pose_apply(rig.places[corners.place], corners.corners_mm)
    for camera, lens in enumerate(rig.lenses):
        chosen = corners.camera == camera
        if chosen.any():
            pixels[chosen] = lens.project(pose_apply(rig.cameras[camera], local[chosen]))
    return pixels


def derivative_blocks(
    rig: Rig, corners: Corners, camera: int
) -> tuple[NDArray[np.int64], Floats, Floats, Floats, Floats]:
    """Compute the projected corners of one camera and their derivatives with respect to lens and poses.

    Returns:
        The rows (M,) of the corners that this camera sees, their pixels (M, 2), and the pixels' derivatives with
        respect to the camera's lens (M, 2, 4 + D), its pose (M, 2, 6) and the pose of each corner's place (M, 2, 6).
    """
    rows = np.flatnonzero(corners.camera == camera)
    place = rig.places[corners.place[rows]]
    turned = np.einsum("nij,nj->ni", rotation_matrix(place[:, :3]), corners.corners_mm[rows])
    world = turned + place[:, 3:]
    pose = rig.cameras[camera]
    R = rotation_matrix(pose[:3])
    pixels, by_point, by_lens = rig.lenses[camera].project_with_derivatives(world @ R.T + pose[3:])
    # A rotation vector's change dw turns a rotated point y by J dw × y = −[y]× J dw.
    by_camera = np.concatenate([-by_point @ cross_matrix(world @ R.T) @ left_jacobian(pose[:3]), by_point], axis=2)
    by_world = by_point @ R
    by_place = np.concatenate([-by_world @ cross_matrix(turned) @ left_jacobian(place[:, :3]), by_world], axis=2)
    return rows, pixels, by_lens, by_camera, by_place


def fit_bundle(
    views: Sequence[View],
    start: Rig,
    *,
    sigma_px: Floats | None = None,
    lenses_fixed: bool = False,
    robust: bool = True,
) -> BundleFit:
    """Adjust a rig to corners.

    Args:
        views: photographs of boards; every camera and every place must be linked to place 0 by shared views.
        start: a first guess, as from ``services.calibrate.cameras.start``.
        sigma_px: standard deviations of the cameras' corners (K,) from fits of each camera alone, of which only the
            ratios count; all equal by default. The ratios are not estimated here, because in a joint fit the camera of
            the smallest residuals would draw all weight to itself.
        lenses_fixed: keep the intrinsics of the first guess.
        robust: find outliers and leave them out.

    Raises:
        CaptureInputError: photographs of a place or a camera fit no common pose.
    """
    corners, layout = joined(views), layout_of(start, lenses_fixed=lenses_fixed)
    weights = np.ones(len(start.lenses)) if sigma_px is None else np.maximum(sigma_px, SIGMA_FLOOR_PX)
    values, inliers = layout.pack(start), np.ones(len(corners.pixels), dtype=bool)
    if robust:
        values, inliers = _without_outliers(layout, start, corners, values, weights)
        _require_inliers(views, corners, inliers)
    used = corners.selected(inliers)
    values, converged = _solve(layout, start, used, values, weights)
    rig = layout.unpack(values, start)
    residuals = corners.pixels - project_corners(rig, corners)
    whitened = residuals[inliers] / weights[used.camera, None]
    freedom = max(whitened.size - layout.length, 1)
    sigma = np.maximum(weights * np.sqrt((whitened**2).sum() / freedom), SIGMA_FLOOR_PX)
    return BundleFit(
        rig=rig,
        layout=layout,
        covariance=_covariance(jacobian(layout, rig, used, sigma)),
        sigma_px=sigma,
        residuals_px=residuals,
        inliers=inliers,
        corners=corners,
        converged=converged,
    )


def _without_outliers(
    layout: Layout, start: Rig, corners: Corners, values: Floats, weights: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the parameters (length,) of a robust fit, and a mask (N,) of the corners that are inliers of it."""
    scale, plausible = (
        1.0,
        corners.selected(~_misplaced(corners, project_corners(layout.unpack(values, start), corners))),
    )
    for _ in range(ROBUST_ROUNDS):
        off = (
            np.abs(plausible.pixels - project_corners(layout.unpack(values, start), plausible))
            / weights[plausible.camera, None]
        )
        before, scale = scale, max(robust_sigma(off), SIGMA_FLOOR_PX)
        if abs(scale - before) < SETTLED_SCALE * before:
            break
        values, _ = _solve(layout, start, plausible, values, scale * weights, huber=True)
    off = (
        np.abs(corners.pixels - project_corners(layout.unpack(values, start), corners)) / weights[corners.camera, None]
    )
    return values, off.max(axis=1) <= OUTLIER_SIGMAS * scale


def _misplaced(corners: Corners, projected: Floats) -> NDArray[np.bool_]:
    """Return a mask (N,) of the corners of photographs that the first guess projects far away, such as those of frames
    that were interchanged.

    Huber's loss bounds the influence of each corner, but a whole photograph of wrong corners still biases the poses of
    its place and its camera. At least one photograph of every camera and of every place stays.
    """
    off = np.linalg.norm(corners.pixels - projected, axis=1)
    median = np.array([float(np.median(off[corners.view == view])) for view in range(corners.view.max() + 1)])
    bad = median > max(MISPLACED_PX, MISPLACED_TIMES * float(np.median(median)))
    for numbers in (corners.camera, corners.place):
        for number in np.unique(numbers):
            views = np.unique(corners.view[numbers == number])
            bad[views[np.argmin(median[views])]] = False
    return np.asarray(bad[corners.view])


def _require_inliers(views: Sequence[View], corners: Corners, inliers: NDArray[np.bool_]) -> None:
    """Refuse a session in which a camera or a place has too few inliers for a pose.

    Raises:
        CaptureInputError: a camera or a place has fewer than ``MIN_INLIERS`` inliers.
    """
    for what, numbers in (("the board at one place", corners.place), ("one camera", corners.camera)):
        for number in np.unique(numbers):
            mine = numbers == number
            if np.count_nonzero(inliers & mine) < MIN_INLIERS:
                name = views[int(corners.view[mine][0])].name
                raise CaptureInputError(
                    f"The photographs of {what}, among them {name}, fit no common pose: the board or a camera moved"
                    " there, or frames are interchanged; leave them out or take them again."
                )


def jacobian(layout: Layout, rig: Rig, corners: Corners, sigma_px: Floats) -> object:
    """Return the sparse derivative (2N, length) of the projected corners, each divided by its camera's σ, with respect
    to the parameters.
    """
    from scipy.sparse import csr_array

    entries, rows, columns = [], [], []
    for camera in range(len(rig.lenses)):
        visible, _, by_lens, by_camera, by_place = derivative_blocks(rig, corners, camera)
        row = np.stack([2 * visible, 2 * visible + 1], axis=1)[:, :, None]
        places = corners.place[visible]
        has_pose = places > 0
        place_columns = layout.place_columns(0)[None, :] + 6 * places[:, None]
        all_rows = np.ones(len(visible), dtype=bool)
        blocks = [(by_camera, np.broadcast_to(layout.camera_columns(camera), (len(visible), 6)), all_rows)]
        blocks.append((by_place, place_columns, has_pose))
        if not layout.lenses_fixed:
            lens_columns = layout.lens_columns(camera)
            blocks.append((by_lens, np.broadcast_to(lens_columns, (len(visible), len(lens_columns))), all_rows))
        for block, column, chosen in blocks:
            part = block[chosen] / sigma_px[camera]
            entries.append(part.ravel())
            rows.append(np.broadcast_to(row[chosen], part.shape).ravel())
            columns.append(np.broadcast_to(column[chosen][:, None, :], part.shape).ravel())
    shape = (2 * len(corners.pixels), layout.length)
    return csr_array((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=shape)


def pose_apply(pose: Floats, points: Floats) -> Floats:
    """Return points (N, 3) transformed by one pose (6,), or each by its own pose (N, 6)."""
    matrix = pose_matrix(pose)
    moved = np.einsum("...ij,...j->...i", matrix[..., :3, :3], points) + matrix[..., :3, 3]
    return np.asarray(moved, dtype=np.float64)


def _solve(
    layout: Layout, template: Rig, corners: Corners, values: Floats, sigma: Floats, *, huber: bool = False
) -> tuple[Floats, bool]:
    """Minimise over all parameters with SciPy's trust-region solver and the sparse derivative.

    Returns:
        The parameters (length,), and whether the solver met its tolerance.
    """
    from scipy.optimize import least_squares

    def residuals(x: Floats) -> Floats:
        off = project_corners(layout.unpack(x, template), corners) - corners.pixels
        return (off / sigma[corners.camera, None]).ravel()

    solution = least_squares(
        residuals,
        values,
        jac=lambda x: jacobian(layout, layout.unpack(x, template), corners, sigma),
        method="trf",
        tr_solver="lsmr",
        tr_options={"atol": STEP_PRECISION, "btol": STEP_PRECISION, "maxiter": 10 * layout.length},
        x_scale="jac",
        loss="huber" if huber else "linear",
        f_scale=HUBER_SIGMAS,
        ftol=1e-10,
        xtol=1e-10,
        gtol=1e-10,
        max_nfev=100,
    )
    return np.asarray(solution.x), bool(solution.success)


def _covariance(whitened: object) -> Floats:
    """Return (JᵀJ)⁻¹, computed with the columns of J scaled to unit length, so that the different sizes of pixels,
    radians and millimetres cost no digits.
    """
    from scipy.linalg import cho_factor, cho_solve

    normal = np.asarray((whitened.T @ whitened).todense())  # type: ignore[attr-defined]
    scale = 1 / np.sqrt(np.diag(normal))
    factor = cho_factor(normal * np.outer(scale, scale))
    return np.asarray(cho_solve(factor, np.eye(len(normal)))) * np.outer(scale, scale)
