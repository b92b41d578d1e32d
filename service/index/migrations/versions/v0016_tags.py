"""Tags that users give to grasps."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "tags",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("created", sa.String(32), nullable=False),
        sa.Column("changed", sa.String(32), nullable=False),
        sa.Column("owner", sa.String(64), nullable=False, server_default=""),
        sa.Column("project", sa.String(32), nullable=False, server_default=""),
    )
    op.create_index("tags_by_name", "tags", ["name", "project"])
    op.create_table(
        "tagged",
        sa.Column("tag", sa.String(32), primary_key=True),
        sa.Column("shard_id", sa.String(32), primary_key=True),
        sa.Column("row", sa.Integer(), primary_key=True),
    )
    op.create_index("tagged_grasps", "tagged", ["shard_id", "row"])


def downgrade() -> None:
    for table in ("tagged", "tags"):
        op.drop_table(table)
