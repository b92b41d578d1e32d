"""The fidelity of a dataset's cell, where a chart chose it."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("dataset_cells", sa.Column("fidelity", sa.String(64), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("dataset_cells") as cells:
        cells.drop_column("fidelity")
