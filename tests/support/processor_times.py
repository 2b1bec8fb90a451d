"""Processor time of each test: dear ones are named at the end of a run, and must say why they are dear.

A test's time is that of its set-up, its body and its clean-up, in this process and in all that it started. A fixture
that several tests share counts for the test that made it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator

import psutil
import pytest

NAMED_S = 2.0
"""A test that takes more processor time than this, in seconds, is named at the end of the run."""
MAX_S = 6.0
"""A test that takes more processor time than this, in seconds, fails unless it is marked ``dear("its reason")``."""
EXEMPT = ("dear", "slow")
_PROPERTY = "processor_s"


def processor_s() -> float:
    """Seconds of processor time of this process, of its ended children, and of its running descendants."""
    times = os.times()
    total = times.user + times.system + times.children_user + times.children_system
    for child in psutil.Process().children(recursive=True):
        try:
            used = child.cpu_times()
        except psutil.Error:
            continue
        total += used.user + used.system + used.children_user + used.children_system
    return total


class ProcessorTimes:
    """A plugin of pytest. It runs in every worker process, and in the one that prints the report.

    Args:
        clock: seconds of processor time until now.
    """

    def __init__(self, clock: Callable[[], float] = processor_s) -> None:
        self._clock = clock
        self._last_s: float | None = None
        self._dear: list[tuple[float, str]] = []

    @pytest.hookimpl
    def pytest_runtest_logstart(self) -> None:
        """Begin with the first test: collecting the tests counts for none."""
        if self._last_s is None:
            self._last_s = self._clock()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Write the test's time into the report of its clean-up, and fail it where the time is over the limit."""
        report = yield
        if call.when == "teardown":
            now_s = self._clock()
            used_s = now_s - (now_s if self._last_s is None else self._last_s)
            self._last_s = now_s
            report.user_properties.append((_PROPERTY, used_s))
            if used_s > MAX_S and report.passed and not any(item.get_closest_marker(name) for name in EXEMPT):
                report.outcome = "failed"
                report.longrepr = (
                    f"{item.nodeid} took {used_s:.1f} s of processor time, more than {MAX_S:g} s; make it cheaper, or"
                    ' mark it pytest.mark.dear("its reason").'
                )
        return report

    @pytest.hookimpl
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember dear tests, also those of worker processes."""
        used_s = dict(report.user_properties).get(_PROPERTY, 0.0)
        if report.when == "teardown" and isinstance(used_s, float) and used_s > NAMED_S:
            self._dear.append((used_s, report.nodeid))

    @pytest.hookimpl
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the dear tests, the dearest first."""
        if self._dear:
            terminalreporter.section(f"over {NAMED_S:g} s of processor time")
            for used_s, name in sorted(self._dear, reverse=True):
                terminalreporter.write_line(f"{used_s:6.1f} s  {name}")
