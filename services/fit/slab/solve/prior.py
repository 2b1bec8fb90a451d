"""Smoothness prior of ln f: its second derivative by angle is Gaussian, with a scale that the evidence chooses.

A phase function is even at both poles, so the second difference there takes the mirrored neighbour, which pulls the
slope to zero where no camera looks. The prior is not centred on an HG function, which would put a forward peak where
none is measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.slab.model.dictionary import ANGLES_RAD, KNOTS, SPACING_RAD, Material
from services.fit.slab.solve.normal import UNKNOWNS

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
    return np.asarray(np.hypot(scale, (1 - _near_poles()) * (second_differences() @ np.log(material.scattering))))


def flag_scales() -> Array:
    """The weak prior's scale at each knot, by the angle from the nearer pole."""
    return np.asarray(np.maximum(SHARPEST * _near_poles(), BLUNTEST))


def _near_poles() -> Array:
    """Weight of a knot: 1 at the poles, half of it at ``POLE_RAD`` from them (KNOTS,)."""
    return np.asarray(1 / (1 + (np.minimum(ANGLES_RAD, math.pi - ANGLES_RAD) / POLE_RAD) ** 2))


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
