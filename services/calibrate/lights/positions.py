"""Positions of lights from their highlights on mirror spheres, all spheres, cameras and lights at once.

Unknown are the spheres' centres, the lights, for each camera by how far its edges are found outside the true outline
(blur and contrast shift all edges of a camera alike; a radius that is given wrongly shows there too), and the cameras
themselves within the covariance that their own calibration left. Observed are outlines and highlights in pixels. So
lights and cameras err together, and the spheres may mend the cameras a little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import Lens
from services.calibrate.lights.mirror import Eye
from services.calibrate.lights.problem import MIN_HIGHLIGHTS, Problem, SphereView
from services.calibrate.reweighted import solve_reweighted

Floats = NDArray[np.float64]
EDGE_SHIFT_SE_PX = 0.3
"""By how far a camera's edges may be found off: half a pixel of blur, seen against a background of another
brightness."""
HUBER_SIGMAS = 1.345
OUTLIER_SIGMAS = 5.0
SIGMA_FLOOR_PX = 1e-6
MAD_TO_SIGMA = 1.4826
ROBUST_ROUNDS = 3
STEP = 1e-4
"""Of a central difference, mm or px: a millionth of the distances, so its error is 1e-12 and rounding's 1e-9 of the
derivative."""


STEP_SIGMAS = 0.01
"""Of a difference in a camera's value, in its own ±."""


@dataclass(frozen=True)
class Outlier:
    """A highlight that fits no position that the others allow: its camera, place and light, and how far off it is."""

    camera: int
    place: int
    light: int
    off_px: float


@dataclass(frozen=True)
class LightsFit:
    """What the highlights say.

    Attributes:
        lights: numbers of the lights that were found (M,), in order.
        positions_mm: where they are (M, 3).
        centres_mm: of the spheres by place (P, 3).
        edge_shifts_px: by camera (K,).
        eyes: the cameras, as spheres and boards together say.
        covariance: of lights (3 M, mm), centres (3 P, mm), edge shifts (K, px), and, where the cameras' was given, the
            lens values and pose of each camera in turn.
        highlight_sigma_px, outline_sigma_px: scatter of the two kinds of observation.
        highlight_errors_px: found minus drawn (N, 2), in the order of the views' highlights.
        outliers: what was left out.
    """

    lights: NDArray[np.int64]
    positions_mm: Floats
    centres_mm: Floats
    edge_shifts_px: Floats
    eyes: tuple[Eye, ...]
    covariance: Floats
    highlight_sigma_px: float
    outline_sigma_px: float
    highlight_errors_px: Floats
    outliers: tuple[Outlier, ...]


