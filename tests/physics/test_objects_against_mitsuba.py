"""Optics of objects of known shape, found from stock Mitsuba's images of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.objects import Row, rows


def test_a_figure_is_reached_by_its_limit_or_by_its_bound() -> None:
    figures = {(0.02, 0.01): True, (0.04, 0.01): False, (0.07, 0.04): True, (0.09, 0.04): False}
    assert {key: Row("", "matched", 1, "sigma_s_reduced", *key, 0.0).is_reached for key in figures} == figures


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("shape", ["sphere", "cube"])
def test_one_image_and_three_tell_scattering_and_absorption(tmp_path: Path, shape: str) -> None:
    found = list(rows(tmp_path, shape, "matched", (1, 3), pixel_mm=0.8, samples=2048, max_samples=4096))
    assert len(found) == 4
    assert [row for row in found if not row.is_reached] == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_one_image_of_a_rough_sphere_tells_them_too(tmp_path: Path) -> None:
    found = list(rows(tmp_path, "sphere", "rough", (1,), pixel_mm=0.8, samples=32_768, max_samples=8192))
    assert [row for row in found if not row.is_reached] == []
    # The renders' noise is most of the standard errors, which were 6 and 7 %: larger ones would let any fit pass.
    assert max(row.se for row in found) < 0.1
