"""What one more image would teach: the covariance of a fit that had it, from the image's Jacobian alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.covariance import Uncertainty, positive_part
from services.fit.solve.sandwich import Sandwich

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Addition:
    """What further measurements add in whitened coordinates y (F,), each (F, F); blocks add.

    Where these measurements have errors of their own in common, such as a new light's gain, K of them in units of their
    ± are the last coordinates (F + K,), and ``left`` is what remains for y.
    """

    information: Array
    """J'WJ"""
    meat: Array
    """Covariance of J'W r by the noise of the measurements and of the renders."""
    errors: int = 0
    """K"""

    def __add__(self, other: Addition) -> Addition:
        return Addition(self.information + other.information, self.meat + other.meat, self.errors)

    def scaled(self, factor: float) -> Addition:
        """Of ``factor`` times as many measurements of the same kind."""
        return Addition(factor * self.information, factor * self.meat, self.errors)

    def left(self) -> Addition:
        """Of y alone, its own errors at their best for any y; noise in J makes them explain a little more than they
        can.
        """
        if not self.errors:
            return self
        count = len(self.information) - self.errors
        prior = np.diag(np.repeat([0.0, 1.0], [count, self.errors]))
        whole = self.information + prior
        lift = np.concatenate([np.eye(count), -np.linalg.solve(whole[count:, count:], whole[count:, :count])])
        return Addition(lift.T @ whole @ lift, lift.T @ (self.meat + prior) @ lift)


def addition(
    known: Sandwich,
    slopes: tuple[Array, Array],
    renders: tuple[Array, Array],
    variance: Array,
    weight: float,
    errors: Array | None = None,
) -> Addition:
    """Sum measurements that have not been made, with as many paths as the fit's last measurement.

    Args:
        known: of the fit without them.
        slopes: J (F, M) from two seeds.
        renders: images (M,) from two more.
        variance: the measurements' expected variance (M,).
        weight: what the fit would give each of them.
        errors: what one ± of each error of their own changes them by (K, M).
    """
    m, d = (known.transform.T @ (0.5 * (slopes[0] + sign * slopes[1])) for sign in (1, -1))
    if errors is not None:
        m, d = np.concatenate([m, errors]), np.concatenate([d, np.zeros(errors.shape)])
    render_variance = 0.25 * (renders[0] - renders[1]) ** 2

    # Gradient noise as in the normal equations, with residuals that are noise alone.
    data = (variance * m) @ m.T - (variance * d) @ d.T
    monte_carlo = (render_variance * m) @ m.T + (variance * d) @ d.T
    meat = weight**2 * (known.misfit * data + monte_carlo)
    return Addition(weight * (m @ m.T - d @ d.T), meat, 0 if errors is None else len(errors))


def covariance_with(known: Sandwich, added: Addition) -> Array:
    """Covariance (F, F) of x in a fit with the further measurements; negative information, which noise alone makes,
    counts as none.
    """
    own = added.left()
    information, meat = (positive_part(matrix) for matrix in (own.information, own.meat))
    inverse = np.asarray(np.linalg.inv(np.linalg.inv(known.inverse) + information), dtype=np.float64)
    return known.covariance_of(inverse, known.meat + meat)


def covariance_after(known: Uncertainty, added: Addition) -> Array:
    """Covariance (F, F) of x as the fit states it, had it the further measurements; the step that was left stays
    left.
    """
    assert known.sandwich is not None
    return covariance_with(known.sandwich, added) + known.parts.get("unfinished", np.zeros_like(known.covariance))
