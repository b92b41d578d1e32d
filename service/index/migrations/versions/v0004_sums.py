"""Indexes that hold what sums over shards need, so that no sum reads the manifests; shards larger than 2 GB."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_NEW = {
    "shards_sums": ["kind", "hand", "object", "count", "valid", "tried", "size_bytes"],
    "shards_of_task": ["id", "count", "valid", "tried", "audited", "audit_held"],
    "shards_made": ["created", "kind", "count", "valid", "seconds"],
}


def upgrade() -> None:
    with op.batch_alter_table("shards") as shards:
        shards.alter_column("size_bytes", existing_type=sa.Integer(), type_=sa.BigInteger(), existing_nullable=False)
    op.drop_index("shards_by_pair", table_name="shards")
    for name, columns in _NEW.items():
        op.create_index(name, "shards", columns, unique=False)


def downgrade() -> None:
    for name in _NEW:
        op.drop_index(name, table_name="shards")
    op.create_index("shards_by_pair", "shards", ["hand", "object", "kind"], unique=False)
    with op.batch_alter_table("shards") as shards:
        shards.alter_column("size_bytes", existing_type=sa.BigInteger(), type_=sa.Integer(), existing_nullable=False)
