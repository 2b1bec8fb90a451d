"""Deliveries to webhooks: which are due, which attempts were made, and with which outcome.

A delivery is claimed for the time of an attempt: if the process dies meanwhile, it falls due again.
"""

from __future__ import annotations

import json
import logging
import secrets
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sql
from pydantic import Field

from services.api.tables.outbox import (
    DAY_S,
    TRY_FOR_S,
    collect_changes,
    has_new_events,
    insert_delivery,
    message_body,
)
from services.api.tables.webhooks import DeliveryState, attempt_table, delivery_table, webhook_table
from services.api.webhooks.webhooks import find_webhook, switch_off
from services.client.errors import UnknownWebhookError
from services.core.geometry import Record
from services.pipeline.database import writing

DISABLE_AFTER_S = 5 * DAY_S
"""Time in s without a success after which a webhook that fails is switched off."""
KEEP_S = 30 * DAY_S
"""Time in s for which the log keeps deliveries that are settled."""
CLAIM_S = 60.0
"""Time in s for which a delivery is claimed."""


class Attempt(Record):
    """One try to deliver."""

    time_s: float = Field(description="Unix time")
    duration_s: float
    status: int | None = Field(description="HTTP status; null where no answer came")
    error: str | None = Field(description="what went wrong; null where it was delivered")


class Delivery(Record):
    """One message to one webhook."""

    id: int
    message: str = Field(
        description="header webhook-id: the same in every try, so that a receiver can tell a repetition"
    )
    payload: dict[str, Any]
    created_s: float = Field(description="Unix time")
    state: DeliveryState
    next_try_s: float | None = Field(description="Unix time; null where none will be made")
    attempts: tuple[Attempt, ...] = Field(description="oldest first")


@dataclass(frozen=True)
class Claim:
    """A delivery to be attempted now, by nobody else for ``CLAIM_S``."""

    delivery: int
    webhook: str
    message: str
    payload: str
    url: str
    secret: str = field(repr=False)
    tries: int
    deadline_s: float


