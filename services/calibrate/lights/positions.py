"""Positions of lights from their highlights on mirror spheres, by one fit of all spheres, cameras and lights.

The unknowns are the spheres' centres, the lights' positions, one edge shift for each camera (the distance by which its
edges are detected outside the true outline, because blur and contrast shift all edges of a camera alike; a wrong radius
appears there too), and the cameras' parameters, with the covariance of their own calibration as prior. The observations
are outlines and highlights in pixels. The result has the joint covariance of lights and cameras, and the spheres may
improve the cameras a little.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import Lens
from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.lights.problem import MIN_HIGHLIGHTS, Problem, SphereView
from services.calibrate.reweighted import solve_reweighted
from services.core.robust import HUBER_SIGMAS, robust_sigma

Floats = NDArray[np.float64]
EDGE_SHIFT_SE_PX = 0.3
"""Standard deviation of the prior of a camera's edge shift: half a pixel of blur, against a background of another
brightness."""
OUTLIER_SIGMAS = 5.0
"""Residual in σ beyond which a highlight is an outlier."""
SIGMA_FLOOR_PX = 1e-6
"""Smallest σ of highlights and edges in px, for exact synthetic observations."""
ROBUST_ROUNDS = 3
"""Number of robust fits, each followed by an estimate of σ."""
STEP = 1e-4
"""Step of the central differences of positions in mm: a millionth of the distances, so the truncation error is 1e-12
and the rounding error 1e-9 of the derivative."""


STEP_SIGMAS = 0.01
"""Step of the central differences of a camera's parameter, in its own standard errors."""


@dataclass(frozen=True)
class Outlier:
    """A highlight that disagrees with the other ones of its light: its camera, place and light, and its residual."""

    camera: int
    place: int
    light: int
    residual_px: float


@dataclass(frozen=True)
class LightsFit:
    """Positions of lights and spheres, fitted to highlights and outlines.

    Attributes:
        lights: numbers of the lights whose highlights were found (M,), in order.
        positions_mm: positions of these lights (M, 3).
        centres_mm: centres of the spheres by place (P, 3).
        edge_shifts_px: edge shift of each camera (K,), positive outside the true outline.
        cameras: the cameras, estimated from spheres and boards together.
        covariance: joint covariance of lights (3 M, mm), centres (3 P, mm), edge shifts (K, px) and, where the cameras'
            covariance was given, the lens values and pose of each camera in turn.
        highlight_sigma_px: standard deviation of one coordinate of a highlight.
        outline_sigma_px: standard deviation of an edge point across the outline.
        highlight_errors_px: detected minus projected highlights (N, 2), in the order of the views' highlights.
        outliers: highlights that the fit left out.
    """

    lights: NDArray[np.int64]
    positions_mm: Floats
    centres_mm: Floats
    edge_shifts_px: Floats
    cameras: tuple[PosedCamera, ...]
    covariance: Floats
    highlight_sigma_px: float
    outline_sigma_px: float
    highlight_errors_px: Floats
    outliers: tuple[Outlier, ...]


