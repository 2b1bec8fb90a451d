"""Advice on the instrument's measurement that would help most: covariance of a fit whose calibration knew one kind of
error twice as precisely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.fit.checks.identifiability import quantity_in_words
from services.fit.checks.next_capture import MIN_REDUCTION, in_percent, relative_errors
from services.fit.coordinates.instrument_errors import kind_of_error
from services.fit.measurements.instrument.moves import MOVING_BODIES
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.estimates import estimates
from services.fit.solve.information import AddedInformation, covariance_after
from services.transport.optics.parameters import Tissue

Array = NDArray[np.float64]

SE_DIVISOR = 2.0
"""Factor by which the standard errors of a kind are divided."""
WORDS = {
    "gain": "Measuring the gain",
    "light_gain": "Measuring each light",
    "flare": "Measuring the flare",
    "teeth": "Registering the scan",
    "dome": "Measuring where the dome stands",
    "shift": "Measuring how the subject moves, by tracking frames,",
}


def calibration_advice(tissue: Tissue, parts: Sequence[str], uncertainty: Uncertainty) -> str:
    """One sentence on the kind of error that is worth measuring; '' where none is. It is judged by the quantity with
    the largest relative error, or by the next ones where no measurement helps that one.

    Args:
        tissue: the solution.
        parts: names of the media, ``enamel`` and ``dentin``.
        uncertainty: uncertainty at the solution.
    """
    before = relative_errors(estimates(tissue, parts, uncertainty))
    kinds = dict.fromkeys(
        [*map(kind_of_error, uncertainty.domain.errors.names), *(k for k in MOVING_BODIES if k in uncertainty.parts)]
    )
    after = {
        kind: relative_errors(
            estimates(tissue, parts, replace(uncertainty, covariance=covariance_if_known(uncertainty, kind)))
        )
        for kind in kinds
    }
    for name in sorted(before, key=lambda name: -before[name]):
        if not after:
            break
        kind = min(after, key=lambda kind: after[kind][name])
        if after[kind][name] <= (1 - MIN_REDUCTION) * min(before[name], 1.0):
            initial = in_percent(before[name]) if before[name] <= 1 else "more than 100 %"
            cut = f"would cut the error of {quantity_in_words(name)} from {initial} to {in_percent(after[kind][name])}"
            return f"{WORDS[kind]} {_target_precision(uncertainty, kind)} {cut}."
    return ""


def covariance_if_known(uncertainty: Uncertainty, kind: str) -> Array:
    """Covariance (F, F) of a fit whose calibration knew a kind of error ``SE_DIVISOR`` times as precisely; the
    remaining step of the fit stays in it.
    """
    own = [k for k, name in enumerate(uncertainty.domain.errors.names) if kind_of_error(name) == kind]
    if not own:
        return np.asarray(uncertainty.covariance - (1 - SE_DIVISOR**-2) * uncertainty.parts[kind])
    assert uncertainty.sandwich is not None
    domain = uncertainty.domain
    chosen = [domain.tissue_count + k for k in own]
    # Add information that divides the kind's own covariance, whatever its correlations with other kinds.
    added = np.zeros_like(uncertainty.covariance)
    added[np.ix_(chosen, chosen)] = (SE_DIVISOR**2 - 1) * np.linalg.inv(domain.errors.matrix[np.ix_(own, own)])
    whitened = uncertainty.sandwich.transform.T @ added @ uncertainty.sandwich.transform
    count = domain.tissue_count
    better = np.asarray(np.linalg.inv(domain.errors.precision + added[count:, count:]), dtype=np.float64)
    with_prior = replace(uncertainty, sandwich=replace(uncertainty.sandwich, prior=better))
    weight = domain.errors.weight
    return covariance_after(with_prior, AddedInformation(weight * whitened, weight**2 * whitened))


def _target_precision(uncertainty: Uncertainty, kind: str) -> str:
    if kind in {*MOVING_BODIES, "shift"}:
        return "twice as well"
    errors = uncertainty.domain.errors
    se = min(se for name, se in zip(errors.names, errors.se.tolist(), strict=True) if kind_of_error(name) == kind)
    return f"to {100 * se / SE_DIVISOR:.2g} %"
