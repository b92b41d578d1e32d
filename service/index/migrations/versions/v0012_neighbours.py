"""The neighbours in the scenes of jobs and datasets, and how many a grasp was planned among."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # With defaults: an older graspd goes on writing jobs, none of which has neighbours.
    for table in ("jobs", "datasets"):
        op.add_column(table, sa.Column("neighbours", sa.String(300), nullable=False, server_default=""))
    op.add_column("grasps", sa.Column("neighbours", sa.Integer(), nullable=False, server_default="0"))
    op.create_index("jobs_beside", "jobs", ["neighbours"])


def downgrade() -> None:
    op.drop_index("jobs_beside", "jobs")
    for table in ("jobs", "datasets", "grasps"):
        with op.batch_alter_table(table) as changed:
            changed.drop_column("neighbours")
