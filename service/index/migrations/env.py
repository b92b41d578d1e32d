"""Alembic's entry point: runs the migrations on the connection that `service.index.database` hands over."""

from __future__ import annotations

from alembic import context

from service.index.tables import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    render_as_batch=True,
    transaction_per_migration=False,
)
context.run_migrations()
