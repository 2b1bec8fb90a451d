"""The simulated controller: it must be as safe as a real one, or tests that use it prove nothing."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.capture.dome import registers as reg
from services.capture.dome.model import DEVICE_FAILURE, ILLEGAL_VALUE, DomeModel
from services.capture.dome.registers import FaultBit, FaultKind

WATCHDOG_S = 1.0
LIGHTS = 20


def fed_model() -> DomeModel:
    model = DomeModel(LIGHTS, WATCHDOG_S)
    model.advance(0.0)
    assert model.write("holding", reg.KEEPALIVE.address, [1]) == 0
    return model


def set_active(model: DomeModel, light: int, level: int, strobe_ms: int = 0) -> int:
    return model.write("holding", reg.STROBE_MS.address, [strobe_ms, light, level, level, level])


OPERATIONS = st.one_of(
    st.tuples(st.just("wait"), st.floats(0.0, 1.5)),
    st.tuples(st.just("feed"), st.none()),
    st.tuples(st.just("light"), st.integers(0, LIGHTS - 1)),
    st.tuples(st.just("all"), st.none()),
    st.tuples(st.just("off"), st.none()),
    st.tuples(st.just("reset"), st.none()),
    st.tuples(
        st.just("fault"),
        st.sampled_from([FaultKind.NONE, FaultKind.WATCHDOG_TRIP, FaultKind.INTERLOCK_OPEN, FaultKind.STUCK_LIGHT]),
    ),
)


@given(st.lists(OPERATIONS, max_size=40))
def test_no_light_without_a_fed_watchdog_and_a_closed_interlock(operations: list[tuple[str, Any]]) -> None:
    model, now_s, fed_at_s = DomeModel(LIGHTS, WATCHDOG_S), 0.0, float("-inf")
    for what, argument in operations:
        if what == "wait":
            now_s += float(argument)
        model.advance(now_s)
        if what == "feed":
            model.write("holding", reg.KEEPALIVE.address, [1])
            fed_at_s = now_s
        elif what == "light":
            set_active(model, int(argument), 1000)
        elif what == "all":
            set_active(model, reg.ALL_LIGHTS, 1000)
        elif what in {"off", "reset"}:
            model.write("coil", (reg.ALL_OFF if what == "off" else reg.FAULT_RESET).address, [1])
        elif what == "fault":
            model.write("holding", reg.FAULT_ORDER.address, [int(argument), 3, 1, reg.ANY_SPACE, 0])
        model.advance(now_s)
        if (
            now_s >= fed_at_s + WATCHDOG_S
            or model.values(reg.INTERLOCK_CLOSED) == [0]
            or model.values(reg.FAULTS) != [0]
        ):
            assert not any(model.outputs())


def test_the_fast_path_changes_one_light_and_clears_the_rest() -> None:
    model = fed_model()
    assert set_active(model, 3, 500) == 0
    assert set_active(model, 7, 900) == 0
    assert [k for k, level in enumerate(model.outputs()) if level] == [21, 22, 23]
    assert set_active(model, reg.NO_LIGHT, 900) == 0
    assert not any(model.outputs())


def test_watchdog_goes_dark_and_stays_so_until_reset() -> None:
    model = fed_model()
    set_active(model, 3, 500)
    model.advance(WATCHDOG_S - 1e-6)
    assert any(model.outputs())
    model.advance(WATCHDOG_S)
    assert not any(model.outputs())
    assert FaultBit(model.values(reg.FAULTS)[0]) == FaultBit.WATCHDOG
    model.write("holding", reg.KEEPALIVE.address, [1])
    assert set_active(model, 3, 500) == DEVICE_FAILURE
    model.write("coil", reg.FAULT_RESET.address, [1])
    assert set_active(model, 3, 500) == 0


def test_strobe_ends_a_light_that_nobody_switches_off() -> None:
    model = fed_model()
    set_active(model, 3, 500, strobe_ms=200)
    model.advance(0.199)
    assert any(model.outputs())
    model.advance(0.2)
    assert not any(model.outputs())
    assert model.values(reg.FAULTS) == [0]


@pytest.mark.parametrize("light", [LIGHTS, 500])
def test_lights_that_are_not_fitted_are_refused(light: int) -> None:
    model = fed_model()
    assert set_active(model, light, 500) == ILLEGAL_VALUE
    assert model.write("holding", reg.LEVELS.address + 3 * LIGHTS, [1]) == ILLEGAL_VALUE
    assert not any(model.outputs())


@pytest.mark.parametrize("space", ["coil", "discrete", "holding", "input"])
def test_registers_of_a_space_do_not_overlap(space: str) -> None:
    ranges = sorted((r.address, r.end) for r in reg.TABLE if r.space == space)
    assert all(end <= start for (_, end), (start, _) in pairwise(ranges))
    assert reg.LEVELS.count == reg.OUTPUTS.count == 3 * reg.MAX_LIGHTS


def test_one_write_spans_the_fast_path() -> None:
    assert (reg.STROBE_MS.end, reg.ACTIVE_LIGHT.end) == (reg.ACTIVE_LIGHT.address, reg.ACTIVE_LEVEL.address)


def test_the_documentation_prints_the_register_table() -> None:
    page = Path(reg.__file__).with_name("REGISTERS.md")
    assert reg.markdown_table() in page.read_text()
