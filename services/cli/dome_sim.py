"""``dentine dome-sim``: a simulated controller of a dome."""

from __future__ import annotations

from typing import Annotated

import typer


def dome_sim(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 picks a free one.")] = 5020,
    lights: Annotated[int, typer.Option(min=1, help="Number of lights.")] = 155,
    watchdog_s: Annotated[
        float, typer.Option(min=0.05, help="Seconds without a request until the dome goes dark.")
    ] = 2.0,
) -> None:
    """Simulate a dome's Modbus controller."""
    from services.capture.dome.simulator import serve_dome

    serve_dome(host, port, lights, watchdog_s)
