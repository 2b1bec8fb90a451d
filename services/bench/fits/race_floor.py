"""The floor that photographs set to every fit: its smallest errors by the bound of Cramér and Rao.

Extinction and albedo of enamel and dentin are unknown, and the phase functions are taken as known, so no fit can do
better; mean cosines that are fitted raise the floor by 1 to 20 %. The derivatives are the engine's at the true media.
Products of derivatives are taken from independent seeds only, so that their noise adds no information.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import PreparedTooth
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import View

Array = NDArray[np.float64]

MEDIA = ("enamel", "dentin")
NAMES = tuple(f"{part}.{leaf}" for part in MEDIA for leaf in ("sigma", "alpha"))
HELD_OUT = "held_out"
QUANTITIES = tuple(f"{part}.{leaf}" for leaf in ("sigma_s_reduced", "sigma_a") for part in MEDIA)
"""Reduced scattering and absorption, per mm, whose errors the race is held to."""
SEEDS, MAX_SEEDS = 4, 16
"""Number of independent Jacobians, and at most so many where fewer leave no positive information."""


def quantities(tissue: Tissue) -> dict[str, float]:
    """Return reduced scattering and absorption of both media, per mm."""
    found = {}
    for name in QUANTITIES:
        part, leaf = name.split(".")
        medium = tissue.medium(part)
        found[name] = medium.sigma_s_reduced if leaf == "sigma_s_reduced" else (1 - medium.alpha) * medium.sigma
    return found


def relative_slopes(truth: Tissue) -> Array:
    """Derivatives (4, 4) of the quantities' logarithms with respect to the parameters ``NAMES``."""
    slopes = np.zeros((len(QUANTITIES), len(NAMES)))
    for row, name in enumerate(QUANTITIES):
        part, leaf = name.split(".")
        medium, column = truth.medium(part), NAMES.index(f"{part}.sigma")
        by_alpha = 1 / medium.alpha if leaf == "sigma_s_reduced" else -1 / (1 - medium.alpha)
        slopes[row, column : column + 2] = 1 / medium.sigma, by_alpha
    return slopes


@dataclass(frozen=True)
class Measurements:
    """Photographs as rows of M values."""

    reference: Array
    variance: Array
    fitted: NDArray[np.bool_]
    held_out: NDArray[np.bool_]


def measurements(case: PreparedTooth) -> Measurements:
    """Return the photographs of all views."""
    views = case.views
    held = np.concatenate([np.broadcast_to(one.held_out[:, None], one.valid.shape).reshape(-1) for one in views])
    reference, variance, valid = (
        np.concatenate([getattr(one, name).reshape(-1) for one in views]) for name in ("reference", "variance", "valid")
    )
    return Measurements(reference.astype(np.float64), variance.astype(np.float64), valid & ~held, valid & held)


def pair_product(jacobians: Sequence[Array], weight: Array) -> Array:
    """Mean (F, F) of J W J' over all pairs of different Jacobians (F, M), so that their noise does not add to it."""
    total, count = np.sum(jacobians, axis=0), len(jacobians)
    product = (total * weight) @ total.T - sum((one * weight) @ one.T for one in jacobians)
    return np.asarray(product / (count * (count - 1)))


def bound(jacobians: Sequence[Array], photographs: Measurements, truth: Tissue) -> dict[str, float] | None:
    """Return the floor of the quantities and of ``HELD_OUT``, the held-out images' root mean square, as relative
    errors of one standard deviation; None where the Jacobians' noise leaves no positive information.

    Args:
        jacobians: at least two derivatives (4, M) of the measurements from independent seeds.
        photographs: the measurements.
        truth: the true media.
    """
    fitted, aside = photographs.fitted, photographs.held_out
    information = pair_product(jacobians, np.where(fitted, 1 / np.where(fitted, photographs.variance, 1.0), 0.0))
    # Scale to a unit diagonal before the inversion: extinction and albedo differ by orders of magnitude.
    diagonal = np.diag(information)
    if np.any(diagonal <= 0):
        return None
    scale = np.sqrt(np.outer(diagonal, diagonal))
    if np.linalg.eigvalsh(information / scale)[0] <= 0:
        return None
    covariance = np.linalg.inv(information / scale) / scale
    slopes = relative_slopes(truth)
    sd = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    square = np.trace(covariance @ pair_product(jacobians, aside.astype(np.float64)))
    signal = float((photographs.reference[aside] ** 2 - photographs.variance[aside]).sum())
    return dict(zip(QUANTITIES, sd.tolist(), strict=True)) | {HELD_OUT: float(np.sqrt(max(square, 0.0) / signal))}


def floor(case: PreparedTooth, truth: Tissue, samples: int, seed: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return the floor of a prepared tooth and its standard error, by leaving out one Jacobian after the other.

    Raises:
        ArithmeticError: ``MAX_SEEDS`` Jacobians of so many paths per pixel are too noisy.
    """
    photographs, jacobians = measurements(case), list[Array]()
    while len(jacobians) < MAX_SEEDS:
        for _ in range(SEEDS):
            k = seed + len(jacobians)
            jacobians.append(
                np.concatenate([
                    case.engine.jacobian(
                        truth, View(view.camera, view.pixels), NAMES, samples=samples, seed=7919 * number + k
                    ).jacobian.reshape(len(NAMES), -1)
                    for number, view in enumerate(case.views)
                ], axis=1)
            )  # fmt: skip
        found = bound(jacobians, photographs, truth)
        without = [bound(jacobians[:k] + jacobians[k + 1 :], photographs, truth) for k in range(len(jacobians))]
        if found is not None and all(one is not None for one in without):
            rows = np.array([list(one.values()) for one in without if one is not None])
            spread = np.sqrt((len(rows) - 1) * rows.var(axis=0))
            return found, dict(zip(found, spread.tolist(), strict=True))
    raise ArithmeticError(f"{MAX_SEEDS} Jacobians of {samples} paths per pixel are too noisy for a bound; take more.")
