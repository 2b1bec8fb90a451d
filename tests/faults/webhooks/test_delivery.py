"""Events are delivered at least once and signed, and the log records each attempt."""

from __future__ import annotations

import json

import pytest
from standardwebhooks.webhooks import Webhook as Verifier

from services.api.jobs.records import Failure
from services.api.tables.lifecycle import JobState, Trigger
from services.api.webhooks.sender import FIRST_RETRY_S
from services.api.webhooks.webhooks import WebhookChange
from tests.support.receiver import receiving
from tests.support.webhook_service import ENTERED, Service, states_in


def test_a_change_is_told_signed_and_without_personal_data(service: Service) -> None:
    with receiving() as receiver, service.sending():
        webhook = service.subscribe(f"{receiver.url}/hook?key=k1", *ENTERED)
        job = service.run_job()
        service.wait_for(webhook, "delivered", "delivered", "delivered")
    for state, (headers, body) in zip(ENTERED, receiver.received, strict=True):
        told = Verifier(webhook.secret).verify(body, headers)
        assert told["type"] == "job.state"
        assert told["data"] == {"job": job, "state": state, "failure_code": None}
        assert (headers[":path"], headers["content-type"], headers["host"]) == (
            "/hook?key=k1",
            "application/json",
            receiver.url.removeprefix("http://"),
        )
        assert "jane" not in body
    assert len({headers["webhook-id"] for headers, _ in receiver.received}) == 3
    with pytest.raises(Exception, match="No matching signature"):
        Verifier(service.subscribe(receiver.url).secret).verify(body, headers)


def test_a_failure_is_told_by_its_code(service: Service) -> None:
    failure = Failure(code="bad-capture", message="Frame /people/jane-doe/3.npy is missing; copy it.", exit_status=2)
    with receiving() as receiver, service.sending():
        service.subscribe(receiver.url)
        job = service.run_job(Trigger.START, Trigger.FAIL, failure=failure)
        ((_, body),) = receiver.wait(1)
    assert json.loads(body)["data"] == {"job": job, "state": "FAILED", "failure_code": "bad-capture"}
    assert "jane" not in body


def test_each_gets_what_it_asked_for_from_then_on(service: Service) -> None:
    with receiving() as receiver, service.sending():
        service.run_job()
        failed, all_of_it = service.subscribe(receiver.url, "FAILED"), service.subscribe(receiver.url, *ENTERED)
        service.run_job()
        service.wait_for(all_of_it, *["delivered"] * 3)
        assert service.log(failed) == []
        service.webhooks.change(all_of_it.id, WebhookChange(active=False))
        service.run_job()
        service.webhooks.change(failed.id, WebhookChange(states=(JobState.RUNNING,)))
        service.run_job()
        service.wait_for(failed, "delivered")
        assert len(service.log(all_of_it)) == 3
    assert states_in(receiver) == [*ENTERED, "RUNNING"]


def test_a_receiver_that_fails_is_tried_again_under_the_same_id(service: Service) -> None:
    with receiving(500, 503, 404) as receiver, service.sending():
        webhook = service.subscribe(receiver.url)
        service.run_job()
        for tries in (1, 2, 3):
            delivery = service.wait_for_tries(webhook, tries)
            assert delivery.state == "pending"
            assert delivery.next_try_s == pytest.approx(service.now_s + FIRST_RETRY_S * 2 ** (tries - 1), abs=5)
            assert delivery.next_try_s is not None
            service.now_s = delivery.next_try_s + 1
        (delivery,) = service.wait_for(webhook, "delivered")
    assert [attempt.status for attempt in delivery.attempts] == [500, 503, 404, 204]
    assert [attempt.error is None for attempt in delivery.attempts] == [False, False, False, True]
    assert {headers["webhook-id"] for headers, _ in receiver.received} == {delivery.message}
    assert len({headers["webhook-timestamp"] for headers, _ in receiver.received}) == 4
    assert service.webhooks.get(webhook.id).failing_since_s is None


@pytest.mark.attack("webhooks", "a receiver that never answers")
def test_a_receiver_that_hangs_does_not_hold_up_others(service: Service) -> None:
    with receiving(0) as hanging, receiving() as prompt, service.sending(total_s=1.0):
        slow, quick = service.subscribe(hanging.url), service.subscribe(prompt.url)
        service.run_job()
        service.wait_for(quick, "delivered")
        delivery = service.wait_for_tries(slow, 1)
    assert delivery.state == "pending"
    assert delivery.attempts[0].error == "The receiver did not answer within 1 s."


def test_nobody_there_is_an_error_in_the_log(service: Service) -> None:
    with receiving() as receiver:
        pass
    with service.sending():
        webhook = service.subscribe(receiver.url)
        service.run_job()
        assert (
            service.wait_for_tries(webhook, 1).attempts[0].error == "The receiver could not be reached (ConnectError)."
        )
