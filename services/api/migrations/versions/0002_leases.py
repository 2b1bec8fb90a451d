"""Leases of running jobs, and receipts of deleted ones."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0002", "0001"


def upgrade() -> None:
    """Create both tables."""
    op.create_table(
        "lease",
        sql.Column("job", sql.Text, primary_key=True),
        sql.Column("number", sql.Integer, nullable=False),
        sql.Column("holder", sql.Text, nullable=False),
        sql.Column("until_s", sql.Float, nullable=False),
    )
    op.create_table(
        "deletion",
        sql.Column("job", sql.Text, primary_key=True),
        sql.Column("deleted_s", sql.Float, nullable=False),
        sql.Column("submitted_s", sql.Float, nullable=False),
        sql.Column("files", sql.Integer, nullable=False),
        sql.Column("bytes", sql.BigInteger, nullable=False),
        sql.Column("digest", sql.Text, nullable=False),
    )
