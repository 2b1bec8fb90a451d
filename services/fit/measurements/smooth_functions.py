"""Smooth functions of a pixel's place, which the derivatives of a rough body's images to its media follow.

A walk behind a rough surface is reflected within for long, so derivatives by differences and scores have several times
more noise than signal in each pixel. But a change of media brightens and darkens wide areas: on the micro-CT incisor
polynomials of the third degree for each view and light kept the curvature within its noise, and left a third of the
standard errors of a step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DEGREE = 3
"""Largest total degree of the polynomials, of which there are ten."""


def smooth_functions(pixels: NDArray[np.int32]) -> NDArray[np.float64]:
    """Products of Chebyshev polynomials (K, N) of the places of some pixels (N, 2), stretched to -1 to 1."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    x, y = (2 * (pixels - low) / np.maximum(high - low, 1) - 1).T
    along_x, along_y = (np.polynomial.chebyshev.chebvander(one, DEGREE).T for one in (x, y))
    return np.array([along_x[i] * along_y[k] for i in range(DEGREE + 1) for k in range(DEGREE + 1 - i)])
