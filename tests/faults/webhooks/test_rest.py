"""Webhooks over REST, their limits and their secrets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import pytest
from standardwebhooks.webhooks import Webhook as Verifier

from services.api.app import create_app
from services.api.webhooks.address import AddressPolicy
from services.api.webhooks.webhooks import WebhookRequest, Webhooks
from services.client.errors import JobStateError, WebhookAddressError
from services.core.settings import ServerSettings
from tests.support.live_server import serving
from tests.support.receiver import receiving, wait_until
from tests.support.webhook_service import Service


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
