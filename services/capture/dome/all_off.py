"""ALL OFF: darkens a dome independently of the process that drives it."""

from __future__ import annotations

from contextlib import closing, suppress

from services.capture.dome import registers as reg
from services.capture.dome.controller import DARK_ATTEMPTS, REPLY_TIMEOUT_S, error_kind, read_status, require_dome
from services.capture.dome.modbus_link import LinkError, ModbusLink, NoReplyError, RefusedError, WrongReplyError
from services.core.dome import DomeStatus

IDENTITY_TIMEOUT_S = 0.1
"""Time in seconds that ALL OFF waits for the answer whether the device is a dome. A dome on a network of its own
answers in milliseconds, and one that is late may be lit."""


def all_off(host: str, port: int) -> DomeStatus:
    """Switch off every light of a dome, and keep its supply relay open until a driver arms the watchdog anew.

    It acts over a connection of its own, so no matter which process drives the dome.

    Raises:
        RigError: darkness could not be confirmed.
    """
    link, asker = ModbusLink(host, port, REPLY_TIMEOUT_S), ModbusLink(host, port, IDENTITY_TIMEOUT_S)
    problem: Exception | None = None
    try:
        for _ in range(DARK_ATTEMPTS):
            try:
                with suppress(NoReplyError, RefusedError, WrongReplyError), closing(asker):
                    require_dome(asker, repeated=False)
                link.write(reg.ALL_OFF, [1])
                link.write(reg.KEEPALIVE, [1, reg.STOPPED_MS])
                status = read_status(link)
            except LinkError as failure:
                link.close()
                problem = failure
                continue
            if not status.lit:
                return status
            problem = LinkError(f"light {status.lit[0]} still emits")
    finally:
        link.close()
    raise error_kind(problem)(
        f"The dome at {host}:{port} is not confirmed dark ({problem}); press its emergency stop or cut its power."
    ) from problem
