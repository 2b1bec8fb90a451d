"""What a report says of the squares that a fit compared and of its time."""

from __future__ import annotations

from services.assets.job_report import facts_of_fit
from services.core.results import FitReport

BARE = FitReport(
    converged=True, advice="", parameters={}, fit_error={}, held_out_error={}, steps=1, seconds=10.0
)  # fmt: skip


def test_squares_and_shares_of_the_time() -> None:
    seconds = {"images": 150.0, "comparison of steps": 49.8, "advice on the next capture": 0.2}
    found = facts_of_fit(
        BARE.model_copy(update={"pixel_step": 7, "pixel_edge_mm": 0.448, "seconds_by_purpose": seconds})
    )
    assert found == {
        "squares": "7 × 7 pixels, 0.45 mm wide",
        "time by purpose": "images 75 %, comparison of steps 25 %",
    }


def test_a_report_of_an_earlier_version_says_neither() -> None:
    assert facts_of_fit(BARE) == {}
