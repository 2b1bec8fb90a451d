"""Sentences on the instrument for the report: the assumed uncertainties, and the errors that the images show to be
faults of the calibration.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType

from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.records import JobSpec
from services.core.results import Estimate
from services.fit.checks.instrument.moved import pose_sentences, shift_sentences, stated_names
from services.fit.coordinates.instrument_errors import (
    COMMON_KINDS,
    DEFAULT_SE,
    InstrumentErrors,
    have_common_cause,
    kind_of_error,
)
from services.fit.solve.recombination import Fault

SIZES = {
    "gain": f"{100 * DEFAULT_SE['gain']:g} % for the gain",
    "light_gain": f"{100 * DEFAULT_SE['light_gain']:g} % for each light",
    "flare": f"{100 * DEFAULT_SE['flare']:g} % for flare",
    "teeth": "0.05 mm and 0.1° for where the scan lies",
    "dome": "2 mm and 0.1° for where the dome stands",
}
REMEDY = {
    "light_gain": "check that light, its cable and its name, and measure it again",
    "flare": "look for stray light and a dirty lens, and measure the flare again",
}


def assumed_names(errors: Mapping[str, InstrumentErrors], moves: Sequence[str]) -> tuple[str, ...]:
    """Names of the errors that took their default, over all channels.

    Args:
        errors: by channel, the errors before the fit.
        moves: ``teeth`` or ``dome``, each where its move is at least partly a default and some channel's standard
            errors include it.
    """
    names = [name for own in errors.values() for name in own.names if name in own.assumed]
    return stated_names([*names, *moves])


def instrument_sentences(
    spec: JobSpec,
    errors: Mapping[str, InstrumentErrors],
    faults: Mapping[str, Sequence[Fault]],
    assumed: tuple[str, ...],
    stated: CalibrationUncertainty | None = None,
    *,
    found: Mapping[str, Mapping[str, Estimate]] = MappingProxyType({}),
    is_alone: bool = True,
) -> tuple[str, ...]:
    """Sentences for the report, the assumptions first.

    Args:
        spec: the job.
        stated: the calibration's uncertainty.
        assumed: names, as ``assumed_names`` gives them.
        errors: by channel, the errors before the fit.
        faults: by channel, the errors that the images show to be faults of the calibration.
        found: by channel, the estimates of the errors by name.
        is_alone: whether the fit renders a tooth without gums and other teeth.
    """
    if spec.instrument == "off":
        return (
            (
                "The standard errors take the instrument for perfect, as instrument = 'off' says: gain, lights and"
                " flare may be wrong."
            ),
        )
    if not any(own.names for own in errors.values()):
        return (
            (
                f"The standard errors take the instrument for perfect: a fit of the solver {spec.solver} does not know"
                " its gain, lights and flare."
            ),
        )
    unmoved = (
        ("The standard errors of a fit with two lobes take the dome to stand where the calibration says.",)
        if spec.lobes == 2
        else ()
    )
    return (
        *_assumed(assumed, errors),
        *_unused(stated),
        *_exact_lights(errors),
        *unmoved,
        *pose_sentences(errors, found),
        *_faults(spec, errors, faults, is_alone=is_alone),
    )


def _assumed(names: tuple[str, ...], errors: Mapping[str, InstrumentErrors]) -> Iterator[str]:
    if names:
        sizes = list(_sizes(names, {name for own in errors.values() for name in own.names}))
        listed = sizes[0] if len(sizes) == 1 else f"{', '.join(sizes[:-1])} and {sizes[-1]}"
        gain = (
            " Images hardly show a gain that is farther off; absorption is then wrong: measure it on a white standard."
            if any(kind_of_error(name) == "gain" for name in names)
            else ""
        )
        yield (
            f"Assumed, as the calibration does not state how wrong it may be: {listed}. The standard errors depend on"
            f" these; state them as uncertainty in capture.json, or in a raw folder's calibration.json.{gain}"
        )


def _sizes(names: tuple[str, ...], every: Collection[str]) -> Iterator[str]:
    # Name a kind as a whole, or only those of its errors that the calibration does not state.
    for kind, size in SIZES.items():
        own = [name for name in names if kind_of_error(name) == kind]
        if own and kind not in DEFAULT_SE:
            yield size
            continue
        if own and len(own) < sum(kind_of_error(name) == kind for name in every):
            yield f"{100 * DEFAULT_SE[kind]:g} % for {' and '.join([', '.join(own[:-1]), own[-1]] if own[1:] else own)}"
        elif own:
            yield size


def _unused(stated: CalibrationUncertainty | None) -> Iterator[str]:
    unused = [name for name in (stated.names if stated is not None else ()) if name.startswith(("camera.", "light."))]
    if unused:
        rest = f" and {len(unused) - 1} more" if unused[1:] else ""
        yield (
            f"The calibration states how wrong {unused[0]}{rest} may be. No fit moves single cameras and lights: of"
            " these errors the standard errors know at most the lights' distances, which count in their gains, and what"
            " moves all lights as one."
        )


def _exact_lights(errors: Mapping[str, InstrumentErrors]) -> Iterator[str]:
    if not any(kind_of_error(name) == "light_gain" for own in errors.values() for name in own.names):
        yield (
            "The standard errors take single lights for as bright as the calibration says: under so many a jaw's fit"
            " knows their common gain alone."
        )


def _faults(
    spec: JobSpec, errors: Mapping[str, InstrumentErrors], faults: Mapping[str, Sequence[Fault]], *, is_alone: bool
) -> Iterator[str]:
    alone = " Light from gums and other teeth is rendered with surroundings = 'on'." if is_alone else ""
    has_one_lobe = spec.kind != "jaw" and spec.lobes == 1
    options = f"Look also at the option{'s boundary and lobes' if has_one_lobe else ' boundary'}."
    for channel, every in faults.items():
        names = errors[channel].names
        yield from shift_sentences(channel, every, errors[channel])
        own = [fault for fault in every if kind_of_error(names[fault.index]) in COMMON_KINDS[0]]
        if have_common_cause(len(own), names):
            worst = max(own, key=lambda fault: abs(fault.z))
            yield (
                f"In {channel} the images put {len(own)} gains of lights and flares off, most of all"
                f" {names[worst.index]} by {100 * worst.size:+.1f} %, {abs(worst.z):.1f} times what it may be: so many"
                " have one cause: what the model leaves out, photographs under wrong names, or a scan in another"
                f" place. The standard errors do not contain it.{alone} {options}"
            )
            continue
        for fault in own:
            name, before = errors[channel].names[fault.index], errors[channel].se[fault.index]
            yield (
                f"In {channel} the images put {name} off by {100 * fault.size:+.1f} %, {abs(fault.z):.1f} times what "
                f"their own error and its standard error of {100 * before:.2g} % allow together: the calibration seems"
                f" at fault; {REMEDY[kind_of_error(name)]}."
            )
