"""Webhooks over faults of the receiver, the network and the server: what happened is told at least once, signed, and the log says how it went."""

from __future__ import annotations

import asyncio
import json
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from standardwebhooks.webhooks import Webhook as Verifier

from services.api.app import create_app
from services.api.jobs.lifecycle import JobState, Trigger
from services.api.jobs.records import Failure
from services.api.jobs.repository import Repository
from services.api.webhooks.address import AddressPolicy
from services.api.webhooks.deliveries import CLAIM_S, DISABLE_AFTER_S, KEEP_S, Attempt, Deliveries, Delivery
from services.api.webhooks.outbox import DAY_S
from services.api.webhooks.sender import FIRST_RETRY_S, WebhookSender, retry_s
from services.api.webhooks.webhooks import NewWebhook, WebhookChange, WebhookRequest, Webhooks
from services.client.errors import JobStateError, WebhookAddressError
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.pipeline.database import sqlite_url
from tests.support.live_server import serving
from tests.support.receiver import Receiver, receiving, wait_until

OPEN = AddressPolicy(allow_private=True)
CERTIFICATE = Path(__file__).parents[1] / "support" / "localhost.pem"
"""For the name localhost, signed by itself, with its key."""
ENTERED = ["QUEUED", "RUNNING", "SUCCEEDED"]


class Service:
    """A server's database with a clock of its own; ``sending`` is the life of one server process."""

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
        """Deliveries, oldest first."""
        return self.deliveries.page(webhook.id, 1000)[::-1]

    def wait_for(self, webhook: NewWebhook, *states: str) -> list[Delivery]:
        wait_until(lambda: [delivery.state for delivery in self.log(webhook)] == list(states))
        return self.log(webhook)

    def wait_for_tries(self, webhook: NewWebhook, count: int) -> Delivery:
        """The only delivery, once it was tried so often."""
        wait_until(lambda: [len(delivery.attempts) for delivery in self.log(webhook)] == [count])
        return self.log(webhook)[0]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    yield service
    service.repository.close()


def states_in(receiver: Receiver) -> list[str]:
    return [json.loads(body)["data"]["state"] for _, body in receiver.received]


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
            service.now_s = delivery.next_try_s + 1
        (delivery,) = service.wait_for(webhook, "delivered")
    assert [attempt.status for attempt in delivery.attempts] == [500, 503, 404, 204]
    assert [attempt.error is None for attempt in delivery.attempts] == [False, False, False, True]
    assert {headers["webhook-id"] for headers, _ in receiver.received} == {delivery.message}
    assert len({headers["webhook-timestamp"] for headers, _ in receiver.received}) == 4
    assert service.webhooks.get(webhook.id).failing_since_s is None


@pytest.mark.attack("webhooks", "a redirect")
def test_a_redirect_is_not_followed(service: Service) -> None:
    with receiving(302, 307) as receiver, service.sending():
        webhook = service.subscribe(receiver.url)
        service.run_job()
        delivery = service.wait_for_tries(webhook, 1)
        assert (delivery.attempts[0].status, delivery.attempts[0].error) == (
            302,
            "The receiver answered 302; redirects are not followed.",
        )
    assert [headers[":path"] for headers, _ in receiver.received] == ["/"]


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


@pytest.mark.attack("webhooks", "a name that leads inside once it is checked")
def test_a_name_that_leads_inside_is_not_connected_to(service: Service) -> None:
    """The subscription is old, the name was public then; what counts is where it leads now."""
    with receiving() as receiver, service.sending(AddressPolicy()):
        webhook = service.subscribe(receiver.url.replace("127.0.0.1", "localhost"))
        service.run_job()
        error = service.wait_for_tries(webhook, 1).attempts[0].error
    assert error is not None
    assert "no public address" in error
    assert receiver.received == []


