"""Indexes of the keeper's feed: the waiting tasks of one job, and the tasks believed to be in the queue."""

from __future__ import annotations

from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_index("tasks_to_queue", table_name="tasks")
    op.create_index("tasks_waiting", "tasks", ["job_id", "ready", "queued", "batch"], unique=False)
    op.create_index("tasks_in_queue", "tasks", ["queued", "ready"], unique=False)


def downgrade() -> None:
    op.drop_index("tasks_in_queue", table_name="tasks")
    op.drop_index("tasks_waiting", table_name="tasks")
    op.create_index("tasks_to_queue", "tasks", ["ready", "queued", "lane", "batch", "created", "job_id"], unique=False)
