"""Owners of jobs, receipts and captures, groups of tokens, and sessions that were ended.

Earlier jobs, receipts, captures and tokens belong to the default group.
"""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0011", "0010"

DEFAULT = "default"


def upgrade() -> None:
    """Add the columns and the table."""
    op.add_column("token", sql.Column("group", sql.Text))
    tokens = sql.table("token", sql.column("group"))
    op.execute(tokens.update().values(group=DEFAULT))
    for table in ("job", "capture", "deletion"):
        op.add_column(table, sql.Column("owner", sql.Text, nullable=False, server_default=DEFAULT))
    for table in ("job", "capture"):
        keyed = sql.table(table, sql.column("key"))
        op.execute(keyed.update().where(keyed.c.key.is_not(None)).values(key=f"{DEFAULT}/" + keyed.c.key))
        op.create_index(f"{table}_of_owner", table, ["owner", "number"])
    # This column says whether the owner has sent a content, as opposed to somebody else.
    op.add_column("capture_file", sql.Column("is_known", sql.Boolean, nullable=False, server_default=sql.false()))
    files = sql.table("capture_file", sql.column("is_known"), sql.column("received_bytes"), sql.column("bytes"))
    op.execute(files.update().where(files.c.received_bytes == files.c.bytes).values(is_known=sql.true()))
    op.create_table(
        "ended_session",
        sql.Column("sha256", sql.Text, primary_key=True),
        sql.Column("expires_s", sql.Float, nullable=False),
    )
