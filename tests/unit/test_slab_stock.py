"""The race of a slab's solver with stock Mitsuba: derivatives by the numbers that Adam moves, and what rows state."""

from __future__ import annotations

import numpy as np
import pytest

from services.bench.slab.stock import STOCK, chained, medium_numbers, times_faster


def test_derivatives_go_from_mitsubas_numbers_to_weights() -> None:
    random = np.random.default_rng(1)
    tables, known, by_values = random.random((5, 3)), np.array([0.5, 0.2, 0.1, 0.05]), random.normal(size=5)

    def value(x: np.ndarray) -> float:
        extinction, albedo, values = medium_numbers(np.exp(x), tables)
        return 2.0 * extinction - 3.0 * albedo + float(by_values @ values)

    x, step = np.log(known), 1e-5
    differences = [(value(x + step * one) - value(x - step * one)) / (2 * step) for one in np.eye(4)]
    # Central differences err by the step's square and rounding, 1e-10 each.
    assert chained(2.0, -3.0, by_values, known, tables) == pytest.approx(differences, rel=1e-7, abs=1e-8)


def row(peer: str, seconds: float, error: float, scattering_error: float) -> dict[str, object]:
    return {"peer": peer, "seconds": seconds, "error": error, "scattering_error": scattering_error}


def test_the_race_is_judged_where_stock_came_nearest_and_by_both_errors() -> None:
    ours = [row("dentine", 2.0, 0.02, 0.03), row("dentine", 5.0, 0.01, 0.004)]
    assert times_faster([*ours, row(STOCK, 100.0, 0.03, 0.04), row(STOCK, 10.0, 0.3, 0.4)]) == pytest.approx(50)
    # Stock's sigma_s is nearer to the truth, so only the longer run of the default solver is as near.
    assert times_faster([*ours, row(STOCK, 100.0, 0.03, 0.005)]) == pytest.approx(20)
    assert times_faster([*ours, row(STOCK, 100.0, 0.001, 0.005)]) is None
