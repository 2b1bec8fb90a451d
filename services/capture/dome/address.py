"""Network address of a dome."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from services.core.errors import SettingsError
from services.core.records import SIMULATED_DOME


@contextmanager
def dome_address(address: str, lights: int, watchdog_s: float) -> Iterator[tuple[str, int]]:
    """Yield host and port of a dome; the address 'simulated' starts a simulated dome for the time of the block.

    Args:
        address: 'simulated' or host:port.
        lights: number of lights of a simulated dome.
        watchdog_s: watchdog period of a simulated dome at power-on, seconds.

    Raises:
        SettingsError: the address is neither 'simulated' nor host:port.
    """
    if address == SIMULATED_DOME:
        from services.capture.dome.simulator import simulated_dome

        with simulated_dome(lights, watchdog_s) as address_of_server:
            yield address_of_server
        return
    host, separator, port = address.rpartition(":")
    if not (separator and host and port.isdigit()):
        raise SettingsError(f"rig.dome '{address}' is neither 'simulated' nor host:port; correct it.")
    yield host, int(port)
