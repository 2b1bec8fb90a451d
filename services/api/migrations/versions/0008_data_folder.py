"""The data folder that holds the files of the jobs."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0008", "0007"


def upgrade() -> None:
    """Create the table; the first server that starts writes its folder into it."""
    op.create_table("data_folder", sql.Column("id", sql.Text, primary_key=True))
