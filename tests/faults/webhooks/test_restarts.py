"""Events that are still delivered after the server was killed or restarted, or has deleted the job."""

from __future__ import annotations

import json
import time

from services.api.tables.lifecycle import Trigger
from services.api.webhooks.deliveries import CLAIM_S
from tests.support.receiver import receiving
from tests.support.webhook_service import Service, states_in


def test_a_server_killed_between_event_and_delivery_tells_it_after_its_restart(service: Service) -> None:
    """The server stops after it claimed a delivery, then before it read an event, then after the receiver had it."""
    with receiving() as receiver:
        webhook = service.subscribe(receiver.url)
        service.run_job()
        assert service.deliveries.collect(service.now_s) == 1
        assert service.deliveries.collect(service.now_s) == 0
        (claim,) = service.deliveries.claim(service.now_s, (), 16)
        assert service.deliveries.claim(service.now_s, (), 16) == []
        with service.sending():
            assert [delivery.state for delivery in service.log(webhook)] == ["pending"]
            service.now_s += CLAIM_S + 1
            service.wait_for(webhook, "delivered")
        service.run_job()
        with service.sending():
            service.wait_for(webhook, "delivered", "delivered")
        with service.sending():
            job = service.run_job(Trigger.CANCEL)
            service.wait_for(webhook, "delivered", "delivered", "delivered")
    assert states_in(receiver) == ["SUCCEEDED", "SUCCEEDED", "CANCELLED"]
    assert json.loads(receiver.received[-1][1])["data"]["job"] == job
    assert receiver.received[0][0]["webhook-id"] == claim.message
    assert len({headers["webhook-id"] for headers, _ in receiver.received}) == 3


def test_what_happened_to_a_job_is_told_though_it_was_deleted_before_the_events_were_read(service: Service) -> None:
    webhook = service.subscribe("https://example.org/hook", "SUCCEEDED", "DELETING")
    job = service.run_job()
    service.repository.apply(job, Trigger.DELETE)
    service.repository.forget(job, 0, 0, "abc")
    assert service.deliveries.collect(service.now_s) == 0
    assert [
        (delivery.payload["data"]["job"], delivery.payload["data"]["state"]) for delivery in service.log(webhook)
    ] == [
        (job, "SUCCEEDED"),
        (job, "DELETING"),
    ]


def test_restarts_at_random_moments_lose_nothing_and_repeat_only_under_the_same_id(service: Service) -> None:
    jobs = []
    with receiving() as receiver:
        webhook = service.subscribe(receiver.url)
        for pause_s in (0.0, 0.01, 0.03, 0.05, 0.1, 0.15):
            with service.sending():
                jobs += [service.run_job() for _ in range(3)]
                time.sleep(pause_s)
            service.now_s += CLAIM_S + 1
        with service.sending():
            service.wait_for(webhook, *["delivered"] * len(jobs))
    told = {headers["webhook-id"]: json.loads(body)["data"]["job"] for headers, body in receiver.received}
    assert sorted(told.values()) == sorted(jobs)
