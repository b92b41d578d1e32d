"""Whether the index was made whole, and what is known to be damaged in the store."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    notes = op.create_table(
        "notes", sa.Column("name", sa.String(64), primary_key=True), sa.Column("value", sa.JSON(), nullable=False)
    )
    op.create_table(
        "damage",
        sa.Column("key", sa.String(512), primary_key=True),
        sa.Column("what", sa.Text(), nullable=False),
        sa.Column("shard", sa.String(64), nullable=False),
        sa.Column("found", sa.String(32), nullable=False),
    )
    # An index with jobs was in use before there were notes: it was taken for whole, and is still.
    if op.get_bind().scalar(sa.text("SELECT 1 FROM jobs LIMIT 1")):
        value = {"at": "", "left_out": 0, "names": []}
        op.bulk_insert(notes, [{"name": "rebuilt", "value": value}])


def downgrade() -> None:
    op.drop_table("damage")
    op.drop_table("notes")
