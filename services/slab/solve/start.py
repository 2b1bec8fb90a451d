"""First guess of a fit: an HG medium of three numbers, which many different images already determine."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import KNOTS, Material, henyey_greenstein, hg_values
from services.slab.cell.forward import Blocks, render
from services.slab.cell.rig import Rig
from services.slab.read.images import Measurements
from services.slab.solve.normal import normal_equations
from services.slab.solve.weights import independent_weights, smoothed_variance

Array = NDArray[np.float64]

THICKNESSES = (0.3, 1.0, 3.0, 9.0)
COSINES = (0.0, 0.7)
"""Values of sigma_s w and of g that a table combines."""
ALBEDOS = (0.97, 0.6)
"""Albedo of each table; the second is used where the first leads nowhere. Every thick medium of the first is brighter
than a cell with sigma_t w = 8.3 and an albedo of 0.59, and the search began, and ended, at almost no scattering. In one
table with the second, dim thin cells began at thick dark media, from which a search does not return."""
MAX_MISFIT_SHARE = 0.5
"""Share of the misfit of no light at all above which a medium explains too little. From the first table it was at most
0.26 for 21 cells whose searches found their way, and 0.8 and 4 for two dark, thick ones."""
LARGEST_COSINE, SMALLEST_COSINE = 0.8, -0.5
"""Bounds of g. The forward peak of a larger cosine may lie where no camera looks; the fit of all knots finds it from
here."""
MODEL_ERROR = 0.1
"""Error of an HG medium, as a share of a pixel, that the misfit tolerates: it keeps the brightest pixels from deciding
alone."""
TABLE_PATHS, STEP_PATHS, BATCHES, STEPS = 1000, 2000, 4, 6


def start(rig: Rig, measured: Measurements, seed: int, blocks: Blocks) -> Material:
    """The best of a table of HG media, improved by Gauss-Newton steps in ln sigma_s, g and sigma_a; of the first table
    after which it explains most of the light, or else of the last.
    """
    fitted = np.isfinite(measured.variances) & ~measured.held_out[:, None]
    tolerated = measured.variances + (MODEL_ERROR * np.maximum(measured.values, 0)) ** 2
    numbers, steps = itertools.count(1), itertools.count()

    def misfit(point: Array) -> float:
        images = render(
            rig, _material(point), seed=seed, step=2**32 - next(numbers), batches=2, paths=TABLE_PATHS, scores=False,
            blocks=blocks,
        ).images  # fmt: skip
        first, second = images - measured.values
        return float((first * second / tolerated)[fitted].sum())

    of_nothing = float((measured.values**2 / tolerated)[fitted].sum())
    point = np.zeros(3)
    for albedo in ALBEDOS:
        table = [
            np.array([math.log(thickness / rig.width_mm), g, thickness / rig.width_mm * (1 / albedo - 1)])
            for thickness in THICKNESSES
            for g in COSINES
        ]
        point = min(table, key=misfit)
        for _ in range(STEPS):
            point = _improved(rig, measured, point, np.where(fitted, tolerated, np.inf), seed, next(steps), blocks)
        if misfit(point) < MAX_MISFIT_SHARE * of_nothing:
            break
    return _material(point)


def _material(point: Array) -> Material:
    return henyey_greenstein(math.exp(point[0]), float(point[1]), float(point[2]))


def _improved(
    rig: Rig, measured: Measurements, point: Array, tolerated: Array, seed: int, step: int, blocks: Blocks
) -> Array:
    material = _material(point)
    batches = render(
        rig, material, seed=seed, step=step + 2**31, batches=BATCHES, paths=STEP_PATHS, scores=True, blocks=blocks
    )
    noise = smoothed_variance(batches.images, (rig.grid.rows, rig.grid.columns))
    equations = normal_equations(batches, material, measured.values, independent_weights(tolerated, noise))

    # Apply the chain rule from ln f and sigma_a to the three numbers; the cosine's column by differences of ln p.
    chain = np.zeros((KNOTS + 1, 3))
    chain[:KNOTS, 0] = 1
    small = 1e-4
    chain[:KNOTS, 1] = (np.log(hg_values(point[1] + small)) - np.log(hg_values(point[1] - small))) / (2 * small)
    chain[KNOTS, 2] = 1
    matrix = chain.T @ equations.matrix @ chain + chain.T @ equations.noise @ chain
    change = -np.linalg.solve(matrix + 1e-9 * np.trace(matrix) * np.eye(3), chain.T @ equations.gradient)
    sigma_s = math.exp(point[0])
    limits = np.array([1.0, 0.3, 0.5 * sigma_s])
    moved: Array = point + np.clip(change, -limits, limits)
    moved[1] = np.clip(moved[1], SMALLEST_COSINE, LARGEST_COSINE)
    moved[2] = max(moved[2], 0.0)
    return moved
