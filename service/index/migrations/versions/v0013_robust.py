"""Along which axis a grasp fails first in models around the nominal one; its share is a metric."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("grasps", sa.Column("robust_weakest", sa.String(16), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("grasps") as changed:
        changed.drop_column("robust_weakest")
