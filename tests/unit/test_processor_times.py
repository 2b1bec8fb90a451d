"""The plugin that names dear tests and fails those without a reason."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support.processor_times import MAX_S, NAMED_S, ProcessorTimes, processor_s


def report_after(used_s: float, *marks: str, outcome: str = "passed") -> tuple[ProcessorTimes, pytest.TestReport]:
    """A plugin and the report of one test's clean-up that ``used_s`` of processor time have passed before."""
    times = iter((100.0, 100.0 + used_s))
    plugin = ProcessorTimes(clock=lambda: next(times))
    plugin.pytest_runtest_logstart()
    item = SimpleNamespace(nodeid="tests/test_it.py::test_it", get_closest_marker=lambda name: name in marks)
    made = pytest.TestReport(item.nodeid, ("", 0, ""), {}, cast(Any, outcome), None, "teardown")
    steps = plugin.pytest_runtest_makereport(cast(Any, item), cast(Any, SimpleNamespace(when="teardown")))
    next(cast(Iterator[None], steps))
    with pytest.raises(StopIteration) as ended:
        steps.send(made)
    return plugin, ended.value.value


@pytest.mark.parametrize(
    ("used_s", "mark", "fails"),
    [(MAX_S + 1, "other", True), (MAX_S + 1, "dear", False), (MAX_S + 1, "slow", False), (MAX_S - 1, "other", False)],
)
def test_a_dear_test_fails_unless_it_says_why(used_s: float, mark: str, fails: bool) -> None:
    report = report_after(used_s, mark)[1]
    assert report.failed is fails
    if fails:
        assert "tests/test_it.py::test_it took 7.0 s of processor time, more than 6 s" in report.longreprtext


def test_a_failure_keeps_its_own_text() -> None:
    assert report_after(MAX_S + 1, outcome="failed")[1].longrepr is None


@pytest.mark.parametrize("used_s", [NAMED_S + 1, NAMED_S - 1])
def test_tests_over_two_seconds_are_named_at_the_end(used_s: float) -> None:
    plugin, report = report_after(used_s, "dear")
    plugin.pytest_runtest_logreport(report)
    lines: list[str] = []
    terminal = SimpleNamespace(section=lines.append, write_line=lines.append)
    plugin.pytest_terminal_summary(cast(Any, terminal))
    named = ["over 2 s of processor time", f"{used_s:6.1f} s  tests/test_it.py::test_it"]
    assert lines == (named if used_s > NAMED_S else [])


def test_time_of_child_processes_counts_while_they_run_and_afterwards() -> None:
    before_s = processor_s()
    code = "import time\nwhile time.process_time() < 0.3: pass\nprint(flush=True)\ninput()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        # The kernel counts in ticks of 0.01 s.
        assert processor_s() - before_s > 0.28
        child.communicate(b"\n")
    assert processor_s() - before_s > 0.28
