"""The verdict on a slab's wavelengths, and what it advises where one of them went wrong."""

from __future__ import annotations

import pytest

from services.fit.slab.results.result import Errors, SlabReport
from tests.support.small_slab import made_up_fit

FAR, NEAR = 2.5, 0.01
"""Held-out errors of a fit unlike its images, and of one like them."""


@pytest.mark.parametrize(
    ("converged", "held_out_error", "advice"),
    [
        (True, NEAR, ""),
        (False, NEAR, "The fit at 635 nm has not converged; raise option effort."),
        (True, FAR, "No material gives such images at 635 nm; compare slab.json with the set-up"),
        (False, FAR, "The fit at 635 nm ended far from its images without converging. Fit again with a greater option"),
    ],
)
def test_advice_blames_the_folder_where_the_search_did_not_fail(
    converged: bool, held_out_error: float, advice: str
) -> None:
    errors = Errors(fit_error=0.0, held_out_error=held_out_error)
    other = made_up_fit(635.0).model_copy(update={"converged": converged, "errors": errors})
    verdict = SlabReport(fits=(made_up_fit(), other)).verdict()
    assert verdict.converged == (converged and held_out_error == NEAR)
    assert verdict.advice.startswith(advice)
    assert bool(verdict.advice) == bool(advice)
    assert ("compare slab.json" in verdict.advice) == (held_out_error == FAR)
