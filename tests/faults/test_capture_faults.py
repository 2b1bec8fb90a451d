"""Every fault of the simulated dome, triggered while a light is on, ends with the right error and with a dark dome."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from services.capture.dome import registers as reg
from services.capture.dome.controller import DomeObserver
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault, serve_dome, simulated_dome
from services.core.errors import InterlockError, ReadbackError, RigError, RigUnreachableError
from tests.support.dome_proxy import Proxy

pytestmark = pytest.mark.usefixtures("unhurried_flashes")

WATCHDOG_S = 1.0
ALWAYS = 60_000
Address = tuple[str, int]


@pytest.fixture(scope="module")
def shared_dome() -> Iterator[Address]:
    with simulated_dome(8) as address:
        yield address


@pytest.fixture
def address(shared_dome: Address) -> Iterator[Address]:
    order_fault(*shared_dome, FaultKind.NONE)
    yield shared_dome
    order_fault(*shared_dome, FaultKind.NONE)


@pytest.fixture
def observer(address: Address) -> Iterator[DomeObserver]:
    observer = DomeObserver(*address)
    yield observer
    observer.close()


def open_dome(address: Address) -> ModbusDome:
    return ModbusDome(*address, ExposureBudget(100, 100), WATCHDOG_S)


def require_dark_within_watchdog(observer: DomeObserver, since_s: float) -> None:
    """Assert that no request that starts a watchdog period after the driver gave up sees light."""
    deadline_s = since_s + WATCHDOG_S
    while True:
        asked_s = time.monotonic()
        lit = observer.outputs().any()
        if asked_s >= deadline_s:
            assert not lit
            return
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("kind", "argument", "times", "on", "error", "words"),
    [
        (FaultKind.DROP_REQUEST, 0, 1, reg.ACTIVE_LIGHT, ReadbackError, "Light 2 holds"),
        (FaultKind.DROP_REPLY, 0, ALWAYS, reg.LEVELS, RigUnreachableError, "does not answer for levels"),
        (FaultKind.DELAY, 700, 1, reg.ACTIVE_LIGHT, ReadbackError, "Light 2 holds"),
        (FaultKind.EXCEPTION, 4, 1, reg.ACTIVE_LIGHT, RigError, "Modbus exception 4"),
        (FaultKind.WRONG_REPLY, 0, 1, reg.LEVELS, ReadbackError, "Light 7 holds"),
        (FaultKind.WRONG_REPLY, 0, 1, reg.OUTPUTS, ReadbackError, "Light 7 emits"),
        (FaultKind.STUCK_LIGHT, 5, 1, None, ReadbackError, "Light 5 emits"),
        (FaultKind.DEAD_LIGHT, 3, 1, None, ReadbackError, "Light 3 emits"),
        (FaultKind.WATCHDOG_TRIP, 0, 1, None, RigError, "reports watchdog"),
        (FaultKind.OVER_TEMPERATURE, 0, 1, None, RigError, "reports temperature"),
        (FaultKind.INTERLOCK_OPEN, 0, 1, None, InterlockError, "interlock"),
        (FaultKind.EMERGENCY_STOP, 0, 1, None, InterlockError, "emergency stop"),
    ],
)
def test_a_fault_ends_in_its_error_and_in_the_dark(
    address: Address,
    observer: DomeObserver,
    kind: FaultKind,
    argument: int,
    times: int,
    on: reg.Register | None,
    error: type[RigError],
    words: str,
) -> None:
    def light_into_the_fault() -> None:
        with open_dome(address) as dome:
            dome.light(2, 0.5, 0.5)
            assert observer.outputs()[2].all()
            order_fault(*address, kind, argument, times, on)
            dome.light(3, 0.5, 0.5)

    with pytest.raises(RigError) as caught:
        light_into_the_fault()
    gave_up_s = time.monotonic()
    assert type(caught.value) is error
    assert words in caught.value.message
    require_dark_within_watchdog(observer, gave_up_s)


@pytest.mark.parametrize(
    ("kind", "argument", "on"),
    [
        (FaultKind.DROP_REPLY, 0, reg.ACTIVE_LIGHT),
        (FaultKind.WRONG_REPLY, 0, reg.ACTIVE_LIGHT),
        (FaultKind.DELAY, 100, reg.ACTIVE_LIGHT),
        (FaultKind.DROP_REQUEST, 0, reg.LEVELS),
        (FaultKind.DROP_REPLY, 0, reg.OUTPUTS),
    ],
)
def test_what_the_readback_settles_does_not_stop_a_capture(
    address: Address, observer: DomeObserver, kind: FaultKind, argument: int, on: reg.Register
) -> None:
    with open_dome(address) as dome:
        order_fault(*address, kind, argument, 1, on)
        dome.light(3, 0.5, 0.5)
        assert observer.outputs()[3].all()
    assert not observer.outputs().any()


@pytest.mark.parametrize(
    "kind", [FaultKind.DROP_REQUEST, FaultKind.DROP_REPLY, FaultKind.WRONG_REPLY, FaultKind.EXCEPTION]
)
def test_all_off_is_insisted_on(address: Address, observer: DomeObserver, kind: FaultKind) -> None:
    with open_dome(address) as dome:
        dome.light(3, 0.5, 0.5)
        order_fault(*address, kind, 4, 2, reg.ALL_OFF)
        dome.dark()
        assert not observer.outputs().any()


def test_a_write_is_never_sent_twice(address: Address, observer: DomeObserver) -> None:
    before = observer.trigger_count()
    with open_dome(address) as dome:
        order_fault(*address, FaultKind.DROP_REPLY, 0, 1, reg.EXPOSURE_TRIGGER)
        dome.trigger()
    assert observer.trigger_count() == before + 1


def test_a_lost_trigger_is_noticed(address: Address, observer: DomeObserver) -> None:
    def trigger_in_vain() -> None:
        with open_dome(address) as dome:
            dome.light(3, 0.5, 0.5)
            order_fault(*address, FaultKind.DROP_REQUEST, 0, 1, reg.EXPOSURE_TRIGGER)
            dome.trigger()

    with pytest.raises(RigError, match="did not trigger"):
        trigger_in_vain()
    assert not observer.outputs().any()


@pytest.mark.parametrize("kind", [FaultKind.INTERLOCK_OPEN, FaultKind.EMERGENCY_STOP])
def test_nothing_starts_while_it_is_unsafe(address: Address, observer: DomeObserver, kind: FaultKind) -> None:
    order_fault(*address, kind)
    with pytest.raises(InterlockError), open_dome(address):
        pytest.fail("entered an unsafe dome")
    assert not observer.outputs().any()


def test_a_dome_that_falls_silent_is_reported_as_not_confirmed_dark(address: Address, observer: DomeObserver) -> None:
    def light_into_silence() -> None:
        with open_dome(address) as dome:
            dome.light(3, 0.5, 0.5)
            order_fault(*address, FaultKind.DROP_REPLY, 0, ALWAYS)
            dome.dark()

    with pytest.raises(ReadbackError, match=r"not confirmed dark .* cuts the supply within 1 s"):
        light_into_silence()
    gave_up_s = time.monotonic()
    order_fault(*address, FaultKind.NONE)
    require_dark_within_watchdog(observer, gave_up_s)


def test_connections_that_hang_are_replaced(address: Address, observer: DomeObserver) -> None:
    proxy = Proxy(address)
    with ModbusDome(*proxy.address, ExposureBudget(100, 100), watchdog_s=4.0) as dome:
        dome.light(2, 0.5, 0.5)
        dome.dark()
        proxy.silence()
        dome.light(3, 0.5, 0.5)
        assert observer.outputs()[3].all()
        dome.dark()
        assert not observer.outputs().any()
    assert len(proxy.accepted) > 2
    proxy.close()


def test_a_taken_port_is_an_error_that_names_it(address: Address) -> None:
    with pytest.raises(RigError, match=f"cannot listen on {address[0]}:{address[1]}"):
        serve_dome(*address, lights=4, watchdog_s=1.0)


def test_a_dome_larger_than_the_register_map_is_refused() -> None:
    with pytest.raises(RigError, match="156 lights"):
        serve_dome("127.0.0.1", 0, lights=156, watchdog_s=1.0)


# A process inherits ignored signals: interrupts from a shell's background job, hang-ups from nohup. So both are reset.
SIGNALLED = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.driver import ModbusDome
with ModbusDome("127.0.0.1", int(sys.argv[1]), ExposureBudget(1e3, 1e3), watchdog_s=60.0) as dome:
    dome.light(3, 0.5, 50.0)
    print("lit", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGTERM, 128 + signal.SIGTERM), (signal.SIGHUP, 128 + signal.SIGHUP), (signal.SIGINT, -signal.SIGINT)],
)
def test_a_signal_goes_dark_before_the_process_ends(
    address: Address, observer: DomeObserver, number: signal.Signals, status: int
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SIGNALLED, str(address[1])], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"lit\n"
        assert observer.outputs()[3].all()
        process.send_signal(number)
        assert process.wait(30) == status
    # The watchdog would wait for 60 s, so the driver itself darkened the dome.
    assert not observer.outputs().any()
