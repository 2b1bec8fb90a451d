"""Read access to a dome's controller without driving the dome: its state and the light it emits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.capture.dome import registers as reg
from services.capture.dome.modbus_link import LinkError, ModbusLink, NoReplyError
from services.core.dome import DomeStatus
from services.core.errors import RigError, RigUnreachableError

REPLY_TIMEOUT_S = 0.5
DARK_ATTEMPTS = 3
"""Number of times that a dome is ordered to go dark before a person is asked to cut its power."""


class OtherDeviceError(LinkError):
    """The device that answers is not a dome controller; nothing is written to it."""


class DomeObserver:
    """Read-only observer of the dome's light, over a connection of its own; it never feeds the watchdog."""

    def __init__(self, host: str, port: int) -> None:
        self._link = ModbusLink(host, port, REPLY_TIMEOUT_S)
        self._lights = self._read(reg.LIGHT_COUNT)[0]

    def outputs(self) -> NDArray[np.float64]:
        """Present output (light, 3) of each LED as a fraction of full scale."""
        return np.asarray(self._read(reg.OUTPUTS, 3 * self._lights), dtype=np.float64).reshape(-1, 3) / reg.FULL_SCALE

    def trigger_count(self) -> int:
        """Exposure triggers since power-on, modulo 65536."""
        return self._read(reg.TRIGGER_COUNT)[0]

    def faults(self) -> reg.FaultBit:
        """Faults that are latched in the controller."""
        return reg.FaultBit(self._read(reg.FAULTS)[0])

    def status(self) -> DomeStatus:
        """The controller's state."""
        try:
            return read_status(self._link)
        except LinkError as problem:
            raise self._blind(problem) from problem

    def close(self) -> None:
        """Drop the connection."""
        self._link.close()

    def _blind(self, problem: LinkError) -> RigError:
        self._link.close()
        return error_kind(problem)(f"The dome cannot be observed: {problem}; check its power and network.")

    def _read(self, register: reg.Register, count: int | None = None) -> list[int]:
        try:
            return self._link.read(register, count)
        except LinkError as problem:
            raise self._blind(problem) from problem


def require_dome(link: ModbusLink, *, repeated: bool = True) -> None:
    """Check that a device is a dome's controller; ``repeated`` asks again if it does not reply.

    Raises:
        OtherDeviceError: it is another device. LinkError: it does not answer the question.
    """
    if link.read(reg.IDENTITY, repeated=repeated)[0] != reg.IDENTITY_VALUE:
        raise OtherDeviceError(f"the device at {link.address} is no dome controller")


def read_status(link: ModbusLink) -> DomeStatus:
    """Read the controller's state, register by register.

    Raises:
        LinkError: the state cannot be read, or the device is not a dome.
    """
    require_dome(link)
    firmware, lights = link.read(reg.FIRMWARE)[0], min(link.read(reg.LIGHT_COUNT)[0], reg.MAX_LIGHTS)
    closed, pressed, supply = link.read(reg.INTERLOCK_CLOSED, 3)
    banks = -(-lights // reg.LIGHTS_PER_BANK)
    outputs = np.asarray(link.read(reg.OUTPUTS, 3 * lights)).reshape(-1, 3)
    return DomeStatus(
        firmware=f"{firmware >> 8}.{firmware & 0xFF}",
        light_count=lights,
        interlock_closed=bool(closed),
        emergency_stop=bool(pressed),
        supply_on=bool(supply),
        stopped=link.read(reg.WATCHDOG_MS)[0] == reg.STOPPED_MS,
        faults=fault_names(reg.FaultBit(link.read(reg.FAULTS)[0])),
        lit=tuple(int(light) for light in np.flatnonzero(outputs.any(axis=1))),
        temperature_degc=tuple(tenths / 10 for tenths in link.read(reg.BANK_TEMPERATURE, banks)),
        current_ma=tuple(link.read(reg.BANK_CURRENT, banks)),
    )


def error_kind(problem: Exception | None) -> type[RigError]:
    """Class of the error that reports a failure of the link.

    A missing reply has a class of its own, because such a dome may still be lit.
    """
    return RigUnreachableError if isinstance(problem, NoReplyError) else RigError


def fault_names(faults: reg.FaultBit) -> tuple[str, ...]:
    """Names of the latched faults in words."""
    return tuple(bit.name.lower().replace("_", " ") for bit in reg.FaultBit if bit in faults and bit.name)
