"""Why a worker is in quarantine, and room for that state's name."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with op.batch_alter_table("workers") as workers:
        workers.add_column(sa.Column("reason", sa.String(300), nullable=False, server_default=""))
        workers.alter_column("state", existing_type=sa.String(10), type_=sa.String(16), existing_nullable=False)


def downgrade() -> None:
    # The live workers are told of anew; a state that the older schema has no room for must not stand in the way.
    op.execute("DELETE FROM workers")
    with op.batch_alter_table("workers") as workers:
        workers.alter_column("state", existing_type=sa.String(16), type_=sa.String(10), existing_nullable=False)
        workers.drop_column("reason")
