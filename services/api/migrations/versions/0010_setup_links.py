"""Links that make the first administrator's token."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0010", "0009"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "setup_link",
        sql.Column("sha256", sql.Text, primary_key=True),
        sql.Column("expires_s", sql.Float, nullable=False),
    )
