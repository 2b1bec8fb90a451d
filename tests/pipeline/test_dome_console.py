"""The dome by hand under difficulties: no connection left for ALL OFF, and a rig that requests more than the server
allows.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from services.capture.console import Console
from services.capture.dome import registers as reg
from services.capture.dome.controller import DomeObserver
from services.capture.dome.modbus_link import ModbusLink
from services.capture.dome.simulator import simulated_dome
from services.capture.preflight import preflight
from services.capture.rig import PlannedRig
from services.core.dome import DomeAnswer, DomeCommand
from services.core.errors import RigStoppedError
from services.core.records import RigSpec
from services.core.settings import DomeSettings
from tests.support.dome_proxy import Proxy
from tests.support.mouth import write_mouth

pytestmark = pytest.mark.usefixtures("unhurried_flashes")

LIGHTS = 4
# The watchdog's period is much longer than the tests, so a light that goes dark was switched off.
WATCHDOG_S = 30.0
Address = tuple[str, int]


@pytest.fixture(scope="module")
def address() -> Iterator[Address]:
    with simulated_dome(LIGHTS, WATCHDOG_S) as address:
        yield address


@pytest.fixture
def observer(address: Address) -> Iterator[DomeObserver]:
    with closing(DomeObserver(*address)) as observer:
        yield observer


@pytest.fixture
def rig(tmp_path: Path) -> Callable[..., RigSpec]:
    write_mouth(tmp_path, LIGHTS)
    usual: dict[str, Any] = {"mouth": tmp_path, "exposure_s": 0.01, "settle_s": 0.0, "watchdog_s": WATCHDOG_S}
    return lambda **options: RigSpec(**usual | options)


@contextmanager
def console(address: Address, **limits: Any) -> Iterator[Callable[..., DomeAnswer]]:
    """Give the console of the dome's process, run inside the test instead of in a process of its own."""
    settings: dict[str, Any] = {"watchdog_s": WATCHDOG_S, **limits}
    worked = Console(*address, DomeSettings(**settings))
    try:
        yield lambda **command: worked.answer(DomeCommand(**{"number": 1} | command))
    finally:
        worked.close()


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s, "waited for a minute in vain"
        time.sleep(0.01)


def require_failed_all_off(answer: DomeAnswer) -> None:
    assert answer.code == "rig-unreachable"
    assert "not confirmed dark" in answer.message


def test_all_off_darkens_a_light_by_hand_though_the_controller_takes_no_further_connection(
    address: Address, observer: DomeObserver
) -> None:
    proxy = Proxy(address)
    with console(proxy.address) as answer:
        assert answer(do="light", light=2, level=0.1, on_s=30).code is None
        assert observer.status().lit == (2,)
        proxy.close()
        require_failed_all_off(answer(number=2, do="off"))
        assert observer.status().lit == ()


def test_all_off_ends_a_preflight_though_the_controller_takes_no_further_connection(
    address: Address, observer: DomeObserver, rig: Callable[..., RigSpec]
) -> None:
    proxy, answers, exposure_s = Proxy(address), list[DomeAnswer](), 1.0
    with console(proxy.address) as answer:
        asking = threading.Thread(
            target=lambda: answers.append(answer(do="preflight", rig=rig(exposure_s=exposure_s, level=0.4)))
        )
        asking.start()
        # All lights are on together only in its last exposure.
        wait_until(lambda: len(observer.status().lit) == LIGHTS)
        lit_s = time.monotonic()
        proxy.close()
        off: list[DomeAnswer] = []
        switching_off = threading.Thread(target=lambda: off.append(answer(number=2, do="off")))
        switching_off.start()
        wait_until(lambda: observer.status().lit == ())
        assert time.monotonic() < lit_s + exposure_s, "it was lit for the whole exposure"
        asking.join()
        switching_off.join()
    require_failed_all_off(off[0])
    assert answers[0].code == "rig-stopped"


def test_a_preflight_lights_no_further_light_once_it_is_unwanted(address: Address, rig: Callable[..., RigSpec]) -> None:
    spent_s: dict[int, float] = {}

    def raise_if_cancelled() -> None:
        if len(spent_s) == 2:
            raise RigStoppedError("ALL OFF was pressed.")

    planned = PlannedRig.read(rig(dome=f"{address[0]}:{address[1]}"))
    with planned.in_use(spent_s) as (dome, cameras), pytest.raises(RigStoppedError):
        preflight(planned.plan, dome, cameras, planned.spec, raise_if_cancelled)
    assert set(spent_s) == {0, 1}


def test_a_preflight_may_not_ask_for_more_than_the_server_allows(
    address: Address, observer: DomeObserver, rig: Callable[..., RigSpec]
) -> None:
    unbounded: dict[str, Any] = {"light_exposure_limit_s": 1e9, "total_exposure_limit_s": 1e9, "watchdog_s": 60.0}
    triggers = observer.trigger_count()
    with console(address) as answer:
        assert answer(do="preflight", rig=rig(level=1.0, exposure_s=60.0, **unbounded)).code == "rig-exposure-limit"
        assert observer.trigger_count() == triggers
        assert answer(do="preflight", rig=rig(**unbounded)).code is None
    with closing(ModbusLink(*address, timeout_s=1.0)) as link:
        assert link.read(reg.WATCHDOG_MS) == [round(1000 * WATCHDOG_S)]


def test_preflights_add_up_to_the_limit_with_light_by_hand(
    address: Address, observer: DomeObserver, rig: Callable[..., RigSpec]
) -> None:
    # In each preflight the last light is on for 0.3 s and for a flash of some milliseconds, the others for the flash
    # alone. One preflight and the capture after it are within the limit. Whether a second preflight is depends on the
    # length of the flash; a third one exceeds the limit by 0.3 s.
    wanted = rig(level=1.0, exposure_s=0.3, tracking_every=0)
    with console(address, light_exposure_limit_s=0.607) as answer:
        assert answer(do="preflight", rig=wanted).code is None
        assert "rig-exposure-limit" in {answer(do="preflight", rig=wanted).code for _ in range(2)}
        assert answer(do="light", light=LIGHTS - 1, level=1.0, on_s=0.3).code == "rig-exposure-limit"
        assert observer.status().lit == ()
        assert answer(do="light", light=0, level=1.0, on_s=0.3).code is None
