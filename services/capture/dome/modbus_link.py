"""Modbus TCP connection whose errors state whether a write may have been carried out.

Three properties of the library require this: a timeout leaves the connection open and a late answer in its buffer; its
retries send a write again; and it checks neither the length of an answer nor the echoed address. So here every timeout
closes the connection, only reads are repeated, and lengths and echoes are checked.
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
    """A transaction failed; the driver turns it into a RigError once the lights are dark."""


class NoReplyError(LinkError):
    """No answer came in time: a write may or may not have been carried out."""


class RefusedError(LinkError):
    """The controller answered with an exception code: a write has not been carried out."""


class WrongReplyError(LinkError):
    """The answer does not match the request: a write may or may not have been carried out."""


class ModbusLink:
    """Access to one controller's registers, one transaction at a time, from any thread."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self.address = f"{host}:{port}"
        library_log = logging.getLogger("pymodbus")
        if not library_log.handlers:
            library_log.addHandler(logging.NullHandler())
        self._client = ModbusTcpClient(host, port=port, timeout=timeout_s, retries=0)
        self._lock = threading.RLock()

    def read(self, register: Register, count: int | None = None, *, repeated: bool = True) -> list[int]:
        """Read the first ``count`` values of a register, in requests of at most 125 values.

        With ``repeated`` a request without a valid answer is repeated once over a new connection.

        Raises:
            NoReplyError, RefusedError, WrongReplyError.
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
        """Write values from the register's first address on; more values than it holds go to the registers after it.

        Each request is sent once and never repeated.

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
