"""Choice of a lens's distortion model by cross-validation on held-out boards."""

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
BETTER = 2.0
"""Standard errors by which a richer model must be better on held-out boards; of two equal models one is so once in 40
times."""
FOLDS = 5
"""Number of folds of the cross-validation."""
MODEL_FOR_OUTLIERS = "radial-tangential-5"
"""Distortion model of the fit that finds outliers. This is OpenCV's default: it has enough coefficients for bad corners
to stand out, and any usable session determines them."""

MIN_BOARDS, MODEL_OF_FEW = 6, "radial-tangential-4"
"""Smallest number of boards for cross-validation, and the model that is used with fewer: its four coefficients suffice
for all but wide-angle lenses."""


@dataclass(frozen=True)
class ModelChoice:
    """A lens, and the held-out error of every distortion model.

    Attributes:
        lens: the lens of the chosen model, fitted to all boards.
        sigma_px: standard deviation of one coordinate of the corners in a fit of this camera alone.
        held_out_px: rms reprojection error of the corners of held-out boards, by model; empty where there were too few
            boards.
        folding: models that were left out, as they draw two directions at one pixel of the image.
    """

    lens: Lens
    sigma_px: float
    held_out_px: dict[str, float]
    folding: tuple[str, ...] = ()


def fit_lens(views: Sequence[View], size: tuple[int, int], model: str, name: str) -> BundleFit:
    """Fit the intrinsics of one camera to its own boards by bundle adjustment."""
    good = of_one_camera(usable(views))
    return fit_bundle(good, first_rig(good, [first_lens(good, size, model, name)], [name]))


def choose_lens(
    views: Sequence[View], size: tuple[int, int], name: str, models: Sequence[str] = tuple(MODELS), folds: int = FOLDS
) -> ModelChoice:
    """Choose the simplest distortion model that no richer model beats on held-out boards by more than ``BETTER``
    standard errors; models that fold the image are left out.

    Outliers are left out first. Each fold then holds every ``folds``-th board out, fits the lens to the others, and
    measures its reprojection error on the held-out boards, each with its best pose. The difference of two models is the
    mean over boards, and its standard error comes from the scatter over boards. With fewer than six boards none is held
    out, and the model is ``MODEL_OF_FEW``.

    Raises:
        CaptureInputError: the camera shows fewer than three boards.
    """
    if len(usable(views)) < MIN_BOARDS:
        fit = fit_lens(views, size, MODEL_OF_FEW, name)
        return ModelChoice(fit.rig.lenses[0], float(fit.sigma_px[0]), {})
    good = without_outliers(of_one_camera(usable(views)), fit_lens(views, size, MODEL_FOR_OUTLIERS, name))
    errors = {model: _cross_validated(good, size, model, name, min(folds, len(good) // 2)) for model in models}
    fitted = {model: lens_and_scatter(good, size, model, name) for model in models}
    folding = tuple(model for model, (lens, _) in fitted.items() if not lens.keeps_order)
    able = [model for model in models if model not in folding] or [models[0]]
    chosen = next(
        model
        for number, model in enumerate(able)
        if not any(_beats(errors[richer], errors[model]) for richer in able[number + 1 :])
    )
    rms_px = {model: float(np.sqrt(np.mean(squares))) for model, squares in errors.items()}
    return ModelChoice(*fitted[chosen], held_out_px=rms_px, folding=folding)


def without_outliers(views: Sequence[View], fit: BundleFit) -> list[View]:
    """Return the usable views without the corners that are outliers of a fit."""
    return usable([view.selected(fit.inliers[fit.corners.view == number]) for number, view in enumerate(views)])


def held_out_squares(views: Sequence[View], lens: Lens) -> Floats:
    """Return the mean squared reprojection error (V,) in px² of each view, with the pose that fits the view best."""
    projected = (lens.project(pose_apply(board_pose(view, lens), view.corners_mm)) for view in views)
    return np.array([((d - view.pixels) ** 2).sum(axis=1).mean() for d, view in zip(projected, views, strict=True)])


def of_one_camera(views: Sequence[View]) -> list[View]:
    """Return the views renumbered as those of camera 0, each at a place of its own."""
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
    return bool(better.mean() > BETTER * better.std(ddof=1) / np.sqrt(len(better)))
