"""Number of tries for a receiver, the time after which it is given up, and the deliveries that the log forgets."""

from __future__ import annotations

import pytest

from services.api.tables.outbox import DAY_S
from services.api.webhooks.deliveries import DISABLE_AFTER_S, KEEP_S, Attempt
from services.api.webhooks.sender import retry_s
from services.api.webhooks.webhooks import WebhookChange
from tests.support.receiver import receiving, wait_until
from tests.support.webhook_service import ENTERED, Service


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
    assert retry_s(4, 0.0) == 40.0
    assert retry_s(4, 0.999) == pytest.approx(120.0, rel=1e-2)
    waits = [retry_s(tries, 0.5) for tries in range(1, 14)]
    assert sum(waits[:13]) < DAY_S < sum(waits) + retry_s(14, 0.5)
