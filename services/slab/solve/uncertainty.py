"""Uncertainty of a fit: covariance of the unknowns and of quantities derived from them, and which of these the images
do not determine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import (
    ANGLES_RAD,
    KNOTS,
    SPACING_RAD,
    Material,
    cosine_moments,
    tent_solid_angles,
)
from services.slab.solve.measured_directions import measured_directions
from services.slab.solve.prior import Quadratic
from services.slab.solve.solution import Solution

Array = NDArray[np.float64]

LARGEST_SHARE = 0.1
"""Largest standard error, as a share of the value, at which a value of the phase function is determined."""
RESOLVED_NEAR_RAD = math.radians(10)
"""Distance from an angle within which degrees of freedom count for its resolution. Near the poles images are of single
angles, so that the kernels' diagonal jumps from knot to knot there."""
LARGEST_COEFFICIENT_SHARE = 0.05
"""Largest standard error at which a coefficient is determined, as a share of its value, and for g in units of 1."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariances of ln f and sigma_a (KNOTS + 1, KNOTS + 1)."""

    covariance: Array
    """Covariance with the prior's scale that the evidence chose."""
    images_alone: Array
    """Covariance with a prior so weak that it adds no information; flags are judged by it."""
    of_unknowns: tuple[Array, Array]
    """Both covariances in the solver's own unknowns (U, U)."""
    averaging: Array | None = None
    """Averaging kernels (KNOTS, KNOTS): the change of the answer's ln f by the true one's. The answer has the structure
    that they pass, and the covariance is that of the true phase function seen through them. None of a dictionary with
    few atoms."""

    def standard_error(self, slope: Array) -> float:
        """Standard error of a quantity, from its derivatives with respect to ln f and sigma_a (KNOTS + 1,)."""
        return float(np.sqrt(slope @ self.covariance @ slope))

    def error_by_images(self, slope: Array) -> float:
        """The same standard error as far as the images alone determine the quantity."""
        return float(np.sqrt(slope @ self.images_alone @ slope))

    def larger_error(self, slope: Array) -> float:
        """The larger of both, by which a quantity is judged: a fit that ended short of its minimum may have the smaller
        error under the weak prior.
        """
        return max(self.standard_error(slope), self.error_by_images(slope))


def uncertainty_of(solution: Solution, *, with_remaining: bool = True) -> Uncertainty:
    """Covariances at a solution.

    The unbiased matrix is indefinite where it is noise, and the matrix with the noise included would promise too much:
    so only directions whose curvature stands out count. The gradient's noise is that of the measurements, and that of
    the paths as measured between batches; the displacement left to the minimum counts as error, and so does the prior's
    pull.

    Args:
        solution: the solution.
        with_remaining: whether the displacement left to the minimum counts as error.
    """
    coordinates, material, quadratic = solution.coordinates, solution.material, solution.quadratic
    x = coordinates.unknowns(material)
    priors = coordinates.precision(solution.scale), coordinates.weak_precision(material)
    (directions, bounds), (weak_directions, weak_bounds) = (
        (measured_directions(quadratic, prior), np.diag(_half_lines(quadratic, prior, x, coordinates.is_at_bound(x))))
        for prior in priors
    )
    chosen: Array = np.asarray(np.linalg.inv(directions.total + bounds), dtype=np.float64)
    alone: Array = np.asarray(np.linalg.inv(weak_directions.total + weak_bounds), dtype=np.float64)
    noise = (
        solution.data_noise
        + solution.gradient_noise
        + np.outer(solution.matrix_error_gradient, solution.matrix_error_gradient)
    )
    pull = coordinates.pull_covariance(material, quadratic, solution.scale)
    chosen = chosen @ (directions.noise(noise) + pull + bounds) @ chosen
    remaining = _remaining_square(solution, x, priors[0], chosen)
    # Flags ask what the prior adds, so the covariance under the weak prior has only the noise that the weights contain.
    if with_remaining:
        chosen, alone = chosen + remaining, alone + remaining
    if (chain := coordinates.chain(material)) is None:
        averaging = np.linalg.inv(directions.total) @ directions.curvature
        return Uncertainty(chosen, alone, (chosen, alone), averaging[:KNOTS, :KNOTS])
    return Uncertainty(chain @ chosen @ chain.T, chain @ alone @ chain.T, (chosen, alone))


