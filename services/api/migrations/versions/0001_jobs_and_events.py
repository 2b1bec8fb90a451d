"""Jobs and their events."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0001", None


def upgrade() -> None:
    """Create both tables."""
    op.create_table(
        "job",
        sql.Column("number", sql.Integer, primary_key=True),
        sql.Column("id", sql.Text, nullable=False, unique=True),
        sql.Column("key", sql.Text, unique=True),
        sql.Column("state", sql.Text, nullable=False, index=True),
        sql.Column("created_s", sql.Float, nullable=False),
        sql.Column("changed_s", sql.Float, nullable=False),
        sql.Column("spec", sql.Text, nullable=False),
        sql.Column("failure", sql.Text),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "event",
        sql.Column("id", sql.Integer, primary_key=True),
        sql.Column("job", sql.Text, nullable=False),
        sql.Column("time_s", sql.Float, nullable=False),
        sql.Column("attempt", sql.Integer, nullable=False),
        sql.Column("stage", sql.Text),
        sql.Column("kind", sql.Text, nullable=False),
        sql.Column("message", sql.Text, nullable=False),
        sql.Column("done", sql.Float),
        sql.Column("data", sql.Text, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("event_of_job", "event", ["job", "id"])
