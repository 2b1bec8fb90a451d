"""How well a fit went: the one judgement that the report, the page, the API and the command line show.

That a job *succeeded* means that its stages ran to their end; that its fit *converged* means that the numbers can be
believed. The first is a stored state of the job. The second is derived here from the fit's report and is no state:
retries, deletions and notifications depend on the state alone, and the states that version 0.1 has stored keep their
meaning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from services.core.results import Figure, FitReport, Verdict

MAX_ERROR = 0.15
"""Relative error on the fitted or on the held-out images of a channel above which a fit is not called converged,
whatever its solver reports."""
_HELD_OUT: Literal["held-out"] = "held-out"
_FITTED: Literal["fitted"] = "fitted"
VERDICT = "verdict"
"""Key of the verdict in the event with which a fit finishes, and in ``errors.json``."""
NOT_CONVERGED_STATUS = 9
"""Exit status of a command whose job ran to its end and did not converge."""


def verdict_of(report: FitReport) -> Verdict:
    """Judge a fit by its report."""
    is_tested = bool(report.held_out_error)
    errors, ses = (
        (report.held_out_error, report.held_out_error_se) if is_tested else (report.fit_error, report.fit_error_se)
    )
    fitted, held_out = (max(found.values(), default=0.0) for found in (report.fit_error, report.held_out_error))
    worst = max(fitted, held_out)
    error, error_of = mean_figure(errors, ses), _HELD_OUT if is_tested else _FITTED
    converged, is_above_limit = report.converged and worst <= MAX_ERROR, worst > MAX_ERROR
    error_text = f"{error_of} error {percent(error)}"
    if is_above_limit and error.value <= MAX_ERROR:
        above = f"{_FITTED if fitted > MAX_ERROR else _HELD_OUT} error{' of one channel' if len(errors) > 1 else ''}"
        error_text += f", {above} {percent(Figure(value=worst, se=None))}"
    doubtful = converged and report.doubtful
    outcome = ("Converged, but doubtful," if doubtful else "Converged") if converged else "Not converged"
    convergence_text = f"{outcome} after {report.steps} steps: {error_text}."
    return Verdict(
        headline=f"Not converged: {error_text}; no fit above {100 * MAX_ERROR:g} % is believed."
        if is_above_limit
        else convergence_text,
        converged=converged,
        doubtful=doubtful,
        is_above_limit=is_above_limit,
        limit=MAX_ERROR,
        error_of=error_of,
        error=error,
        channels={channel: Figure(value=error, se=ses.get(channel)) for channel, error in errors.items()},
        enamel_thickness=report.enamel_thickness,
        steps=report.steps,
        advice=report.advice,
    )


def mean_figure(errors: Mapping[str, float], ses: Mapping[str, float]) -> Figure:
    """The mean of some channels' errors, with its standard error.

    Channels are rendered with separate paths, so their noise is independent.
    """
    count = max(len(errors), 1)
    is_known = bool(errors) and errors.keys() <= ses.keys()
    se = math.sqrt(sum(ses[channel] ** 2 for channel in errors)) / count if is_known else None
    return Figure(value=sum(errors.values()) / count, se=se)


def percent(figure: Figure) -> str:
    """A figure in percent, rounded to two significant digits of its standard error, with one to three decimals; an
    error without one that is zero is what is left of a difference smaller than its noise. Below its standard error it
    is told as an upper limit, two standard errors above it.
    """
    if figure.se is None and figure.value == 0:
        return "below the noise"
    if figure.se is None:
        return f"{100 * figure.value:.1f} %" if figure.value >= 0.01 else f"{100 * figure.value:.2f} %"
    se = 100 * figure.se
    decimals = min(max(1 - math.floor(math.log10(se)), 1), 3) if se > 0 else 2
    if 0 <= figure.value < figure.se:
        return f"at most {100 * figure.value + 2 * se:.{decimals}f} % (two standard errors)"
    return f"{100 * figure.value:.{decimals}f} ± {se:.{decimals}f} %"
