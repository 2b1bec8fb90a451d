"""A server's webhooks without the server: its database, a clock that the test sets, and the webhook sender, which can
be started several times.
"""

from __future__ import annotations

import asyncio
import json
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.api.jobs.records import Failure
from services.api.jobs.repository import Repository
from services.api.tables.lifecycle import JobState, Trigger
from services.api.webhooks.address import AddressPolicy
from services.api.webhooks.deliveries import Deliveries, Delivery
from services.api.webhooks.sender import WebhookSender
from services.api.webhooks.webhooks import NewWebhook, WebhookRequest, Webhooks
from services.core.records import JobSpec
from services.pipeline.database import sqlite_url
from tests.support.receiver import Receiver, wait_until

OPEN = AddressPolicy(allow_private=True)
ENTERED = ["QUEUED", "RUNNING", "SUCCEEDED"]


class Service:
    """A server's database with a clock that the test sets; ``sending`` stands for the life of one server process."""

    def __init__(self, data: Path) -> None:
        self.repository = Repository(sqlite_url(data / "dentine.sqlite"))
        self.webhooks = Webhooks(self.repository.engine, OPEN)
        self.deliveries = Deliveries(self.repository.engine)
        self.now_s = time.time()

    @contextmanager
    def sending(
        self, policy: AddressPolicy = OPEN, total_s: float = 30.0, tls: ssl.SSLContext | None = None
    ) -> Iterator[None]:
        sender = WebhookSender(self.deliveries, policy, 0.02, total_s, lambda: self.now_s, lambda: 0.5, tls)
        loop = asyncio.new_event_loop()
        task = loop.create_task(sender.run())

        def run() -> None:
            try:
                loop.run_until_complete(task)
            except asyncio.CancelledError:
                loop.run_until_complete(loop.shutdown_default_executor())
                loop.close()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            loop.call_soon_threadsafe(task.cancel)
            thread.join()
            assert task.cancelled()

    def subscribe(self, url: str, *states: str) -> NewWebhook:
        return self.webhooks.create(
            WebhookRequest(
                url=url, states=tuple(JobState(state) for state in states or ("SUCCEEDED", "FAILED", "CANCELLED"))
            )
        )

    def run_job(self, *triggers: Trigger, failure: Failure | None = None) -> str:
        job = self.repository.create(JobSpec(capture=Path("/people/jane-doe")), None).job
        for trigger in triggers or (Trigger.START, Trigger.SUCCEED):
            self.repository.apply(job.id, trigger, failure if trigger is Trigger.FAIL else None)
        return job.id

    def log(self, webhook: NewWebhook) -> list[Delivery]:
        """Deliveries of a webhook, oldest first."""
        return self.deliveries.page(webhook.id, 1000)[::-1]

    def wait_for(self, webhook: NewWebhook, *states: str) -> list[Delivery]:
        wait_until(lambda: [delivery.state for delivery in self.log(webhook)] == list(states))
        return self.log(webhook)

    def wait_for_tries(self, webhook: NewWebhook, count: int) -> Delivery:
        """Wait until the webhook's only delivery has ``count`` attempts, and return it."""
        wait_until(lambda: [len(delivery.attempts) for delivery in self.log(webhook)] == [count])
        return self.log(webhook)[0]


def states_in(receiver: Receiver) -> list[str]:
    return [json.loads(body)["data"]["state"] for _, body in receiver.received]
