"""Forecast ranges of time: as wide as the known cases require, and holding the truth as often as they claim."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from services.api.jobs.forecast import MIN_OBSERVATIONS, SHARE, Observation, foresee, survival

SECONDS = st.floats(0.01, 1e6)
LOGARITHMS = st.floats(-5, 15)
PAST = st.lists(
    st.builds(Observation, st.tuples(LOGARITHMS, LOGARITHMS), SECONDS), min_size=MIN_OBSERVATIONS, max_size=20
)
SLOPES = (0.5, 0.5)
some = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def range_of(
    past: list[Observation], features: tuple[float, ...] = (0.0, 0.0), elapsed_s: float = 0.0, share: float = SHARE
) -> tuple[float, float]:
    outlook = foresee(past, features, SLOPES)
    assert outlook is not None
    left = outlook.remaining_s(elapsed_s, share)
    assert left is not None
    return left


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 5, 10, 39])
@pytest.mark.parametrize("t", [-20.0, -1.3, 0.0, 0.4, 2.5, 11.0])
def test_the_tail_is_that_of_students_t(degrees: int, t: float) -> None:
    assert survival(t, degrees) == pytest.approx(stats.t.sf(t, degrees), abs=1e-12)


@some
@given(PAST, LOGARITHMS, LOGARITHMS)
def test_a_range_is_ordered_finite_and_grows_with_its_share(past: list[Observation], x: float, y: float) -> None:
    low, high = range_of(past, (x, y))
    assert 0 <= low < high < math.inf
    wider_low, wider_high = range_of(past, (x, y), share=0.95)
    assert wider_low <= low
    assert wider_high >= high


@some
@given(PAST, st.floats(0.01, 100))
def test_slower_machines_take_longer_in_proportion(past: list[Observation], factor: float) -> None:
    slower = [Observation(one.features, factor * one.seconds) for one in past]
    assert range_of(slower) == pytest.approx([factor * limit for limit in range_of(past)], rel=1e-6)


def test_what_was_unexpected_of_the_last_case_goes_on_in_part() -> None:
    chance = np.random.default_rng(5)
    usual = [Observation((0.0, 0.0), float(10 * math.exp(0.1 * chance.standard_normal()))) for _ in range(12)]
    slow = [Observation((0.0, 0.0), 8 * one.seconds) for one in usual[:3]]
    before, after = range_of(usual), range_of([*usual, *slow])
    assert before[1] < 20
    assert after[0] < 80 < after[1]
    assert range_of([*slow, *usual])[1] < after[1]


@some
@given(PAST, st.floats(0.0, 1.0))
def test_what_has_lasted_does_not_end_earlier(past: list[Observation], share: float) -> None:
    low, high = range_of(past)
    elapsed_s = share * low
    later_low, later_high = range_of(past, elapsed_s=elapsed_s)
    assert later_low + elapsed_s >= low * (1 - 1e-9)
    assert later_high + elapsed_s >= high * (1 - 1e-9)


@some
@given(st.lists(st.builds(Observation, st.tuples(LOGARITHMS, LOGARITHMS), SECONDS), max_size=MIN_OBSERVATIONS - 1))
def test_a_few_cases_tell_nothing(past: list[Observation]) -> None:
    assert foresee(past, (0.0, 0.0), SLOPES) is None


def test_what_lasted_far_longer_than_all_others_has_no_range() -> None:
    outlook = foresee([Observation((0.0, 0.0), 10.0 + k) for k in range(8)], (0.0, 0.0), SLOPES)
    assert outlook is not None
    assert outlook.remaining_s(12.0) is not None
    assert outlook.remaining_s(1000.0) is None


def test_a_job_unlike_the_others_gets_a_wider_range() -> None:
    chance = np.random.default_rng(3)
    past = [
        Observation((x, 0.0), math.exp(0.8 * x + 0.1 * chance.standard_normal()))
        for x in (0.0, 0.3, 0.5, 0.8, 1.0, 1.1)
    ]
    widths = [math.log(high / low) for low, high in (range_of(past, (x, 0.0)) for x in (0.6, 5.0, 10.0))]
    assert widths[0] < widths[1] < widths[2]


@pytest.mark.parametrize("count", [MIN_OBSERVATIONS, 10, 40])
@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_ranges_hold_the_truth_as_often_as_they_say(count: int, noise: float) -> None:
    """Durations with a fixed part and one in proportion to the size, which is not quite what the model says."""
    chance, held, cases = np.random.default_rng(7), 0, 250
    for _ in range(cases):
        x = chance.normal(0.0, 1.0, count + 1)
        seconds = (0.5 + np.exp(x)) * np.exp(noise * chance.standard_normal(count + 1))
        low, high = range_of(
            [Observation((a, 0.0), b) for a, b in zip(x[:-1], seconds[:-1], strict=True)], (x[-1], 0.0)
        )
        held += low <= seconds[-1] <= high
    assert 0.65 < held / cases < 0.92
