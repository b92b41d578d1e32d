"""The project of jobs, datasets, sets of objects, hands and objects, and what each used. What was there before belongs
to the one without a name."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

_TABLES = ("jobs", "datasets", "object_sets", "assets")
_CHARGED = ["created", "charged", "kind", "device", "count", "valid", "seconds", "size_bytes"]


def upgrade() -> None:
    # With defaults: an older graspd goes on writing rows, and knows no project.
    for table in _TABLES:
        op.add_column(table, sa.Column("project", sa.String(32), nullable=False, server_default=""))
    op.add_column("assets", sa.Column("shared", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.create_index("jobs_of_project", "jobs", ["project", "created", "id"])
    op.add_column("shards", sa.Column("charged", sa.String(32), nullable=False, server_default=""))
    op.create_index("shards_charged", "shards", _CHARGED)
    op.create_table(
        "spent",
        sa.Column("project", sa.String(32), primary_key=True),
        sa.Column("day", sa.String(10), primary_key=True),
        sa.Column("device", sa.String(64), primary_key=True),
        sa.Column("grasps", sa.BigInteger(), nullable=False),
        sa.Column("valid", sa.BigInteger(), nullable=False),
        sa.Column("tasks", sa.BigInteger(), nullable=False),
        sa.Column("seconds", sa.Float(), nullable=False),
    )


def downgrade() -> None:
    op.drop_table("spent")
    op.drop_index("shards_charged", "shards")
    op.drop_index("jobs_of_project", "jobs")
    with op.batch_alter_table("shards") as changed:
        changed.drop_column("charged")
    with op.batch_alter_table("assets") as changed:
        changed.drop_column("shared")
    for table in _TABLES:
        with op.batch_alter_table(table) as changed:
            changed.drop_column("project")
