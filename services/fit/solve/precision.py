"""How many paths a result needs: more of them shorten only the rendering's part of its standard errors."""

from __future__ import annotations

import numpy as np

from services.fit.solve.covariance import Uncertainty

MAX_RENDERING = 0.6
"""Largest share of a standard error that the noise of rendering may be, where the limit of paths allows it: more paths
would shorten the standard error by at most a fifth."""


def samples_needed(known: Uncertainty, samples: int, most: int) -> int:
    """Paths per pixel with which rendering is at most ``MAX_RENDERING`` of the standard error of each coordinate of the
    tissue that the data determine: its variance falls with the number of paths, and the other parts stay. A step that
    noise left unfinished counts as rendering.

    Args:
        known: the uncertainty with so many samples.
        samples: paths per pixel so far, the least result.
        most: largest result, unless there were more already.
    """
    units = np.eye(len(known.x))[: known.domain.tissue_count]
    determined = [k for k, unit in enumerate(units) if known.is_determined(unit)]
    if not determined or "rendering" not in known.parts:
        return samples
    by_noise = known.parts["rendering"] + known.parts.get("unfinished", 0.0)
    rendering, whole = (np.diag(one)[determined] for one in (by_noise, known.covariance))
    others = np.maximum(whole - rendering, 1e-300)
    factor = float((rendering / others).max()) * (1 - MAX_RENDERING**2) / MAX_RENDERING**2
    return min(max(samples, round(min(factor, most) * samples)), max(most, samples))
