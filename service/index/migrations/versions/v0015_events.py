"""Ends of jobs and datasets in their order, webhooks, and what was delivered to them."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "ends",
        sa.Column("seq", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("kind", sa.String(8), nullable=False),
        sa.Column("subject", sa.String(64), nullable=False),
        sa.Column("state", sa.String(10), nullable=False),
        sa.Column("at", sa.String(32), nullable=False),
        sa.Column("project", sa.String(32), nullable=False, server_default=""),
        sa.Column("owner", sa.String(64), nullable=False, server_default=""),
    )
    op.create_index("ends_of_project", "ends", ["project", "seq"])
    op.create_table(
        "webhooks",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("url", sa.Text(), nullable=False),
        sa.Column("states", sa.JSON(), nullable=False),
        sa.Column("created", sa.String(32), nullable=False),
        sa.Column("owner", sa.String(64), nullable=False, server_default=""),
        sa.Column("project", sa.String(32), nullable=False, server_default=""),
        sa.Column("seen", sa.BigInteger(), nullable=False, server_default="0"),
    )
    op.create_table(
        "deliveries",
        sa.Column("webhook", sa.String(32), primary_key=True),
        sa.Column("seq", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("state", sa.String(10), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("due", sa.Float(), nullable=False),
        sa.Column("tried", sa.String(32)),
        sa.Column("status", sa.Integer()),
        sa.Column("detail", sa.String(300), nullable=False, server_default=""),
    )
    op.create_index("deliveries_due", "deliveries", ["state", "due"])
    # What was there before is told to nobody.
    op.add_column("datasets", sa.Column("told", sa.Integer(), nullable=False, server_default="-1"))
    op.execute("UPDATE datasets SET told = events")


def downgrade() -> None:
    with op.batch_alter_table("datasets") as changed:
        changed.drop_column("told")
    for table in ("deliveries", "webhooks", "ends"):
        op.drop_table(table)