@dataclass(frozen=True)
class _Weighted:
    """The problem with weights: residuals in units of their σ.

    Cameras are moved by ``spread @ z`` with z of unit prior.
    """

    problem: Problem
    eyes: tuple[Eye, ...]
    spread: Floats
    sigmas: Floats
    good: NDArray[np.bool_]

    def moved_eyes(self, values: Floats) -> tuple[Eye, ...]:
        """The cameras of all values."""
        off, first, moved = self.spread @ values[self.problem.length :], 0, []
        for eye in self.eyes:
            count = len(eye.lens.values)
            lens = Lens(eye.lens.size, eye.lens.values + off[first : first + count])
            moved.append(Eye(lens, eye.pose + off[first + count : first + count + 6]))
            first += count + 6
        return tuple(moved)

    def residuals(self, values: Floats) -> Floats:
        """Highlights, edges, edge shifts against their prior, cameras against theirs."""
        eyes, problem = self.moved_eyes(values), self.problem
        off = problem.highlights(eyes, values) * self.good[:, None] / self.sigmas[0]
        shifts = problem.split(values)[2] / EDGE_SHIFT_SE_PX
        return np.concatenate(
            [off.ravel(), problem.outlines(eyes, values) / self.sigmas[1], shifts, values[problem.length :]]
        )

    def by_own(self, values: Floats) -> Floats:
        """Derivative to lights, centres and shifts.

        No residual depends on two of a kind, so one axis of all is moved at once.
        """
        problem, eyes = self.problem, self.moved_eyes(values)
        n_highlights, n_edges = 2 * len(problem.row), len(problem.edge_place)
        derivative = np.zeros((n_highlights + n_edges + len(values) - problem.first_shift, problem.length))
        sides = np.arange(n_highlights).reshape(-1, 2)
        edges = n_highlights + np.arange(n_edges)
        weight = self.good[:, None] / self.sigmas[0]
        for axis in range(3):
            lights, centres = 3 * problem.row + axis, problem.first_centre + 3 * problem.place + axis
            for columns in (lights, centres):
                step = np.zeros(len(values))
                step[columns] = STEP
                slope = (problem.highlights(eyes, values + step) - problem.highlights(eyes, values - step)) / (2 * STEP)
                derivative[sides, columns[:, None]] = slope * weight
            edge_columns = problem.first_centre + 3 * problem.edge_place + axis
            step = np.zeros(len(values))
            step[edge_columns] = STEP
            slope = (problem.outlines(eyes, values + step) - problem.outlines(eyes, values - step)) / (2 * STEP)
            derivative[edges, edge_columns] = slope / self.sigmas[1]
        derivative[edges, problem.first_shift + problem.edge_camera] = -1 / self.sigmas[1]
        shifts = np.arange(problem.n_cameras)
        derivative[n_highlights + n_edges + shifts, problem.first_shift + shifts] = 1 / EDGE_SHIFT_SE_PX
        return derivative

    def by_cameras(self, values: Floats) -> Floats:
        """Derivative to z, through that to the cameras' own values: no residual depends on two cameras, so one value of
        all is moved at once.
        """
        problem, eyes = self.problem, self.moved_eyes(values)
        n_highlights, n_edges = 2 * len(problem.row), len(problem.edge_place)
        count = self.spread.shape[1]
        whole = np.zeros((n_highlights + n_edges + problem.n_cameras + count, count))
        if count == 0:
            return whole
        own = np.zeros((n_highlights + n_edges, len(self.spread)))
        se = np.sqrt((self.spread**2).sum(axis=1))
        first = np.cumsum([0, *(_length(eye) for eye in eyes)])
        cameras = np.concatenate([np.repeat(problem.camera, 2), problem.edge_camera])
        for value in range(max(map(_length, eyes))):
            having = [camera for camera, eye in enumerate(eyes) if value < _length(eye)]
            steps = {camera: STEP_SIGMAS * se[first[camera] + value] for camera in having}
            ahead, back = (
                [_moved(eye, value, sign * steps.get(k, 0.0)) for k, eye in enumerate(eyes)] for sign in (1, -1)
            )
            slope = np.concatenate(
                [
                    (problem.highlights(ahead, values) - problem.highlights(back, values)).ravel()
                    * np.repeat(self.good, 2)
                    / self.sigmas[0],
                    (problem.outlines(ahead, values) - problem.outlines(back, values)) / self.sigmas[1],
                ]
            )
            for camera in having:
                mine = np.flatnonzero(cameras == camera)
                own[mine, first[camera] + value] = slope[mine] / (2 * steps[camera])
        whole[: len(own)] = own @ self.spread
        whole[len(own) + problem.n_cameras :] = np.eye(count)
        return whole


def _length(eye: Eye) -> int:
    """Number of a camera's values: of its lens and its pose."""
    return len(eye.lens.values) + 6


def _moved(eye: Eye, value: int, step: float) -> Eye:
    """The camera with one of its values changed."""
    values = np.concatenate([eye.lens.values, eye.pose])
    if step:
        values[value] += step
    return Eye(Lens(eye.lens.size, values[:-6]), values[-6:])


