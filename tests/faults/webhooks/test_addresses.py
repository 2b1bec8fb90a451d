"""Targets of webhooks: redirects, names that resolve to private addresses, certificates of other names."""

from __future__ import annotations

import ssl
from pathlib import Path

import pytest

from services.api.webhooks.address import AddressPolicy
from tests.support.receiver import receiving
from tests.support.webhook_service import Service

CERTIFICATE = Path(__file__).parents[2] / "support" / "localhost.pem"
"""File with a self-signed certificate for the name localhost and its key."""


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


@pytest.mark.attack("webhooks", "a name that leads inside once it is checked")
def test_a_name_that_leads_inside_is_not_connected_to(service: Service) -> None:
    """The name's address counts at the delivery, whatever it was at the subscription."""
    with receiving() as receiver, service.sending(AddressPolicy()):
        webhook = service.subscribe(receiver.url.replace("127.0.0.1", "localhost"))
        service.run_job()
        error = service.wait_for_tries(webhook, 1).attempts[0].error
    assert error is not None
    assert "no public address" in error
    assert receiver.received == []


@pytest.mark.attack("webhooks", "a certificate of another name")
def test_a_certificate_must_prove_the_name_though_the_address_is_connected_to(service: Service) -> None:
    """Three deliveries: a trusted certificate of the right name, an untrusted signer, and a certificate of another
    name.
    """
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
