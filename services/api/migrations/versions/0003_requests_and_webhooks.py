"""Columns by which jobs are found, the request that submitted a job, and the tables of webhooks."""

import json

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0003", "0002"


def upgrade() -> None:
    """Add the columns, fill them from the options, and create the webhooks' tables."""
    for name in ("request_id", "kind", "source"):
        op.add_column("job", sql.Column(name, sql.Text))
    job = sql.table("job", *(sql.column(name) for name in ("number", "spec", "kind", "source")))
    connection = op.get_bind()
    for number, spec in connection.execute(sql.select(job.c.number, job.c.spec)).all():
        options = json.loads(spec)
        source = (options.get("rig") or {}).get("mouth") or options.get("capture")
        connection.execute(
            job.update().where(job.c.number == number).values(kind=options.get("kind", "tooth"), source=source)
        )

    op.create_table(
        "webhook",
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
    op.create_table(
        "webhook_delivery",
        sql.Column("id", sql.Integer, primary_key=True),
        sql.Column("webhook", sql.Text, nullable=False),
        sql.Column("message", sql.Text, nullable=False, unique=True),
        sql.Column("payload", sql.Text, nullable=False),
        sql.Column("created_s", sql.Float, nullable=False),
        sql.Column("state", sql.Text, nullable=False),
        sql.Column("tries", sql.Integer, nullable=False),
        sql.Column("next_try_s", sql.Float),
        sql.Column("deadline_s", sql.Float, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("delivery_of_webhook", "webhook_delivery", ["webhook", "id"])
    op.create_index("delivery_due", "webhook_delivery", ["state", "next_try_s"])
    op.create_table(
        "webhook_attempt",
        sql.Column("id", sql.Integer, primary_key=True),
        sql.Column("delivery", sql.Integer, nullable=False, index=True),
        sql.Column("time_s", sql.Float, nullable=False),
        sql.Column("duration_s", sql.Float, nullable=False),
        sql.Column("status", sql.Integer),
        sql.Column("error", sql.Text),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "webhook_cursor",
        sql.Column("reader", sql.Text, primary_key=True),
        sql.Column("event", sql.Integer, nullable=False),
    )
