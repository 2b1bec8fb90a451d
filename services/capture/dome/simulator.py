"""The simulated dome: a real Modbus TCP server around ``DomeModel``, with faults on request.

Faults are requested through the register ``fault_order``, so that any process can do it, and everything below the
registers is real. The server runs alone (``serve_dome``), or as a child process that ends with its parent
(``simulated_dome``).
"""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from services.capture.dome import registers as reg
from services.capture.dome.modbus_link import UNIT, LinkError, ModbusLink
from services.capture.dome.model import DomeModel
from services.capture.dome.registers import FaultKind, Space
from services.core.errors import RigError

START_TIMEOUT_S = 30.0
"""Time that a simulated dome may take to start or to end, seconds."""
_SPACES: dict[int, Space] = {
    **dict.fromkeys((1, 5, 15), "coil"),
    2: "discrete",
    4: "input",
    **dict.fromkeys((3, 6, 16, 22, 23), "holding"),
}


def serve_dome(
    host: str, port: int, lights: int, watchdog_s: float, announce: Callable[[str, int], None] | None = None
) -> None:
    """Serve one simulated dome until SIGINT or SIGTERM.

    Args:
        host: address to listen on.
        port: port to listen on; 0 picks a free one.
        lights: number of RGB lights fitted, 1 to 155.
        watchdog_s: watchdog period at power-on, seconds; a driver sets its own.
        announce: called with host and port once requests are answered.

    Raises:
        RigError: the port cannot be opened, or the number of lights is out of range.
    """
    if not 1 <= lights <= reg.MAX_LIGHTS:
        raise RigError(
            f"A dome with {lights} lights cannot be simulated, the register map holds 1 to {reg.MAX_LIGHTS}; correct"
            " --lights."
        )
    asyncio.run(_serve(host, port, DomeModel(lights, watchdog_s), announce, with_parent=False))


@contextmanager
def simulated_dome(lights: int, watchdog_s: float = 2.0, host: str = "127.0.0.1") -> Iterator[tuple[str, int]]:
    """Run a simulated dome in a child process on a free port and yield its address. It ends with this process."""
    command = [
        sys.executable,
        "-m",
        "services.capture.dome.simulator",
        json.dumps({"host": host, "lights": lights, "watchdog_s": watchdog_s}),
    ]
    # Start a session of its own, so that Ctrl-C reaches only the driver, which still needs the dome to go dark.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True) as process:  # noqa: S603
        assert process.stdin is not None
        assert process.stdout is not None
        start_timer = threading.Timer(START_TIMEOUT_S, process.kill)
        start_timer.start()
        try:
            line = process.stdout.readline()
        finally:
            start_timer.cancel()
        try:
            if not line:
                raise RigError("The simulated dome did not start; run 'dentine dome-sim' to see why.")
            yield host, int(line)
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()
            with suppress(subprocess.TimeoutExpired):
                process.wait(START_TIMEOUT_S)
            process.kill()


def order_fault(
    host: str, port: int, kind: FaultKind, argument: int = 0, times: int = 1, on: reg.Register | None = None
) -> None:
    """Request a fault from the simulator at this address.

    Args:
        host, port: address of the simulator.
        kind: kind of the fault.
        argument: a light's index, a delay in milliseconds, or a Modbus exception code, depending on the kind.
        times: number of requests that are affected; faults of the dome itself stay until ``FaultKind.NONE``.
        on: affect only requests that touch this register's first address; None for all requests.

    Raises:
        RigError: the simulator does not accept the order.
    """
    link = ModbusLink(host, port, timeout_s=2.0)
    target = [reg.ANY_SPACE, 0] if on is None else [reg.SPACE_CODE[on.space], on.address]
    try:
        link.write(reg.FAULT_ORDER, [kind, argument, times, *target])
    except LinkError as problem:
        raise RigError(f"The fault cannot be ordered: {problem}; is a simulated dome running there?") from problem
    finally:
        link.close()


