"""The network that grasps of jobs and datasets set out from."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # With a default: an older graspd goes on writing jobs, none of which has a network.
    for table in ("jobs", "datasets"):
        op.add_column(table, sa.Column("network_digest", sa.String(32), nullable=False, server_default=""))


def downgrade() -> None:
    for table in ("jobs", "datasets"):
        with op.batch_alter_table(table) as changed:
            changed.drop_column("network_digest")
