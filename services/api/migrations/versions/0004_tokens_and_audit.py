"""Tokens of callers, and the audit log of their actions."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0004", "0003"


def upgrade() -> None:
    """Create both tables."""
    op.create_table(
        "token",
        sql.Column("id", sql.Text, primary_key=True),
        sql.Column("name", sql.Text, nullable=False),
        sql.Column("scopes", sql.Text, nullable=False),
        sql.Column("sha256", sql.Text, nullable=False),
        sql.Column("created_s", sql.Float, nullable=False),
        sql.Column("expires_s", sql.Float),
        sql.Column("revoked_s", sql.Float),
        sql.Column("last_used_s", sql.Float),
    )
    op.create_table(
        "audit",
        sql.Column("id", sql.Integer, primary_key=True),
        sql.Column("time_s", sql.Float, nullable=False),
        sql.Column("who", sql.Text, nullable=False),
        sql.Column("token", sql.Text),
        sql.Column("address", sql.Text, nullable=False),
        sql.Column("action", sql.Text, nullable=False),
        sql.Column("ids", sql.Text, nullable=False),
        sql.Column("outcome", sql.Integer, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("audit_of_who", "audit", ["who", "id"])