def fit_lights(
    views: Sequence[SphereView],
    eyes: Sequence[Eye],
    light_names: Sequence[str],
    camera_covariance: Floats | None = None,
) -> LightsFit:
    """Find lights and spheres.

    Args:
        views: mirror spheres in photographs.
        eyes: the calibrated cameras.
        light_names: for messages.
        camera_covariance: of lens values and pose of each camera in turn, (C, C); exact cameras by default.

    Raises:
        CaptureInputError: a light that shows only once.
    """
    problem = Problem(views, len(eyes), light_names)
    spread = _square_root(camera_covariance) if camera_covariance is not None else np.zeros((_states(eyes), 0))
    weighted = _Weighted(problem, tuple(eyes), spread, np.ones(2), np.ones(len(problem.row), dtype=bool))
    values, weighted = _without_outliers(weighted, problem.start(eyes))
    values = np.concatenate([values, np.zeros(spread.shape[1])])
    # The first plain fit finds the scatter of highlights and edges, the second weighs by it.
    for _ in range(2):
        values = _solve(weighted, values)
        moved = weighted.moved_eyes(values)
        off, edges = problem.highlights(moved, values)[weighted.good], problem.outlines(moved, values)
        highlight = np.sqrt((off**2).sum() / max(off.size - 3 * len(problem.lights), 1))
        outline = np.sqrt((edges**2).sum() / max(len(edges) - 3 * problem.n_places - len(eyes), 1))
        weighted = replace(weighted, sigmas=np.maximum([highlight, outline], SIGMA_FLOOR_PX))
    return _finished(weighted, values, with_cameras=camera_covariance is not None)


def _states(eyes: Sequence[Eye]) -> int:
    return sum(map(_length, eyes))


def _square_root(covariance: Floats) -> Floats:
    """L with L Lᵀ = covariance, through unit variances."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0)))


def _without_outliers(weighted: _Weighted, values: Floats) -> tuple[Floats, _Weighted]:
    """Fits by Huber's loss with the cameras held, first over pixels, then over the scatter that is left; outliers leave
    the weights.

    Of a light that would lose all highlights but one, all stay, and its large errors show in the residuals.
    """
    problem = weighted.problem
    held = replace(weighted, spread=np.zeros((len(weighted.spread), 0)))
    for _ in range(ROBUST_ROUNDS):
        values = _solve(held, values, HUBER_SIGMAS)
        off, edges = problem.highlights(held.eyes, values), problem.outlines(held.eyes, values)
        medians = [float(np.median(np.abs(off))), float(np.median(np.abs(edges)))]
        held = replace(held, sigmas=np.maximum(MAD_TO_SIGMA * np.array(medians), SIGMA_FLOOR_PX))
    good = np.asarray(np.abs(off).max(axis=1) <= OUTLIER_SIGMAS * held.sigmas[0])
    for row in range(len(problem.lights)):
        mine = problem.row == row
        if np.count_nonzero(good & mine) < MIN_HIGHLIGHTS:
            good |= mine
    return values, replace(weighted, sigmas=held.sigmas, good=good)


def _solve(weighted: _Weighted, values: Floats, huber: float | None = None) -> Floats:
    # Cameras move by fractions of a pixel, so what they move is linear in them and its slope is taken once.
    by_cameras = weighted.by_cameras(values)
    return solve_reweighted(
        weighted.residuals,
        lambda x: np.concatenate([weighted.by_own(x), by_cameras], axis=1),
        values,
        huber,
    )


def _finished(weighted: _Weighted, values: Floats, *, with_cameras: bool) -> LightsFit:
    """The covariance at the solution, (JᵀJ)⁻¹ with cameras in their own units, and the record of it."""
    problem = weighted.problem
    slope = np.concatenate([weighted.by_own(values), weighted.by_cameras(values)], axis=1)
    scale = 1 / np.sqrt((slope**2).sum(axis=0))
    inverse = np.linalg.inv((slope * scale).T @ (slope * scale)) * np.outer(scale, scale)
    if with_cameras:
        cameras, count = weighted.spread, problem.length
        to_units = np.zeros((count + len(cameras), len(values)))
        to_units[:count, :count], to_units[count:, count:] = np.eye(count), cameras
        inverse = to_units @ inverse @ to_units.T
    lights, centres, shifts = problem.split(values)
    eyes = weighted.moved_eyes(values)
    off = problem.highlights(eyes, values)
    left_out = np.flatnonzero(~weighted.good)
    named = problem.lights[problem.row]
    return LightsFit(
        lights=problem.lights,
        positions_mm=lights,
        centres_mm=centres,
        edge_shifts_px=shifts,
        eyes=eyes,
        covariance=(inverse + inverse.T) / 2,
        highlight_sigma_px=float(weighted.sigmas[0]),
        outline_sigma_px=float(weighted.sigmas[1]),
        highlight_errors_px=off,
        outliers=tuple(
            Outlier(int(problem.camera[n]), int(problem.place[n]), int(named[n]), float(np.linalg.norm(off[n])))
            for n in left_out
        ),
    )
