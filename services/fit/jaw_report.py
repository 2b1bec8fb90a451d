"""What a jaw's fit says: gums and wall by channel, and each tooth by its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from services.core.records import Estimate, FitReport, ToothReport
from services.fit.attempt import UNEXPLAINED, judge
from services.fit.evaluate import ErrorSums, Evaluation
from services.fit.identifiability import told
from services.fit.jaw_starts import ToothStart
from services.fit.observations import ViewStack
from services.fit.optics.parameters import Mouth
from services.fit.solve.covariance import estimates
from services.fit.stages import ChannelFit

STATES = ("fitted", "tied", "failed")


@dataclass(frozen=True)
class JawFit:
    """One channel's result, with where its teeth came from."""

    starts: tuple[ToothStart, ...]
    dentin: tuple[bool, ...]
    """Which teeth have any."""
    fit: ChannelFit[Mouth]
    views: tuple[ViewStack, ...]
    """What was fitted and judged."""


def report(fits: Mapping[str, JawFit], seconds: float) -> FitReport:
    """The report of all channels."""
    first = next(iter(fits.values()))
    teeth = {str(start.fdi): _tooth(k, fits) for k, start in enumerate(first.starts)}
    converged, advice = judge({c: jaw.fit for c, jaw in fits.items()})
    unexplained = [fdi for fdi, tooth in teeth.items() if tooth.state == "fitted" and tooth.sentence]
    advice += [tooth.sentence for tooth in teeth.values() if tooth.state != "tied" and tooth.sentence]
    return FitReport(
        converged=converged and not unexplained,
        advice=" ".join(advice),
        parameters={c: estimates(jaw.fit.tissue, _surroundings(jaw.fit.tissue), jaw.fit.known) for c, jaw in fits.items()},
        fit_error={c: jaw.fit.fit_error for c, jaw in fits.items()},
        held_out_error={c: jaw.fit.held_out_error for c, jaw in fits.items() if jaw.fit.held_out_error is not None},
        steps=sum(jaw.fit.steps for jaw in fits.values()),
        seconds=seconds,
        teeth=teeth,
    )


def _surroundings(mouth: Mouth) -> tuple[str, ...]:
    return (*(() if mouth.gums is None else ("gums",)), *(() if mouth.reflectance is None else ("cavity",)))


def _tooth(k: int, fits: Mapping[str, JawFit]) -> ToothReport:
    # The worst state of all channels, and what it says.
    start = max((jaw.starts[k] for jaw in fits.values()), key=lambda s: STATES.index(s.state))
    fit_error, held_out_error = (_errors({c: jaw.fit.evaluation for c, jaw in fits.items()}, k, kind) for kind in (0, 1))
    worst = max([*fit_error.values(), *held_out_error.values()], default=0.0)
    sentence = start.sentence
    if start.state == "fitted" and worst > UNEXPLAINED:
        sentence = f"Tooth {start.fdi} is still {100 * worst:.0f} % off in its images; check its mesh and its masks."
    tables = {c: _table(k, jaw) for c, jaw in fits.items()}
    return ToothReport(
        state=start.state,
        sentence=sentence,
        told=told(tables, {}),
        pixels=max(jaw.starts[k].pixels for jaw in fits.values()),
        parameters=tables,
        fit_error=fit_error,
        held_out_error=held_out_error,
    )


def _table(k: int, jaw: JawFit) -> dict[str, Estimate]:
    parts = (f"{k}.enamel", f"{k}.dentin") if jaw.dentin[k] else (f"{k}.enamel",)
    return {name.removeprefix(f"{k}."): estimate for name, estimate in estimates(jaw.fit.tissue, parts, jaw.fit.known).items()}


def _errors(evaluations: Mapping[str, Evaluation], k: int, kind: int) -> dict[str, float]:
    nothing = ErrorSums(), ErrorSums()
    errors = {channel: evaluation.parts.get(k, nothing)[kind].resolved_error for channel, evaluation in evaluations.items()}
    return {channel: error for channel, error in errors.items() if error is not None}
