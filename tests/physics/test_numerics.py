"""Fixed seeds give the numbers that were stored when ``NUMERICS`` was last raised, so that a fit continues a checkpoint
only with the numerics that wrote it.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.transport.numerics import NUMERICS, numerics_name
from tests.support.golden_numerics import STORED, fit_results, renders

REMEDY = "if that is meant, raise services.transport.numerics.NUMERICS and run python -m tests.support.golden_numerics"
RENDER_TOLERANCE = 1e-3
"""Tolerance of rendered values as a fraction of the largest one. The number of threads alone changes an image by 1e-5
and a derivative by 1e-4 of its norm (test_engine_repeats); other random numbers change most values by a tenth."""
ALIKE = 0.95
"""Least fraction of the values that must agree. On another processor, rounding may now and then change a decision of a
path, which changes one pixel."""
FIT_TOLERANCE = 1e-6
"""Relative tolerance of a fit's results. NumPy's sums differ between processors by some 1e-15, which a few steps of a
well-posed solver amplify; another solver changes the third digit."""


@pytest.fixture(scope="module")
def golden() -> dict[str, NDArray[np.float64]]:
    with np.load(STORED) as stored:
        return {key: stored[key] for key in stored.files}


def test_the_stored_numbers_are_of_these_numerics(golden: dict[str, NDArray[np.float64]]) -> None:
    assert golden["numerics"] == NUMERICS, "run python -m tests.support.golden_numerics"


def test_the_first_numerics_go_by_the_name_that_version_0_1_wrote() -> None:
    assert [numerics_name(number) for number in (1, 2)] == ["0.1.0", "numerics 2"]


def test_the_engine_renders_what_it_rendered(golden: dict[str, NDArray[np.float64]]) -> None:
    found = renders()
    assert found.keys() == {key for key in golden if key.startswith("render/")}
    for key, value in found.items():
        assert value.shape == golden[key].shape, f"{key} has another shape; {REMEDY}"
        alike = np.abs(value - golden[key]) <= RENDER_TOLERANCE * np.abs(golden[key]).max()
        assert alike.mean() >= ALIKE, f"{1 - alike.mean():.0%} of {key} differ; {REMEDY}"


@pytest.mark.parametrize("instrument", ["on", "off"])
def test_a_fit_records_what_it_recorded(golden: dict[str, NDArray[np.float64]], instrument: str) -> None:
    found = fit_results(instrument)
    keys = {key for key in golden if key.startswith(f"fit-{instrument}/")}
    assert found.keys() == keys, f"other results: {sorted(found.keys() ^ keys)}; {REMEDY}"
    for key, value in found.items():
        assert value.shape == golden[key].shape, f"{key} has another shape; {REMEDY}"
        np.testing.assert_allclose(
            value, golden[key], rtol=FIT_TOLERANCE, atol=FIT_TOLERANCE, err_msg=f"{key}; {REMEDY}"
        )
