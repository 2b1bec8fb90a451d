"""Modbus register map of the dome controller: one typed table for driver, simulator and documentation.

Every level has 16 bits, and 65535 is full scale. ``LEVELS`` holds the commanded levels. ``OUTPUTS`` holds the levels
that the LEDs emit after supply relay, faults and watchdog. A light is confirmed only when both agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Literal

Space = Literal["coil", "discrete", "holding", "input"]
SPACE_CODE: dict[Space, int] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
ANY_SPACE = 0

MAX_LIGHTS = 155
LIGHTS_PER_BANK = 16
MAX_BANKS = -(-MAX_LIGHTS // LIGHTS_PER_BANK)
FULL_SCALE = 0xFFFF
IDENTITY_VALUE = 0xDE17
FIRMWARE_MAJOR = 1
NO_LIGHT = 0xFFFF
ALL_LIGHTS = 0xFFFE
STOPPED_MS = 0


class FaultBit(IntFlag):
    """Bits of ``FAULTS``. Any latched bit keeps the supply relay open until ``FAULT_RESET``."""

    WATCHDOG = 1
    INTERLOCK = 2
    EMERGENCY_STOP = 4
    TEMPERATURE = 8
    CURRENT = 16


class FaultKind(IntEnum):
    """Kinds of faults that ``FAULT_ORDER`` triggers in the simulator; a real controller has no such register."""

    NONE = 0
    DROP_REPLY = 1
    DROP_REQUEST = 2
    DELAY = 3
    EXCEPTION = 4
    WRONG_REPLY = 5
    STUCK_LIGHT = 6
    DEAD_LIGHT = 7
    WATCHDOG_TRIP = 8
    INTERLOCK_OPEN = 9
    EMERGENCY_STOP = 10
    OVER_TEMPERATURE = 11


@dataclass(frozen=True)
class Register:
    """One named range of the map.

    Attributes:
        name: name of the register.
        space: Modbus data block; coil and holding can be written.
        address: first address, counted from zero as in the request.
        count: number of addresses in the range.
        unit: unit of each value; '1' for plain numbers.
        meaning: text for the documentation.
    """

    name: str
    space: Space
    address: int
    count: int
    unit: str
    meaning: str

    @property
    def end(self) -> int:
        """Address after the last one."""
        return self.address + self.count


IDENTITY = Register("identity", "input", 0, 1, "1", f"always 0x{IDENTITY_VALUE:04X}")
FIRMWARE = Register("firmware", "input", 1, 1, "1", f"major x 256 + minor; this map is major {FIRMWARE_MAJOR}")
LIGHT_COUNT = Register("light_count", "input", 2, 1, "1", f"lights fitted, at most {MAX_LIGHTS}")
FAULTS = Register(
    "faults",
    "input",
    3,
    1,
    "bits",
    ", ".join(f"{bit.value} {bit.name.lower().replace('_', ' ')}" for bit in FaultBit if bit.name),
)
TRIGGER_COUNT = Register("trigger_count", "input", 4, 1, "1", "exposure triggers since power-on, modulo 65536")
BANK_TEMPERATURE = Register(
    "bank_temperature", "input", 16, MAX_BANKS, "0.1 degC", f"heat sink of each bank of {LIGHTS_PER_BANK} lights"
)
BANK_CURRENT = Register("bank_current", "input", 32, MAX_BANKS, "mA", "supply current of each bank")
OUTPUTS = Register(
    "outputs", "input", 1000, 3 * MAX_LIGHTS, "1/65535", "light emitted now: R, G, B of light 0, of light 1, ..."
)

INTERLOCK_CLOSED = Register("interlock_closed", "discrete", 0, 1, "1", "1 when the interlock loop is closed")
EMERGENCY_STOP = Register("emergency_stop", "discrete", 1, 1, "1", "1 when the emergency stop is pressed")
SUPPLY_ON = Register(
    "supply_on",
    "discrete",
    2,
    1,
    "1",
    "1 when the LED supply relay is closed: watchdog fed, no fault, interlock closed",
)

ALL_OFF = Register("all_off", "coil", 0, 1, "1", "write 1: every level becomes 0; reads 0")
EXPOSURE_TRIGGER = Register(
    "exposure_trigger", "coil", 1, 1, "1", "write 1: pulse on the cameras' trigger line; reads 0"
)
FAULT_RESET = Register(
    "fault_reset", "coil", 2, 1, "1", "write 1: clear latched faults whose cause is gone; levels stay 0; reads 0"
)

KEEPALIVE = Register("keepalive", "holding", 0, 1, "1", "any write feeds the watchdog; nothing else does")
WATCHDOG_MS = Register(
    "watchdog_ms",
    "holding",
    1,
    1,
    "ms",
    f"go dark when not fed for this long; {STOPPED_MS} keeps the supply open whatever is fed (ALL OFF)",
)
STROBE_MS = Register(
    "strobe_ms", "holding", 16, 1, "ms", "a level goes dark by itself this long after it was written; 0 for no limit"
)
ACTIVE_LIGHT = Register(
    "active_light",
    "holding",
    17,
    1,
    "1",
    f"fast path: on write this light takes active_level and all others 0; {ALL_LIGHTS} all, {NO_LIGHT} none",
)
ACTIVE_LEVEL = Register(
    "active_level",
    "holding",
    18,
    3,
    "1/65535",
    "R, G, B of the fast path; written in one transaction with active_light",
)
LEVELS = Register("levels", "holding", 1000, 3 * MAX_LIGHTS, "1/65535", "commanded R, G, B of light 0, of light 1, ...")
FAULT_ORDER = Register(
    "fault_order",
    "holding",
    9000,
    5,
    "1",
    "simulator only: kind, argument, times; space (1 coil, 2 discrete, 3 holding, 4 input, 0 any) and address of the"
    " requests meant",
)

TABLE: tuple[Register, ...] = (
    IDENTITY, FIRMWARE, LIGHT_COUNT, FAULTS, TRIGGER_COUNT, BANK_TEMPERATURE, BANK_CURRENT, OUTPUTS,
    INTERLOCK_CLOSED, EMERGENCY_STOP, SUPPLY_ON,
    ALL_OFF, EXPOSURE_TRIGGER, FAULT_RESET,
    KEEPALIVE, WATCHDOG_MS, STROBE_MS, ACTIVE_LIGHT, ACTIVE_LEVEL, LEVELS, FAULT_ORDER,
)  # fmt: skip


def level_word(level: float) -> int:
    """Register value of a level in [0, 1]."""
    return round(level * FULL_SCALE)


def markdown_table() -> str:
    """The map as a Markdown table, as printed in REGISTERS.md."""
    rows = ["| register | space | address | count | unit | meaning |", "|---|---|---|---|---|---|"]
    rows += [f"| {r.name} | {r.space} | {r.address} | {r.count} | {r.unit} | {r.meaning} |" for r in TABLE]
    return "\n".join(rows)
