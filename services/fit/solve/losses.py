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

floor is a share of the mean reference; u = r over its standard deviation (sensor and Monte Carlo), in units of the
median size of all u. The last three depend on the residual: iteratively reweighted least squares (Beaton and Tukey
1974), weights from a render that no other pass sees, so that for given weights the fit is as unbiased as l2. What stays
is that noise of that render enlarges small residuals: l1 becomes least squares where the fit is closer than the noise.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
from numpy.typing import NDArray

from services.core.choices import chosen
from services.core.records import Loss

Array = NDArray[np.float64]

FLOOR = 0.1
"""Added to the reference in relative losses, as a share of the mean reference."""
CAUCHY = 2.385
"""Tuning constant: 95 % of least squares' efficiency under Gaussian noise (Holland and Welsch 1977)."""
MEDIAN_OF_NORMAL = 0.6745
MIN_RESIDUAL = 0.1
"""Residuals of l1 count as at least this share of their own standard deviation."""


def is_reweighted(loss: Loss) -> bool:
    """Whether weights follow residuals."""
    return chosen("Loss", loss, {name: name not in {"l2", "relative_l2"} for name in get_args(Loss)})


def first_weights(loss: Loss, reference: Array, variance: Array) -> Array:
    """Weights (M,) before any residual is known.

    Args:
        reference: the measurements that count, (M,).
        variance: theirs.
    """
    weight = np.ones_like(reference)
    if loss in {"relative_l2", "relative_l1"}:
        weight /= _floored(reference) ** 2
    return _scaled(weight, variance)


def weights(loss: Loss, reference: Array, variance: Array, residual: Array, residual_variance: Array) -> Array:
    """Weights (M,) of the next round.

    Args:
        residual: render minus reference of a seed used for nothing else.
        residual_variance: Monte Carlo variance of that render.
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
    # So that F is in units of the measurements' noise, and priors keep their meaning; sensor noise of nothing leaves
    # weights of mean one.
    total = float(weight @ variance)
    return np.asarray(weight * (len(weight) / total if total > 0 else 1 / weight.mean()))
