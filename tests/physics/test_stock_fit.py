"""The stock peer of the fit's benchmark descends: stock gradients in the project's unbounded domain lead from a distant
start towards the truth. It goes on from a stored state as if nothing had happened.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from services.bench.fits.stock_fit import TEETH_2018, TUTORIAL, StockFit
from services.bench.fits.tooth_capture import prepared_tooth
from services.core.records import JobSpec
from services.fit.measurements.observations import read_channel, read_observations
from services.phantom.tooth import write_phantom
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from tests.support.prepared import write_prepared


@pytest.mark.slow
def test_stock_fit_goes_downhill(tmp_path: Path) -> None:
    # The rate is so large that twelve rounds halve the error, which is many times the noise of the gradients.
    write_phantom(tmp_path / "capture", pixel_mm=1.0, cameras=1, lights=4, samples=256, subject=2)
    options = {"capture": tmp_path / "capture", "boundary": "matched", "dentin": "known"}
    case = prepared_tooth(tmp_path / "job", JobSpec.model_validate(options))
    fit = StockFit(case, tmp_path, rate=0.2, recipe=replace(TUTORIAL, start=Medium(6.0, 0.95, g1=0.8)))
    first, last = (case.errors(tissue, samples=128, seed=3)[0] for tissue in (fit.tissue(), _after(fit, 12)))
    assert first.error is not None
    assert last.error is not None
    assert first.error > 0.4
    assert last.error < 0.5 * first.error
    assert fit.rounds == 12
    assert fit.seconds > 0


def test_stock_fit_goes_on_from_a_stored_state(tmp_path: Path) -> None:
    prepare_device()
    write_prepared(tmp_path)
    spec = JobSpec.model_validate({"capture": tmp_path, "boundary": "matched", "dentin": "known", "pixel_step": 1})
    observations = read_observations(tmp_path, spec)
    # One of its two cameras under one light is enough.
    view = read_channel(observations, "green", spec)[0]
    view = replace(view, held_out=np.arange(len(view.held_out)) > 0)
    case: Any = SimpleNamespace(observations=observations, views=(view,))
    recipe = replace(TEETH_2018, samples=1, start=Medium(1.5, 0.9, 0.9, 0.3, 0.0), homogeneous_rounds=1)
    fit = StockFit(case, tmp_path, 0.1, recipe)
    fit.step()
    assert fit.tissue().enamel == fit.tissue().dentin != recipe.start
    fit.step()
    assert fit.tissue().enamel != fit.tissue().dentin
    other = StockFit(case, tmp_path, 0.1, recipe, json.loads(json.dumps(fit.state)))
    assert (other.rounds, other.seconds) == (fit.rounds, fit.seconds)
    assert other.tissue() == fit.tissue()
    # Equal to the last bit: the state has all that Adam remembers, and the seed follows from the round.
    assert _after(other, 1) == _after(fit, 1)


def _after(fit: StockFit, rounds: int) -> Tissue:
    for _ in range(rounds):
        fit.step()
    return fit.tissue()
