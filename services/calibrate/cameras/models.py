"""Which distortion model a lens needs, judged by boards that did not take part in its fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.bundle import BundleFit, fit_bundle, pose_apply
from services.calibrate.cameras.lens import MODELS, Lens
from services.calibrate.cameras.sightings import View
from services.calibrate.cameras.start import board_pose, first_lens, first_rig, lens_and_scatter, usable

Floats = NDArray[np.float64]
FOLDS = 5
MODEL_FOR_OUTLIERS = "radial-tangential-5"
"""OpenCV's default: rich enough that bad corners stand out, and determined by any session that can be used."""

MIN_BOARDS, MODEL_OF_FEW = 6, "radial-tangential-4"
"""With fewer boards nothing can be left out and judged; four coefficients serve all lenses but wide ones."""


@dataclass(frozen=True)
class ModelChoice:
    """A lens, and what held-out boards say of every model.

    Attributes:
        lens: of the chosen model, from all boards.
        sigma_px: scatter of one coordinate of its corners about a fit of this camera alone.
        held_out_px: rms distance of the corners of boards that were left out, by model; empty where there were too few
            boards.
    """

    lens: Lens
    sigma_px: float
    held_out_px: dict[str, float]


def fit_lens(views: Sequence[View], size: tuple[int, int], model: str, name: str) -> BundleFit:
    """Intrinsics of one camera from its own boards, by bundle adjustment."""
    good = of_one_camera(usable(views))
    return fit_bundle(good, first_rig(good, [first_lens(good, size, model, name)], [name]))


def choose_lens(
    views: Sequence[View], size: tuple[int, int], name: str, models: Sequence[str] = tuple(MODELS), folds: int = FOLDS
) -> ModelChoice:
    """The simplest distortion model that no other beats on held-out boards by more than its standard error.

    Corners that fit nowhere are left out first. Each fold then leaves every ``folds``-th board out, fits the others,
    and judges the lens by how well it draws the left out boards with a pose of their own. The difference of two models
    is a mean over boards, and so is its standard error. Of fewer than six boards none can be left out, and the model is
    held.

    Raises:
        CaptureInputError: the camera shows fewer than three boards.
    """
    if len(usable(views)) < MIN_BOARDS:
        held = fit_lens(views, size, MODEL_OF_FEW, name)
        return ModelChoice(held.rig.lenses[0], float(held.sigma_px[0]), {})
    good = without_outliers(of_one_camera(usable(views)), fit_lens(views, size, MODEL_FOR_OUTLIERS, name))
    errors = {model: _cross_validated(good, size, model, name, min(folds, len(good) // 2)) for model in models}
    chosen = next(model for model in errors if not any(_beats(other, errors[model]) for other in errors.values()))
    told = {model: float(np.sqrt(np.mean(squares))) for model, squares in errors.items()}
    return ModelChoice(*lens_and_scatter(good, size, chosen, name), held_out_px=told)


def without_outliers(views: Sequence[View], fit: BundleFit) -> list[View]:
    """The views without the corners that a fit left out."""
    return usable([view.kept(fit.inliers[fit.corners.view == number]) for number, view in enumerate(views)])


def held_out_squares(views: Sequence[View], lens: Lens) -> Floats:
    """Mean squared distance in px² of each view's corners from where a lens draws them, with the view's best pose
    (V,).
    """
    drawn = (lens.project(pose_apply(board_pose(view, lens), view.corners_mm)) for view in views)
    return np.array([((d - view.pixels) ** 2).sum(axis=1).mean() for d, view in zip(drawn, views, strict=True)])


def of_one_camera(views: Sequence[View]) -> list[View]:
    """The views as those of camera 0, each at a place of its own."""
    return [replace(view, camera=0, place=number) for number, view in enumerate(views)]


def _cross_validated(views: Sequence[View], size: tuple[int, int], model: str, name: str, folds: int) -> Floats:
    squares = np.empty(len(views))
    for fold in range(folds):
        out = [number for number in range(len(views)) if number % folds == fold]
        rest = [view for number, view in enumerate(views) if number % folds != fold]
        squares[out] = held_out_squares([views[number] for number in out], first_lens(rest, size, model, name))
    return squares


def _beats(challenger: Floats, holder: Floats) -> bool:
    better = holder - challenger
    return bool(better.mean() > better.std(ddof=1) / np.sqrt(len(better)))
