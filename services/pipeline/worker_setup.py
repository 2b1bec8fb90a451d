"""Check each Dask worker that ``dentine worker`` starts (by ``--preload services.pipeline.worker_setup``).

A worker claims by Dask resources (``services.core.placement``) what it can do. Before it takes tasks, a separate
process checks each claim. A claim that fails is withdrawn and reported, in the log and to the scheduler, and no task
that needs it is given to this worker.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any

from distributed import WorkerPlugin
from tornado.ioloop import PeriodicCallback

from services.pipeline.worker_check import CHECKS, fault_of
from services.pipeline.worker_health import SIGN_S, Sign
from services.pipeline.workers import FAULT_KEY


async def dask_setup(worker: Any) -> None:
    """Called by Dask in each worker's process, before it registers with the scheduler."""
    await worker.plugin_add(WorkerSetup(), name=WorkerSetup.name, catch_errors=False)


class WorkerSetup(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Plugin of Dask that checks one worker and gives its signs of life."""

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
        worker.startup_information[FAULT_KEY] = lambda _: self.fault_sentences
        # The event loop that answers the scheduler also writes the sign, so that a worker that hangs gives none.
        sign = PeriodicCallback(lambda: self._give_sign(worker), 1000 * SIGN_S)
        worker.periodic_callbacks[self.name] = sign

    def teardown(self, worker: Any) -> None:  # noqa: ARG002 - Dask's signature
        """Called by Dask when the worker closes."""
        self._sign.withdraw()

    @property
    def fault_sentences(self) -> str:
        """The faults of the worker, in sentences; empty where there are none."""
        return " ".join(dict.fromkeys(self._faults.values()))

    def _give_sign(self, worker: Any) -> None:
        if worker.status.name == "running":
            self._sign.give(self.fault_sentences)
