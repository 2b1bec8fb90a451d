"""Behaviour of the simulated controller: registers in, light out; time is given from outside, and there is no I/O.

::

    supply on  =  watchdog fed in time  and  no latched fault  and  interlock closed  and  emergency stop released
    output     =  level if supply on else 0

A level above 0 is refused while the supply is off. If the watchdog expires while a light is on, every level becomes 0
and the fault is latched; if it expires in the dark, it only opens the supply until the next feed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from services.capture.dome import registers as reg
from services.capture.dome.registers import FaultBit, FaultKind, Register, Space

ILLEGAL_VALUE = 3
"""Modbus exception code of a value that is out of range."""
DEVICE_FAILURE = 4
"""Modbus exception code of a write that the device cannot carry out."""
AMBIENT_DEGC = 24.0
"""Temperature of a bank without current, degrees Celsius."""
FULL_LED_MA = 350.0
"""Current of one LED at full scale, mA."""


@dataclass
class FaultOrder:
    """A fault that applies to the next ``times`` requests that touch ``address`` of a space."""

    kind: FaultKind = FaultKind.NONE
    argument: int = 0
    times: int = 0
    space: int = reg.ANY_SPACE
    address: int = 0

    def take(self, space: Space, address: int, count: int) -> FaultKind:
        """Return the fault for this request, NONE if there is none, and count it."""
        is_affected = self.space == reg.ANY_SPACE or (
            self.space == reg.SPACE_CODE[space] and address <= self.address < address + count
        )
        if self.times == 0 or not is_affected:
            return FaultKind.NONE
        self.times -= 1
        return self.kind


class DomeModel:
    """State of one controller with ``lights`` RGB lights."""

    def __init__(self, lights: int, watchdog_s: float) -> None:
        self.lights = lights
        self.order = FaultOrder()
        self._holding = {r.name: [0] * r.count for r in reg.TABLE if r.space == "holding"}
        self._holding[reg.WATCHDOG_MS.name] = [round(1000 * watchdog_s)]
        self._holding[reg.ACTIVE_LIGHT.name] = [reg.NO_LIGHT]
        self._latched = FaultBit(0)
        self._interlock_open = self._stop_pressed = self._too_hot = False
        self._stuck: dict[int, int] = {}
        self._dead: set[int] = set()
        self._triggers = 0
        self._fed_until_s = self._strobe_until_s = float("-inf")
        self._now_s = 0.0

    @property
    def _levels(self) -> list[int]:
        return self._holding[reg.LEVELS.name]

    @property
    def supply_on(self) -> bool:
        """Whether the LED supply relay is closed."""
        return self._now_s < self._fed_until_s and not self._latched

    def advance(self, now_s: float) -> None:
        """Advance the time and update strobe, watchdog and interlock."""
        self._now_s = now_s
        if now_s >= self._strobe_until_s:
            self._go_dark()
        if now_s >= self._fed_until_s and any(self._levels):
            self._latched |= FaultBit.WATCHDOG
        self._latched |= self._causes()
        if self._latched:
            self._go_dark()

    def outputs(self) -> list[int]:
        """Emitted R, G, B of every light."""
        if not self.supply_on:
            return [0] * reg.OUTPUTS.count
        emitted = list(self._levels)
        for light, level in self._stuck.items():
            emitted[3 * light : 3 * light + 3] = [level] * 3
        for light in self._dead:
            emitted[3 * light : 3 * light + 3] = [0] * 3
        return emitted

    def values(self, register: Register) -> list[int]:
        """Present values of a register."""
        if register.space == "holding":
            return self._holding[register.name]
        if register.space == "coil":
            return [0]
        sensors: dict[Register, Callable[[], list[int]]] = {
            reg.IDENTITY: lambda: [reg.IDENTITY_VALUE],
            reg.FIRMWARE: lambda: [reg.FIRMWARE_MAJOR << 8],
            reg.LIGHT_COUNT: lambda: [self.lights],
            reg.FAULTS: lambda: [int(self._latched)],
            reg.TRIGGER_COUNT: lambda: [self._triggers],
            reg.BANK_TEMPERATURE: lambda: [round(10 * (AMBIENT_DEGC + 0.01 * ma)) for ma in self._bank_currents_ma()],
            reg.BANK_CURRENT: lambda: [round(ma) for ma in self._bank_currents_ma()],
            reg.OUTPUTS: self.outputs,
            reg.INTERLOCK_CLOSED: lambda: [int(not self._interlock_open)],
            reg.EMERGENCY_STOP: lambda: [int(self._stop_pressed)],
            reg.SUPPLY_ON: lambda: [int(self.supply_on)],
        }
        return sensors[register]()

    def write(self, space: str, address: int, values: list[int]) -> int:
        """Carry out a write and return a Modbus exception code, 0 for none. A refused write changes nothing."""
        holding = {name: list(old) for name, old in self._holding.items()}
        touched: set[str] = set()
        for register in (r for r in reg.TABLE if r.space == space):
            first, last = max(address, register.address), min(address + len(values), register.end)
            if first < last:
                touched.add(register.name)
                if space == "holding":
                    holding[register.name][first - register.address : last - register.address] = values[
                        first - address : last - address
                    ]
        if space == "coil":
            return self._pulse(touched) if values[0] else 0
        if reg.ACTIVE_LIGHT.name in touched:
            active = holding[reg.ACTIVE_LIGHT.name][0]
            if active >= self.lights and active not in {reg.ALL_LIGHTS, reg.NO_LIGHT}:
                return ILLEGAL_VALUE
            holding[reg.LEVELS.name] = self._fast_path(active, holding[reg.ACTIVE_LEVEL.name])
            touched.add(reg.LEVELS.name)
        if any(holding[reg.LEVELS.name][3 * self.lights :]):
            return ILLEGAL_VALUE
        if reg.LEVELS.name in touched and any(holding[reg.LEVELS.name]):
            if not self.supply_on:
                return DEVICE_FAILURE
            strobe_ms = holding[reg.STROBE_MS.name][0]
            self._strobe_until_s = self._now_s + strobe_ms / 1000 if strobe_ms else float("inf")
        self._holding = holding
        if reg.KEEPALIVE.name in touched:
            self._fed_until_s = self._now_s + holding[reg.WATCHDOG_MS.name][0] / 1000
        if reg.FAULT_ORDER.name in touched:
            self._apply_order(
                FaultOrder(FaultKind(holding[reg.FAULT_ORDER.name][0]), *holding[reg.FAULT_ORDER.name][1:])
            )
        return 0

    def _fast_path(self, active: int, rgb: list[int]) -> list[int]:
        return [
            rgb[k % 3] if k < 3 * self.lights and (active in {k // 3, reg.ALL_LIGHTS}) and active != reg.NO_LIGHT else 0
            for k in range(reg.LEVELS.count)
        ]  # fmt: skip

    def _pulse(self, touched: set[str]) -> int:
        if reg.ALL_OFF.name in touched:
            self._go_dark()
        if reg.EXPOSURE_TRIGGER.name in touched:
            self._triggers = (self._triggers + 1) & 0xFFFF
        if reg.FAULT_RESET.name in touched:
            self._latched = self._causes()
        return 0

    def _go_dark(self) -> None:
        self._holding[reg.LEVELS.name] = [0] * reg.LEVELS.count
        self._strobe_until_s = float("inf")

    def _causes(self) -> FaultBit:
        causes = FaultBit(0)
        causes |= FaultBit.INTERLOCK if self._interlock_open else causes
        causes |= FaultBit.EMERGENCY_STOP if self._stop_pressed else causes
        causes |= FaultBit.TEMPERATURE if self._too_hot else causes
        return causes

    def _apply_order(self, order: FaultOrder) -> None:
        self.order = FaultOrder()
        if order.kind is FaultKind.NONE:
            self._stuck.clear()
            self._dead.clear()
            self._interlock_open = self._stop_pressed = self._too_hot = False
        elif order.kind is FaultKind.STUCK_LIGHT:
            self._stuck[order.argument] = reg.FULL_SCALE
        elif order.kind is FaultKind.DEAD_LIGHT:
            self._dead.add(order.argument)
        elif order.kind is FaultKind.WATCHDOG_TRIP:
            self._latched |= FaultBit.WATCHDOG
        elif order.kind is FaultKind.INTERLOCK_OPEN:
            self._interlock_open = True
        elif order.kind is FaultKind.EMERGENCY_STOP:
            self._stop_pressed = True
        elif order.kind is FaultKind.OVER_TEMPERATURE:
            self._too_hot = True
        else:
            self.order = order
        self.advance(self._now_s)

    def _bank_currents_ma(self) -> list[float]:
        emitted, per_bank = self.outputs(), 3 * reg.LIGHTS_PER_BANK
        return [
            FULL_LED_MA * sum(emitted[bank * per_bank : (bank + 1) * per_bank]) / reg.FULL_SCALE
            for bank in range(reg.MAX_BANKS)
        ]
