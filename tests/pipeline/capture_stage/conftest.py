"""A simulated dome, a virtual mouth, and the job that captures it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault, simulated_dome
from services.core.records import JobSpec, RigSpec
from tests.support.captured_frames import LIGHTS, NOISELESS, Address
from tests.support.mouth import write_mouth


@pytest.fixture(autouse=True)
def _unhurried(unhurried_flashes: None) -> None:
    """No test of this folder waits for a flash."""


@pytest.fixture(scope="module")
def shared_dome() -> Iterator[Address]:
    with simulated_dome(LIGHTS) as address:
        yield address


@pytest.fixture
def address(shared_dome: Address) -> Iterator[Address]:
    order_fault(*shared_dome, FaultKind.NONE)
    yield shared_dome
    order_fault(*shared_dome, FaultKind.NONE)


@pytest.fixture
def mouth(tmp_path: Path) -> Path:
    write_mouth(tmp_path / "mouth", LIGHTS)
    return tmp_path / "mouth"


@pytest.fixture
def job(mouth: Path, address: Address) -> Callable[..., JobSpec]:
    def make(**options: object) -> JobSpec:
        rig = {
            "mouth": mouth,
            "dome": f"{address[0]}:{address[1]}",
            "exposure_s": 0.01,
            "settle_s": 0.0,
            "simulation": NOISELESS,
        }
        return JobSpec(rig=RigSpec.model_validate(rig | options))

    return make