def _remaining_square(solution: Solution, x: Array, prior: Array, covariance: Array) -> Array:
    """Outer square (U, U) of the displacement left to the minimum within bounds, reduced by the share that noise alone
    leaves on average.
    """
    coordinates, quadratic = solution.coordinates, solution.quadratic
    directions = measured_directions(quadratic, prior)
    slope = directions.projected(quadratic.linear + quadratic.matrix @ x)
    remaining = coordinates.minimum(directions.total, directions.curvature @ x - slope) - x
    # In units of the covariance (U, U) without this term, noise leaves a squared length of one for each measured
    # direction.
    length = float(remaining @ np.linalg.lstsq(covariance, remaining)[0])
    share = max(0.0, 1 - len(directions.signals) / max(length, 1e-300))
    return np.asarray(share * np.outer(remaining, remaining))


def covariance_of(quadratic: Quadratic, prior: Array) -> Array:
    """Posterior covariance of the unknowns under a prior's precision (U, U), where the weights contain all noise."""
    return np.asarray(np.linalg.inv(measured_directions(quadratic, prior).total))


def _half_lines(quadratic: Quadratic, prior: Array, x: Array, bound: NDArray[np.bool_]) -> Array:
    """Precision (U,) that a bound adds to the unknowns that lie at it.

    On the half line within the bound, an unknown of slope s has the density exp(-s x - a x^2 / 2): its second moment is
    1/a where s is small, as without the bound, and 2/s^2 where s is large.
    """
    slope = quadratic.linear + quadratic.noise_linear + (quadratic.matrix + quadratic.noise + prior) @ x
    return np.where(bound, np.maximum(slope, 0) ** 2 / 2, 0.0)


def slopes(material: Material) -> dict[str, Array]:
    """Derivatives of the reported quantities with respect to ln f and sigma_a (KNOTS + 1,)."""
    parts, moments = material.scattering * tent_solid_angles(), material.scattering * cosine_moments()
    sigma_s, g = material.scattering_per_mm, material.mean_cosine
    return {
        "sigma_t": np.append(parts, 1.0),
        "sigma_s": material.slope_of_scattering(),
        "sigma_a": np.append(np.zeros(KNOTS), 1.0),
        "sigma_s_reduced": np.append(parts - moments, 0.0),
        "g": np.append((moments - g * parts) / sigma_s, 0.0),
    }


def largest_move(before: Material, after: Material, uncertainty: Uncertainty) -> float:
    """Change from one medium to another in standard errors: the largest of the coefficients' and g's changes, and the
    rms of those of the determined values of the phase function.
    """
    change = np.append(np.log(after.scattering / before.scattering), after.absorption_per_mm - before.absorption_per_mm)
    numbers = [abs(float(slope @ change)) / uncertainty.larger_error(slope) for slope in slopes(after).values()]
    errors, determined = phase_errors(after, uncertainty)
    values = (phase_chain(after) @ change * after.phase_per_sr / errors)[determined]
    return max(*numbers, float(np.sqrt(np.mean(values**2))) if values.size else 0.0)


def phase_chain(material: Material) -> Array:
    """Derivatives of ln p at the knots with respect to ln f and sigma_a (KNOTS, UNKNOWNS), as ln p = ln f - ln
    sigma_s.
    """
    return np.asarray(np.eye(KNOTS + 1)[:KNOTS] - material.slope_of_scattering() / material.scattering_per_mm)


def phase_errors(material: Material, uncertainty: Uncertainty) -> tuple[Array, NDArray[np.bool_]]:
    """Standard errors of the phase function at the knots, 1/sr, and which of its values are determined."""
    chain = phase_chain(material)
    errors, alone = (
        np.sqrt(np.einsum("ij,jk,ik->i", chain, covariance, chain, optimize=True))
        for covariance in (uncertainty.covariance, uncertainty.images_alone)
    )
    return errors * material.phase_per_sr, alone <= LARGEST_SHARE


def resolution_deg(averaging: Array) -> Array:
    """Width (KNOTS,), degrees, of the narrowest structure that the images resolve at each knot.

    It is the range of angles near the knot over the degrees of freedom for signal in it, which are the sum of the
    averaging kernels' diagonal (Rodgers 2000, Inverse Methods for Atmospheric Sounding, 2.4 and 3.1).
    """
    near = np.abs(ANGLES_RAD[:, None] - ANGLES_RAD) <= RESOLVED_NEAR_RAD
    freedom = near @ np.clip(np.diag(averaging), 0, 1)
    range_deg = np.degrees(SPACING_RAD) * near.sum(axis=1)
    return np.asarray(np.minimum(range_deg / np.maximum(freedom, 1e-9), 180.0))
