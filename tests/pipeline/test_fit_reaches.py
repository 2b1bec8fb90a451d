"""Accuracy that a fit must reach on single teeth rendered by stock Mitsuba; the limits are those of
``tests/benchmarks/fit_table.py``, which prints the figures.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.fit_table import LAYERED, Bench, Figure, cameras, homogeneous, known


def missed(figures: list[Figure]) -> list[str]:
    assert figures
    return [
        f"{one.subject}, {one.figure}: {one.value:.3f} > {one.must:g}" for one in figures if one.reached == "missed"
    ]


def test_a_figure_is_judged_by_its_limits() -> None:
    values = {0.01: "goal", 0.03: "must", 0.07: "missed", float("nan"): "missed"}
    assert {value: Figure("", "", "", value, 0.05, 0.02, 0.0).reached for value in values} == values


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_homogeneous_tooth(tmp_path: Path) -> None:
    assert not missed(list(homogeneous(Bench(tmp_path, {}), ())))


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("subject", LAYERED)
def test_known_dentin(tmp_path: Path, subject: str) -> None:
    assert not missed(list(known(Bench(tmp_path, {}), (subject,))))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_unseen_camera(tmp_path: Path) -> None:
    assert not missed(list(cameras(Bench(tmp_path, {}), (LAYERED[0],))))
