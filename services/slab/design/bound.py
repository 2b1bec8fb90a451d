"""Cramér-Rao bound of a material under a rig: the smallest errors that images of a cell allow, before anything is
measured.

The curvature of the misfit comes from the forward model at a known material, and the smoothness prior adds its own. The
bound of a quantity is the root of the sum of its posterior variance and the square of its bias by the prior at that
material.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import Material
from services.slab.cell.forward import Blocks, render
from services.slab.cell.rig import Rig
from services.slab.read.images import shot_noise
from services.slab.solve.coordinates import Knots, seen_poles
from services.slab.solve.gauss_newton import quadratic_at
from services.slab.solve.normal import normal_equations
from services.slab.solve.prior import Quadratic, flag_scales, is_thick, precision, sharp_scales
from services.slab.solve.smooth import smoother_of
from services.slab.solve.uncertainty import Uncertainty, covariance_of, phase_chain
from services.slab.solve.weights import independent_weights

Array = NDArray[np.float64]

BATCHES, PATHS = 8, 60_000
"""Batches, and paths per batch and light, of the render that gives the curvature. With fewer, noise passes for signal:
of 200 nm spheres at sigma_t w = 9.1, sigma_s was bounded by 0.36 % with 8,000 paths, 1.4 % with 40,000, 0.85 % with
250,000."""
FIRST_STEP = 2**33
"""Number of the render, apart from those of a fit, so that the two share no random stream."""


@dataclass(frozen=True)
class Bound:
    """Bound of one material under one rig."""

    uncertainty: Uncertainty
    bias: Array
    """Bias of the unknowns by the prior (UNKNOWNS,)."""

    def of(self, slope: Array) -> float:
        """Bound of a quantity, from its derivatives with respect to ln f and sigma_a (UNKNOWNS,)."""
        return float(np.hypot(self.uncertainty.standard_error(slope), slope @ self.bias))

    def of_phase(self, material: Material) -> Array:
        """Bound of the phase function at the knots, 1/sr (KNOTS,)."""
        chain = phase_chain(material)
        variance = np.einsum("ij,jk,ik->i", chain, self.uncertainty.covariance, chain, optimize=True)
        return np.asarray(np.sqrt(variance + (chain @ self.bias) ** 2) * material.phase_per_sr)


def bound_of(
    rig: Rig,
    material: Material,
    *,
    noise: float,
    variances: Array | None = None,
    seed: int = 1,
    paths: int | None = None,
) -> Bound:
    """The bound from images with shot noise.

    Args:
        noise: standard deviation of a pixel that has its image's mean, as a share of it.
        variances: variances of the measurement beside its shot noise (images, values), such as a reference's own.
        paths: paths per batch and light, instead of ``PATHS``.
    """
    quadratic = curvature_of(rig, material, noise=noise, variances=variances, seed=seed, paths=paths)
    x = Knots().unknowns(material)
    # The scale of the smoothness prior, per rad2, is the loosest that a fit may choose.
    scale = sharp_scales(material, seen_poles(quadratic))[-1]
    chosen, alone = (covariance_of(quadratic, precision(one)) for one in (scale, flag_scales()))
    uncertainty = Uncertainty(chosen, alone, (chosen, alone))
    return Bound(uncertainty, -uncertainty.covariance @ precision(scale) @ x)


def curvature_of(
    rig: Rig,
    material: Material,
    *,
    noise: float,
    variances: Array | None = None,
    seed: int = 1,
    paths: int | None = None,
    blocks: Blocks = map,
) -> Quadratic:
    """Quadratic model of half the misfit in ln f and sigma_a for images with shot noise; arguments as of
    ``bound_of``.
    """
    thick = is_thick(material, rig.width_mm)
    batches = render(
        rig, material, seed=seed, step=FIRST_STEP, batches=BATCHES, paths=paths or PATHS, scores=True, blocks=blocks
    )
    mean = batches.mean
    halves = 2 if rig.grid.folded else 1
    shot = np.stack([shot_noise(image, noise) for image in mean]) / halves
    total = shot + (0 if variances is None else variances)
    if thick:
        batches = smoother_of(rig.grid, rig.width_mm, mean - batches.single_images, total).of(batches)
    weights = independent_weights(total, np.zeros_like(shot))
    return quadratic_at(Knots().unknowns(material), normal_equations(batches, material, mean, weights))
