"""What ``dentine worker`` loads into each of its Dask workers (``--preload services.pipeline.worker_setup``).

A worker claims what it can do by Dask resources (``services.core.placement``). Before it takes tasks each claim is
checked by a process of its own; what the machine does not bear out is withdrawn and told, in the log and to the
scheduler, and no task that needs it is given to this worker.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any

from distributed import WorkerPlugin
from tornado.ioloop import PeriodicCallback

from services.pipeline.worker_check import CHECKS, fault_of
from services.pipeline.worker_health import SIGN_S, Sign
from services.pipeline.workers import TOLD


async def dask_setup(worker: Any) -> None:
    """Called by Dask in each worker's process, before it registers with the scheduler."""
    await worker.plugin_add(WorkerSetup(), name=WorkerSetup.name, catch_errors=False)


class WorkerSetup(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Prepares one worker."""

    name = "dentine-setup"

    def __init__(self) -> None:
        self._faults: dict[str, str] = {}
        self._sign = Sign.of_this_process()

    async def setup(self, worker: Any) -> None:
        """Check what the worker claims, before it takes tasks."""
        claims = [claim for claim in CHECKS if worker.state.total_resources.get(claim)]
        for claim in claims:
            fault = await asyncio.to_thread(fault_of, [claim])
            if fault:
                self._faults[claim] = fault
                for resources in (worker.state.total_resources, worker.state.available_resources):
                    del resources[claim]
                logging.getLogger(__name__).error("This worker takes no task that needs %s: %s", claim, fault)
        worker.startup_information[TOLD] = lambda _: self.told
        # The loop that answers the scheduler writes it, so that a worker that hangs gives no sign of life either.
        sign = PeriodicCallback(lambda: self._give_sign(worker), 1000 * SIGN_S)
        worker.periodic_callbacks[self.name] = sign

    def teardown(self, worker: Any) -> None:  # noqa: ARG002 - Dask's signature
        """Called by Dask when the worker closes."""
        self._sign.withdraw()

    @property
    def told(self) -> str:
        """What is wrong with the worker; empty where nothing is."""
        return " ".join(dict.fromkeys(self._faults.values()))

    def _give_sign(self, worker: Any) -> None:
        if worker.status.name == "running":
            self._sign.give(self.told)
