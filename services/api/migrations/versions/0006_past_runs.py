"""Past runs of jobs that succeeded, from which the time of others is predicted."""

import sqlalchemy as sql
from alembic import op

revision, down_revision = "0006", "0005"


def upgrade() -> None:
    """Create the table. It begins empty, because jobs of earlier versions did not record on which machines they ran."""
    op.create_table(
        "past_run",
        sql.Column("job", sql.Text, primary_key=True),
        sql.Column("ended_s", sql.Float, nullable=False),
        sql.Column("method", sql.Text, nullable=False),
        sql.Column("machine", sql.Text, nullable=False),
        sql.Column("size", sql.Text, nullable=False),
        sql.Column("course", sql.Text, nullable=False),
    )
    op.create_index("past_run_alike", "past_run", ["method", "machine", "ended_s"])
