"""Indices by which the progress of a job is found without reading all its events."""

from alembic import op

revision, down_revision = "0007", "0006"


def upgrade() -> None:
    """Create both indices."""
    op.create_index("event_of_stage", "event", ["job", "stage", "id"])
    op.create_index("event_of_kind", "event", ["job", "kind", "id"])