class Deliveries:
    """The tables of deliveries and attempts."""

    def __init__(self, engine: sql.Engine) -> None:
        self._engine = engine

    def collect(self, now_s: float) -> int:
        """Add deliveries for the changes of state since the last call; returns how many."""
        with self._engine.connect() as connection:
            if not has_new_events(connection):
                return 0  # looking for changes costs no write
        with writing(self._engine) as connection:
            _forget(connection, now_s - KEEP_S)
            return collect_changes(connection, now_s)

    def claim(self, now_s: float, busy: Collection[str], most: int) -> list[Claim]:
        """Claim the oldest due delivery of each webhook that is not busy, of at most ``most`` webhooks."""
        is_due = (
            delivery_table.c.state == DeliveryState.PENDING,
            delivery_table.c.next_try_s <= now_s,
            delivery_table.c.webhook.not_in(busy),
        )
        oldest = (
            sql.select(sql.func.min(delivery_table.c.id)).where(*is_due).group_by(delivery_table.c.webhook).limit(most)
        )
        with self._engine.connect() as connection:
            if not connection.scalars(oldest).all():
                return []
        with writing(self._engine) as connection:
            ids = connection.scalars(oldest).all()
            connection.execute(
                delivery_table.update().where(delivery_table.c.id.in_(ids)).values(next_try_s=now_s + CLAIM_S)
            )
            query = (
                sql.select(delivery_table, webhook_table.c.url, webhook_table.c.secret)
                .join_from(delivery_table, webhook_table, delivery_table.c.webhook == webhook_table.c.id)
                .where(delivery_table.c.id.in_(ids))
            )
            names = ("webhook", "message", "payload", "url", "secret", "tries", "deadline_s")
            return [
                Claim(delivery=row["id"], **{name: row[name] for name in names})
                for row in connection.execute(query).mappings()
            ]

    def settle(self, claim: Claim, attempt: Attempt, retry_s: float, *, is_gone: bool = False) -> None:
        """Log an attempt; after a failed one plan the next in ``retry_s``, or give the delivery up.

        Args:
            retry_s: time in s until the next attempt.
            is_gone: whether the receiver has answered that it wants no more messages.
        """
        now_s = attempt.time_s + attempt.duration_s
        with writing(self._engine) as connection:
            webhook = (
                connection.execute(sql.select(webhook_table).where(webhook_table.c.id == claim.webhook))
                .mappings()
                .first()
            )
            if webhook is None:
                return  # deleted meanwhile, with its log
            connection.execute(attempt_table.insert().values(attempt.model_dump() | {"delivery": claim.delivery}))
            if attempt.error is None:
                _update(connection, claim, state=DeliveryState.DELIVERED, next_try_s=None, tries=claim.tries + 1)
                connection.execute(
                    webhook_table.update().where(webhook_table.c.id == claim.webhook).values(failing_since_s=None)
                )
                return
            failing_since_s = webhook["failing_since_s"] or attempt.time_s
            connection.execute(
                webhook_table.update()
                .where(webhook_table.c.id == claim.webhook)
                .values(failing_since_s=failing_since_s)
            )
            again_s = now_s + retry_s
            is_last = again_s > claim.deadline_s or is_gone or not webhook["active"]
            state, next_try_s = (DeliveryState.GIVEN_UP, None) if is_last else (DeliveryState.PENDING, again_s)
            _update(connection, claim, state=state, next_try_s=next_try_s, tries=claim.tries + 1)
            note = _reason_to_stop(now_s - failing_since_s, is_gone=is_gone) if webhook["active"] else ""
            if note:
                switch_off(connection, claim.webhook, note)
        log = logging.getLogger(__name__)
        origin = {"webhook": claim.webhook, "delivery": claim.delivery}
        log.info("Webhook not delivered.", extra=origin | {"error": attempt.error})
        if state is DeliveryState.GIVEN_UP:
            log.warning("Webhook delivery given up.", extra=origin)
        if note:
            log.warning("Webhook switched off: %s", note, extra=origin)

    def page(self, webhook_id: str, limit: int, before: int | None = None) -> list[Delivery]:
        """Return up to ``limit`` deliveries of a webhook, newest first, of those with an id below ``before``.

        Raises:
            UnknownWebhookError: there is no such webhook.
        """
        query = (
            sql.select(delivery_table)
            .where(delivery_table.c.webhook == webhook_id)
            .order_by(delivery_table.c.id.desc())
            .limit(limit)
        )
        if before is not None:
            query = query.where(delivery_table.c.id < before)
        with self._engine.connect() as connection:
            find_webhook(connection, webhook_id)
            rows = connection.execute(query).mappings().all()
            return [_delivery(connection, row) for row in rows]

    def get(self, webhook_id: str, delivery_id: int) -> Delivery:
        """One delivery.

        Raises:
            UnknownWebhookError: the webhook has none with this id.
        """
        with self._engine.connect() as connection:
            return _delivery(connection, _find(connection, webhook_id, delivery_id))

    def test(self, webhook_id: str, now_s: float) -> Delivery:
        """Queue a message that says that it is a test, also to an inactive webhook."""
        with writing(self._engine) as connection:
            find_webhook(connection, webhook_id)
            payload = message_body("webhook.test", now_s, {"webhook": webhook_id})
            delivery_id = insert_delivery(connection, webhook_id, f"test_{secrets.token_hex(8)}", payload, now_s)
            return _delivery(connection, _find(connection, webhook_id, delivery_id))

    def redeliver(self, webhook_id: str, delivery_id: int, now_s: float) -> Delivery:
        """Queue a delivery again, under the same message id, to be attempted for another ``TRY_FOR_S``."""
        with writing(self._engine) as connection:
            row = _find(connection, webhook_id, delivery_id)
            values = {"state": DeliveryState.PENDING, "tries": 0, "next_try_s": now_s, "deadline_s": now_s + TRY_FOR_S}
            connection.execute(delivery_table.update().where(delivery_table.c.id == row["id"]).values(values))
            return _delivery(connection, _find(connection, webhook_id, delivery_id))


def _update(connection: sql.Connection, claim: Claim, **values: Any) -> None:
    connection.execute(delivery_table.update().where(delivery_table.c.id == claim.delivery).values(values))


def _reason_to_stop(failing_s: float, *, is_gone: bool) -> str:
    if is_gone:
        return "The receiver answered 410: it wants no more messages."
    return f"Every delivery failed for {DISABLE_AFTER_S / DAY_S:g} days." if failing_s >= DISABLE_AFTER_S else ""


def _forget(connection: sql.Connection, before_s: float) -> None:
    """Delete settled deliveries that were created before a time, with their attempts."""
    old = sql.select(delivery_table.c.id).where(
        delivery_table.c.created_s < before_s, delivery_table.c.next_try_s.is_(None)
    )
    connection.execute(attempt_table.delete().where(attempt_table.c.delivery.in_(old)))
    connection.execute(
        delivery_table.delete().where(delivery_table.c.created_s < before_s, delivery_table.c.next_try_s.is_(None))
    )


def _find(connection: sql.Connection, webhook_id: str, delivery_id: int) -> Any:
    query = sql.select(delivery_table).where(delivery_table.c.webhook == webhook_id, delivery_table.c.id == delivery_id)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise UnknownWebhookError(
            f"Webhook {webhook_id} has no delivery {delivery_id}; list its deliveries to see their ids."
        )
    return row


def _delivery(connection: sql.Connection, row: Any) -> Delivery:
    query = sql.select(attempt_table).where(attempt_table.c.delivery == row["id"]).order_by(attempt_table.c.id)
    attempts = tuple(
        Attempt(**{name: tried[name] for name in Attempt.model_fields})
        for tried in connection.execute(query).mappings()
    )
    fields = {name: row[name] for name in ("id", "message", "created_s", "state", "next_try_s")}
    return Delivery(**fields, payload=json.loads(row["payload"]), attempts=attempts)
