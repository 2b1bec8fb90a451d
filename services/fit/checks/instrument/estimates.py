"""Results of a fit on the instrument, as fields of its report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.fit.checks.instrument.sentences import assumed_names, instrument_sentences
from services.fit.coordinates.instrument_errors import single_faults
from services.fit.measurements.instrument.moves import move_covariance
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.estimates import instrument_estimates


def instrument_report(
    spec: JobSpec, uncertainties: Mapping[str, Uncertainty], manifest: PreparedManifest
) -> dict[str, Any]:
    """Fields of a ``FitReport`` on the instrument.

    Args:
        spec: the job.
        uncertainties: by channel, the uncertainty at the solution.
        manifest: manifest of the prepared capture, with the uncertainty that its calibration states.
    """
    errors = {channel: one.domain.errors for channel, one in uncertainties.items()}
    found = {channel: own for channel, one in uncertainties.items() if (own := instrument_estimates(one))}
    _, moves = move_covariance(manifest.uncertainty, manifest.lights)
    assumed = assumed_names(
        errors, [body for body in moves if any(body in one.parts for one in uncertainties.values())]
    )
    faults = {channel: one.faults for channel, one in uncertainties.items() if one.faults}
    named = {
        c: tuple(errors[c].names[k] for k in single_faults([fault.index for fault in own], errors[c].names))
        for c, own in faults.items()
    }
    return {
        "instrument": found,
        "instrument_prior": {c: dict(zip(errors[c].names, errors[c].se.tolist(), strict=True)) for c in found},
        "assumed": assumed,
        "instrument_faults": {c: names for c, names in named.items() if names},
        "instrument_told": instrument_sentences(
            spec,
            errors,
            faults,
            assumed,
            manifest.uncertainty,
            found=found,
            is_alone=spec.kind != "jaw" and not manifest.surroundings,
        ),
    }