@pytest.mark.attack("webhooks", "a certificate of another name")
def test_a_certificate_must_prove_the_name_though_the_address_is_connected_to(service: Service) -> None:
    """Trusted and named rightly; then signed by nobody known; then for another name."""
    certified = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    certified.load_cert_chain(CERTIFICATE)
    trusting = ssl.create_default_context(cafile=CERTIFICATE)
    with receiving(tls=certified) as receiver:
        named = service.subscribe(receiver.url)
        with service.sending(tls=trusting):
            service.run_job()
            service.wait_for(named, "delivered")
        assert [headers["host"] for headers, _ in receiver.received] == [receiver.url.removeprefix("https://")]
        service.webhooks.delete(named.id)
        for tls, url in ((None, receiver.url), (trusting, receiver.url.replace("localhost", "127.0.0.1"))):
            webhook = service.subscribe(url)
            with service.sending(tls=tls):
                service.run_job()
                assert (
                    service.wait_for_tries(webhook, 1).attempts[0].error
                    == "The receiver could not be reached (ConnectError)."
                )
            service.webhooks.delete(webhook.id)
        assert len(receiver.received) == 1


def test_a_server_killed_between_event_and_delivery_tells_it_after_its_restart(service: Service) -> None:
    """Killed before it read the event; then after it had claimed the delivery; then after the receiver had it."""
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


