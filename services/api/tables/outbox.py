"""Makes deliveries to webhooks from the event table. Everything here runs inside the caller's transaction.

A cursor says how far the event table was read; it moves in the same transaction that adds the deliveries, so that a
restart neither loses nor repeats one. That requires that event ids become visible in their order, for which
``database.writing`` admits one writer at a time.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sql

from services.api.tables.lifecycle import JobState
from services.api.tables.webhooks import DeliveryState, cursor_table, delivery_table, webhook_table
from services.pipeline.event_log import event_table

DAY_S = 86_400.0
TRY_FOR_S = DAY_S
"""Time in s for which a delivery is attempted."""
_BATCH = 500
_READER = "webhooks"


def has_new_events(connection: sql.Connection) -> bool:
    """Whether the event table is to be read: a state has changed, or the table has grown so far that the cursor should
    follow.
    """
    cursor = _cursor(connection)
    return bool(_changes(connection, cursor, 1)) or _newest(connection) - cursor >= _BATCH


def collect_changes(connection: sql.Connection, now_s: float) -> int:
    """Add a delivery for each new change of state and each active webhook that asked for it, and move the cursor;
    returns how many.
    """
    webhooks = connection.execute(sql.select(webhook_table).where(webhook_table.c.active)).mappings().all()
    cursor, newest, added = _cursor(connection), _newest(connection), 0
    while changes := _changes(connection, cursor, _BATCH):
        cursor = changes[-1]["id"]
        for event in changes:
            data = json.loads(event["data"])
            for webhook in webhooks:
                if data["state"] in states_of(webhook) and event["id"] > webhook["after_event"]:
                    payload = _payload(event["job"], data, event["time_s"])
                    insert_delivery(connection, webhook["id"], f"evt_{event['id']}_{webhook['id']}", payload, now_s)
                    added += 1
    if not connection.execute(
        cursor_table.update().where(cursor_table.c.reader == _READER).values(event=newest)
    ).rowcount:
        connection.execute(cursor_table.insert().values(reader=_READER, event=newest))
    return added


def insert_delivery(connection: sql.Connection, webhook_id: str, message: str, payload: str, now_s: float) -> int:
    """Queue a message; returns the delivery's id."""
    row = {
        "webhook": webhook_id,
        "message": message,
        "payload": payload,
        "created_s": now_s,
        "state": DeliveryState.PENDING,
        "tries": 0,
    }
    row |= {"next_try_s": now_s, "deadline_s": now_s + TRY_FOR_S}
    new = delivery_table.insert().values(row).returning(delivery_table.c.id)
    return int(connection.execute(new).scalar_one())


def message_body(kind: str, time_s: float, data: dict[str, Any]) -> str:
    """Encode a payload in the form that Standard Webhooks recommends."""
    return json.dumps({"type": kind, "timestamp": datetime.fromtimestamp(time_s, UTC).isoformat(), "data": data})


def states_of(row: Any) -> tuple[JobState, ...]:
    """Return the states that the row of a subscription names."""
    return tuple(JobState(state) for state in json.loads(row["states"]))


def _payload(job: str, data: dict[str, Any], time_s: float) -> str:
    failure = data.get("failure") or {}
    return message_body("job.state", time_s, {"job": job, "state": data["state"], "failure_code": failure.get("code")})


def _changes(connection: sql.Connection, after: int, limit: int) -> Any:
    query = (
        sql.select(event_table)
        .where(event_table.c.id > after, event_table.c.kind == "state")
        .order_by(event_table.c.id)
        .limit(limit)
    )
    return connection.execute(query).mappings().all()


def _cursor(connection: sql.Connection) -> int:
    return connection.scalar(sql.select(cursor_table.c.event).where(cursor_table.c.reader == _READER)) or 0


def _newest(connection: sql.Connection) -> int:
    return connection.scalar(sql.select(sql.func.max(event_table.c.id))) or 0