@dataclass(frozen=True)
class _Weighted:
    """The problem with residuals in units of their σ.

    The cameras' parameters change by ``spread @ z``, where z has a standard normal prior; z follows the problem's own
    unknowns in the vector of values.

    Attributes:
        problem: residuals of all views.
        cameras: the cameras at z = 0.
        spread: square root (C, z) of the covariance of the cameras' C parameters; no columns for fixed cameras.
        sigmas: σ of a highlight's coordinate and of an edge point, in px (2,).
        good: mask of the highlights that are not outliers (N,).
    """

    problem: Problem
    cameras: tuple[PosedCamera, ...]
    spread: Floats
    sigmas: Floats
    good: NDArray[np.bool_]

    def moved_cameras(self, values: Floats) -> tuple[PosedCamera, ...]:
        """Return the cameras for the given values."""
        off, first, moved = self.spread @ values[self.problem.length :], 0, []
        for camera in self.cameras:
            count = len(camera.lens.values)
            lens = Lens(camera.lens.size, camera.lens.values + off[first : first + count])
            moved.append(PosedCamera(lens, camera.pose + off[first + count : first + count + 6]))
            first += count + 6
        return tuple(moved)

    def residuals(self, values: Floats) -> Floats:
        """Return the residuals of the highlights, the edges, and the priors of edge shifts and of cameras."""
        cameras, problem = self.moved_cameras(values), self.problem
        off = problem.highlights(cameras, values) * self.good[:, None] / self.sigmas[0]
        shifts = problem.split(values)[2] / EDGE_SHIFT_SE_PX
        return np.concatenate(
            [off.ravel(), problem.outlines(cameras, values) / self.sigmas[1], shifts, values[problem.length :]]
        )

    def by_geometry(self, values: Floats) -> Floats:
        """Return the derivative of all residuals with respect to lights, centres and edge shifts.

        Each residual depends on at most one light and one centre, so one axis of all lights, or of all centres, is
        changed at once.
        """
        problem, cameras = self.problem, self.moved_cameras(values)
        n_highlights, n_edges = 2 * len(problem.row), len(problem.edge_place)
        derivative = np.zeros((n_highlights + n_edges + len(values) - problem.first_shift, problem.length))
        sides = np.arange(n_highlights).reshape(-1, 2)
        edges = n_highlights + np.arange(n_edges)
        weight = self.good[:, None] / self.sigmas[0]

        def slopes(
            of: Callable[[Sequence[PosedCamera], Floats], Floats], columns: Sequence[NDArray[np.int64]]
        ) -> Floats:
            # By central differences: a step along some columns at a time.
            steps = np.zeros((len(columns), len(values)))
            for step, own in zip(steps, columns, strict=True):
                step[own] = STEP
            ahead, back = of(cameras, np.concatenate([values + steps, values - steps])).reshape(2, len(columns), -1)
            return np.asarray((ahead - back) / (2 * STEP))

        axes = range(3)
        columns = [3 * problem.row + axis for axis in axes]
        columns += [problem.first_centre + 3 * problem.place + axis for axis in axes]
        for own, slope in zip(columns, slopes(problem.highlights, columns), strict=True):
            derivative[sides, own[:, None]] = slope.reshape(-1, 2) * weight
        columns = [problem.first_centre + 3 * problem.edge_place + axis for axis in axes]
        for own, slope in zip(columns, slopes(problem.outlines, columns), strict=True):
            derivative[edges, own] = slope / self.sigmas[1]
        derivative[edges, problem.first_shift + problem.edge_camera] = -1 / self.sigmas[1]
        shifts = np.arange(problem.n_cameras)
        derivative[n_highlights + n_edges + shifts, problem.first_shift + shifts] = 1 / EDGE_SHIFT_SE_PX
        return derivative

    def by_cameras(self, values: Floats) -> Floats:
        """Return the derivative of all residuals with respect to z, by way of that with respect to the cameras'
        parameters.

        Each residual depends on one camera only, so one parameter of all cameras is changed at once.
        """
        problem, cameras = self.problem, self.moved_cameras(values)
        n_highlights, n_edges = 2 * len(problem.row), len(problem.edge_place)
        count = self.spread.shape[1]
        whole = np.zeros((n_highlights + n_edges + problem.n_cameras + count, count))
        if count == 0:
            return whole
        own = np.zeros((n_highlights + n_edges, len(self.spread)))
        se = np.sqrt((self.spread**2).sum(axis=1))
        first = np.cumsum([0, *(_length(camera) for camera in cameras)])
        residual_cameras = np.concatenate([np.repeat(problem.camera, 2), problem.edge_camera])
        for value in range(max(map(_length, cameras))):
            with_value = [number for number, camera in enumerate(cameras) if value < _length(camera)]
            steps = {number: STEP_SIGMAS * se[first[number] + value] for number in with_value}
            ahead, back = (
                [_moved(camera, value, sign * steps.get(k, 0.0)) for k, camera in enumerate(cameras)]
                for sign in (1, -1)
            )
            slope = np.concatenate(
                [
                    (problem.highlights(ahead, values) - problem.highlights(back, values)).ravel()
                    * np.repeat(self.good, 2)
                    / self.sigmas[0],
                    (problem.outlines(ahead, values) - problem.outlines(back, values)) / self.sigmas[1],
                ]
            )
            for number in with_value:
                mine = np.flatnonzero(residual_cameras == number)
                own[mine, first[number] + value] = slope[mine] / (2 * steps[number])
        whole[: len(own)] = own @ self.spread
        whole[len(own) + problem.n_cameras :] = np.eye(count)
        return whole


def _length(camera: PosedCamera) -> int:
    """Return the number of a camera's parameters, those of its lens and its pose."""
    return len(camera.lens.values) + 6


def _moved(camera: PosedCamera, value: int, step: float) -> PosedCamera:
    """Return the camera with one of its parameters changed by a step."""
    values = np.concatenate([camera.lens.values, camera.pose])
    if step:
        values[value] += step
    return PosedCamera(Lens(camera.lens.size, values[:-6]), values[-6:])