class _RequestHandler:
    """Adapter between the model and pymodbus: updates the registers before every request, and applies the ordered
    faults.
    """

    def __init__(self, model: DomeModel) -> None:
        self._model = model
        self._reply_fault = FaultKind.NONE

    async def action(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Handle one read or write; pymodbus calls this first."""
        space, span = _SPACES[function], count if values is None else len(values)
        is_order = space == "holding" and address == reg.FAULT_ORDER.address
        fault = FaultKind.NONE if is_order else self._model.order.take(space, address, span)
        if fault in {FaultKind.DROP_REPLY, FaultKind.DROP_REQUEST, FaultKind.WRONG_REPLY}:
            self._reply_fault = fault
        if fault is FaultKind.DELAY:
            await asyncio.sleep(self._model.order.argument / 1000)
        if fault is FaultKind.EXCEPTION:
            return ExcCodes(self._model.order.argument)
        if fault is FaultKind.DROP_REQUEST:
            return ExcCodes.DEVICE_BUSY
        self._model.advance(asyncio.get_running_loop().time())
        if values is not None:
            refusal = self._model.write(space, address, [int(value) for value in values])
            if refusal:
                return ExcCodes(refusal)
        self._refresh(space, start, registers)
        return None

    def packet(self, sending: bool, data: bytes) -> bytes:
        """Return a packet as it is or spoiled; pymodbus calls this with every packet on the wire."""
        if not sending or self._reply_fault is FaultKind.NONE:
            return data
        fault, self._reply_fault = self._reply_fault, FaultKind.NONE
        if fault is FaultKind.WRONG_REPLY:
            return data[:-1] + bytes([data[-1] ^ 0x5A])
        return b""

    def _refresh(self, space: Space, start: int, registers: list[int]) -> None:
        for register in (r for r in reg.TABLE if r.space == space):
            values = self._model.values(register)
            if space in {"coil", "discrete"}:
                mask = 1 << register.address % 16
                word = register.address // 16 - start
                registers[word] = registers[word] | mask if values[0] else registers[word] & ~mask
            else:
                registers[register.address - start : register.end - start] = values


async def _serve(
    host: str, port: int, model: DomeModel, announce: Callable[[str, int], None] | None, *, with_parent: bool
) -> None:
    handler, loop, stop = _RequestHandler(model), asyncio.get_running_loop(), asyncio.Event()
    coils, discretes = ([SimData(0, values=[False] * 16, datatype=DataType.BITS)] for _ in range(2))
    holdings, inputs = (
        [
            SimData(r.address, count=r.count, values=0, datatype=DataType.REGISTERS)
            for r in reg.TABLE
            if r.space == space
        ]
        for space in ("holding", "input")
    )
    device = SimDevice(id=UNIT, simdata=(coils, discretes, holdings, inputs), action=handler.action)
    server = ModbusTcpServer(device, address=(host, port), trace_packet=handler.packet)
    try:
        await server.serve_forever(background=True)
    except RuntimeError as problem:
        raise RigError(f"The simulated dome cannot listen on {host}:{port}; choose another port.") from problem
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
    if with_parent:
        await loop.connect_read_pipe(lambda: _Parent(stop), sys.stdin)
    if announce is not None:
        announce(host, server.transport.sockets[0].getsockname()[1])
    await stop.wait()
    await server.shutdown()


class _Parent(asyncio.Protocol):
    """Watches for the parent's end, at which the pipe on standard input closes."""

    def __init__(self, stop: asyncio.Event) -> None:
        self._stop = stop

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        """Stop the server when the pipe closes."""
        self._stop.set()


def _main() -> None:
    settings = json.loads(sys.argv[1])
    model = DomeModel(settings["lights"], settings["watchdog_s"])
    asyncio.run(_serve(settings["host"], 0, model, lambda _host, port: print(port, flush=True), with_parent=True))


if __name__ == "__main__":
    _main()
