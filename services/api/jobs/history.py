"""Reads the curve of a fit, its pictures and the log of a job from the job's events."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

from pydantic import Field

from services.core.events import JobEvent
from services.core.geometry import Record
from services.core.stage import StageName
from services.pipeline.event_log import EventLog, TimedData

PICTURES = ("render", "photo", "residual")
ENTRY_BYTES = 512
"""Memory in bytes that a kept curve takes besides its text and its channel: its key, tuples and place in the
mapping."""


class LogLine(Record):
    """Something that a stage said."""

    id: int = Field(description="grows with time")
    time_s: float = Field(description="Unix time")
    stage: StageName | None
    attempt: int
    message: str


class LogPage(Record):
    """Some lines, oldest first."""

    lines: list[LogLine]
    next_after: int = Field(description="give as 'after' to get what follows, also later on")
    is_last: bool = Field(description="whether nothing follows by now")


class Series(Record):
    """Steps of one channel as columns of equal length; null where a step does not tell a number."""

    channel: str
    step: list[int] = Field(description="number of the step; gaps where the columns are thinned")
    time_s: list[float] = Field(description="Unix time")
    stage: list[str | None] = Field(description="stage of the fit")
    tooth: list[int | None] = Field(description="FDI number, where the step looks at one tooth of a jaw alone")
    samples: list[int | None] = Field(description="paths per pixel and pass")
    loss: list[float | None]
    fit_error: list[float | None] = Field(description="relative image error on fitted images")
    held_out_error: list[float | None] = Field(description="relative image error on held-out images")
    held_out_se: list[float | None] = Field(description="Monte Carlo standard error of held_out_error")
    parameters: dict[str, list[float | None]] = Field(description="by name; units as in parameters.json")


class History(Record):
    """The curve of a fit."""

    series: list[Series] = Field(description="one per channel, in the order in which they began")


class Preview(Record):
    """One picture in three versions, as a step left it."""

    id: int = Field(description="of the event that told of it")
    time_s: float = Field(description="Unix time")
    attempt: int
    camera: str
    light: str
    channel: str
    step: int
    held_out: bool
    pictures: dict[str, str] = Field(description="render, photo, residual: paths to get them from")


class PreviewPage(Record):
    """Some pictures, oldest first."""

    previews: list[Preview]
    next_after: int = Field(description="give as 'after' to get what follows, also later on")
    is_last: bool = Field(description="whether nothing follows by now")


def read_log(log: EventLog, after: int, limit: int, stage: StageName | None, attempt: int | None) -> LogPage:
    """Return one page of the log messages of the stages."""
    events = log.read(after, limit + 1, kind="log", stage=stage, attempt=attempt)
    lines = [LogLine(**{name: getattr(event, name) for name in LogLine.model_fields}) for event in events[:limit]]
    return LogPage(lines=lines, next_after=lines[-1].id if lines else after, is_last=len(events) <= limit)


def read_previews(log: EventLog, job_id: str, after: int, limit: int) -> PreviewPage:
    """Return one page of the pictures that the fit wrote."""
    events = log.read(after, limit + 1, kind="preview")
    previews = [_preview(event, job_id) for event in events[:limit]]
    return PreviewPage(
        previews=previews, next_after=previews[-1].id if previews else after, is_last=len(events) <= limit
    )


def read_history(log: EventLog, points: int, channel: str | None = None) -> History:
    """Return the steps of every channel, evenly thinned to ``points`` each, with the first and the last step kept. A
    step that a later attempt repeats replaces the earlier one.
    """
    thinned: dict[str, _Thinned] = {}
    for event in log.data_of("step"):
        name = str(event.data.get("channel", ""))
        if isinstance(event.data.get("step"), int) and channel in {None, name}:
            thinned.setdefault(name, _Thinned(points)).add(event)
    return History(series=[_series(name, one) for name, one in thinned.items()])


class HistoryCache:
    """Cache of curves as JSON.

    Rows of the event table never change, so that a curve is read again only once its job has a newer event.

    Args:
        max_bytes: largest size of the cache in bytes; the curves that were read longest ago are dropped first.
    """

    def __init__(self, max_bytes: int = 2**24) -> None:
        self._max_bytes, self._bytes = max_bytes, 0
        self._kept: OrderedDict[tuple[str, int, str | None], tuple[int, bytes]] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, log: EventLog, points: int, channel: str | None = None) -> bytes:
        """Return the result of ``read_history`` as JSON."""
        key, newest = (log.job, points, channel), log.newest_id()
        with self._lock:
            if (kept := self._kept.get(key)) is not None and kept[0] == newest:
                self._kept.move_to_end(key)
                return kept[1]
        text = read_history(log, points, channel).model_dump_json().encode()
        with self._lock:
            self._evict(key)
            self._kept[key] = newest, text
            self._bytes += _entry_bytes(channel, text)
            while self._bytes > self._max_bytes:
                self._evict(next(iter(self._kept)))
        return text

    def _evict(self, key: tuple[str, int, str | None]) -> None:
        if (kept := self._kept.pop(key, None)) is not None:
            self._bytes -= _entry_bytes(key[2], kept[1])


def _entry_bytes(channel: str | None, text: bytes) -> int:
    return len(text) + 4 * len(channel or "") + ENTRY_BYTES


class _Thinned:
    """Every n-th step of a channel. The stride n doubles as steps come, so that a long fit needs no more memory than a
    short one.
    """

    def __init__(self, points: int) -> None:
        self._points, self._stride = points, 1
        self._kept: dict[int, TimedData] = {}
        self._first: TimedData | None = None
        self._last: TimedData | None = None

    def add(self, event: TimedData) -> None:
        """Add a step."""
        if self._first is None or event.data["step"] <= self._first.data["step"]:
            self._first = event
        if self._last is None or event.data["step"] >= self._last.data["step"]:
            self._last = event
        if event.data["step"] % self._stride == 0:
            self._kept[event.data["step"]] = event
        while len(self._kept) > max(self._points - 2, 1):
            self._stride *= 2
            self._kept = {step: kept for step, kept in self._kept.items() if step % self._stride == 0}

    def events(self) -> list[TimedData]:
        """Return the steps that are kept, in their order."""
        ends = {event.data["step"]: event for event in (self._first, self._last) if event is not None}
        return [event for _, event in sorted((self._kept | ends).items())]


def _series(channel: str, thinned: _Thinned) -> Series:
    events = thinned.events()
    rows = [event.data for event in events]
    parameters: list[dict[str, float]] = [row.get("parameters") or {} for row in rows]
    names = list(dict.fromkeys(name for one in parameters for name in one))

    def column(name: str) -> list[Any]:
        return [row.get(name) for row in rows]

    return Series(
        channel=channel,
        step=column("step"),
        time_s=[event.time_s for event in events],
        stage=column("stage"),
        tooth=column("tooth"),
        samples=column("samples"),
        loss=column("loss"),
        fit_error=column("fit_error"),
        held_out_error=column("held_out_error"),
        held_out_se=column("held_out_se"),
        parameters={name: [one.get(name) for one in parameters] for name in names},
    )


def _preview(event: JobEvent, job_id: str) -> Preview:
    absent = {"camera": "", "light": "", "channel": "", "step": 0, "held_out": False}
    known = {name: event.data.get(name, default) for name, default in absent.items()}
    pictures = {kind: f"/v1/jobs/{job_id}/previews/{event.id}/{kind}" for kind in PICTURES if kind in event.data}
    return Preview(id=event.id, time_s=event.time_s, attempt=event.attempt, pictures=pictures, **known)
