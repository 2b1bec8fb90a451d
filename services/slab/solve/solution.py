"""Result of the solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import Material
from services.slab.solve.coordinates import Coordinates
from services.slab.solve.prior import Quadratic

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """Result of the solver; ``converged`` is a value, not an error."""

    material: Material
    quadratic: Quadratic
    """Model of half the misfit, at the last linearisation."""
    gradient_noise: Array
    scale: float | Array
    used: int
    steps: int
    """Number of all steps, in the search and in the last stages."""
    converged: bool
    paths: int
    """Number of all paths, over lights and batches."""
    coordinates: Coordinates
    """Coordinates whose unknowns the quadratic is in."""
    misfit: float
    """Half of the weighted squares before the last step, without the Monte Carlo noise of the images."""
    misfit_se: float
    data_noise: Array
    """Covariance of the last gradient's noise by the measurements (U, U)."""
    matrix_error_gradient: Array
    """Error of the last step by the noise of the matrix, as a gradient: ``matrix_error`` times the step (U,)."""
    path_variance: float
    """Variance of the last step by the paths, in units of that by the measurements; 0 where renders are not
    combined."""
