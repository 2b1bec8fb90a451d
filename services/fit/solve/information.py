"""Predicted covariance of a fit with one more image, from the Jacobian of that image alone (optimal experimental
design).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.covariance import Uncertainty
from services.fit.solve.final_uncertainty import positive_part
from services.fit.solve.sandwich import Sandwich

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AddedInformation:
    """Information and gradient covariance that further measurements add, each (F, F) in whitened coordinates y (F,);
    blocks of measurements add up.

    Where these measurements have K calibration errors of their own, such as a new light's gain, these errors are the
    last coordinates, in units of their standard error, the matrices are (F + K, F + K), and ``marginalised`` eliminates
    them.
    """

    information: Array
    """Information J'WJ."""
    meat: Array
    """Covariance of the gradient J'W r that is due to the noise of the measurements and of the renders."""
    errors: int = 0
    """Number K of the measurements' own calibration errors."""

    def __add__(self, other: AddedInformation) -> AddedInformation:
        return AddedInformation(self.information + other.information, self.meat + other.meat, self.errors)

    def scaled(self, factor: float) -> AddedInformation:
        """The addition of ``factor`` times as many measurements of the same kind."""
        return AddedInformation(factor * self.information, factor * self.meat, self.errors)

    def marginalised(self) -> AddedInformation:
        """The addition to y (F,) alone, with the measurements' own errors at their optimum for any y.

        Noise in J makes these errors explain a little more than they can in truth.
        """
        if not self.errors:
            return self
        count = len(self.information) - self.errors
        prior = np.diag(np.repeat([0.0, 1.0], [count, self.errors]))
        whole = self.information + prior
        lift = np.concatenate([np.eye(count), -np.linalg.solve(whole[count:, count:], whole[count:, :count])])
        return AddedInformation(lift.T @ whole @ lift, lift.T @ (self.meat + prior) @ lift)


def added_information(
    sandwich: Sandwich,
    slopes: tuple[Array, Array],
    renders: tuple[Array, Array],
    variance: Array,
    weight: float,
    errors: Array | None = None,
) -> AddedInformation:
    """Sum planned measurements, rendered with as many paths as the last measurement of the fit.

    Args:
        sandwich: sandwich covariance of the fit without the planned measurements.
        slopes: derivatives J (F, M) from two seeds.
        renders: images (M,) from two further seeds.
        variance: the measurements' expected variance (M,).
        weight: the weight that the fit would give each measurement.
        errors: changes (K, M) of the measurements by one standard error of each of their own calibration errors.
    """
    m, d = (sandwich.transform.T @ (0.5 * (slopes[0] + sign * slopes[1])) for sign in (1, -1))
    if errors is not None:
        m, d = np.concatenate([m, errors]), np.concatenate([d, np.zeros(errors.shape)])
    render_variance = 0.25 * (renders[0] - renders[1]) ** 2

    # The gradient's noise as in the normal equations, where the expected residuals are noise alone.
    data = (variance * m) @ m.T - (variance * d) @ d.T
    monte_carlo = (render_variance * m) @ m.T + (variance * d) @ d.T
    meat = weight**2 * (sandwich.misfit * data + monte_carlo)
    return AddedInformation(weight * (m @ m.T - d @ d.T), meat, 0 if errors is None else len(errors))


def covariance_with(sandwich: Sandwich, added: AddedInformation) -> Array:
    """Covariance (F, F) of x in a fit with the further measurements.

    Negative eigenvalues of the added information come from noise alone and count as zero.
    """
    own = added.marginalised()
    information, meat = (positive_part(matrix) for matrix in (own.information, own.meat))
    inverse = np.asarray(np.linalg.inv(np.linalg.inv(sandwich.inverse) + information), dtype=np.float64)
    return sandwich.covariance_of(inverse, sandwich.meat + meat)


def covariance_after(uncertainty: Uncertainty, added: AddedInformation) -> Array:
    """Covariance (F, F) of x that the fit would state with the further measurements; the covariance of its unfinished
    step stays in it.
    """
    assert uncertainty.sandwich is not None
    return covariance_with(uncertainty.sandwich, added) + uncertainty.parts.get(
        "unfinished", np.zeros_like(uncertainty.covariance)
    )
