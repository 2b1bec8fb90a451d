"""Report of a jaw's fit: gums and wall by channel, and each tooth with a report of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.core.records import JobSpec
from services.core.results import Estimate, FitReport, ToothReport
from services.core.verdict import MAX_ERROR
from services.fit.checks.alignment import offset_sentences
from services.fit.checks.frames import photograph_sentences
from services.fit.checks.identifiability import determined_sentences
from services.fit.checks.instrument.estimates import instrument_report
from services.fit.measurements.observations import Observations
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import ErrorSums, Evaluation
from services.fit.solve.estimates import estimates
from services.fit.stages.attempt import assess_convergence, is_above, standard_errors, worst_error
from services.fit.stages.channel_fit import ChannelFit
from services.fit.stages.jaw.starts import ToothStart
from services.fit.stages.tooth.driver import shape_covariance
from services.transport.optics.parameters import Mouth
from services.transport.thickness import thickness_map

STATES = ("fitted", "tied", "failed")
"""States of a tooth's start, the best first."""


@dataclass(frozen=True)
class JawFit:
    """Result of one channel, with the starts of its teeth."""

    starts: tuple[ToothStart, ...]
    dentin: tuple[bool, ...]
    """Whether each tooth has dentin."""
    fit: ChannelFit[Mouth]
    views: tuple[ViewStack, ...]
    """Views that were fitted and evaluated."""


def report(
    spec: JobSpec,
    fits: Mapping[str, JawFit],
    shaped_by: str,
    dentins: Sequence[DentinShape | None],
    observations: Observations,
    seconds: float,
) -> FitReport:
    """Report of all channels.

    Args:
        spec: the job.
        fits: results by channel.
        shaped_by: channel in which blend weights were fitted, where any were.
        dentins: dentin of each tooth.
        observations: the fit's observations.
        seconds: duration of the fit.
    """
    first = fits[shaped_by]
    assessment = assess_convergence({c: jaw.fit for c, jaw in fits.items()})
    misplaced = offset_sentences(
        _evaluations(fits),
        {c: worst_error(jaw.fit) for c, jaw in fits.items()},
        observations,
        _views(fits),
        "the jaw's meshes",
    )
    wrong = photograph_sentences(_evaluations(fits), observations, _views(fits), is_placed=not misplaced)
    advice = assessment.lacking + misplaced + wrong + assessment.advice
    teeth = {
        str(start.fdi): _tooth(k, fits, first, dentins[k], observations, is_placed=not misplaced)
        for k, start in enumerate(first.starts)
    }
    unexplained = [fdi for fdi, tooth in teeth.items() if tooth.state == "fitted" and tooth.sentence]
    advice += [tooth.sentence for tooth in teeth.values() if tooth.state != "tied" and tooth.sentence]
    return FitReport(
        converged=assessment.converged and not unexplained and not misplaced and not wrong,
        doubtful=assessment.doubtful,
        advice=" ".join(advice),
        parameters={
            c: estimates(jaw.fit.tissue, _surroundings(jaw.fit.tissue), jaw.fit.uncertainty) for c, jaw in fits.items()
        },
        fit_error={c: jaw.fit.fit_error for c, jaw in fits.items()},
        held_out_error={c: jaw.fit.held_out_error for c, jaw in fits.items() if jaw.fit.held_out_error is not None},
        fit_error_se=standard_errors({c: one.fitted for c, one in _evaluations(fits).items()}),
        held_out_error_se=standard_errors({c: one.held_out for c, one in _evaluations(fits).items()}),
        steps=sum(jaw.fit.steps for jaw in fits.values()),
        pixel_step=observations.pixel_step,
        pixel_edge_mm=observations.pixel_edge_mm,
        seconds=seconds,
        teeth=teeth,
        **instrument_report(spec, {c: jaw.fit.uncertainty for c, jaw in fits.items()}, observations.manifest),
    )


def _surroundings(mouth: Mouth) -> tuple[str, ...]:
    return (*(() if mouth.gums is None else ("gums",)), *(() if mouth.reflectance is None else ("cavity",)))


def _evaluations(fits: Mapping[str, JawFit]) -> dict[str, Evaluation]:
    return {channel: jaw.fit.evaluation for channel, jaw in fits.items()}


def _views(fits: Mapping[str, JawFit]) -> dict[str, tuple[ViewStack, ...]]:
    return {channel: jaw.views for channel, jaw in fits.items()}


def _tooth(
    k: int,
    fits: Mapping[str, JawFit],
    first: JawFit,
    dentin: DentinShape | None,
    observations: Observations,
    *,
    is_placed: bool,
) -> ToothReport:
    # Report of one tooth, with the worst state over all channels and its sentence. Whether the tooth is misplaced is
    # tested only where the jaw as a whole is not.
    start = max((jaw.starts[k] for jaw in fits.values()), key=lambda s: STATES.index(s.state))
    fit_error, held_out_error = (_errors(_evaluations(fits), k, kind) for kind in (0, 1))
    worst = max([*fit_error.values(), *held_out_error.values()], default=0.0)
    sentence, sums = start.sentence, [one for own in _evaluations(fits).values() for one in own.parts.get(k, ())]
    if start.state == "fitted" and worst > MAX_ERROR and not any(is_above(one, MAX_ERROR) for one in sums):
        sentence = (
            f"The renders of tooth {start.fdi} are too noisy to tell how far its images are off; raise"
            " max_samples_per_pixel."
        )
    elif start.state == "fitted" and worst > MAX_ERROR:
        sentence = f"Tooth {start.fdi} is still {100 * worst:.0f} % off in its images; check its mesh and its masks."
        if is_placed:
            errors = {c: max(fit_error.get(c, 0.0), held_out_error.get(c, 0.0)) for c in fits}
            sentence = " ".join(
                [
                    *offset_sentences(
                        _evaluations(fits), errors, observations, _views(fits), f"the mesh of tooth {start.fdi}", k
                    ),
                    sentence,
                ]
            )
    shape, covariance = first.fit.tissue.teeth[k].shape, shape_covariance(first.fit.uncertainty, k)
    thickness_arguments = shape, np.array(covariance) if covariance else None, observations.manifest.cameras[0]
    thickness = (
        None
        if dentin is None or not first.dentin[k]
        else thickness_map(observations.teeth[k].outer, dentin, *thickness_arguments)
    )
    tables = {c: _table(k, jaw, first) for c, jaw in fits.items()}
    return ToothReport(
        state=start.state,
        sentence=sentence,
        told=determined_sentences(tables, {}),
        pixels=max(jaw.starts[k].pixels for jaw in fits.values()),
        parameters=tables,
        fit_error=fit_error,
        held_out_error=held_out_error,
        shape=shape,
        enamel_thickness=None if thickness is None else thickness.mean,
    )


def _table(k: int, jaw: JawFit, first: JawFit) -> dict[str, Estimate]:
    parts = (f"{k}.enamel", f"{k}.dentin", f"{k}.shape") if jaw.dentin[k] else (f"{k}.enamel",)
    shaped = first.fit.uncertainty if shape_covariance(first.fit.uncertainty, k) else None
    return {
        name.removeprefix(f"{k}."): estimate
        for name, estimate in estimates(jaw.fit.tissue, parts, jaw.fit.uncertainty, shaped).items()
    }


def _errors(evaluations: Mapping[str, Evaluation], k: int, kind: int) -> dict[str, float]:
    nothing = ErrorSums(), ErrorSums()
    errors = {
        channel: evaluation.parts.get(k, nothing)[kind].resolved_error for channel, evaluation in evaluations.items()
    }
    return {channel: error for channel, error in errors.items() if error is not None}