def fit_lights(
    views: Sequence[SphereView],
    cameras: Sequence[PosedCamera],
    light_names: Sequence[str],
    camera_covariance: Floats | None = None,
) -> LightsFit:
    """Fit the positions of lights and spheres.

    Args:
        views: mirror spheres in photographs.
        cameras: the calibrated cameras.
        light_names: names of the lights, for messages.
        camera_covariance: covariance (C, C) of the lens values and pose of each camera in turn; exact cameras by
            default.

    Raises:
        CaptureInputError: a light has only one highlight.
    """
    problem = Problem(views, len(cameras), light_names)
    spread = _square_root(camera_covariance) if camera_covariance is not None else np.zeros((_states(cameras), 0))
    weighted = _Weighted(problem, tuple(cameras), spread, np.ones(2), np.ones(len(problem.row), dtype=bool))
    values, weighted = _without_outliers(weighted, problem.start(cameras))
    values = np.concatenate([values, np.zeros(spread.shape[1])])
    # The first plain fit estimates the σ of highlights and edges, the second uses them as weights.
    for _ in range(2):
        values = _solve(weighted, values)
        moved = weighted.moved_cameras(values)
        off, edges = problem.highlights(moved, values)[weighted.good], problem.outlines(moved, values)
        highlight = np.sqrt((off**2).sum() / max(off.size - 3 * len(problem.lights), 1))
        outline = np.sqrt((edges**2).sum() / max(len(edges) - 3 * problem.n_places - len(cameras), 1))
        weighted = replace(weighted, sigmas=np.maximum([highlight, outline], SIGMA_FLOOR_PX))
    return _finished(weighted, values, with_cameras=camera_covariance is not None)


def _states(cameras: Sequence[PosedCamera]) -> int:
    return sum(map(_length, cameras))


def _square_root(covariance: Floats) -> Floats:
    """Return L with L Lᵀ = covariance, computed from the correlation matrix so that different units cost no digits."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0)))


def _without_outliers(weighted: _Weighted, values: Floats) -> tuple[Floats, _Weighted]:
    """Fit with Huber's loss and fixed cameras, first with the given σ, then with σ from the residuals, and mark the
    outliers.

    If a light would lose all highlights but one, all of them stay, and its large errors appear in the residuals.

    Returns:
        The values, and the problem with its new σ and mask of good highlights.
    """
    problem = weighted.problem
    fixed = replace(weighted, spread=np.zeros((len(weighted.spread), 0)))
    for _ in range(ROBUST_ROUNDS):
        values = _solve(fixed, values, HUBER_SIGMAS)
        off, edges = problem.highlights(fixed.cameras, values), problem.outlines(fixed.cameras, values)
        fixed = replace(fixed, sigmas=np.maximum([robust_sigma(off), robust_sigma(edges)], SIGMA_FLOOR_PX))
    good = np.asarray(np.abs(off).max(axis=1) <= OUTLIER_SIGMAS * fixed.sigmas[0])
    for row in range(len(problem.lights)):
        mine = problem.row == row
        if np.count_nonzero(good & mine) < MIN_HIGHLIGHTS:
            good |= mine
    return values, replace(weighted, sigmas=fixed.sigmas, good=good)


def _solve(weighted: _Weighted, values: Floats, huber: float | None = None) -> Floats:
    # The cameras change by fractions of a pixel, so the residuals are linear in them and one derivative suffices.
    by_cameras = weighted.by_cameras(values)
    return solve_reweighted(
        weighted.residuals,
        lambda x: np.concatenate([weighted.by_geometry(x), by_cameras], axis=1),
        values,
        huber,
    )


def _finished(weighted: _Weighted, values: Floats, *, with_cameras: bool) -> LightsFit:
    """Return the result with the covariance (JᵀJ)⁻¹ at the solution, the cameras' parameters in their own units."""
    problem = weighted.problem
    slope = np.concatenate([weighted.by_geometry(values), weighted.by_cameras(values)], axis=1)
    scale = 1 / np.sqrt((slope**2).sum(axis=0))
    inverse = np.linalg.inv((slope * scale).T @ (slope * scale)) * np.outer(scale, scale)
    if with_cameras:
        spread, count = weighted.spread, problem.length
        to_units = np.zeros((count + len(spread), len(values)))
        to_units[:count, :count], to_units[count:, count:] = np.eye(count), spread
        inverse = to_units @ inverse @ to_units.T
    lights, centres, shifts = problem.split(values)
    cameras = weighted.moved_cameras(values)
    off = problem.highlights(cameras, values)
    left_out = np.flatnonzero(~weighted.good)
    named = problem.lights[problem.row]
    return LightsFit(
        lights=problem.lights,
        positions_mm=lights,
        centres_mm=centres,
        edge_shifts_px=shifts,
        cameras=cameras,
        covariance=(inverse + inverse.T) / 2,
        highlight_sigma_px=float(weighted.sigmas[0]),
        outline_sigma_px=float(weighted.sigmas[1]),
        highlight_errors_px=off,
        outliers=tuple(
            Outlier(int(problem.camera[n]), int(problem.place[n]), int(named[n]), float(np.linalg.norm(off[n])))
            for n in left_out
        ),
    )
