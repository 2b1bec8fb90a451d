"""Sentences on where a fit found the scan, and on photographs that are shifted farther than the preparation allows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.results import Estimate
from services.fit.coordinates.instrument_errors import COMMON_KINDS, InstrumentErrors, have_common_cause, kind_of_error
from services.fit.solve.recombination import Fault
from services.transport.scene.rigid_moves import SCAN

Array = NDArray[np.float64]

FAR_Z = 3.0
"""Distance of the scan, in standard errors of what the calibration states, beyond which it is said to lie elsewhere."""
MIN_SE = 1e-3
"""Smallest standard error that is told, mm and degrees."""


def pose_sentences(
    errors: Mapping[str, InstrumentErrors], found: Mapping[str, Mapping[str, Estimate]]
) -> Iterator[str]:
    """One sentence for each channel whose fit estimates the pose of the scan.

    Args:
        errors: by channel, the errors before the fit.
        found: by channel, the errors' estimates.
    """
    for channel, own in errors.items():
        if SCAN[0] not in own.names or channel not in found:
            continue
        estimates = [found[channel][name] for name in SCAN]
        value, se = (np.array([getattr(one, field) or 0.0 for one in estimates]) for field in ("value", "se"))
        chosen = [own.names.index(name) for name in SCAN]
        prior = own.matrix[np.ix_(chosen, chosen)]
        degrees, millimetres = slice(0, 3), slice(3, 6)
        turn, turn_se, turn_before = np.degrees(_along(value[degrees], se[degrees], prior[degrees, degrees]))
        way, way_se, way_before = _along(value[millimetres], se[millimetres], prior[millimetres, millimetres])
        far = max(turn / turn_before, way / way_before)
        beyond = (
            f" That is {far:.1f} times what the calibration states: check how the scan was registered, and the standard"
            " error that the registration states."
            if far > FAR_Z
            else ""
        )
        yield (
            f"In {channel} the photographs put the scan {way:.2f} ± {max(way_se, MIN_SE):.2g} mm and {turn:.2f} ±"
            f" {max(turn_se, MIN_SE):.2g}° from where the calibration says, which states ± {way_before:.2g} mm and"
            f" ± {turn_before:.2g}°; the fit renders it there.{beyond}"
        )


def _along(value: Array, se: Array, prior: Array) -> Array:
    # Length of a vector, its standard error along the vector, and the prior's.
    length = float(np.linalg.norm(value))
    way = value / length if length > 0 else np.array([1.0, 0.0, 0.0])
    return np.array([length, np.sqrt(way**2 @ se**2), np.sqrt(way @ prior @ way)])


def shift_sentences(channel: str, faults: Sequence[Fault], errors: InstrumentErrors) -> Iterator[str]:
    """One sentence for each photograph that is shifted too far; one for all where they have a common cause.

    Args:
        channel: name of the channel.
        faults: errors that lie too far from their prior.
        errors: the errors before the fit.
    """
    own = [fault for fault in faults if kind_of_error(errors.names[fault.index]) == "shift"]
    if own and have_common_cause(len(own), errors.names, COMMON_KINDS[1]):
        worst = max(own, key=lambda fault: abs(fault.z))
        yield (
            f"In {channel} the images put {len(own)} shifts of photographs off, most that of"
            f" {_photograph(errors, worst)}, by {abs(worst.size):.2f} px: so many have one cause: the subject moved"
            " more than the preparation found, or the model leaves something out; take tracking frames, or look at the"
            " preparation's motion."
        )
        return
    named = set[str]()
    for fault in own:
        if (photograph := _photograph(errors, fault)) in named:
            continue
        named.add(photograph)
        yield (
            f"In {channel} {photograph} is shifted by {abs(fault.size):.2f} px, {abs(fault.z):.1f} times what its own"
            f" error and the standard error of its motion, {errors.se[fault.index]:.2g} px, allow together: the subject"
            " moved in it; take it again, or leave that light out (left_out_lights)."
        )


def _photograph(errors: InstrumentErrors, fault: Fault) -> str:
    _, camera, light, _ = errors.names[fault.index].split(".")
    return f"the photograph of camera {camera} under light {light}"


def stated_names(assumed: Collection[str]) -> tuple[str, ...]:
    """Names of assumed errors, with the six coordinates of the scan's pose as ``teeth``."""
    return tuple(dict.fromkeys("teeth" if name in SCAN else name for name in assumed))
