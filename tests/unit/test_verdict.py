"""One judgement of a fit, used alike by the report, the page, the API and the command line."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from services.core.results import Estimate, Figure, FitReport
from services.core.verdict import MAX_ERROR, mean_figure, percent, verdict_of


def report(**changes: Any) -> FitReport:
    told: dict[str, Any] = {
        "fit_error": {"red": 0.02, "green": 0.03},
        "held_out_error": {"red": 0.05, "green": 0.07},
        "held_out_error_se": {"red": 0.003, "green": 0.004},
    }
    return FitReport(
        **told | {"converged": True, "advice": "", "parameters": {}, "steps": 12, "seconds": 1.0} | changes
    )


def test_the_error_is_the_mean_over_channels_with_its_standard_error() -> None:
    verdict = verdict_of(report())
    assert (verdict.converged, verdict.is_above_limit, verdict.error_of) == (True, False, "held-out")
    assert verdict.error.value == pytest.approx(0.06)
    assert verdict.error.se == pytest.approx(0.0025)
    assert verdict.headline == "Converged after 12 steps: held-out error 6.00 ± 0.25 %."


def test_the_standard_error_of_the_mean_is_that_of_independent_channels() -> None:
    drawn = np.random.default_rng(1).normal([0.05, 0.07], [0.003, 0.004], (40_000, 2)).mean(axis=1)
    found = mean_figure({"red": 0.05, "green": 0.07}, {"red": 0.003, "green": 0.004})
    assert found.se == pytest.approx(
        drawn.std(), rel=4 / np.sqrt(2 * len(drawn))
    )  # four standard errors of a standard deviation


@pytest.mark.parametrize(
    "errors", [{"held_out_error": {"red": 0.02, "green": 0.336}}, {"fit_error": {"red": 0.02, "green": 0.336}}]
)
def test_an_error_above_the_limit_leads_whatever_the_solver_says(errors: dict[str, Any]) -> None:
    verdict = verdict_of(report(**errors))
    assert (verdict.converged, verdict.is_above_limit, verdict.limit) == (False, True, MAX_ERROR)
    assert verdict.headline.startswith("Not converged: held-out error ")
    assert verdict.headline.endswith("; no fit above 15 % is believed.")


@pytest.mark.parametrize(
    ("fitted", "held_out", "told"),
    [
        ({"633": 0.3}, {"633": 0.099}, "held-out error 9.9 %, fitted error 30.0 %;"),
        ({}, {"red": 0.02, "green": 0.2}, "held-out error 11.0 %, held-out error of one channel 20.0 %;"),
    ],
)
def test_the_error_above_the_limit_is_the_one_that_is_told(
    fitted: dict[str, float], held_out: dict[str, float], told: str
) -> None:
    verdict = verdict_of(report(fit_error=fitted, held_out_error=held_out, held_out_error_se={}))
    assert verdict.headline == f"Not converged: {told} no fit above 15 % is believed."


def test_a_fit_that_stopped_early_did_not_converge_however_small_its_error() -> None:
    verdict = verdict_of(report(converged=False, advice="Raise max_steps."))
    assert verdict.headline == "Not converged after 12 steps: held-out error 6.00 ± 0.25 %."
    assert (verdict.converged, verdict.is_above_limit, verdict.advice) == (False, False, "Raise max_steps.")


def test_a_doubt_is_told_in_the_headline_of_a_fit_that_converged() -> None:
    verdict = verdict_of(report(doubtful=True))
    assert (verdict.converged, verdict.doubtful) == (True, True)
    assert verdict.headline == "Converged, but doubtful, after 12 steps: held-out error 6.00 ± 0.25 %."
    assert not verdict_of(report(converged=False, doubtful=True)).doubtful


def test_fitted_images_stand_in_where_none_was_held_out() -> None:
    verdict = verdict_of(report(held_out_error={}, held_out_error_se={}))
    assert verdict.error_of == "fitted"
    assert verdict.error.value == pytest.approx(0.025)
    assert verdict.error.se is None
    assert verdict.headline == "Converged after 12 steps: fitted error 2.5 %."


def test_a_report_of_an_earlier_version_is_judged_without_standard_errors() -> None:
    thickness = Estimate(value=0.7, se=0.06, unit="mm", determined=True)
    stored = json.loads(report(enamel_thickness=thickness).model_dump_json())
    earlier = {name: value for name, value in stored.items() if not name.endswith("_se")}
    verdict = verdict_of(FitReport.model_validate_json(json.dumps(earlier)))
    assert verdict.error.value == pytest.approx(0.06)
    assert verdict.error.se is None
    assert verdict.enamel_thickness == thickness


@pytest.mark.parametrize(
    ("value", "se", "told"),
    [
        (0.204, 0.204, "20.4 ± 20.4 %"),
        (0.0741, 0.0042, "7.41 ± 0.42 %"),
        (0.0, 0.026, "at most 5.2 % (two standard errors)"),
        (0.011, 0.017, "at most 4.5 % (two standard errors)"),
        (0.05, 0.0, "5.00 ± 0.00 %"),
        (0.074, None, "7.4 %"),
        (0.004, None, "0.40 %"),
        (0.0, None, "below the noise"),
    ],
)
def test_a_figure_has_as_many_digits_as_its_standard_error_allows(value: float, se: float | None, told: str) -> None:
    assert percent(Figure(value=value, se=se)) == told
