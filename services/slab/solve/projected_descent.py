"""The solver of Gkioulekas et al. (2013): projected stochastic gradient descent on simplex weights, Algorithms 1 and 2.

It serves as a named baseline. As ``optics.md`` corrects it: the image and the derivative of line 9 come from
independent streams, the average is over as many iterates as are summed, weights are clamped before they are raised to a
power, and the common offset of all atoms, 99 % of Eq. 19, goes with the vacuum atom. The particle caches of Algorithms
3 and 4 with their step h are replaced by the quantity that they estimate, the path's scores, which have no step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import KNOTS, LARGEST_EXTINCTION_PER_MM, Material, mixture, tent_solid_angles
from services.slab.cell.forward import Blocks, render
from services.slab.cell.rig import Rig
from services.slab.read.images import Measurements

Array = NDArray[np.float64]

WEIGHT_FLOOR, WEIGHT_POWER = 0.01, 3
"""c and alpha of Eq. 10."""
SMALLEST_SCATTERING = 1e-9
"""Smallest f, per mm and sr, for knots whose weight the projection has set to zero, because scores divide by f."""
FIRST_STEP = 2**29
"""Number of the first render, so that it shares no stream with the other solver."""


@dataclass(frozen=True)
class DescentOptions:
    """Budget and rate of the descent; the step is rate / sqrt(t)."""

    iterations: int = 200
    rate: float = 1e-10
    paths: int = 4000
    regulariser: float = 0.0
    """Factor of the squared differences of f between knots, because smoothing raw weights would smooth p sin(theta)
    instead."""


def projected(point: Array) -> Array:
    """The nearest point of the simplex (Duchi et al. 2008), by sorting and sums in float64."""
    falling = np.sort(np.asarray(point, dtype=np.float64))[::-1]
    # Subtract the largest coordinate, so that huge coordinates keep their differences.
    falling = falling - falling[0]
    sums = np.cumsum(falling) - 1
    count = np.nonzero(falling - sums / np.arange(1, len(falling) + 1) > 0)[0][-1] + 1
    return np.asarray(np.maximum(point - np.max(point) - sums[count - 1] / count, 0))


def weight_gradient(rows: Array, material: Material, cotangent: Array) -> Array:
    """Derivative with respect to the weights (KNOTS + 2,) of the sum of ``cotangent`` (images, pixels) times images.

    ``rows`` are sums of shares and path lengths (images, pixels, KNOTS + 1). Weight n adds sigma_max / Omega_n to f at
    knot n and sigma_max to the extinction; vacuum adds nothing.
    """
    shares = np.einsum("ip,ipn->n", cotangent, rows)
    solid = tent_solid_angles()
    by_scattering = shares[:KNOTS] / (material.scattering * solid) - shares[KNOTS]
    return np.append(LARGEST_EXTINCTION_PER_MM * np.append(by_scattering, -shares[KNOTS]), 0.0)


def image_weights(values: Array) -> Array:
    """w_m of Eq. 10 for each pixel, 1 / max(c, I^3) with I clamped at zero, in units of the brightest pixel."""
    relative = np.maximum(values, 0) / values.max()
    return np.asarray(1 / np.maximum(WEIGHT_FLOOR, relative**WEIGHT_POWER))


def descend(
    rig: Rig,
    measured: Measurements,
    start: Material,
    seed: int,
    options: DescentOptions | None = None,
    blocks: Blocks = map,
) -> Material:
    """The average of the iterates from a start; arguments as of ``GaussNewton``."""
    options = options or DescentOptions()
    used = np.isfinite(measured.variances) & ~measured.held_out[:, None]
    weights = np.where(used, image_weights(np.where(used, measured.values, 0)), 0)
    brightest = float(measured.values[used].max())
    point, summed = start.weights(), np.zeros(KNOTS + 2)
    for step in range(options.iterations):
        material = floored(point)
        batches = render(
            rig, material, seed=seed, step=FIRST_STEP + step, batches=2, paths=options.paths, scores=True, blocks=blocks
        )
        gradient = np.zeros(KNOTS + 2)
        for image, rows in zip(batches.images, batches.rows[::-1], strict=True):
            gradient += weight_gradient(rows, material, weights * (image - measured.values)) / brightest**2
        gradient[:KNOTS] += options.regulariser * _roughness_slope(material)
        point = projected(point - options.rate / np.sqrt(step + 1) * gradient)
        summed += point
    return floored(summed / options.iterations)


def floored(point: Array) -> Material:
    """The medium of simplex weights, with a little scattering at every angle."""
    material = mixture(point)
    return Material(np.maximum(material.scattering, SMALLEST_SCATTERING), material.absorption_per_mm)


def _roughness_slope(material: Material) -> Array:
    differences = np.diff(material.scattering)
    by_f = 2 * (np.append(0.0, differences) - np.append(differences, 0.0))
    return np.asarray(by_f * LARGEST_EXTINCTION_PER_MM / tent_solid_angles())
