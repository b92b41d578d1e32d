"""The scene of a grasp, and its verdicts besides the lift."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # With a default: an older graspd goes on writing grasps, all of them free.
    op.add_column("grasps", sa.Column("scene_kind", sa.String(8), nullable=False, server_default="free"))
    for name in ("lift_hard", "pushes_held"):
        op.add_column("grasps", sa.Column(name, sa.Boolean(), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("grasps") as grasps:
        for name in ("scene_kind", "lift_hard", "pushes_held"):
            grasps.drop_column(name)
