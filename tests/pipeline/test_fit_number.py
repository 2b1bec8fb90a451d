"""A tooth whose FDI number is that of another kind of tooth; its dentin then gets a wrong shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.benchmarks.fit_table import Bench, known_enamel
from tests.support import truths


@pytest.mark.slow
def test_a_premolar_called_an_incisor_is_told_and_not_called_converged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = truths.read
    monkeypatch.setattr(truths, "read", lambda name: replace(read(name), fdi="11"))
    options = {
        "samples_per_pixel": 8,
        "max_samples_per_pixel": 16,
        "max_steps": 1,
        "search_candidates": 500,
        "pixel_step": 3,
    }
    fit = Bench(tmp_path, options).fit("premolar", "misnumbered", dentin="fit", held=known_enamel("premolar"))
    assert not fit.report.converged
    assert fit.report.advice.startswith(
        "Tooth 11 is shaped like a first premolar and not like a central incisor; give its right FDI number"
    )
