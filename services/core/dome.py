"""The messages on the pipe between a server and the process that works its dome by hand."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.core.geometry import Record
from services.core.records import RigSpec


class DomeStatus(Record):
    """A snapshot for people: preflight, dashboard."""

    firmware: str
    light_count: int
    interlock_closed: bool
    emergency_stop: bool = Field(description="whether the emergency stop is pressed")
    supply_on: bool = Field(
        description="whether the relay of the LED supply is closed; it is while a driver feeds the watchdog"
    )
    stopped: bool = Field(
        description=(
            "whether ALL OFF holds: no light goes on until somebody starts a capture, a preflight or a light anew"
        )
    )
    faults: tuple[str, ...]
    lit: tuple[int, ...] = Field(description="indices of the lights that emit now")
    temperature_degc: tuple[float, ...] = Field(description="of each bank")
    current_ma: tuple[int, ...] = Field(description="of each bank")


class DomeCommand(Record):
    """A command to the process that works the dome: one line on its standard input."""

    number: int = Field(description="grows; what was asked before an ALL OFF is not done after it")
    do: Literal["status", "off", "light", "dark", "preflight"]
    light: int = 0
    level: float = 0.0
    on_s: float = 0.0
    rig: RigSpec | None = None


class DomeAnswer(Record):
    """The result of a command: one line on the process's standard output."""

    number: int
    status: DomeStatus | None = None
    findings: tuple[str, ...] = ()
    code: str | None = Field(default=None, description="of the error that it ended in")
    message: str = ""
