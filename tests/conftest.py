"""Configuration of all tests: the device on which paths are traced, the time limit of slow tests, and the check that
databases are closed.
"""

from __future__ import annotations

from itertools import count

import pytest

from tests.support.processor_times import ProcessorTimes
from tests.support.unclosed_databases import watch_databases

SLOW_TIMEOUT_S = 3600


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device",
        choices=("llvm", "cuda"),
        help="trace paths there in this process's tests; a CUDA device must be present for cuda",
    )


def pytest_configure(config: pytest.Config) -> None:
    watch_databases()
    config.pluginmanager.register(ProcessorTimes())


def pytest_sessionstart(session: pytest.Session) -> None:
    device = session.config.getoption("--device")
    if device is not None:
        from services.core.errors import PlatformError
        from services.transport.platform import prepare_device

        try:
            prepare_device(backend=device)
        except PlatformError as problem:
            raise pytest.UsageError(str(problem)) from problem


@pytest.fixture
def unhurried_flashes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock for the flashes of drivers in this process that is a second on whenever it is read, so that no test
    waits until a light may go on.
    """
    monkeypatch.setattr("services.capture.dome.flashes.monotonic", map(float, count()).__next__)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT_S))
    # Worker processes take file after file, so that a dear file at the end would keep one busy while the others idle.
    dear = {item.path for item in items if item.get_closest_marker("dear")}
    items.sort(key=lambda item: item.path not in dear)
