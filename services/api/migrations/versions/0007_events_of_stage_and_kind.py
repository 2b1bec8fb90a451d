"""Where a job is among its events, without reading all of them."""

from alembic import op

revision, down_revision = "0007", "0006"


def upgrade() -> None:
    """Create both indices."""
    op.create_index("event_of_stage", "event", ["job", "stage", "id"])
    op.create_index("event_of_kind", "event", ["job", "kind", "id"])
