"""Thread that feeds the controller's watchdog while the host is alive."""

from __future__ import annotations

import threading
import time

from services.capture.dome.modbus_link import LinkError, ModbusLink
from services.capture.dome.registers import ALL_OFF, KEEPALIVE
from services.core.errors import RigError

FEEDS_PER_WATCHDOG = 5
"""Number of feeds in one watchdog period."""


class KeepAlive:
    """Thread that feeds the watchdog over its own connection, so that a slow transaction elsewhere cannot delay it."""

    def __init__(self, link: ModbusLink, watchdog_s: float) -> None:
        self._link = link
        self._watchdog_s = watchdog_s
        self._fed_at_s = float("-inf")
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._problem: LinkError | None = None

    def start(self) -> None:
        """Feed once, then keep feeding."""
        self._link.write(KEEPALIVE, [1])
        self._fed_at_s = time.monotonic()
        self._thread = threading.Thread(target=self._feed, name="dome keep-alive", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop feeding; the controller goes dark within its watchdog period."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._link.close()

    def darken(self) -> None:
        """Order all off over this connection, which no slow transaction of the driver holds.

        Raises:
            LinkError: the order may or may not have been carried out.
        """
        self._link.write(ALL_OFF, [1])

    def require_alive(self) -> None:
        """Raise RigError if no feed has succeeded for a watchdog period."""
        if self._stop.is_set() or time.monotonic() > self._fed_at_s + self._watchdog_s:
            raise RigError(
                f"The dome's watchdog is no longer fed ({self._problem or 'stopped'}); check the network and run again."
            )

    def _feed(self) -> None:
        while not self._stop.wait(self._watchdog_s / FEEDS_PER_WATCHDOG):
            try:
                self._link.write(KEEPALIVE, [1])
                self._fed_at_s = time.monotonic()
            except LinkError as problem:
                self._problem = problem
