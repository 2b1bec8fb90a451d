"""Smoothness prior of ln f: its second derivative by angle is Gaussian, with a scale that the evidence chooses.

A phase function is even at both poles, so the second difference there takes the mirrored neighbour, which pulls the
slope to zero where no camera looks. The prior is not centred on an HG function, which would put a forward peak where
none is measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import ANGLES_RAD, KNOTS, SPACING_RAD, Material
from services.slab.solve.normal import UNKNOWNS

Array = NDArray[np.float64]

SCALES = (3.0, 10.0, 30.0)
"""Standard deviations of d2 ln f / d theta2, per rad2, among which the evidence chooses; HG 0.8 has 60 at its peak, 3
beyond 20 degrees. Thick cells have the same: there 1 per rad2 pulled the fit towards a constant ln f along the
direction that images hardly determine, sigma_s at a constant sigma_s' (200 nm spheres at sigma_t w = 5.4: sigma_s by
-11 % at 640,000 paths, where 3 does by -2.6 % and 10 by -0.2 %)."""
SHARPEST, BLUNTEST, POLE_RAD = 600.0, 10.0, math.radians(8)
"""Scales of the weak prior by which values are flagged, per rad2: at the poles and far from them; and the angle from a
pole at which the first has halved. HG 0.93 bends by 570 at its peak; any narrower prior there would let smoothness pass
for a measurement."""
BENDS_RAD = math.radians(5)
"""Standard deviation of the angles over which the bends of ln f are averaged where they widen the prior. By single
knots, each bend made room for itself alone: fits had corners, and one of two lobes a notch 27 % deep at 89 degrees that
was told as determined, 3.4 standard errors off."""
POLE_SCALE = 100.0
"""Scale at a pole, falling away from it as ``SHARPEST`` does, that the evidence may choose. HG 0.8 bends by 60 at its
peak and by 3 beyond 20 degrees: one scale for all angles pulled the peak down by 1.4 of its standard errors and let the
other angles follow noise."""
RIDGE = 1e-12
"""Ridge as a share of the largest curvature, so that a direction that nothing determines can be solved for."""
THICK, THICK_REDUCED = 4.0, 2.5
"""Values of sigma_t w and of sigma_s' w from which cameras of one side see nearly the same of every path. Both count,
because a fit may begin half off in sigma_t and knows sigma_s' at once: 200 nm spheres at sigma_t w = 5.4 were taken for
a thin sample at 3.9, and the search stopped there."""


def is_thick(material: Material, width_mm: float) -> bool:
    """Whether a cell's light has scattered so often that sigma_s and g are hardly told apart."""
    return (
        material.extinction_per_mm * width_mm > THICK or material.reduced_scattering_per_mm * width_mm > THICK_REDUCED
    )


def second_differences() -> Array:
    """Matrix (KNOTS, KNOTS) from ln f to its second derivative, per rad2."""
    matrix = np.zeros((KNOTS, KNOTS))
    rows = np.arange(1, KNOTS - 1)
    matrix[rows, rows - 1] = matrix[rows, rows + 1] = 1
    matrix[0, 1] = matrix[-1, -2] = 2
    np.fill_diagonal(matrix, -2)
    return matrix / SPACING_RAD**2


def precision(scale: float | Array) -> Array:
    """Inverse covariance of all unknowns (UNKNOWNS, UNKNOWNS) for one scale or one per knot; the absorption has a flat
    prior.
    """
    bends = second_differences() / np.broadcast_to(scale, KNOTS)[:, None]
    matrix = np.zeros((UNKNOWNS, UNKNOWNS))
    matrix[:KNOTS, :KNOTS] = bends.T @ bends
    return matrix


def widened(scale: float, material: Material) -> Array:
    """A scale at each knot (KNOTS,), widened by the medium's own second derivative there: a Cauchy prior by iterative
    reweighting.

    Between the rings of large spheres ln f has troughs that bend by hundreds per rad2, and elsewhere it bends by tens.
    With 30 alone, the prior pulled sigma_s of 800 nm spheres in blue by -3.3 %, with this by -1.1 %. Wider scales at
    all knots left other samples to noise: with 100, phase functions of 500 nm spheres came out twice as far off. Near
    the poles, where no camera may look, the curvature of a fit is the prior's own, and a peak that follows it runs away
    (two lobes: 3.4 % off in place of 0.4 %). Thick cells resolve no troughs, and there it only made standard errors
    larger.
    """
    bends = second_differences() @ np.log(material.scattering)
    near = np.exp(-0.5 * ((ANGLES_RAD[:, None] - ANGLES_RAD) / BENDS_RAD) ** 2)
    around = np.sqrt(near @ bends**2 / near.sum(axis=1))
    return np.asarray(np.hypot(scale, (1 - np.maximum(*near_poles())) * around))


def sharp_scales(material: Material, poles: Sequence[Array]) -> list[Array]:
    """Scales at each knot (KNOTS,) for the end of a fit: ``SCALES`` widened by the medium's bends, each with and
    without ``POLE_SCALE`` at each of these poles, which are of ``near_poles``.
    """
    scales = [widened(scale, material) for scale in SCALES]
    for near in poles:
        scales += [np.hypot(scale, POLE_SCALE * near) for scale in scales]
    return scales


def pull_covariance(scale: float | Array, bends: float | Array) -> Array:
    """Covariance (UNKNOWNS, UNKNOWNS) of the pull, as a gradient, of a prior of this scale on media that bend by
    ``bends``; where both are the same it is the precision of the prior.
    """
    return precision(np.broadcast_to(scale, KNOTS) ** 2 / bends)


def flag_scales() -> Array:
    """The weak prior's scale at each knot, by the angle from the nearer pole."""
    return np.asarray(np.maximum(SHARPEST * np.maximum(*near_poles()), BLUNTEST))


def near_poles() -> tuple[Array, Array]:
    """Weight of a knot near 0 and near 180 degrees: 1 at the pole, half of it at ``POLE_RAD`` from it (KNOTS,)."""
    forward = 1 / (1 + (ANGLES_RAD / POLE_RAD) ** 2)
    return forward, forward[::-1]


@dataclass(frozen=True)
class Quadratic:
    """Half the misfit near a material: linear^T x + x^T matrix x / 2 + a constant, in the unknowns x (U,) and not in
    steps.
    """

    matrix: Array
    linear: Array
    noise: Array
    """Excess of the matrix by the Monte Carlo noise of the derivatives, where they are not paired; positive
    semidefinite."""
    noise_linear: Array
    """The same excess of the linear term."""
    error: Array
    """About the error of the matrix by chance (U, U), of either sign."""
