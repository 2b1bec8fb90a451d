"""A coefficient below its standard error is told as an upper limit, which it is."""

from __future__ import annotations

import pytest

from services.core.pages.cells import cell
from services.core.results import Estimate


@pytest.mark.parametrize(
    ("value", "se", "unit", "told"),
    [
        (0.011, 0.017, "1/mm", ("at most 0.045 (two standard errors)", "")),
        (0.0, 0.5, "1/mm", ("at most 1.00 (two standard errors)", "")),
        (0.02, 0.017, "1/mm", ("0.020", "0.017")),
        (-0.011, 0.017, "1", ("-0.011", "0.017")),
        (0.011, 0.017, "1", ("0.011", "0.017")),
    ],
)
def test_a_coefficient_below_its_standard_error_is_an_upper_limit(
    value: float, se: float, unit: str, told: tuple[str, str]
) -> None:
    shown = cell(Estimate(value=value, se=se, unit=unit, determined=True))
    assert (shown["value"], shown["se"]) == told
