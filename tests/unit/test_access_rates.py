"""Rate limits, on a clock that the test moves."""

from __future__ import annotations

import time
import types

import pytest

from services.api.http import rate_limits as rates
from services.api.http.rate_limits import RateLimits, network_of
from services.core.settings import RateSettings


class Clock:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        fake = types.SimpleNamespace(monotonic=lambda: self.now_s)
        monkeypatch.setattr(rates, "time", fake)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


@pytest.mark.attack("exhaustion", "requests without number")
def test_reads_writes_and_refusals_are_counted_apart(clock: Clock) -> None:
    limited = RateLimits(RateSettings(reads_per_10_s=3, writes_per_10_s=2, refusals_per_minute=1))
    assert [limited.count("a", is_change=False) for _ in range(4)] == [0, 0, 0, 10]
    assert [limited.count("a", is_change=True) for _ in range(3)] == [0, 0, 10]
    assert [limited.count_refusal("a") for _ in range(2)] == [0, 60]
    assert limited.count("b", is_change=False) == 0


def test_the_window_moves(clock: Clock) -> None:
    limited = RateLimits(RateSettings(reads_per_10_s=2))
    assert limited.count("a", is_change=False) == 0
    clock.now_s += 6
    assert limited.count("a", is_change=False) == 0
    clock.now_s += 1
    assert limited.count("a", is_change=False) == 3
    clock.now_s += 3.01
    assert limited.count("a", is_change=False) == 0
    assert limited.count("a", is_change=False) == 6


def test_whoever_waits_as_told_may_go_on(clock: Clock) -> None:
    limited = RateLimits(RateSettings(writes_per_10_s=1))
    limited.count("a", is_change=True)
    clock.now_s += 2.5
    clock.now_s += limited.count("a", is_change=True) + 0.01
    assert limited.count("a", is_change=True) == 0


def test_a_wall_clock_that_steps_back_keeps_nobody_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    limited = RateLimits(RateSettings(writes_per_10_s=1))
    limited.count("a", is_change=True)
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert 0 < limited.count("a", is_change=True) <= 10


def test_an_address_is_told_of_once_a_minute(clock: Clock) -> None:
    limited = RateLimits(RateSettings())
    assert [limited.should_audit_refusal("a") for _ in range(3)] == [True, False, False]
    clock.now_s += 60.01
    assert limited.should_audit_refusal("a")


def test_those_who_stay_away_are_forgotten(clock: Clock) -> None:
    window = rates.MovingWindow(2, 10.0)
    for number in range(100):
        window.hit(f"address {number}")
    clock.now_s += 10.01
    window.hit("a")
    assert list(window._hits) == ["a"]


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::ffff:1", "2001:db8::/64"),
        ("unknown", "unknown"),
    ],
)
def test_an_ipv6_host_counts_as_its_network(address: str, network: str) -> None:
    assert network_of(address) == network
