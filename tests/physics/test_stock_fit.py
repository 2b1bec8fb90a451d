"""The stock peer of the fit's benchmark descends: stock gradients in the project's unbounded domain lead from a distant
start towards the truth.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from services.bench.fits.stock_fit import StockFit
from services.bench.fits.tooth_capture import prepared_tooth
from services.core.records import JobSpec
from services.phantom.tooth import write_phantom
from services.transport.optics.parameters import Medium, Tissue


@pytest.mark.slow
def test_stock_fit_goes_downhill(tmp_path: Path) -> None:
    # The rate is so large that twelve rounds halve the error, which is many times the noise of the gradients.
    write_phantom(tmp_path / "capture", pixel_mm=1.0, cameras=1, lights=4, samples=256, subject=2)
    options = {"capture": tmp_path / "capture", "boundary": "matched", "dentin": "known"}
    case = prepared_tooth(tmp_path / "job", JobSpec.model_validate(options))
    fit = StockFit(case, tmp_path, rate=0.2, start=Medium(6.0, 0.95, g1=0.8))
    first, last = (case.errors(tissue, samples=128, seed=3)[0] for tissue in (fit.tissue(), _after(fit, 12)))
    assert first.error is not None
    assert last.error is not None
    assert first.error > 0.4
    assert last.error < 0.5 * first.error
    assert fit.rounds == 12
    assert fit.seconds > 0


def _after(fit: StockFit, rounds: int) -> Tissue:
    for _ in range(rounds):
        fit.step()
    return fit.tissue()
