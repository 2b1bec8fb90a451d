"""Contract of every dome driver, run on the Modbus driver with the simulated controller."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from services.capture.dome.controller import DomeObserver
from services.capture.dome.driver import HANG_MARGIN_S, ModbusDome
from services.capture.dome.protocol import Dome, ExposureBudget
from services.capture.dome.registers import FULL_SCALE
from services.capture.dome.simulator import simulated_dome
from services.core.errors import ExposureLimitError, RigError

pytestmark = pytest.mark.usefixtures("unhurried_flashes")

LIGHTS = 50
LEVEL = 0.5
ON_S = 0.01


@pytest.fixture(scope="module")
def address() -> Iterator[tuple[str, int]]:
    with simulated_dome(LIGHTS) as address:
        yield address


class DomeContract:
    """Tests for any driver. A subclass provides the fixtures ``dome`` (entered), ``observer`` (of the same dome) and
    ``make`` (which opens another driver of it).
    """

    def test_one_light_at_a_time(self, dome: Dome, observer: DomeObserver) -> None:
        for light in (0, 17, LIGHTS - 1):
            readback = dome.light(light, LEVEL, ON_S)
            assert readback == (round(LEVEL * FULL_SCALE),) * 3
            emitted = observer.outputs()
            assert list(np.flatnonzero(emitted.any(axis=1))) == [light]
            assert emitted[light] == pytest.approx(LEVEL, abs=0.5 / FULL_SCALE)
        dome.dark()
        assert not observer.outputs().any()

    def test_all_lights_together(self, dome: Dome, observer: DomeObserver) -> None:
        dome.light(None, 0.1, ON_S)
        assert observer.outputs() == pytest.approx(np.full((LIGHTS, 3), 0.1), abs=0.5 / FULL_SCALE)
        dome.dark()

    def test_a_lit_light_is_confirmed_and_a_dark_dome_too(self, dome: Dome) -> None:
        assert dome.confirm() == (0, 0, 0)
        dome.light(4, LEVEL, ON_S)
        assert dome.confirm() == (round(LEVEL * FULL_SCALE),) * 3
        dome.dark()
        assert dome.confirm() == (0, 0, 0)

    def test_trigger_pulses_once(self, dome: Dome, observer: DomeObserver) -> None:
        before = observer.trigger_count()
        dome.trigger()
        assert observer.trigger_count() == (before + 1) % 65536

    def test_status_tells_what_is_lit(self, dome: Dome) -> None:
        dome.light(7, LEVEL, ON_S)
        status = dome.status()
        dome.dark()
        assert (status.light_count, status.lit, status.faults) == (LIGHTS, (7,), ())
        assert status.interlock_closed
        assert status.supply_on
        # 3 LEDs of 350 mA at half level.
        assert status.current_ma[0] == round(3 * 350 * LEVEL)

    def test_unknown_light_is_refused_in_the_dark(self, dome: Dome, observer: DomeObserver) -> None:
        dome.light(3, LEVEL, ON_S)
        with pytest.raises(RigError, match="Light 50 does not exist"):
            dome.light(LIGHTS, LEVEL, ON_S)
        assert not observer.outputs().any()

    @pytest.mark.parametrize("problem", [ValueError, KeyboardInterrupt, SystemExit])
    def test_dark_after_any_exception(
        self, make: Callable[..., Dome], observer: DomeObserver, problem: type[BaseException]
    ) -> None:
        def interrupted() -> None:
            with make() as dome:
                dome.light(3, LEVEL, ON_S)
                assert observer.outputs().any()
                raise problem

        with pytest.raises(problem):
            interrupted()
        assert not observer.outputs().any()

    def test_a_hung_caller_does_not_leave_a_light_on(self, dome: Dome, observer: DomeObserver) -> None:
        asked_s = time.monotonic()
        dome.light(3, LEVEL, ON_S)
        assert observer.outputs().any()
        time.sleep(max(0.0, asked_s + ON_S + HANG_MARGIN_S + 0.1 - time.monotonic()))
        assert not observer.outputs().any()

    def test_stays_lit_longer_than_the_watchdog_while_the_driver_lives(
        self, make: Callable[..., Dome], observer: DomeObserver
    ) -> None:
        with make(watchdog_s=0.6) as dome:
            dome.light(3, LEVEL, 2.0)
            time.sleep(1.2)
            assert dome.confirm() == (round(LEVEL * FULL_SCALE),) * 3
        assert not observer.outputs().any()


class TestModbusDome(DomeContract):
    @pytest.fixture
    def make(self, address: tuple[str, int]) -> Callable[..., ModbusDome]:
        def open_dome(watchdog_s: float = 2.0) -> ModbusDome:
            return ModbusDome(*address, ExposureBudget(math.inf, math.inf), watchdog_s)

        return open_dome

    @pytest.fixture
    def dome(self, make: Callable[..., ModbusDome]) -> Iterator[ModbusDome]:
        with make() as dome:
            yield dome

    @pytest.fixture
    def observer(self, address: tuple[str, int]) -> Iterator[DomeObserver]:
        observer = DomeObserver(*address)
        yield observer
        observer.close()

    def test_observing_does_not_feed_the_watchdog(
        self, make: Callable[..., ModbusDome], observer: DomeObserver
    ) -> None:
        with make(watchdog_s=0.5) as dome:
            dome.light(3, LEVEL, 2.0)
            dome._keepalive.stop()
            deadline_s = time.monotonic() + 0.5
            while time.monotonic() < deadline_s:
                observer.outputs()
                time.sleep(0.02)
            assert not observer.outputs().any()

    @pytest.mark.parametrize(
        ("light_limit_s", "total_limit_s", "which"), [(0.01, 10.0, "Light 3"), (10.0, 0.01, "All lights together")]
    )
    def test_a_dose_over_the_limit_is_refused_before_it_is_sent(
        self, address: tuple[str, int], observer: DomeObserver, light_limit_s: float, total_limit_s: float, which: str
    ) -> None:
        with ModbusDome(*address, ExposureBudget(light_limit_s, total_limit_s)) as dome:
            with pytest.raises(ExposureLimitError, match=which):
                dome.light(3, 0.5, 0.1)
            assert not observer.outputs().any()

    def test_emitted_light_counts_against_the_limit(self, address: tuple[str, int]) -> None:
        with ModbusDome(*address, ExposureBudget(0.1, 10.0)) as dome:
            dome.light(3, 1.0, 0.05)
            time.sleep(0.06)
            dome.dark()
            with pytest.raises(ExposureLimitError, match="Light 3"):
                dome.light(3, 1.0, 0.05)

    def test_a_device_that_does_not_answer_is_named(self) -> None:
        with pytest.raises(RigError, match=r"127\.0\.0\.1:1 .*check the controller"):
            ModbusDome("127.0.0.1", 1, ExposureBudget(1, 1)).__enter__()
