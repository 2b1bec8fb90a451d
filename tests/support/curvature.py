"""Noise of a curvature matrix, for tests of the solvers."""

from __future__ import annotations

import numpy as np

from services.fit.solve.curvature_noise import CurvatureNoise, NoisePart


def isotropic(count: int, variance: float) -> CurvatureNoise:
    """Noise of a symmetric matrix (count, count) whose u'Hu has this variance along every unit vector u."""
    first, second = np.triu_indices(count)
    return CurvatureNoise((NoisePart(tuple(range(count)), np.diag(np.where(first == second, variance, variance / 2))),))
