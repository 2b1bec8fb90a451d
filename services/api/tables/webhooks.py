"""Tables of webhooks: subscriptions, deliveries, attempts, and how far the event table was read."""

from __future__ import annotations

from enum import StrEnum

import sqlalchemy as sql

from services.pipeline.database import metadata

webhook_table = sql.Table(
    "webhook",
    metadata,
    sql.Column("id", sql.Text, primary_key=True),
    sql.Column("url", sql.Text, nullable=False),
    sql.Column("states", sql.Text, nullable=False),
    sql.Column("secret", sql.Text, nullable=False),
    sql.Column("created_s", sql.Float, nullable=False),
    sql.Column("active", sql.Boolean, nullable=False),
    sql.Column("after_event", sql.Integer, nullable=False),
    sql.Column("failing_since_s", sql.Float),
    sql.Column("note", sql.Text, nullable=False),
)

delivery_table = sql.Table(
    "webhook_delivery",
    metadata,
    sql.Column("id", sql.Integer, primary_key=True),
    sql.Column("webhook", sql.Text, nullable=False),
    sql.Column("message", sql.Text, nullable=False, unique=True),
    sql.Column("payload", sql.Text, nullable=False),
    sql.Column("created_s", sql.Float, nullable=False),
    sql.Column("state", sql.Text, nullable=False),
    sql.Column("tries", sql.Integer, nullable=False),
    sql.Column("next_try_s", sql.Float),
    sql.Column("deadline_s", sql.Float, nullable=False),
    sql.Index("delivery_of_webhook", "webhook", "id"),
    sql.Index("delivery_due", "state", "next_try_s"),
    sqlite_autoincrement=True,
)

attempt_table = sql.Table(
    "webhook_attempt",
    metadata,
    sql.Column("id", sql.Integer, primary_key=True),
    sql.Column("delivery", sql.Integer, nullable=False, index=True),
    sql.Column("time_s", sql.Float, nullable=False),
    sql.Column("duration_s", sql.Float, nullable=False),
    sql.Column("status", sql.Integer),
    sql.Column("error", sql.Text),
    sqlite_autoincrement=True,
)

cursor_table = sql.Table(
    "webhook_cursor",
    metadata,
    sql.Column("reader", sql.Text, primary_key=True),
    sql.Column("event", sql.Integer, nullable=False),
)


class DeliveryState(StrEnum):
    """Where a delivery is."""

    PENDING = "pending"
    DELIVERED = "delivered"
    GIVEN_UP = "given-up"
