"""Whether a solution is as precise as it need be: the noise of rendering, and a step that remains, beside the whole
standard error that the photographs, the priors and the calibration leave anyway.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain
from services.fit.solve.covariance import whitening
from services.fit.solve.elimination import ReducedEquations
from services.fit.solve.final_uncertainty import positive_part
from services.fit.solve.normal_equations import NormalEquations

Array = NDArray[np.float64]

MAX_SHARE = 1 / 3
"""Largest share of a standard error that rendering, or a step not taken, may be. Squares add up, so a third lengthens
the whole by a twentieth, which more paths could not shorten any further."""


def rendering_shares(domain: Domain, equations: NormalEquations) -> tuple[Array, Array]:
    """Standard errors (F,) of the tissue's coordinates by the noise of rendering, and by all that the equations know:
    photographs, priors, the instrument's errors and rendering together.

    What the final uncertainty estimate adds later, such as moves of the dome, only makes the first a smaller share.
    """
    t, count = whitening(domain, equations).transform, domain.tissue_count
    misfit = max(1.0, equations.squares / equations.expected_squares) if equations.expected_squares > 0 else 1.0
    rendering = positive_part(t.T @ equations.gradient_noise @ t)
    whole = misfit * positive_part(t.T @ equations.data_noise @ t) + t.T @ domain.precision @ t + rendering
    rows = t[:count]
    by_rendering, by_all = (np.einsum("ka,ab,kb->k", rows, part, rows) for part in (rendering, whole))
    return np.sqrt(np.maximum(by_rendering, 0.0)), np.sqrt(np.maximum(by_all, 1e-300))


def is_settled(domain: Domain, equations: NormalEquations, reduced: ReducedEquations, step: Array) -> bool:
    """Whether neither more paths nor the step (F,) of the tissue would change any coordinate by more than a third of
    its standard error. It is never so while the curvature is not known to a third along every direction, because the
    standard errors are then not known either.

    Args:
        domain: the coordinates.
        equations: normal equations of the data.
        reduced: the same with priors, without the instrument's errors.
        step: step of the tissue to the minimum of the model.
    """
    scale = domain.scale[: domain.tissue_count]
    eigenvalues, vectors = np.linalg.eigh(reduced.hessian * np.outer(scale, scale))
    if (reduced.eigenvalue_noise(scale[:, None] * vectors) > MAX_SHARE * eigenvalues).any():
        return False
    rendering, whole = rendering_shares(domain, equations)
    return bool((np.maximum(rendering, np.abs(step)) <= MAX_SHARE * whole).all())
