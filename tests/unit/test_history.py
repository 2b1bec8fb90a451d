"""The curves of a fit are thinned evenly and keep their ends; a repeated step is taken from the later attempt."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.api.jobs.history import History, HistoryCache, read_history
from services.core.stage import StageEvent
from services.pipeline.event_log import EventLog, event_table, folder_events


@pytest.fixture
def log(tmp_path: Path) -> Iterator[EventLog]:
    with folder_events(tmp_path).open() as log:
        yield log


def step(number: int, channel: str = "green", loss: float = 1.0, **data: object) -> StageEvent:
    return StageEvent(
        stage="fit",
        kind="step",
        data={"channel": channel, "step": number, "loss": loss, "parameters": {"enamel.sigma": float(number)}} | data,
    )


def test_columns_hold_what_steps_tell(log: EventLog) -> None:
    attempt = log.begin_stage("fit")
    log.append(attempt, step(0, held_out_error=0.5, stage="media", tooth=11, samples=64))
    log.append(attempt, step(0, "red"))
    log.append(attempt, step(1, loss=0.25, parameters={"dentin.sigma": 2.0}))
    green, red = read_history(log, 500).series
    assert (green.channel, red.channel) == ("green", "red")
    assert (green.step, green.loss, green.held_out_error, green.stage, green.tooth, green.samples) == (
        [0, 1], [1.0, 0.25], [0.5, None], ["media", None], [11, None], [64, None],
    )  # fmt: skip
    assert green.parameters == {"enamel.sigma": [0.0, None], "dentin.sigma": [None, 2.0]}
    assert [series.channel for series in read_history(log, 500, "red").series] == ["red"]


def test_a_later_attempt_replaces_the_steps_that_it_repeats(log: EventLog) -> None:
    for number in range(4):
        log.append(1, step(number, loss=1.0))
    for number in range(2, 6):
        log.append(2, step(number, loss=2.0))
    assert read_history(log, 500).series[0].loss == [1.0, 1.0, 2.0, 2.0, 2.0, 2.0]


def test_a_curve_is_read_again_only_after_it_has_grown(log: EventLog, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[Any] = []

    def counted(*asked: Any) -> History:
        reads.append(asked)
        return read_history(*asked)

    monkeypatch.setattr("services.api.jobs.history.read_history", counted)
    histories = HistoryCache(max_bytes=2000)
    for number in range(3):
        log.append(1, step(number))
        for _ in range(2):
            assert History.model_validate_json(histories.read(log, 500)) == read_history(log, 500)
    assert len(reads) == 3
    for points in range(3, 30):
        histories.read(log, points)
    histories.read(log, 500)
    assert len(reads) == 3 + 27 + 1  # the other reads have pushed it out of the cache


def test_names_of_channels_that_nothing_is_known_of_count_as_what_they_take(log: EventLog) -> None:
    histories = HistoryCache(max_bytes=100_000)
    for number in range(1000):
        histories.read(log, 500, f"{number:0100}")
    assert len(histories._kept) < 120
    assert histories._bytes <= 100_000


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(first=st.integers(0, 5), count=st.integers(1, 400), points=st.integers(3, 60))
def test_thinned_columns_are_even_and_keep_both_ends(log: EventLog, first: int, count: int, points: int) -> None:
    with log._engine.begin() as connection:
        connection.execute(event_table.delete())
        rows = [
            {"job": "local", "attempt": 1, "time_s": 0.0, "stage": "fit", "kind": "step", "message": ""}
            for _ in range(count)
        ]
        connection.execute(
            event_table.insert(),
            [row | {"data": step(first + k).model_dump_json(include={"data"})[8:-1]} for k, row in enumerate(rows)],
        )
    steps = read_history(log, points).series[0].step
    assert (steps[0], steps[-1]) == (first, first + count - 1)
    assert len(steps) <= points
    assert len(steps) >= min(count, points // 2)
    inner = [after - before for before, after in pairwise(steps[1:-1])]
    assert len(set(inner)) <= 1
