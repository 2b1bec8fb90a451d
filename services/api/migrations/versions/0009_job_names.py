"""Labels that people give to jobs."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0009", "0008"


def upgrade() -> None:
    """Add the column; jobs of earlier versions have none."""
    op.add_column("job", sql.Column("name", sql.Text))
