"""A device at the dome's address that identifies itself as something else is only read, never written to."""

from __future__ import annotations

import socketserver
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from services.capture.dome import registers as reg
from services.capture.dome.all_off import all_off
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.core.errors import RigError, RigUnreachableError

READ_INPUT = 4
ILLEGAL_ADDRESS = 2
Address = tuple[str, int]
Request = tuple[int, int]
ALL_OFF_WRITTEN: Request = (5, reg.ALL_OFF.address)


class Device(socketserver.ThreadingTCPServer):
    """A device that speaks Modbus TCP and records (function, address) of every request.

    Args:
        identities: answers to requests for the identity, in order; the last one is repeated. None stands for no answer,
            0 for the exception "illegal address".
    """

    allow_reuse_address = daemon_threads = True

    def __init__(self, *identities: int | None) -> None:
        super().__init__(("127.0.0.1", 0), _Conversation)
        self.identities, self.asked = list(identities), list[Request]()

    @property
    def address(self) -> Address:
        return "127.0.0.1", self.server_address[1]

    @property
    def written(self) -> list[Request]:
        return [request for request in self.asked if request[0] > READ_INPUT]

    def answer(self, request: bytes) -> bytes | None:
        """The answer to a request; both begin with the function code."""
        function, address, count = struct.unpack(">BHH", request[:5])
        self.asked.append((function, address))
        if (function, address) == (READ_INPUT, reg.IDENTITY.address):
            identity = self.identities.pop(0) if len(self.identities) > 1 else self.identities[0]
            if not identity:
                return identity if identity is None else struct.pack(">BB", function | 0x80, ILLEGAL_ADDRESS)
            return struct.pack(">BBH", function, 2, identity)
        return struct.pack(">BB", function, 2 * count) + bytes(2 * count) if function <= READ_INPUT else request[:5]


class _Conversation(socketserver.StreamRequestHandler):
    server: Device

    def handle(self) -> None:
        while len(head := self.rfile.read(6)) == 6:
            number, _, length = struct.unpack(">HHH", head)
            unit, *request = self.rfile.read(length)
            answer = self.server.answer(bytes(request))
            if answer is not None:
                self.wfile.write(struct.pack(">HHHB", number, 0, 1 + len(answer), unit) + answer)


@contextmanager
def device(*identities: int | None) -> Iterator[Device]:
    with Device(*identities) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def drive(host: str, port: int) -> None:
    with ModbusDome(host, port, ExposureBudget(1, 1)):
        pytest.fail("entered what is no dome")


@pytest.mark.parametrize("use", [drive, all_off])
def test_a_device_of_another_identity_gets_no_write(use: Callable[[str, int], object]) -> None:
    with device(0x1234) as plc, pytest.raises(RigError, match=r"no dome controller|not answer as a dome controller"):
        use(*plc.address)
    assert plc.asked
    assert plc.written == []


def test_a_device_without_an_identity_is_not_driven() -> None:
    with device(0) as plc, pytest.raises(RigError, match="does not answer as a dome controller; correct rig"):
        drive(*plc.address)
    assert plc.written == []


@pytest.mark.parametrize("first", [None, 0])
def test_all_off_switches_off_before_it_is_told_what_it_is(first: int | None) -> None:
    with device(first, reg.IDENTITY_VALUE) as dome:
        assert all_off(*dome.address).lit == ()
    assert dome.asked[:2] == [(READ_INPUT, reg.IDENTITY.address), ALL_OFF_WRITTEN]


def test_a_driver_goes_dark_where_the_identity_gets_no_answer() -> None:
    with (
        device(None) as silent,
        pytest.raises(RigUnreachableError, match="does not answer for identity; lights were switched off"),
    ):
        drive(*silent.address)
    assert ALL_OFF_WRITTEN in silent.written


def test_all_off_asks_again_where_an_answer_was_spoilt() -> None:
    with device(reg.IDENTITY_VALUE ^ 0x5A, reg.IDENTITY_VALUE) as dome:
        assert all_off(*dome.address).lit == ()
    assert dome.written[0] == ALL_OFF_WRITTEN
