"""How a chart chose the fidelity of a job, or of a dataset's cell."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("jobs", "dataset_cells"):
        op.add_column(table, sa.Column("choice", sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    for table in ("jobs", "dataset_cells"):
        with op.batch_alter_table(table) as columns:
            columns.drop_column("choice")
