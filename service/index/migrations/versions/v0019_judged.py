"""How many tries of a shard somebody judged: what the share of valid grasps is of."""

from __future__ import annotations

from collections.abc import Callable

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

_INDEXES = {
    "shards_sums": ["kind", "hand", "object", "count", "valid", "tried", "size_bytes"],
    "shards_of_task": ["id", "count", "valid", "tried", "audited", "audit_held"],
}


def upgrade() -> None:
    op.add_column("shards", sa.Column("judged", sa.Integer(), nullable=False, server_default="0"))
    shards = sa.table(
        "shards",
        *map(sa.column, ("id", "kind", "count", "tried", "judged")),
        sa.column("manifest", sa.JSON),
    )
    grasps = sa.table("grasps", sa.column("shard_id"), sa.column("success"))
    verdict = sa.exists().where(grasps.c.shard_id == shards.c.id, grasps.c.success.is_not(None))
    referee = sa.func.coalesce(shards.c.manifest["request"]["referee"].as_string(), "certificate")
    judged = verdict | sa.and_(shards.c["count"] == 0, referee != "none")
    op.execute(sa.update(shards).where(shards.c.kind == "base", judged).values(judged=shards.c.tried))
    _index(lambda columns: [*columns, "judged"])


def downgrade() -> None:
    _index(lambda columns: columns)
    with op.batch_alter_table("shards") as changed:
        changed.drop_column("judged")


def _index(columns_of: Callable[[list[str]], list[str]]) -> None:
    for name, columns in _INDEXES.items():
        op.drop_index(name, table_name="shards")
        op.create_index(name, "shards", columns_of(columns), unique=False)