def test_after_a_day_it_is_given_up_and_after_five_the_webhook_is_switched_off(
    service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    webhook = service.subscribe("https://example.org/hook")
    started_s = service.now_s
    while service.webhooks.get(webhook.id).active:
        service.run_job()
        service.deliveries.collect(service.now_s)
        while (delivery := service.log(webhook)[-1]).next_try_s is not None:
            service.now_s = max(service.now_s, delivery.next_try_s)
            (claim,) = service.deliveries.claim(service.now_s, (), 16)
            refused = Attempt(time_s=service.now_s, duration_s=0.0, status=500, error="The receiver answered 500.")
            service.deliveries.settle(claim, refused, retry_s(claim.tries + 1, 0.5))
    log = service.log(webhook)
    assert {delivery.state for delivery in log} == {"given-up"}
    assert len(log[0].attempts) == 14
    assert DAY_S / 2 < log[0].attempts[-1].time_s - log[0].attempts[0].time_s <= DAY_S
    assert DISABLE_AFTER_S <= service.now_s - started_s < DISABLE_AFTER_S + DAY_S
    assert "Webhook delivery given up." in caplog.text
    assert "Webhook switched off: Every delivery failed for 5 days." in caplog.text
    assert service.webhooks.get(webhook.id).note == "Every delivery failed for 5 days."
    service.run_job()
    assert service.deliveries.collect(service.now_s) == 0
    again = service.webhooks.change(webhook.id, WebhookChange(active=True))
    assert (again.active, again.note, again.failing_since_s) == (True, "", None)


def test_one_success_forgets_earlier_failures(service: Service) -> None:
    webhook = service.subscribe("https://example.org/hook")
    service.run_job()
    service.deliveries.collect(service.now_s)
    for status, error in ((500, "The receiver answered 500."), (204, None)):
        (claim,) = service.deliveries.claim(service.now_s, (), 16)
        service.deliveries.settle(
            claim, Attempt(time_s=service.now_s, duration_s=0.0, status=status, error=error), retry_s(1, 0.5)
        )
        assert (service.webhooks.get(webhook.id).failing_since_s is None) is (error is None)
        service.now_s += DAY_S / 2
    assert [delivery.state for delivery in service.log(webhook)] == ["delivered"]


def test_the_log_forgets_what_was_settled_long_ago(service: Service) -> None:
    webhook = service.subscribe("https://example.org/hook")
    for age_s in (KEEP_S + DAY_S, 0.0):
        service.run_job()
        service.deliveries.collect(service.now_s - age_s)
        for claim in service.deliveries.claim(service.now_s, (), 16):
            service.deliveries.settle(
                claim, Attempt(time_s=service.now_s, duration_s=0.0, status=204, error=None), 10.0
            )
    assert len(service.log(webhook)) == 1


def test_a_receiver_that_is_gone_is_not_asked_again(service: Service) -> None:
    with receiving(410) as receiver, service.sending():
        webhook = service.subscribe(receiver.url, *ENTERED)
        service.run_job()
        wait_until(lambda: not service.webhooks.get(webhook.id).active)
        assert "410" in service.webhooks.get(webhook.id).note
        assert {delivery.state for delivery in service.log(webhook)} == {"given-up"}
    assert len(receiver.received) == 1


def test_waits_double_and_are_jittered_over_about_a_day() -> None:
    assert [retry_s(tries, 0.5) for tries in (1, 2, 3)] == [10, 20, 40]
    assert (retry_s(4, 0.0), retry_s(4, 0.999)) == (40.0, pytest.approx(120.0, rel=1e-2))
    waits = [retry_s(tries, 0.5) for tries in range(1, 14)]
    assert sum(waits[:13]) < DAY_S < sum(waits) + retry_s(14, 0.5)


def test_there_are_bounds(service: Service) -> None:
    for _ in range(100):
        service.subscribe("https://example.org/hook")
    with pytest.raises(JobStateError, match="100 webhooks"):
        service.subscribe("https://example.org/hook")
    with pytest.raises(WebhookAddressError):
        Webhooks(service.repository.engine, AddressPolicy()).create(WebhookRequest(url="http://10.0.0.1/"))


def test_a_secret_is_in_no_representation(service: Service) -> None:
    webhook = service.subscribe("https://example.org/hook")
    service.deliveries.test(webhook.id, service.now_s)
    (claim,) = service.deliveries.claim(service.now_s, (), 16)
    assert claim.secret == webhook.secret
    assert webhook.secret not in repr(webhook) + repr(claim) + repr(service.webhooks.list()) + repr(
        service.log(webhook)
    )


def test_webhooks_over_rest(tmp_path: Path) -> None:
    settings = ServerSettings(data=tmp_path, private_webhooks=True)
    with receiving(500) as receiver, serving(create_app(settings, lambda *_: None)) as client:
        made = client.post("/v1/webhooks", json={"url": receiver.url, "states": ["SUCCEEDED"]})
        assert made.status_code == 201
        path, secret = made.headers["location"], made.json()["secret"]
        assert made.json()["states"] == ["SUCCEEDED"]
        assert client.get("/v1/webhooks").json() == [client.get(path).json()]
        assert secret not in client.get("/v1/webhooks").text

        tested = client.post(f"{path}/test")
        assert tested.status_code == 202
        receiver.wait(1)
        log = f"{path}/deliveries"
        wait_until(lambda: bool(client.get(log).json()["deliveries"][0]["attempts"]))
        (delivery,) = client.get(log).json()["deliveries"]
        assert (delivery["payload"]["type"], delivery["state"], delivery["attempts"][0]["status"]) == (
            "webhook.test",
            "pending",
            500,
        )
        again = client.post(f"{log}/{delivery['id']}/redeliver")
        assert (again.status_code, again.json()["message"]) == (202, delivery["message"])
        wait_until(lambda: client.get(f"{log}/{delivery['id']}").json()["state"] == "delivered")

        job = client.post("/v1/jobs", json={"capture": "/"}).json()["id"]
        headers, body = receiver.wait(3)[2]
        assert Verifier(secret).verify(body, headers)["data"] == {
            "job": job,
            "state": "SUCCEEDED",
            "failure_code": None,
        }
        page = client.get(log, params={"limit": 1}).json()
        older = client.get(log, params={"limit": 1, "before": page["next_before"]}).json()
        assert (older["deliveries"][0]["id"], older["next_before"]) == (delivery["id"], None)

        assert client.patch(path, json={"active": False, "states": ["FAILED"]}).json()["active"] is False
        assert client.get(path).json()["states"] == ["FAILED"]
        assert client.delete(path).status_code == 204
        for gone in (client.get(path), client.delete(path), client.get(log), client.post(f"{path}/test")):
            assert (gone.status_code, gone.json()["code"]) == (404, "webhook-unknown")


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"url": "http://example.org/"}, "webhook-address"),
        ({"url": "https://127.0.0.1/"}, "webhook-address"),
        ({"url": "https://user:word@example.org/"}, "webhook-address"),
        ({"url": "https://example.org/", "states": []}, "bad-settings"),
        ({"url": "https://example.org/", "states": ["DONE"]}, "bad-settings"),
        ({"url": "https://example.org/", "secret": "mine"}, "bad-settings"),
        ({}, "bad-settings"),
    ],
)
def test_what_is_no_webhook_is_refused(tmp_path: Path, body: dict[str, Any], code: str) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as client:
        answer: httpx.Response = client.post("/v1/webhooks", json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
        assert client.get("/v1/webhooks").json() == []
