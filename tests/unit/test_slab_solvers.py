"""The benchmark of a slab's two solvers: what its rows state about a solution, and what it refuses."""

from __future__ import annotations

import pytest

from services.bench.slab.accuracy import PHASES
from services.bench.slab.cell import near_beam_folder
from services.bench.slab.recovery import Truth
from services.bench.slab.solvers import compared, run
from services.core.errors import InputError
from services.slab.cell.dictionary import Material, henyey_greenstein


def test_a_row_tells_how_far_a_solution_is_from_the_truth() -> None:
    truth = Truth("HG 0.8", near_beam_folder(), 1.0, 0.03, PHASES["HG 0.8"])
    exact = compared(truth, truth.material(), "dentine", "", 1.0)
    # The solution has tents of 0.9 degrees instead of the formula, which is normalised in steps of 0.5 degrees.
    assert exact.error < 2e-3
    assert exact.scattering_error < 1e-12
    true = truth.material()
    more = compared(truth, Material(1.1 * true.scattering, 0.03), "dentine", "", 1.0)
    assert more.scattering_error == pytest.approx(0.1)
    assert more.reduced_error == pytest.approx(0.1)
    assert more.error == pytest.approx(exact.error)
    assert compared(truth, henyey_greenstein(1.0, 0.7, 0.03), "dentine", "", 1.0).error > 0.1


def test_an_unknown_case_is_refused() -> None:
    with pytest.raises(InputError, match="known are default and paper"):
        run(quick=True, case="stock")
