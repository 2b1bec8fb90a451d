"""One Modbus TCP connection that is honest about what it does not know.

Facts about the library that shape it: a timeout leaves the connection open and a late answer in its buffer; its retries
send a write again; it checks neither the request's length nor the echoed address. So every timeout closes the
connection, reads alone are repeated, and lengths and echoes are checked here.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from services.capture.dome.registers import Register

MAX_READ = 125
MAX_WRITE = 123
UNIT = 1


class LinkError(Exception):
    """A transaction did not end as it should; the driver turns it into a RigError once the lights are dark."""


class NoReplyError(LinkError):
    """Nothing came back in time: a write may or may not have happened."""


class RefusedError(LinkError):
    """The controller answered with an exception code: a write has not happened."""


class WrongReplyError(LinkError):
    """The answer does not belong to the question: a write may or may not have happened."""


class ModbusLink:
    """Registers of one controller, one transaction at a time, from any thread."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self.address = f"{host}:{port}"
        library_log = logging.getLogger("pymodbus")
        if not library_log.handlers:
            library_log.addHandler(logging.NullHandler())
        self._client = ModbusTcpClient(host, port=port, timeout=timeout_s, retries=0)
        self._lock = threading.RLock()

    def read(self, register: Register, count: int | None = None, *, repeated: bool = True) -> list[int]:
        """First ``count`` values of a register, in requests of at most 125; unless told not to, repeated once over a
        new connection.
        """
        total = register.count if count is None else count
        values: list[int] = []
        for start in range(0, total, MAX_READ):
            share = min(MAX_READ, total - start)
            try:
                values += self._read_once(register, register.address + start, share)
            except (NoReplyError, WrongReplyError):
                if not repeated:
                    raise
                values += self._read_once(register, register.address + start, share)
        return values

    def write(self, register: Register, values: list[int]) -> None:
        """Write from the register's first address on, running into the registers behind it; sent once, never repeated.

        Raises:
            NoReplyError, RefusedError, WrongReplyError.
        """
        if register.space == "coil":
            answer = self._transact(
                register, partial(self._client.write_coil, register.address, bool(values[0]), device_id=UNIT)
            )
            if answer.address != register.address:
                self._discard(register, "echoes another address")
            return
        for start in range(0, len(values), MAX_WRITE):
            address, share = register.address + start, values[start : start + MAX_WRITE]
            answer = self._transact(register, partial(self._client.write_registers, address, share, device_id=UNIT))
            if (answer.address, answer.count) != (address, len(share)):
                self._discard(register, "echoes another address or count")

    def close(self) -> None:
        """Drop the connection; the next transaction opens a new one."""
        with self._lock:
            self._client.close()

    def _read_once(self, register: Register, address: int, count: int) -> list[int]:
        request = {
            "input": self._client.read_input_registers,
            "holding": self._client.read_holding_registers,
            "discrete": self._client.read_discrete_inputs,
            "coil": self._client.read_coils,
        }[register.space]
        answer = self._transact(register, partial(request, address, count=count, device_id=UNIT))
        values = answer.registers if register.space in {"input", "holding"} else answer.bits[:count]
        if len(values) != count:
            self._discard(register, f"has {len(values)} values instead of {count}")
        return [int(value) for value in values]

    def _transact(self, register: Register, request: Callable[[], Any]) -> Any:
        with self._lock:
            try:
                answer = request()
            except (ModbusException, OSError) as problem:
                self._client.close()
                raise NoReplyError(f"the controller at {self.address} does not answer for {register.name}") from problem
            if answer.isError():
                raise RefusedError(
                    f"the controller at {self.address} refuses {register.name} with Modbus exception"
                    f" {answer.exception_code}"
                )
            return answer

    def _discard(self, register: Register, what: str) -> None:
        self.close()
        raise WrongReplyError(f"the answer of {self.address} for {register.name} {what}")
