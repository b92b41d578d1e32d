"""The first tables."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "assets",
        sa.Column("kind", sa.String(length=8), nullable=False),
        sa.Column("digest", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("filename", sa.Text(), nullable=False),
        sa.Column("files", sa.JSON(), nullable=False),
        sa.Column("size_bytes", sa.Integer(), nullable=False),
        sa.Column("created", sa.String(length=32), nullable=False),
        sa.Column("builtin", sa.Boolean(), nullable=False),
        sa.Column("verdict", sa.String(length=8), nullable=True),
        sa.Column("message", sa.Text(), nullable=True),
        sa.Column("repairs", sa.JSON(), nullable=False),
        sa.Column("facts", sa.JSON(), nullable=False),
        sa.Column("last_attempt", sa.Integer(), nullable=False),
        sa.Column("queued", sa.Boolean(), nullable=False),
        sa.Column("not_before", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("kind", "digest"),
    )
    op.create_index("assets_by_name", "assets", ["kind", "name", "created"], unique=False)
    op.create_table(
        "attempts",
        sa.Column("task_id", sa.String(length=32), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("stage", sa.String(length=12), nullable=False),
        sa.Column("kind", sa.String(length=64), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("trace", sa.Text(), nullable=True),
        sa.Column("worker", sa.String(length=128), nullable=False),
        sa.Column("started", sa.String(length=32), nullable=True),
        sa.Column("ended", sa.String(length=32), nullable=False),
        sa.Column("last", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("task_id", "number"),
    )
    op.create_index("attempts_by_kind", "attempts", ["stage", "kind"], unique=False)
    op.create_index("attempts_of_job", "attempts", ["job_id", "ended"], unique=False)
    op.create_table(
        "grasps",
        sa.Column("shard_id", sa.String(length=32), nullable=False),
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("hand", sa.String(length=64), nullable=False),
        sa.Column("object", sa.String(length=64), nullable=False),
        sa.Column("epsilon", sa.Float(), nullable=True),
        sa.Column("wrench_volume", sa.Float(), nullable=True),
        sa.Column("contact_area_cm2", sa.Float(), nullable=True),
        sa.Column("intersection_volume_cm3", sa.Float(), nullable=True),
        sa.Column("penetration_depth_mm", sa.Float(), nullable=True),
        sa.Column("self_penetration_depth_mm", sa.Float(), nullable=True),
        sa.Column("stability_loss", sa.Float(), nullable=True),
        sa.Column("contact_links", sa.Integer(), nullable=True),
        sa.Column("valid", sa.Boolean(), nullable=False),
        sa.Column("success", sa.Boolean(), nullable=True),
        sa.Column("created", sa.String(length=32), nullable=False),
        sa.PrimaryKeyConstraint("shard_id", "row"),
        sqlite_with_rowid=False,
    )
    op.create_index("grasps_by_hand", "grasps", ["hand", "epsilon", "shard_id", "row"], unique=False)
    op.create_index("grasps_by_object", "grasps", ["object", "epsilon", "shard_id", "row"], unique=False)
    op.create_index("grasps_by_pair", "grasps", ["hand", "object", "epsilon", "shard_id", "row"], unique=False)
    op.create_index("grasps_contact_area_cm2", "grasps", ["contact_area_cm2", "shard_id", "row"], unique=False)
    op.create_index("grasps_created", "grasps", ["created", "shard_id", "row"], unique=False)
    op.create_index("grasps_epsilon", "grasps", ["epsilon", "shard_id", "row"], unique=False)
    op.create_index(
        "grasps_intersection_volume_cm3", "grasps", ["intersection_volume_cm3", "shard_id", "row"], unique=False
    )
    op.create_index("grasps_penetration_depth_mm", "grasps", ["penetration_depth_mm", "shard_id", "row"], unique=False)
    op.create_index(
        "grasps_self_penetration_depth_mm", "grasps", ["self_penetration_depth_mm", "shard_id", "row"], unique=False
    )
    op.create_index("grasps_stability_loss", "grasps", ["stability_loss", "shard_id", "row"], unique=False)
    op.create_index("grasps_wrench_volume", "grasps", ["wrench_volume", "shard_id", "row"], unique=False)
    op.create_table(
        "jobs",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("lane", sa.String(length=12), nullable=False),
        sa.Column("hand", sa.String(length=64), nullable=False),
        sa.Column("object", sa.String(length=64), nullable=False),
        sa.Column("hand_digest", sa.String(length=32), nullable=False),
        sa.Column("object_digest", sa.String(length=32), nullable=False),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("cancelled", sa.Boolean(), nullable=False),
        sa.Column("created", sa.String(length=32), nullable=False),
        sa.Column("finished", sa.String(length=32), nullable=True),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("jobs_by_pair", "jobs", ["hand", "object"], unique=False)
    op.create_index("jobs_by_state", "jobs", ["state", "created", "id"], unique=False)
    op.create_index("jobs_newest", "jobs", ["created", "id"], unique=False)
    op.create_table(
        "shards",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=8), nullable=False),
        sa.Column("stage", sa.String(length=12), nullable=False),
        sa.Column("key", sa.String(length=128), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("size_bytes", sa.Integer(), nullable=False),
        sa.Column("count", sa.Integer(), nullable=False),
        sa.Column("valid", sa.Integer(), nullable=False),
        sa.Column("hand", sa.String(length=64), nullable=False),
        sa.Column("object", sa.String(length=64), nullable=False),
        sa.Column("hand_digest", sa.String(length=32), nullable=False),
        sa.Column("object_digest", sa.String(length=32), nullable=False),
        sa.Column("batch", sa.Integer(), nullable=False),
        sa.Column("seed", sa.Integer(), nullable=False),
        sa.Column("inputs", sa.JSON(), nullable=False),
        sa.Column("device", sa.String(length=64), nullable=False),
        sa.Column("worker", sa.String(length=128), nullable=False),
        sa.Column("seconds", sa.Float(), nullable=False),
        sa.Column("created", sa.String(length=32), nullable=False),
        sa.Column("manifest", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("shards_by_kind", "shards", ["kind", "created", "id"], unique=False)
    op.create_index("shards_by_pair", "shards", ["hand", "object", "kind"], unique=False)
    op.create_index("shards_newest", "shards", ["created", "id"], unique=False)
    op.create_table(
        "tasks",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("stage", sa.String(length=12), nullable=False),
        sa.Column("batch", sa.Integer(), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("count", sa.Integer(), nullable=False),
        sa.Column("lane", sa.String(length=12), nullable=False),
        sa.Column("inputs", sa.JSON(), nullable=False),
        sa.Column("shard_id", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("ready", sa.Boolean(), nullable=False),
        sa.Column("done", sa.Boolean(), nullable=False),
        sa.Column("last_attempt", sa.Integer(), nullable=False),
        sa.Column("exhausted", sa.Boolean(), nullable=False),
        sa.Column("retried_upto", sa.Integer(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("worker", sa.String(length=128), nullable=True),
        sa.Column("device", sa.String(length=64), nullable=True),
        sa.Column("seconds", sa.Float(), nullable=True),
        sa.Column("finished", sa.String(length=32), nullable=True),
        sa.Column("created", sa.String(length=32), nullable=False),
        sa.Column("queued", sa.Boolean(), nullable=False),
        sa.Column("not_before", sa.Float(), nullable=False),
        sa.Column("progress_done", sa.Float(), nullable=False),
        sa.Column("progress_total", sa.Float(), nullable=False),
        sa.Column("progress_message", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("tasks_by_shard", "tasks", ["shard_id"], unique=False)
    op.create_index("tasks_by_state", "tasks", ["job_id", "state"], unique=False)
    op.create_index("tasks_finished", "tasks", ["finished"], unique=False)
    op.create_index("tasks_of_job", "tasks", ["job_id", "batch", "position"], unique=False)
    op.create_index("tasks_to_queue", "tasks", ["ready", "queued", "lane", "batch", "created", "job_id"], unique=False)
    op.create_table(
        "workers",
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("host", sa.String(length=128), nullable=False),
        sa.Column("pid", sa.Integer(), nullable=False),
        sa.Column("device", sa.String(length=64), nullable=False),
        sa.Column("device_name", sa.String(length=128), nullable=False),
        sa.Column("stages", sa.JSON(), nullable=False),
        sa.Column("version", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("task_id", sa.String(length=32), nullable=True),
        sa.Column("started", sa.String(length=32), nullable=False),
        sa.Column("seen", sa.String(length=32), nullable=False),
        sa.PrimaryKeyConstraint("name"),
    )


def downgrade() -> None:
    op.drop_table("workers")
    op.drop_index("tasks_to_queue", table_name="tasks")
    op.drop_index("tasks_of_job", table_name="tasks")
    op.drop_index("tasks_finished", table_name="tasks")
    op.drop_index("tasks_by_state", table_name="tasks")
    op.drop_index("tasks_by_shard", table_name="tasks")
    op.drop_table("tasks")
    op.drop_index("shards_newest", table_name="shards")
    op.drop_index("shards_by_pair", table_name="shards")
    op.drop_index("shards_by_kind", table_name="shards")
    op.drop_table("shards")
    op.drop_index("jobs_newest", table_name="jobs")
    op.drop_index("jobs_by_state", table_name="jobs")
    op.drop_index("jobs_by_pair", table_name="jobs")
    op.drop_table("jobs")
    op.drop_index("grasps_wrench_volume", table_name="grasps")
    op.drop_index("grasps_stability_loss", table_name="grasps")
    op.drop_index("grasps_self_penetration_depth_mm", table_name="grasps")
    op.drop_index("grasps_penetration_depth_mm", table_name="grasps")
    op.drop_index("grasps_intersection_volume_cm3", table_name="grasps")
    op.drop_index("grasps_epsilon", table_name="grasps")
    op.drop_index("grasps_created", table_name="grasps")
    op.drop_index("grasps_contact_area_cm2", table_name="grasps")
    op.drop_index("grasps_by_pair", table_name="grasps")
    op.drop_index("grasps_by_object", table_name="grasps")
    op.drop_index("grasps_by_hand", table_name="grasps")
    op.drop_table("grasps")
    op.drop_index("attempts_of_job", table_name="attempts")
    op.drop_index("attempts_by_kind", table_name="attempts")
    op.drop_table("attempts")
    op.drop_index("assets_by_name", table_name="assets")
    op.drop_table("assets")
