"""Losses as weights of a least-squares fit (teeth 2018, section 7): F = 1/2 sum w r^2, scaled so that sum w var_ref is
the number of measurements.

============  ==========================================  ==================================
loss          sum over measurements                       w, up to the common scale
============  ==========================================  ==================================
l2            r^2                                         1
relative_l2   (r / (ref + floor))^2                       1 / (ref + floor)^2
l1            abs r                                       1 / abs r
relative_l1   abs r / (ref + floor)                       1 / ((ref + floor) abs r)
robust        Cauchy, ln(1 + (u / c)^2)                   1 / (1 + (u / c)^2)
============  ==========================================  ==================================

floor is ``FLOOR`` times the mean reference; u = r over its standard deviation (sensor and Monte Carlo), in units of the
median of all abs u (divided by ``MEDIAN_OF_NORMAL``). The last three losses depend on the residual: iteratively
reweighted least squares (Beaton and Tukey 1974). Their weights come from a render whose seed no other pass uses, so
that for given weights the fit is as unbiased as l2. One bias remains: the noise of that render enlarges small
residuals, so l1 becomes least squares where the fit is closer than the noise.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
from numpy.typing import NDArray

from services.core.choices import chosen
from services.core.records import Loss

Array = NDArray[np.float64]

FLOOR = 0.1
"""Floor that relative losses add to the reference, as a share of the mean reference."""
CAUCHY = 2.385
"""Tuning constant c of the Cauchy loss: 95 % of least squares' efficiency under Gaussian noise (Holland and Welsch
1977)."""
MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal number."""
MIN_RESIDUAL = 0.1
"""Smallest residual of l1 and relative_l1, as a share of the residual's own standard deviation; smaller residuals count
as this one."""


def is_reweighted(loss: Loss) -> bool:
    """Whether the loss's weights depend on the residuals."""
    return chosen("Loss", loss, {name: name not in {"l2", "relative_l2"} for name in get_args(Loss)})


def first_weights(loss: Loss, reference: Array, variance: Array) -> Array:
    """Weights (M,) before any residual is known.

    Args:
        reference: the valid measurements (M,).
        variance: noise variance of the reference (M,).
    """
    weight = np.ones_like(reference)
    if loss in {"relative_l2", "relative_l1"}:
        weight /= _floored(reference) ** 2
    return _scaled(weight, variance)


def weights(loss: Loss, reference: Array, variance: Array, residual: Array, residual_variance: Array) -> Array:
    """Weights (M,) of the next round of reweighting.

    Args:
        reference: the valid measurements (M,).
        variance: noise variance of the reference (M,).
        residual: render minus reference (M,), from a seed that no other pass uses.
        residual_variance: Monte Carlo variance of that render (M,).
    """
    if not is_reweighted(loss):
        return first_weights(loss, reference, variance)
    spread = np.sqrt(np.maximum(variance + residual_variance, 1e-300))
    if loss == "robust":
        deviation = residual / spread
        scale = max(float(np.median(np.abs(deviation))) / MEDIAN_OF_NORMAL, 1e-12)
        return _scaled(1 / (1 + (deviation / (CAUCHY * scale)) ** 2), variance)
    size = np.maximum(np.abs(residual), MIN_RESIDUAL * spread)
    return _scaled(1 / size if loss == "l1" else 1 / (size * _floored(reference)), variance)


def _floored(reference: Array) -> Array:
    return np.maximum(reference, 0.0) + FLOOR * float(np.abs(reference).mean())


def _scaled(weight: Array, variance: Array) -> Array:
    # Scale the weights so that F is in units of the measurements' noise and priors keep their meaning; where the sensor
    # noise is zero, the weights have mean one instead.
    total = float(weight @ variance)
    return np.asarray(weight * (len(weight) / total if total > 0 else 1 / weight.mean()))
