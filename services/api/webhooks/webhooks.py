"""Subscriptions of webhooks to the changes of jobs' states."""

from __future__ import annotations

import base64
import json
import secrets
import time
from typing import Annotated, Any

import sqlalchemy as sql
from pydantic import Field

from services.api.tables.lifecycle import JobState
from services.api.tables.outbox import collect_changes, states_of
from services.api.tables.webhooks import DeliveryState, attempt_table, delivery_table, webhook_table
from services.api.webhooks.address import AddressPolicy
from services.client.errors import JobStateError, UnknownWebhookError
from services.core.geometry import Record
from services.pipeline.database import writing
from services.pipeline.event_log import event_table

MAX_WEBHOOKS = 100
KEY_PREFIX = "whsec_"
_SECRET_BYTES = 32

States = Annotated[
    tuple[JobState, ...],
    Field(
        min_length=1,
        max_length=len(JobState),
        fail_fast=True,
        description="states of a job to tell of when it enters them",
    ),
]
Url = Annotated[
    str,
    Field(
        min_length=1,
        max_length=2000,
        description="where to POST; https, and no private address unless the server's settings allow it",
    ),
]

ENDED = tuple(state for state in JobState if state.is_final)


class WebhookRequest(Record):
    """What to tell and where."""

    url: Url
    states: States = ENDED


class WebhookChange(Record):
    """What to change of a webhook; what is left out stays."""

    url: Url | None = None
    states: States | None = None
    active: bool | None = Field(
        default=None, description="false gives up what is pending; true forgets earlier failures"
    )


class Webhook(Record):
    """A subscription."""

    id: str
    url: str
    states: tuple[JobState, ...]
    created_s: float = Field(description="Unix time")
    active: bool
    failing_since_s: float | None = Field(description="Unix time of the first failure since the last success")
    note: str = Field(description="why the server switched it off; else empty")


class NewWebhook(Webhook):
    """A subscription with its secret, which is shown this once."""

    secret: str = Field(repr=False, description="signs what is sent; see standardwebhooks.com")


class Webhooks:
    """The table of subscriptions."""

    def __init__(self, engine: sql.Engine, policy: AddressPolicy) -> None:
        self._engine, self._policy = engine, policy

    def create(self, request: WebhookRequest) -> NewWebhook:
        """Create a subscription to the changes from now on.

        Raises:
            WebhookAddressError: the address is refused. JobStateError: there are ``MAX_WEBHOOKS`` already.
        """
        self._policy.check_url(request.url)
        secret = KEY_PREFIX + base64.b64encode(secrets.token_bytes(_SECRET_BYTES)).decode()
        with writing(self._engine) as connection:
            if (connection.scalar(sql.select(sql.func.count()).select_from(webhook_table)) or 0) >= MAX_WEBHOOKS:
                raise JobStateError(f"There are {MAX_WEBHOOKS} webhooks already; delete one first.")
            newest = connection.scalar(sql.select(sql.func.max(event_table.c.id))) or 0
            row = {
                "id": f"wh_{secrets.token_hex(8)}",
                "url": request.url,
                "states": _states(request.states),
                "secret": secret,
                "created_s": time.time(),
            }
            row |= {"active": True, "after_event": newest, "failing_since_s": None, "note": ""}
            connection.execute(webhook_table.insert().values(row))
        return NewWebhook(**_fields(row), secret=secret)

    def list(self) -> list[Webhook]:
        """All subscriptions, oldest first."""
        with self._engine.connect() as connection:
            return [
                Webhook(**_fields(row))
                for row in connection.execute(sql.select(webhook_table).order_by(webhook_table.c.created_s)).mappings()
            ]

    def get(self, webhook_id: str) -> Webhook:
        """One subscription.

        Raises:
            UnknownWebhookError: there is none with this id.
        """
        with self._engine.connect() as connection:
            return Webhook(**_fields(find_webhook(connection, webhook_id)))

    def change(self, webhook_id: str, change: WebhookChange) -> Webhook:
        """Change a subscription; its secret stays.

        Raises:
            UnknownWebhookError: there is none with this id. WebhookAddressError: the address is refused.
        """
        values: dict[str, Any] = {}
        if change.url is not None:
            self._policy.check_url(change.url)
            values["url"] = change.url
        if change.states is not None:
            values["states"] = _states(change.states)
        with writing(self._engine) as connection:
            find_webhook(connection, webhook_id)
            collect_changes(connection, time.time())  # earlier changes are delivered by the earlier subscription
            if change.active is True:
                values |= {"active": True, "failing_since_s": None, "note": ""}
            if values:
                connection.execute(webhook_table.update().where(webhook_table.c.id == webhook_id).values(values))
            if change.active is False:
                switch_off(connection, webhook_id, "")
            return Webhook(**_fields(find_webhook(connection, webhook_id)))

    def delete(self, webhook_id: str) -> None:
        """Remove a subscription with its log of deliveries.

        Raises:
            UnknownWebhookError: there is none with this id.
        """
        with writing(self._engine) as connection:
            find_webhook(connection, webhook_id)
            own = sql.select(delivery_table.c.id).where(delivery_table.c.webhook == webhook_id)
            connection.execute(attempt_table.delete().where(attempt_table.c.delivery.in_(own)))
            connection.execute(delivery_table.delete().where(delivery_table.c.webhook == webhook_id))
            connection.execute(webhook_table.delete().where(webhook_table.c.id == webhook_id))


def find_webhook(connection: sql.Connection, webhook_id: str) -> Any:
    """Return the row of a subscription.

    Raises:
        UnknownWebhookError: there is none with this id.
    """
    row = connection.execute(sql.select(webhook_table).where(webhook_table.c.id == webhook_id)).mappings().first()
    if row is None:
        raise UnknownWebhookError(f"There is no webhook {webhook_id}; list the webhooks to see their ids.")
    return row


def switch_off(connection: sql.Connection, webhook_id: str, note: str) -> None:
    """Make a subscription inactive and give up its pending deliveries."""
    connection.execute(webhook_table.update().where(webhook_table.c.id == webhook_id).values(active=False, note=note))
    pending = delivery_table.update().where(
        delivery_table.c.webhook == webhook_id, delivery_table.c.state == DeliveryState.PENDING
    )
    connection.execute(pending.values(state=DeliveryState.GIVEN_UP, next_try_s=None))


def _states(states: tuple[JobState, ...]) -> str:
    return json.dumps(sorted(set(states)))


def _fields(row: Any) -> dict[str, Any]:
    return {name: row[name] for name in Webhook.model_fields} | {"states": states_of(row)}
