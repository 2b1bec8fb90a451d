"""Receipts of deleted jobs name the exports that left. Earlier receipts name none."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0012", "0011"


def upgrade() -> None:
    """Add the column."""
    op.add_column("deletion", sql.Column("exports", sql.Text))
