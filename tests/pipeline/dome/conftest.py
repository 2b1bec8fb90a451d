"""A simulated dome, an observer of it, and a server that drives it."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from services.api.app import create_app
from services.capture.dome.controller import DomeObserver
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault, simulated_dome
from tests.support.dome_by_hand import LIGHTS, WATCHDOG_S, Address, Jobs, lit, settings_of
from tests.support.live_server import serving


@pytest.fixture(autouse=True)
def _unhurried(unhurried_flashes: None) -> None:
    """No test of this folder waits for a flash."""


@pytest.fixture(scope="module")
def shared_dome() -> Iterator[Address]:
    with simulated_dome(LIGHTS, WATCHDOG_S) as address:
        yield address


@pytest.fixture
def observer(shared_dome: Address) -> Iterator[DomeObserver]:
    order_fault(*shared_dome, FaultKind.NONE)
    observer = DomeObserver(*shared_dome)
    yield observer
    order_fault(*shared_dome, FaultKind.NONE)
    observer.close()


@pytest.fixture(scope="module")
def jobs() -> Jobs:
    return Jobs()


@pytest.fixture(scope="module")
def shared_client(shared_dome: Address, jobs: Jobs, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(settings_of(shared_dome, tmp_path_factory.mktemp("data")), jobs)) as client:
        yield client


@pytest.fixture
def client(shared_client: httpx.Client, observer: DomeObserver) -> Iterator[httpx.Client]:
    yield shared_client
    shared_client.delete("/v1/dome/light")
    assert lit(observer) == ()
