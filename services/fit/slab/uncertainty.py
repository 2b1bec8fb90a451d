"""How sure a fit is: covariance of the unknowns, of what is derived from them, and what the images do not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.slab.dictionary import KNOTS, Material, cosine_moments, tent_solid_angles
from services.fit.slab.gauss_newton import Solution
from services.fit.slab.prior import precision

Array = NDArray[np.float64]

FLAG_CURVATURE = 100.0
"""Scale of the prior, per rad2, under which a value counts as determined by the images: HG 0.8 bends by 60 at its peak, so a
narrower one would let the prior's smoothness pass for a measurement."""
LARGEST_SHARE = 0.1
"""Standard error, as a share of the value, up to which a value of the phase function is determined."""
LARGEST_COEFFICIENT_SHARE = 0.05
"""The same for coefficients, and in units of 1 for g."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariances (UNKNOWNS, UNKNOWNS) of ln f and sigma_a."""

    covariance: Array
    """With the prior's scale that the evidence chose."""
    images_alone: Array
    """With a prior so weak that it tells nothing: what flags are judged by."""

    def standard_error(self, slope: Array) -> float:
        """Of a quantity, from its derivatives by the unknowns."""
        return float(np.sqrt(slope @ self.covariance @ slope))

    def undetermined_error(self, slope: Array) -> float:
        """The same as far as the images alone tell."""
        return float(np.sqrt(slope @ self.images_alone @ slope))


def uncertainty_of(solution: Solution) -> Uncertainty:
    """Covariances at a solution.

    The curvature is that of the mean derivatives, noise included, as the unbiased one may be indefinite; the gradient's own
    Monte Carlo noise is added by the sandwich. Both make the answer a little too wide rather than too narrow.
    """
    curvature = solution.quadratic.matrix + solution.quadratic.noise
    return Uncertainty(*(_covariance(curvature, solution.gradient_noise, scale) for scale in (solution.scale, FLAG_CURVATURE)))


def _covariance(curvature: Array, gradient_noise: Array, scale: float) -> Array:
    total = curvature + precision(scale)
    inverse = np.linalg.pinv(total, rcond=1e-14, hermitian=True)
    return np.asarray(inverse + inverse @ gradient_noise @ inverse)


def slopes(material: Material) -> dict[str, Array]:
    """Derivatives of the reported numbers by ln f and sigma_a (UNKNOWNS,)."""
    parts, moments = material.scattering * tent_solid_angles(), material.scattering * cosine_moments()
    sigma_s, g = material.scattering_per_mm, material.mean_cosine
    return {
        "sigma_t": np.append(parts, 1.0),
        "sigma_s": np.append(parts, 0.0),
        "sigma_a": np.append(np.zeros(KNOTS), 1.0),
        "sigma_s_reduced": np.append(parts - moments, 0.0),
        "g": np.append((moments - g * parts) / sigma_s, 0.0),
    }


def phase_errors(material: Material, uncertainty: Uncertainty) -> tuple[Array, NDArray[np.bool_]]:
    """Standard errors of the phase function at the knots, 1/sr, and which of its values are determined."""
    share = material.scattering * tent_solid_angles() / material.scattering_per_mm
    # ln p = ln f - ln sigma_s
    chain = np.eye(KNOTS + 1)[:KNOTS] - np.append(share, 0.0)
    errors, alone = (
        np.sqrt(np.einsum("ij,jk,ik->i", chain, covariance, chain, optimize=True)) for covariance in (uncertainty.covariance, uncertainty.images_alone)
    )
    return errors * material.phase_per_sr, alone <= LARGEST_SHARE
