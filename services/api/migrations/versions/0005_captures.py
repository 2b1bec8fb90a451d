"""Uploaded captures and their files."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0005", "0004"


def upgrade() -> None:
    """Create both tables."""
    op.create_table(
        "capture",
        sql.Column("number", sql.Integer, primary_key=True),
        sql.Column("id", sql.Text, nullable=False, unique=True),
        sql.Column("key", sql.Text, unique=True),
        sql.Column("manifest", sql.Text, unique=True),
        sql.Column("state", sql.Text, nullable=False, index=True),
        sql.Column("subject", sql.Text),
        sql.Column("created_s", sql.Float, nullable=False),
        sql.Column("expires_s", sql.Float, nullable=False),
        sql.Column("file_count", sql.Integer, nullable=False),
        sql.Column("bytes", sql.BigInteger, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "capture_file",
        sql.Column("capture", sql.Text, primary_key=True),
        sql.Column("number", sql.Integer, primary_key=True, autoincrement=False),
        sql.Column("path", sql.Text, nullable=False),
        sql.Column("bytes", sql.BigInteger, nullable=False),
        sql.Column("sha256", sql.Text, nullable=False, index=True),
        sql.Column("received_bytes", sql.BigInteger, nullable=False),
        sql.Column("is_created", sql.Boolean, nullable=False),
        sql.Column("is_corrupt", sql.Boolean, nullable=False),
    )
