"""Routes of webhooks. Annotations are evaluated here, because FastAPI reads them."""

import time
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from pydantic import Field

from services.api.auth.scopes import needs
from services.api.http.bodies import BodyRoute, ValidatedBody
from services.api.http.problems import refusals
from services.api.webhooks.deliveries import Deliveries, Delivery
from services.api.webhooks.webhooks import NewWebhook, Webhook, WebhookChange, WebhookRequest, Webhooks
from services.core.geometry import Record
from services.pipeline.database import MAX_ID

DeliveryId = Annotated[int, Path(ge=1, le=MAX_ID)]


class DeliveryPage(Record):
    """Some deliveries, newest first."""

    deliveries: list[Delivery]
    next_before: int | None = Field(description="give as 'before' to get the next page; null on the last")


def build_webhook_router(webhooks: Webhooks, deliveries: Deliveries) -> APIRouter:
    """Build the routes over the given subscriptions and their log of deliveries."""
    router = APIRouter(
        prefix="/v1/webhooks",
        route_class=BodyRoute,
        tags=["webhooks"],
        responses=refusals(404, 409, 422),
        dependencies=[needs("admin")],
    )

    @router.post("", status_code=201)
    def create(request: ValidatedBody[WebhookRequest], response: Response) -> NewWebhook:
        """Subscribe to changes of jobs' states from now on. The secret is shown this once."""
        webhook = webhooks.create(request)
        response.headers["Location"] = f"/v1/webhooks/{webhook.id}"
        return webhook

    @router.get("")
    def page() -> list[Webhook]:
        """List the webhooks, oldest first."""
        return webhooks.list()

    @router.get("/{webhook_id}")
    def get(webhook_id: str) -> Webhook:
        """One webhook."""
        return webhooks.get(webhook_id)

    @router.patch("/{webhook_id}")
    def change(webhook_id: str, request: ValidatedBody[WebhookChange]) -> Webhook:
        """Change the address or the states, or switch it on or off."""
        return webhooks.change(webhook_id, request)

    @router.delete("/{webhook_id}", status_code=204)
    def delete(webhook_id: str) -> None:
        """Remove a webhook with its log."""
        webhooks.delete(webhook_id)

    @router.post("/{webhook_id}/test", status_code=202)
    def test(webhook_id: str) -> Delivery:
        """Send a message of type webhook.test; the log tells what came of it."""
        return deliveries.test(webhook_id, time.time())

    @router.get("/{webhook_id}/deliveries")
    def log(
        webhook_id: str,
        limit: Annotated[int, Query(ge=1, le=100)] = 50,
        before: Annotated[int | None, Query(ge=0, le=MAX_ID)] = None,
    ) -> DeliveryPage:
        """The webhook's deliveries with every try, newest first."""
        found = deliveries.page(webhook_id, limit + 1, before)
        return DeliveryPage(deliveries=found[:limit], next_before=found[limit - 1].id if len(found) > limit else None)

    @router.get("/{webhook_id}/deliveries/{delivery_id}")
    def delivery(webhook_id: str, delivery_id: DeliveryId) -> Delivery:
        """One delivery."""
        return deliveries.get(webhook_id, delivery_id)

    @router.post("/{webhook_id}/deliveries/{delivery_id}/redeliver", status_code=202)
    def redeliver(webhook_id: str, delivery_id: DeliveryId) -> Delivery:
        """Send a message again, under the same id."""
        return deliveries.redeliver(webhook_id, delivery_id, time.time())

    return router
