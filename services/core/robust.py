"""A standard deviation that outliers hardly change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""
HUBER_SIGMAS = 1.345
"""Threshold of Huber's loss in σ: with it the estimate is 95 % as efficient as least squares where all errors are
normal."""


def robust_sigma(deviations: NDArray[np.floating]) -> float:
    """Return the standard deviation of normal errors by the median of their absolute values.

    Args:
        deviations: errors about their centre, an array of any shape with at least one element. Where the centre is not
            known, it is the errors' median.
    """
    return MAD_TO_SIGMA * float(np.median(np.abs(deviations)))
