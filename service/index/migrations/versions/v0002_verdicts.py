"""What the referee said: grasps tried and audited of a shard; level and robustness of a grasp's verdict.

Jobs of before asked for no verdict, and were planned for the first revision of each stage.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_COUNTS = ("tried", "audited", "audit_held")
_FIRST = '{"synthesize": 1, "scene": 1, "render": 1}'
_JOBS = sa.table("jobs", sa.column("id", sa.String), sa.column("request", sa.JSON))


def upgrade() -> None:
    for name in _COUNTS:
        op.add_column("shards", sa.Column(name, sa.Integer(), nullable=False, server_default="0"))
    # Until now every grasp that was tried was kept.
    op.execute("UPDATE shards SET tried = count WHERE kind = 'base'")
    op.add_column("grasps", sa.Column("verdict_level", sa.String(length=12), nullable=True))
    op.add_column("grasps", sa.Column("robustness", sa.Float(), nullable=True))
    op.add_column("jobs", sa.Column("revisions", sa.JSON(), nullable=False, server_default=_FIRST))
    for job, request in op.get_bind().execute(sa.select(_JOBS.c.id, _JOBS.c.request)).all():
        meant = {"want": "raw", "referee": "none", **request}
        op.execute(_JOBS.update().where(_JOBS.c.id == job).values(request=meant))


def downgrade() -> None:
    # What the new fields of a request say is lost: an older graspd refuses fields it does not know.
    new = ("want", "budget", "referee", "audits", "robustness")
    for job, request in op.get_bind().execute(sa.select(_JOBS.c.id, _JOBS.c.request)).all():
        known = {name: value for name, value in request.items() if name not in new}
        op.execute(_JOBS.update().where(_JOBS.c.id == job).values(request=known))
    op.drop_column("jobs", "revisions")
    op.drop_column("grasps", "robustness")
    op.drop_column("grasps", "verdict_level")
    for name in reversed(_COUNTS):
        op.drop_column("shards", name)
