"""Advice on the instrument's measurement that would help most: covariance of a fit whose calibration knew one kind of
error twice as precisely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.fit.checks.identifiability import in_words
from services.fit.checks.next_capture import WORTH, in_percent, relative_errors
from services.fit.instrument.errors import kind_of_error
from services.fit.instrument.moves import MOVED
from services.fit.optics.parameters import Tissue
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.estimates import estimates
from services.fit.solve.information import Addition, covariance_after

Array = NDArray[np.float64]

FEWER = 2.0
"""Factor by which the standard errors of a kind are divided."""
WORDS = {
    "gain": "Measuring the gain",
    "light_gain": "Measuring each light",
    "flare": "Measuring the flare",
    "teeth": "Registering the scan",
    "dome": "Measuring where the dome stands",
}


def calibration_advice(tissue: Tissue, parts: Sequence[str], known: Uncertainty) -> str:
    """One sentence on the kind of error that is worth measuring; '' where none is. It is judged by the quantity with
    the largest relative error, or by the next ones where no measurement helps that one.

    Args:
        tissue: the solution.
        parts: names of the media, ``enamel`` and ``dentin``.
        known: uncertainty at the solution.
    """
    before = relative_errors(estimates(tissue, parts, known))
    kinds = dict.fromkeys([*map(kind_of_error, known.domain.errors.names), *(k for k in MOVED if k in known.parts)])
    after = {
        kind: relative_errors(estimates(tissue, parts, replace(known, covariance=covariance_if_known(known, kind))))
        for kind in kinds
    }
    for name in sorted(before, key=lambda name: -before[name]):
        if not after:
            break
        kind = min(after, key=lambda kind: after[kind][name])
        if after[kind][name] <= (1 - WORTH) * min(before[name], 1.0):
            was = in_percent(before[name]) if before[name] <= 1 else "more than 100 %"
            cut = f"would cut the error of {in_words(name)} from {was} to {in_percent(after[kind][name])}"
            return f"{WORDS[kind]} {_how_well(known, kind)} {cut}."
    return ""


def covariance_if_known(known: Uncertainty, kind: str) -> Array:
    """Covariance (F, F) of a fit whose calibration knew a kind of error ``FEWER`` times as precisely; the remaining
    step of the fit stays in it.
    """
    if kind in MOVED:
        return np.asarray(known.covariance - (1 - FEWER**-2) * known.parts[kind])
    assert known.sandwich is not None
    domain = known.domain
    own = [k for k, name in enumerate(domain.errors.names) if kind_of_error(name) == kind]
    chosen = [domain.tissue_count + k for k in own]
    # Add information that divides the kind's own covariance, whatever its correlations with other kinds.
    added = np.zeros_like(known.covariance)
    added[np.ix_(chosen, chosen)] = (FEWER**2 - 1) * np.linalg.inv(domain.errors.matrix[np.ix_(own, own)])
    whitened = known.sandwich.transform.T @ added @ known.sandwich.transform
    count = domain.tissue_count
    better = np.asarray(np.linalg.inv(domain.errors.precision + added[count:, count:]), dtype=np.float64)
    with_prior = replace(known, sandwich=replace(known.sandwich, prior=better))
    return covariance_after(with_prior, Addition(whitened, whitened))


def _how_well(known: Uncertainty, kind: str) -> str:
    if kind in MOVED:
        return "twice as well"
    errors = known.domain.errors
    se = min(se for name, se in zip(errors.names, errors.se.tolist(), strict=True) if kind_of_error(name) == kind)
    return f"to {100 * se / FEWER:.2g} %"
